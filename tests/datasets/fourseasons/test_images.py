"""4Seasons' challenges and depth maps: pairs, priors, true poses, point clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fourseasons_files import (
    CAMERA,
    DAY,
    RAIN,
    ROWS,
    SNOW,
    A,
    B,
    image,
    missing_of,
    official,
    pose_of,
    read,
    times_of,
    write,
    write_recording,
    write_two_recordings,
)
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.fourseasons.adapter import FourSeasons, FourSeasonsOptions
from megloc_kapture.datasets.official import write_official
from megloc_kapture.errors import DataError
from megloc_kapture.io import dataset_tables as tables
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import RigidTransform


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_two_recordings(tmp_path / "root")


def many_keyframes(root: Path, count: int) -> list[int]:
    times = [A + 50_000_000 * k for k in range(count)]
    write_recording(root, DAY, times, [f"{t},{k},0,0,0,0,0,1,1,2" for k, t in enumerate(times)])
    return times


@pytest.mark.parametrize(
    ("day", "snow", "name"),
    [
        (DAY, SNOW, f"relocalizationFile_{DAY}_to_{SNOW}.txt"),
        ("loop_2_train", "loop_2_test", "reloc_loop_2_train_to_loop_2_test.txt"),
        (DAY, SNOW, f"{DAY}/RelocalizationFilesTest/relocalizationFile_{SNOW}_hard.txt"),
        (DAY, SNOW, f"{DAY}/relocalizationFile_{SNOW}.txt"),
    ],
)
def test_relocalization_files(root: Path, tmp_path: Path, day: str, snow: str, name: str) -> None:
    times = many_keyframes(root, 50)
    if day != DAY:
        (root / DAY).rename(root / day)
        (root / SNOW).rename(root / snow)
    write_recording(root, "a_drive_elsewhere", (5,), (f"5,{','.join(ROWS[0].split(',')[1:])}",))
    write(root / name, f"{times[25]} {B + 5}\n{times[3]} {B + 5}\n")
    dataset = read(root)
    write_official(dataset, tmp_path / "out")
    written = tmp_path / "out/megloc"
    pose_file = Path(name).name
    assert tables.read_relocalization(written) == [
        tables.RelocalizationPair(pose_file, image(day, times[25]), image(snow, B + 5)),
        tables.RelocalizationPair(pose_file, image(day, times[3]), image(snow, B + 5)),
    ]
    # the images that are asked for, in the recordings that are meant
    assert times_of(dataset.query) == {B + 5}
    assert {n.split("/")[0] for n in dataset.mapping.image_names()} == {day}
    # 20 keyframes around each reference: 5 to 45, and 0 to 23
    near = sorted(image(day, t, c) for t in times[:46] for c in ("cam0", "cam1"))
    assert tables.read_priors(written) == {
        image(snow, B + 5, "cam0"): tuple(near),
        image(snow, B + 5, "cam1"): tuple(near),
    }
    groups = tables.read_groups(written)
    assert groups[image(snow, B + 5)].scored
    assert not groups[image(snow, B + 5, "cam1")].scored
    protocol = tables.read_protocol(written)
    assert protocol.pose_file == "mlad"
    assert protocol.thresholds == ((0.1, None), (0.2, None), (0.5, None))
    assert dataset.query_gt is None
    assert not dataset.remarks


def test_more_than_is_asked_for(root: Path) -> None:
    """All frames of a recording are queries if one wants them; scored are those asked for."""
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {B + 5}\n")
    dataset = read(root, frames="all")
    assert times_of(dataset.query) == {A + 5, B + 5}
    scored = [name for name in dataset.query.image_names() if dataset.groups[name].scored]
    assert scored == [image(SNOW, B + 5)]


def test_pairs_with_poses_in_the_frame_of_poses_txt(root: Path) -> None:
    """As in 2020: the map's poses are already in one frame, queries are known relative to it."""
    (root / DAY / "GNSSPoses.txt").unlink()
    (root / DAY / "Transformations.txt").unlink()
    write(root / DAY / "poses.txt", f"# ts t q\n{A} 100.5 7 3 0 0 0 1\n{B} 101.5 7 3 0 0 0.6 0.8\n")
    write(root / DAY / "keyframe_accuracy.txt", f"{A}\n")
    folder = root / DAY / "RelocalizationFilesVal"
    write(folder / f"relocalizationFile_{SNOW}.txt", f"{A} {B + 5} 1 2 3 0 0 0.6 0.8\n")
    dataset = read(root)
    center = official(dataset, image(DAY, A)).center()
    np.testing.assert_allclose(center, [100.5, 7, 3], atol=1e-12)
    known = official(dataset, image(SNOW, B + 5))
    turn = Rotation.from_quat([0, 0, 0.6, 0.8]).as_matrix()
    np.testing.assert_allclose(known.rotation_matrix(), turn, atol=1e-12)
    # x_query = R (x_world - (100.5, 7, 3)) + (1, 2, 3)
    at = np.array([[101.0, 8.0, 5.0]])
    np.testing.assert_allclose(known.apply(at)[0], turn @ [0.5, 1, 2] + [1, 2, 3], atol=1e-12)
    assert "poses.txt, whose frame is its own" in dataset.remarks[0]
    assert any("0.05 m" in count.what and count.found == 1 for count in dataset.summary)


def test_truth_of_a_pair_counts_before_the_recordings_own(root: Path) -> None:
    write_recording(root, RAIN, (A + 9,), (f"{A + 9},0,0,0,0,0,0,1,1,2",))
    write(root / f"reloc_{DAY}_to_{RAIN}.txt", f"{A} {A + 9} 0 0 0 0 0 0 1\n")
    dataset = read(root)
    assert pose_of(dataset, image(RAIN, A + 9)) == pose_of(dataset, image(DAY, A))


def test_pairs_that_cannot_be(root: Path) -> None:
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {A + 5}\n77 {B + 5}\n{A} 78\n")
    dataset = read(root)
    assert [pair.query for pair in dataset.relocalization] == [image(SNOW, A + 5)]
    assert "2 pairs of relocalization files are left out" in dataset.remarks[0]
    assert missing_of(dataset) == [root / image(SNOW, 78, c) for c in ("cam0", "cam1")]


def test_recordings_that_files_mean_and_are_not_there(root: Path) -> None:
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {A + 5}\n")
    write(root / f"reloc_{DAY}_to_garage.txt", f"{A} 1\n")
    assert missing_of(read(root)) == [root / "garage"]
    assert not missing_of(read(root, queries=SNOW))
    write(root / "relocalizationFile_garage.txt", f"{A} 1\n")
    with pytest.raises(DataError, match="does not say whose map it means"):
        read(root)


def test_published_numbers_of_pairs(root: Path) -> None:
    (root / DAY).rename(root / "parking_garage_2_train")
    (root / SNOW).rename(root / "parking_garage_1_test")
    name = "reloc_parking_garage_2_train_to_parking_garage_1_test.txt"
    write(root / name, f"{A} {A + 5}\n")
    count = next(count for count in read(root).summary if name in count.what)
    assert (count.found, count.published) == (1, 113)


def keyframe_text(timestamp: int, points: str, count: int, size: str = "8,4") -> str:
    return (
        f"# timestamp\n{timestamp}\n\n# fx, fy, cx, cy, width, height, npoints\n"
        f"5,5,4.25,1.75,{size},{count}\n\n# camToWorld: t, q\n0,0,0,0,0,0,1\n\n"
        "# Exposure time (ms)\n0.25\n\n# Point Cloud Data : \n# u,v\n# color information \n"
        + points
    )


def test_depth_of_keyframes(root: Path, tmp_path: Path) -> None:
    folder = root / DAY / "KeyFrameData"
    points = "".join(
        f"{u},{v},{inverse},9,0,0,1\n1,2,3,4,5,6,7,8,\n"
        for u, v, inverse in [(3, 1, 0.25), (3.5, 1.5, 0.1), (0, 0, 0), (8, 0, 1), (7, 3, 0.5)]
    )
    write(folder / f"KeyFrame_{A}.txt", keyframe_text(A, points, 5))
    write(folder / f"KeyFrame_{B}.txt", keyframe_text(B, "", 0))
    before = sorted(root.rglob("*"))
    dataset = read(root, depth=True)
    write_official(dataset, tmp_path / "out")
    assert sorted(root.rglob("*")) == before  # the links to the data are not written through
    mapping = KaptureFolder(tmp_path / "out/mapping").read()
    name = mapping.records_depth[A, "depth"]
    assert name == f"keyframe_depth/{DAY}/{A}.depth"
    assert mapping.rigs["car"]["depth"] == RigidTransform.identity()
    assert mapping.sensors["depth"].camera() == CAMERA
    records = tmp_path / "out/mapping/sensors/records_data"
    expected = np.zeros((4, 8), np.float32)
    # the row's scale is 0.5; of two points in a pixel the nearer one
    expected[1, 3], expected[3, 7] = 0.5 / 0.25, 0.5 / 0.5
    np.testing.assert_array_equal(read_depth_map(records / name, width=8, height=4), expected)
    other = read_depth_map(records / mapping.records_depth[B, "depth"], width=8, height=4)
    assert not other.any()
    files = set(FourSeasons(FourSeasonsOptions(depth=True)).input_files(root))
    assert folder / f"KeyFrame_{A}.txt" in files
    (folder / f"KeyFrame_{B}.txt").unlink()
    assert missing_of(read(root, depth=True)) == [folder / f"KeyFrame_{B}.txt"]


@pytest.mark.parametrize(("time", "size"), [(B, "8,4"), (A, "9,4")])
def test_a_keyframe_of_something_else(root: Path, tmp_path: Path, time: int, size: str) -> None:
    for timestamp in (A, B):
        file = root / DAY / f"KeyFrameData/KeyFrame_{timestamp}.txt"
        write(file, keyframe_text(time, "", 0, size))
    with pytest.raises(DataError, match=r"KeyFrame_\d+\.txt: timestamp .* are not those of its"):
        write_official(read(root, depth=True), tmp_path / "out")
