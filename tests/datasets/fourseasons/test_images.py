"""Relocalization challenges of 4Seasons: pairs, priors and true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fourseasons_files import (
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

from megloc_kapture.datasets.official import write_official
from megloc_kapture.errors import DataError
from megloc_kapture.io import dataset_tables as tables


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
        (DAY, SNOW, f"{DAY}/relocalizationFile_{SNOW}.txt"),
    ],
)
def test_relocalization_files_select_images_and_priors(
    root: Path, tmp_path: Path, day: str, snow: str, name: str
) -> None:
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
    # only images of the pairs, in the recordings of the file's name
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


def test_with_all_frames_only_those_of_the_pairs_are_scored(root: Path) -> None:
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {B + 5}\n")
    dataset = read(root, frames="all")
    assert times_of(dataset.query) == {A + 5, B + 5}
    scored = [name for name in dataset.query.image_names() if dataset.groups[name].scored]
    assert scored == [image(SNOW, B + 5)]


def test_pairs_of_2020_have_poses_relative_to_poses_txt(root: Path) -> None:
    (root / DAY / "GNSSPoses.txt").unlink()
    (root / DAY / "Transformations.txt").unlink()
    write(root / DAY / "poses.txt", f"# ts t q\n{A} 100.5 7 3 0 0 0 1\n{B} 101.5 7 3 0 0 0.6 0.8\n")
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
    assert "poses.txt, in a separate frame" in dataset.remarks[0]


def test_the_pose_of_a_pair_takes_precedence_over_that_of_the_recording(root: Path) -> None:
    write_recording(root, RAIN, (A + 9,), (f"{A + 9},0,0,0,0,0,0,1,1,2",))
    write(root / f"reloc_{DAY}_to_{RAIN}.txt", f"{A} {A + 9} 0 0 0 0 0 0 1\n")
    dataset = read(root)
    assert pose_of(dataset, image(RAIN, A + 9)) == pose_of(dataset, image(DAY, A))


def test_pairs_of_unknown_images_are_skipped(root: Path) -> None:
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {A + 5}\n77 {B + 5}\n{A} 78\n")
    dataset = read(root)
    assert [pair.query for pair in dataset.relocalization] == [image(SNOW, A + 5)]
    assert "2 pairs of relocalization files are left out" in dataset.remarks[0]
    assert missing_of(dataset) == [root / image(SNOW, 78, c) for c in ("cam0", "cam1")]


def test_recordings_named_by_a_file_may_be_missing(root: Path) -> None:
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {A + 5}\n")
    write(root / f"reloc_{DAY}_to_garage.txt", f"{A} 1\n")
    assert missing_of(read(root)) == [root / "garage"]
    assert not missing_of(read(root, queries=SNOW))
    write(root / "relocalizationFile_garage.txt", f"{A} 1\n")
    with pytest.raises(DataError, match="does not say whose map it means"):
        read(root)
