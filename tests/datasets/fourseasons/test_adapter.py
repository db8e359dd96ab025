"""4Seasons' adapter: frames, selection, challenges, partial downloads, the published sample."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.formats.fourseasons_files import read_keyframe
from megloc_kapture.datasets.fourseasons.adapter import FourSeasons, FourSeasonsOptions
from megloc_kapture.datasets.fourseasons.images import LocalFrame, read_keyframe_poses
from megloc_kapture.datasets.fourseasons.recordings import Recording
from megloc_kapture.datasets.official import Missing, OfficialDataset, write_official
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.dataset_tables import (
    RelocalizationPair,
    read_groups,
    read_priors,
    read_protocol,
    read_relocalization,
    read_world,
)
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.values import Camera, RigidTransform

# at odd nanoseconds: a float of 64 bits would move them
A, B = 1600000000000000001, 1600000000033333339
DAY, SNOW, RAIN = (f"recording_{date}_10-00-00" for date in ("2020-05-01", "2021-01-02", "2021-03"))
CAMERA = Camera("PINHOLE", 8, 4, (5.0, 5.0, 4.25, 1.75))
# 90 degrees about z; a shift; 90 degrees about x
TRANSFORMATIONS = """# transform_S_AS: translation vector, rotation quaternion
0,0,0,0,0,0.7071067811865476,0.7071067811865476
# transform_w_gpsw: translation vector, rotation quaternion
10,20,30,0,0,0,1
# transform_e_gpsw: translation vector, rotation quaternion
4000000,800000,4700000,0.7071067811865476,0,0,0.7071067811865476
# GNSS scale
0.125
"""
ROWS = (f"{A},2,0,0,0,0,0,1,0.5,2", f"{B},2,4,0,0,0,0,1,0.25,2,0.5")


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def write_calibration(folder: Path, baseline: float = -0.3) -> None:
    pinhole = "Pinhole 5.0 5.0 4.25 1.75 0.0 0.0 0.0 0.0\n8 4\ncrop\n8 4\n"
    write(folder / "undistorted_calib_0.txt", pinhole)
    write(folder / "undistorted_calib_1.txt", pinhole)
    write(
        folder / "undistorted_calib_stereo.txt",
        f"1.0 0.0 0.0 {baseline}\n0.0 1.0 0.0 0.0\n0.0 0.0 1.0 0.0\n0.0 0.0 0.0 1.0\n",
    )


def write_recording(
    root: Path, name: str, times: Sequence[int], rows: Sequence[str] | None = ROWS
) -> Path:
    """A recording with placeholders for images at ``times``."""
    folder = root / name
    for timestamp in times:
        for camera in ("cam0", "cam1"):
            write(folder / f"undistorted_images/{camera}/{timestamp}.png", "x")
    write(folder / "times.txt", "".join(f"{t} {t / 1e9:.10f} 0.25\n" for t in (*times, 17)))
    if rows is not None:
        write(folder / "GNSSPoses.txt", "# header\n" + "\n".join(rows) + "\n")
        write(folder / "Transformations.txt", TRANSFORMATIONS)
    return folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two recordings: one with poses, the images of two frames kept, and one without."""
    root = tmp_path / "root"
    write_calibration(root / "calibration")
    write_recording(root, DAY, (A, B))
    write_recording(root, SNOW, (A + 5, B + 5), rows=None)
    return root


def read(root: Path, **options: Any) -> OfficialDataset:
    adapter = FourSeasons(FourSeasonsOptions(**options))
    adapter.check(root)
    return adapter.read(root)


def image(recording: str, timestamp: int, camera: str = "cam0") -> str:
    return f"{recording}/undistorted_images/{camera}/{timestamp}.png"


def times_of(data: KaptureData) -> set[int]:
    return {timestamp for timestamp, _ in data.records_camera}


# -------------------------------------------------------------------------------- the frames


def test_the_worked_example(root: Path) -> None:
    """Each row's own scale; then S_AS, the inverse of w_gpsw, and e_gpsw; by hand."""
    dataset = read(root)
    turn = Rotation.from_euler("x", 90, degrees=True) * Rotation.from_euler("z", 90, degrees=True)
    for timestamp, center in (
        # (2, 0, 0) * 0.5 -> (0, 1, 0) -> (-10, -19, -30) -> (-10, 30, -19)
        (A, (3999990.0, 800030.0, 4699981.0)),
        # (2, 4, 0) * 0.25 -> (-1, 0.5, 0) -> (-11, -19.5, -30) -> (-11, 30, -19.5)
        (B, (3999989.0, 800030.0, 4699980.5)),
    ):
        local = dataset.mapping.cam_from_world(image(DAY, timestamp))
        assert local is not None
        assert np.linalg.norm(local.center()) < 2  # recentred
        official = dataset.world.pose_in_official(local)
        np.testing.assert_allclose(official.center(), center, atol=1e-8)
        np.testing.assert_allclose(official.rotation_matrix().T, turn.as_matrix(), atol=1e-12)


def test_the_local_frame_is_level(root: Path) -> None:
    """It is the scene's frame, east, north and up, moved by whole metres."""
    dataset = read(root)
    first, second = (dataset.mapping.cam_from_world(image(DAY, t)) for t in (A, B))
    assert first is not None and second is not None
    np.testing.assert_allclose(second.center() - first.center(), [-1, -0.5, 0], atol=1e-9)
    np.testing.assert_allclose(first.center() - np.round(first.center()), 0, atol=1e-9)


def test_stereo_sign(root: Path) -> None:
    """A point 0.3 m right of the left camera's axis lies on the right camera's axis."""
    dataset = read(root)
    left, right = (dataset.mapping.cam_from_world(image(DAY, A, c)) for c in ("cam0", "cam1"))
    assert left is not None and right is not None
    point = right.apply(left.inverse().apply(np.array([[0.3, 0.0, 5.0]])))
    np.testing.assert_allclose(point, [[0.0, 0.0, 5.0]], atol=1e-9)
    camera = dataset.mapping.camera_of(image(DAY, A, "cam1"))
    colmap = pycolmap.Camera(model=camera.model, width=8, height=4, params=list(camera.params))
    np.testing.assert_allclose(colmap.img_from_cam(point), [[4.25, 1.75]], atol=1e-9)


def test_other_recordings_have_scenes_of_their_own(root: Path) -> None:
    """The same ECEF position through another scene and another SLAM world."""
    folder = write_recording(root, RAIN, (A + 9,))
    write(folder / "GNSSPoses.txt", f"{A + 9} 3 0 0 0 0 0 1 2.0 2\n")
    write(
        folder / "Transformations.txt",
        "# transform_S_AS: t, q\n0,0,0,0,0,0,1\n\n"
        "# transform_w_gpsw: t, q\n1,1,1,0,0,0,1\n\n"
        "# transform_e_gpsw: t, q\n3999985,800031,4699982,0,0,0,1\n",
    )
    dataset = read(root, queries=RAIN)
    assert dataset.query_gt is not None
    pose = dataset.query_gt.cam_from_world(image(RAIN, A + 9))
    assert pose is not None
    # (3, 0, 0) * 2 -> (5, -1, -1) -> where the first keyframe of the map is
    same = dataset.mapping.cam_from_world(image(DAY, A))
    assert same is not None
    np.testing.assert_allclose(pose.center(), same.center(), atol=1e-8)
    right = dataset.query_gt.cam_from_world(image(RAIN, A + 9, "cam1"))
    assert right is not None
    np.testing.assert_allclose((right @ pose.inverse()).translation, (-0.3, 0, 0), atol=1e-12)


# --------------------------------------------------------------------------- what is imported


def test_kapture_reads_what_is_written(root: Path, tmp_path: Path) -> None:
    from kapture.io.csv import kapture_from_dir

    before = sorted(root.rglob("*"))
    write_official(read(root), tmp_path / "out")
    theirs = kapture_from_dir(str(tmp_path / "out/mapping"))
    assert set(theirs.sensors) == {"cam0", "cam1"}
    assert theirs.sensors["cam1"].sensor_params == ["PINHOLE", "8", "4", "5", "5", "4.25", "1.75"]
    assert set(theirs.rigs["car"]) == {"cam0", "cam1"}
    np.testing.assert_allclose(theirs.rigs["car", "cam1"].t_raw, [-0.3, 0, 0])
    assert set(theirs.trajectories) == {A, B}
    assert set(theirs.trajectories[A]) == {"car"}
    assert theirs.records_camera[A, "cam1"] == image(DAY, A, "cam1")
    queries = kapture_from_dir(str(tmp_path / "out/query"))
    assert queries.trajectories is None
    assert set(queries.records_camera) == {A + 5, B + 5}
    for part in ("mapping", "query"):
        folder = KaptureFolder(tmp_path / "out" / part)
        assert all(folder.image_path(name).is_file() for name in folder.read().image_names())
    assert sorted(root.rglob("*")) == before
    # nothing says where the queries are
    assert not (tmp_path / "out/query_gt").exists()
    groups = read_groups(tmp_path / "out/megloc")
    assert groups[image(SNOW, A + 5)].condition == SNOW
    assert groups[image(SNOW, A + 5)].scored
    assert not groups[image(SNOW, A + 5, "cam1")].scored
    assert groups[image(DAY, A)].location == DAY
    protocol = read_protocol(tmp_path / "out/megloc")
    assert protocol.dataset == "4seasons"
    assert protocol.thresholds == ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
    assert (protocol.pose_file, protocol.conditions) == ("ltvl", (SNOW,))
    quaternion = read_world(tmp_path / "out/megloc").official_from_local.quat_wxyz
    np.testing.assert_allclose(quaternion, [np.sqrt(0.5), np.sqrt(0.5), 0, 0])


def test_left_images_alone(root: Path) -> None:
    dataset = read(root, stereo=False)
    assert dataset.mapping.image_names() == [image(DAY, A), image(DAY, B)]
    assert dataset.mapping.rigs == {"car": {"cam0": RigidTransform.identity()}}
    assert len(dataset.mapping.poses()) == 2
    assert dataset.query.image_names() == [image(SNOW, A + 5), image(SNOW, B + 5)]


def test_keyframes_or_all_frames(root: Path) -> None:
    for camera in ("cam0", "cam1"):
        write(root / image(DAY, B + 100, camera), "x")
    write(root / DAY / "undistorted_images/cam0/preview.png", "x")
    assert times_of(read(root).mapping) == {A, B}
    dataset = read(root, frames="all")
    assert times_of(dataset.mapping) == {A, B, B + 100}
    assert len(dataset.mapping.image_names()) == 6
    assert len(dataset.mapping.poses()) == 4


def test_recordings_by_name(root: Path) -> None:
    write_recording(root, RAIN, (A + 9,), (f"{A + 9},0,0,0,0,0,0,1,1,2",))
    # the first with poses is the map, all others are queries
    assert {name.split("/")[0] for name in read(root).query.image_names()} == {SNOW, RAIN}
    dataset = read(root, reference=RAIN, queries=[SNOW, DAY])
    assert {name.split("/")[0] for name in dataset.mapping.image_names()} == {RAIN}
    assert dataset.query_gt is not None  # the day's poses are published
    assert len(dataset.query_gt.poses()) == 4
    assert len(read(root, reference=f"{RAIN}, {DAY}").mapping.poses()) == 6
    with pytest.raises(OptionError, match=f"option queries: no recording 'x' in .*; .* {DAY}"):
        read(root, queries=["x"])
    with pytest.raises(OptionError, match="is given for the map and for the queries"):
        read(root, reference=DAY, queries=DAY)
    with pytest.raises(DataError, match="no poses for the map: GNSSPoses.txt and Transformations"):
        read(root, reference=SNOW)


def test_poor_fusion_is_dropped(root: Path) -> None:
    rows = (ROWS[0], ROWS[1].replace(",2,0.5", ",0,0.5"))
    write(root / DAY / "GNSSPoses.txt", "\n".join(rows))
    dataset = read(root)
    assert times_of(dataset.mapping) == {A}
    assert "1 keyframes are left out" in dataset.remarks[0]
    assert times_of(read(root, min_fusion_quality=0).mapping) == {A, B}
    write(root / DAY / "GNSSPoses.txt", rows[1])
    with pytest.raises(DataError, match="none of its 1 poses has a fusion quality of 1 or better"):
        read(root)


def test_a_pose_without_scale_takes_the_recordings(root: Path) -> None:
    write(root / DAY / "GNSSPoses.txt", f"{A},8,0,0,0,0,0,1\n{B},2,4,0,0,0,0,1,0.25,2")
    pose = read(root).mapping.cam_from_world(image(DAY, A))
    assert pose is not None
    first = read(root).world.pose_in_official(pose).center()
    np.testing.assert_allclose(first, (3999990.0, 800030.0, 4699981.0), atol=1e-8)
    write(root / DAY / "Transformations.txt", TRANSFORMATIONS.partition("# GNSS")[0])
    with pytest.raises(DataError, match=r"GNSSPoses\.txt:1: the pose has no scale"):
        read(root)


def test_calibrations_differ(root: Path) -> None:
    """Recordings may bring their own calibration, under a capital letter."""
    write_calibration(root / SNOW / "Calibration", baseline=-0.31)
    dataset = read(root)
    assert set(dataset.mapping.rigs) == {"car"}
    assert set(dataset.query.rigs) == {f"car_{SNOW}"}
    assert dataset.query.rigs[f"car_{SNOW}"][f"cam1_{SNOW}"].translation[0] == -0.31
    shutil.move(root / "calibration", root / DAY / "Calibration")
    assert set(read(root).mapping.rigs) == {"car"}
    shutil.rmtree(root / DAY / "Calibration")
    with pytest.raises(DataError, match="no folder calibration or Calibration here or in"):
        FourSeasons().check(root)


def test_two_recordings_of_one_time(root: Path) -> None:
    write_recording(root, RAIN, (A + 5,), rows=None)
    with pytest.raises(DataError, match=f"{A + 5}.png: {SNOW}.* has the same time"):
        read(root)


def test_what_is_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        FourSeasons().check(tmp_path / "absent")
    with pytest.raises(DataError, match="no recording here"):
        FourSeasons().check(tmp_path)
    write_calibration(tmp_path / "calibration")
    write_recording(tmp_path, DAY, (A, B))
    FourSeasons().check(tmp_path)
    with pytest.raises(DataError, match="<another recording, for the queries>"):
        write_official(read(tmp_path), tmp_path / "out")
    write_official(read(tmp_path), tmp_path / "out", allow_missing=True)
    assert len(KaptureFolder(tmp_path / "out/mapping").read().poses()) == 4


# ------------------------------------------------------------------------- partial downloads


def test_a_partial_download_is_refused_or_asked_for(root: Path, tmp_path: Path) -> None:
    (root / image(DAY, B)).unlink()
    (root / image(DAY, B, "cam1")).unlink()
    shutil.rmtree(root / SNOW / "undistorted_images/cam1")
    dataset = read(root)
    with pytest.raises(DataError, match=f"4 files are missing: {DAY}/.*{B}.png, .*allow-missing"):
        write_official(dataset, tmp_path / "out")
    write_official(dataset, tmp_path / "out", allow_missing=True)
    assert len(KaptureFolder(tmp_path / "out/mapping").read().poses()) == 2
    assert KaptureFolder(tmp_path / "out/query").read().image_names() == [
        image(SNOW, A + 5),
        image(SNOW, B + 5),
    ]


def test_no_images_of_a_recording(root: Path) -> None:
    shutil.rmtree(root / SNOW / "undistorted_images")
    dataset = read(root)
    assert dataset.missing is not None
    assert dataset.missing.files == [root / SNOW / "undistorted_images/cam0"]


def test_missing_transformations(root: Path) -> None:
    (root / DAY / "Transformations.txt").unlink()
    with pytest.raises(DataError, match="no poses for the map"):
        read(root)


# ------------------------------------------------------------------------------ the challenges


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
    tables = tmp_path / "out/megloc"
    pose_file = Path(name).name
    assert read_relocalization(tables) == [
        RelocalizationPair(pose_file, image(day, times[25]), image(snow, B + 5)),
        RelocalizationPair(pose_file, image(day, times[3]), image(snow, B + 5)),
    ]
    # the images that are asked for, in the recordings that are meant
    assert times_of(dataset.query) == {B + 5}
    assert {n.split("/")[0] for n in dataset.mapping.image_names()} == {day}
    # 20 keyframes around each reference: 5 to 45, and 0 to 23
    near = sorted(image(day, t, c) for t in times[:46] for c in ("cam0", "cam1"))
    assert read_priors(tables) == {
        image(snow, B + 5, "cam0"): tuple(near),
        image(snow, B + 5, "cam1"): tuple(near),
    }
    groups = read_groups(tables)
    assert groups[image(snow, B + 5)].scored
    assert not groups[image(snow, B + 5, "cam1")].scored
    protocol = read_protocol(tables)
    assert protocol.pose_file == "mlad"
    assert protocol.thresholds == ((0.1, None), (0.2, None), (0.5, None))
    assert dataset.query_gt is None
    assert not dataset.remarks


def test_more_than_is_asked_for(root: Path) -> None:
    """All frames of a recording are queries if one wants them; scored are those asked for."""
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {B + 5}\n")
    dataset = read(root, frames="all")
    assert times_of(dataset.query) == {A + 5, B + 5}
    scored = {name for name in dataset.query.image_names() if dataset.groups[name].scored}
    assert scored == {image(SNOW, B + 5)}


def test_pairs_with_poses_in_the_frame_of_poses_txt(root: Path) -> None:
    """As in 2020: the map's poses are already in one frame, queries are known relative to it."""
    (root / DAY / "GNSSPoses.txt").unlink()
    (root / DAY / "Transformations.txt").unlink()
    write(root / DAY / "poses.txt", f"# ts t q\n{A} 100.5 7 3 0 0 0 1\n{B} 101.5 7 3 0 0 0.6 0.8\n")
    write(root / DAY / "keyframe_accuracy.txt", f"{A}\n")
    folder = root / DAY / "RelocalizationFilesVal"
    write(folder / f"relocalizationFile_{SNOW}.txt", f"{A} {B + 5} 1 2 3 0 0 0.6 0.8\n")
    dataset = read(root)
    world = dataset.world
    pose = dataset.mapping.cam_from_world(image(DAY, A))
    assert pose is not None and dataset.query_gt is not None
    np.testing.assert_allclose(world.pose_in_official(pose).center(), [100.5, 7, 3], atol=1e-12)
    known = dataset.query_gt.cam_from_world(image(SNOW, B + 5))
    assert known is not None
    official = world.pose_in_official(known)
    turn = Rotation.from_quat([0, 0, 0.6, 0.8]).as_matrix()
    np.testing.assert_allclose(official.rotation_matrix(), turn, atol=1e-12)
    # x_query = R (x_world - (100.5, 7, 3)) + (1, 2, 3)
    at = np.array([[101.0, 8.0, 5.0]])
    np.testing.assert_allclose(official.apply(at)[0], turn @ [0.5, 1, 2] + [1, 2, 3], atol=1e-12)
    assert "poses.txt, whose frame is its own" in dataset.remarks[0]
    assert any("0.05 m" in count.what and count.found == 1 for count in dataset.summary)


def test_truth_of_a_pair_counts_before_the_recordings_own(root: Path) -> None:
    write_recording(root, RAIN, (A + 9,), (f"{A + 9},0,0,0,0,0,0,1,1,2",))
    write(root / f"reloc_{DAY}_to_{RAIN}.txt", f"{A} {A + 9} 0 0 0 0 0 0 1\n")
    dataset = read(root)
    assert dataset.query_gt is not None
    assert dataset.query_gt.cam_from_world(image(RAIN, A + 9)) == dataset.mapping.cam_from_world(
        image(DAY, A)
    )


def test_pairs_that_cannot_be(root: Path) -> None:
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {A + 5}\n77 {B + 5}\n{A} 78\n")
    dataset = read(root)
    assert [pair.query for pair in dataset.relocalization] == [image(SNOW, A + 5)]
    assert "2 pairs of relocalization files are left out" in dataset.remarks[0]
    assert dataset.missing is not None
    assert dataset.missing.files == [root / image(SNOW, 78, c) for c in ("cam0", "cam1")]


def test_recordings_that_files_mean_and_are_not_there(root: Path) -> None:
    write(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {A + 5}\n")
    write(root / f"reloc_{DAY}_to_garage.txt", f"{A} 1\n")
    dataset = read(root)
    assert dataset.missing is not None
    assert dataset.missing.files == [root / "garage"]
    assert not read(root, queries=SNOW).missing.files  # type: ignore[union-attr]
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


# ---------------------------------------------------------------------------- depth, truth


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
    assert read(root, depth=True).missing.files == [  # type: ignore[union-attr]
        folder / f"KeyFrame_{B}.txt"
    ]


@pytest.mark.parametrize(("time", "size"), [(B, "8,4"), (A, "9,4")])
def test_a_keyframe_of_something_else(root: Path, tmp_path: Path, time: int, size: str) -> None:
    for timestamp in (A, B):
        file = root / DAY / f"KeyFrameData/KeyFrame_{timestamp}.txt"
        write(file, keyframe_text(time, "", 0, size))
    with pytest.raises(DataError, match=r"KeyFrame_\d+\.txt: timestamp .* are not those of its"):
        write_official(read(root, depth=True), tmp_path / "out")


def test_truth_beside_the_dataset(root: Path) -> None:
    """Poses that a user has, in ECEF; what is published counts first."""
    dataset = read(root)
    world = dataset.world
    truth = KaptureData(sensors={"any": Sensor.from_camera(CAMERA)})
    pose = dataset.mapping.cam_from_world(image(DAY, A))
    assert pose is not None
    truth.records_camera = {(1, "any"): image(SNOW, A + 5), (2, "any"): image(SNOW, 7)}
    truth.trajectories = {(t, "any"): world.pose_in_official(pose) for t in (1, 2)}
    write_sensors(root / "ground_truth/query", truth)
    write(
        root / "ground_truth/megloc/groups.csv",
        f"image,condition,frame,location,scored\n{image(SNOW, A + 5)},blizzard,,,1\n",
    )
    dataset = read(root)
    assert dataset.query_gt is not None
    assert set(dataset.query_gt.poses()) == {image(SNOW, A + 5)}
    found = dataset.query_gt.cam_from_world(image(SNOW, A + 5))
    assert found is not None
    np.testing.assert_allclose(found.center(), pose.center(), atol=1e-8)
    assert dataset.groups[image(SNOW, A + 5)].condition == "blizzard"
    assert dataset.groups[image(SNOW, B + 5)].condition == SNOW
    assert root / "ground_truth/query/sensors/trajectories.txt" in set(
        FourSeasons().input_files(root)
    )


def test_input_files(root: Path) -> None:
    write_recording(root, RAIN, (A + 9,), rows=None)
    files = list(FourSeasons(FourSeasonsOptions(queries=(SNOW,))).input_files(root))
    assert len(files) == len(set(files))
    assert all(file.is_file() for file in files)
    names = {str(file.relative_to(root)) for file in files}
    assert names == {
        *(f"calibration/undistorted_calib_{part}.txt" for part in ("0", "1", "stereo")),
        *(f"{DAY}/{name}.txt" for name in ("GNSSPoses", "Transformations", "times")),
        f"{SNOW}/times.txt",
        *(image(DAY, t, c) for t in (A, B) for c in ("cam0", "cam1")),
        *(image(SNOW, t, c) for t in (A + 5, B + 5) for c in ("cam0", "cam1")),
    }


# ------------------------------------------------------------------------ the published sample


@pytest.fixture
def sample(shared_data: Path, tmp_path: Path) -> Path:
    """The published recording, four of its images, as map and again as queries."""
    source = shared_data / "kapture_samples/4seasons/TUM"
    root = tmp_path / "sample"
    root.mkdir()
    (root / "calibration").symlink_to(source / "calibration")
    for name in ("a_map", "b_queries"):
        (root / name).symlink_to(next(source.glob("recording_*")))
    return root


def test_all_poses_of_the_sample_as_kaptures_importer_has_them(sample: Path) -> None:
    from tools.kapture_import_4seasons import import_4seasons_trajectory

    recording = Recording("a_map", sample / "a_map")
    poses = read_keyframe_poses(
        recording, min_fusion_quality=1, on_earth=False, missing=Missing(sample)
    )
    assert poses is not None
    frame = LocalFrame.around(poses)
    theirs = import_4seasons_trajectory(
        str(recording.folder / "GNSSPoses.txt"), str(recording.folder / "Transformations.txt")
    )
    ours = frame.cams_from_local(poses)
    assert len(ours) == len(theirs) == 2874
    for timestamp, pose in ours.items():
        assert np.linalg.norm(pose.center()) < 1000
        official, car = frame.world().pose_in_official(pose), theirs[timestamp, "car"]
        np.testing.assert_allclose(official.center(), car.inverse().t_raw, atol=1e-7)
        # theirs are left at the length that six decimals give them
        dot = np.dot(official.quat_wxyz, car.r_raw) / np.linalg.norm(car.r_raw)
        assert abs(dot) == pytest.approx(1, abs=1e-14)


def test_the_sample_as_kapture(sample: Path, tmp_path: Path) -> None:
    from tools.kapture_import_4seasons import load_4seasons_cameras

    dataset = read(sample)
    with pytest.raises(DataError, match="11480 files are missing"):
        write_official(dataset, tmp_path / "out")
    write_official(dataset, tmp_path / "out", allow_missing=True)
    mapping = KaptureFolder(tmp_path / "out/mapping").read()
    assert len(mapping.poses()) == 8
    sensors, rigs = load_4seasons_cameras(str(sample / "calibration"))
    for camera in ("cam0", "cam1"):
        ours = mapping.sensors[camera].camera()
        values = list(map(float, sensors[camera].camera_params))
        assert [ours.width, ours.height, *ours.params] == values
        np.testing.assert_allclose(
            mapping.rigs["car"][camera].translation, rigs["car", camera].t_raw, atol=1e-12
        )
    # the queries are the same images, through another folder
    truth = KaptureFolder(tmp_path / "out/query_gt").read()
    assert truth.trajectories == mapping.trajectories


def test_the_samples_motions_are_the_odometrys(sample: Path) -> None:
    """Between keyframes the car moves as its keyframe files say, times the scale."""
    folder = sample / "a_map"
    mapping = read(sample).mapping
    keyframes = sorted((folder / "KeyFrameData").iterdir())
    steps = []
    for first, second in zip(keyframes[:-1], keyframes[1:], strict=True):
        odometry = [read_keyframe(file) for file in (first, second)]
        motion = odometry[0].world_from_cam.inverse() @ odometry[1].world_from_cam
        poses = [mapping.trajectories[keyframe.timestamp, "car"] for keyframe in odometry]
        ours = poses[0] @ poses[1].inverse()
        assert np.linalg.norm(motion.translation) > 0.08
        np.testing.assert_allclose(
            ours.translation, 0.962356 * np.array(motion.translation), atol=1e-3
        )
        assert abs(np.dot(ours.quat_wxyz, motion.quat_wxyz)) == pytest.approx(1, abs=1e-6)
        steps.append(np.linalg.norm(ours.translation))
    rows = np.loadtxt(folder / "GNSSPoses.txt", delimiter=",")[:4, 1:4]
    unscaled = np.linalg.norm(np.diff(rows, axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.962356 * unscaled, rtol=1e-9)
