"""4Seasons: coordinate frames, selection of images, partial downloads, the published sample."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from aachen_files import put
from fourseasons_files import (
    DAY,
    RAIN,
    ROWS,
    SNOW,
    TRANSFORMATIONS,
    A,
    B,
    image,
    missing_of,
    official,
    pose_of,
    read,
    times_of,
    write_calibration,
    write_recording,
    write_two_recordings,
)
from kapture.io.csv import kapture_from_dir
from scipy.spatial.transform import Rotation
from tools.kapture_import_4seasons import import_4seasons_trajectory, load_4seasons_cameras

from megloc_kapture.datasets.fourseasons import Recording
from megloc_kapture.datasets.fourseasons.adapter import FourSeasons, LocalFrame, read_keyframe_poses
from megloc_kapture.datasets.official import Missing, write_official
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io import dataset_tables as tables
from megloc_kapture.io.kapture import KaptureFolder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_two_recordings(tmp_path / "root")


def test_kapture_reads_the_written_rig_and_integer_times(root: Path, tmp_path: Path) -> None:
    write_official(read(root), tmp_path / "out")
    theirs = kapture_from_dir(str(tmp_path / "out/mapping"))
    assert set(theirs.sensors) == set(theirs.rigs["car"]) == {"cam0", "cam1"}
    assert theirs.sensors["cam1"].sensor_params == ["PINHOLE", "8", "4", "5", "5", "4.25", "1.75"]
    np.testing.assert_allclose(theirs.rigs["car", "cam1"].t_raw, [-0.3, 0, 0])
    assert set(theirs.trajectories) == {A, B} and set(theirs.trajectories[A]) == {"car"}
    assert theirs.records_camera[A, "cam1"] == image(DAY, A, "cam1")
    queries = kapture_from_dir(str(tmp_path / "out/query"))
    assert queries.trajectories is None and set(queries.records_camera) == {A + 5, B + 5}


def test_tables_have_the_groups_protocol_and_world_of_the_challenge(root: Path) -> None:
    dataset = read(root)
    assert dataset.query_gt is None  # the poses of the queries are unknown
    assert dataset.groups[image(SNOW, A + 5)] == tables.ImageGroup(condition=SNOW)
    assert not dataset.groups[image(SNOW, A + 5, "cam1")].scored
    assert dataset.groups[image(DAY, A)].location == DAY
    protocol = dataset.protocol
    assert (protocol.dataset, protocol.conditions) == ("4seasons", (SNOW,))
    assert protocol.thresholds == ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
    assert protocol.pose_file == "ltvl"
    quaternion = dataset.world.official_from_local.quat_wxyz
    np.testing.assert_allclose(quaternion, [np.sqrt(0.5), np.sqrt(0.5), 0, 0])


def test_all_frames_are_imported_on_request(root: Path) -> None:
    for camera in ("cam0", "cam1"):
        put(root / image(DAY, B + 100, camera), "x")
    put(root / DAY / "undistorted_images/cam0/preview.png", "x")
    assert times_of(read(root).mapping) == {A, B}
    dataset = read(root, frames="all")
    assert times_of(dataset.mapping) == {A, B, B + 100}
    assert len(dataset.mapping.image_names()) == 6
    assert len(dataset.mapping.poses()) == 4
    # only those of relocalization pairs are scored
    put(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {B + 5}\n")
    dataset = read(root, frames="all")
    assert times_of(dataset.query) == {A + 5, B + 5}
    scored = [name for name in dataset.query.image_names() if dataset.groups[name].scored]
    assert scored == [image(SNOW, B + 5)]


def test_map_and_queries_are_recordings_by_name(root: Path) -> None:
    write_recording(root, RAIN, (A + 9,), (f"{A + 9},0,0,0,0,0,0,1,1,2",))
    # by default the first recording with poses is the map, all others are queries
    assert {name.split("/")[0] for name in read(root).query.image_names()} == {SNOW, RAIN}
    dataset = read(root, reference=RAIN, queries=[SNOW, DAY])
    assert {name.split("/")[0] for name in dataset.mapping.image_names()} == {RAIN}
    assert dataset.query_gt is not None  # the poses of the day are published
    assert len(dataset.query_gt.poses()) == 4
    assert len(read(root, reference=f"{RAIN}, {DAY}").mapping.poses()) == 6
    with pytest.raises(OptionError, match=f"option queries: no recording 'x' in .*; .* {DAY}"):
        read(root, queries=["x"])
    with pytest.raises(OptionError, match="is given for the map and for the queries"):
        read(root, reference=DAY, queries=DAY)
    with pytest.raises(DataError, match="no poses for the map: GNSSPoses.txt and Transformations"):
        read(root, reference=SNOW)


def test_keyframes_of_poor_fusion_are_skipped(root: Path) -> None:
    rows = (ROWS[0], ROWS[1].replace(",2,0.5", ",0,0.5"))
    put(root / DAY / "GNSSPoses.txt", "\n".join(rows))
    dataset = read(root)
    assert times_of(dataset.mapping) == {A}
    assert "1 keyframes are left out" in dataset.remarks[0]
    assert times_of(read(root, min_fusion_quality=0).mapping) == {A, B}
    put(root / DAY / "GNSSPoses.txt", rows[1])
    with pytest.raises(DataError, match="none of its 1 poses has a fusion quality of 1 or better"):
        read(root)


def test_a_pose_without_scale_uses_the_scale_of_the_recording(root: Path) -> None:
    put(root / DAY / "GNSSPoses.txt", f"{A},8,0,0,0,0,0,1\n{B},2,4,0,0,0,0,1,0.25,2")
    center = official(read(root), image(DAY, A)).center()
    np.testing.assert_allclose(center, (3999990.0, 800030.0, 4699981.0), atol=1e-8)
    put(root / DAY / "Transformations.txt", TRANSFORMATIONS.partition("# GNSS")[0])
    with pytest.raises(DataError, match=r"GNSSPoses\.txt: neither the pose nor"):
        read(root)
    (root / DAY / "Transformations.txt").unlink()
    with pytest.raises(DataError, match="no poses for the map"):
        read(root)


def test_recordings_may_have_their_calibration(root: Path) -> None:
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


@pytest.mark.parametrize(
    ("day", "snow", "name"),
    [
        (DAY, SNOW, f"relocalizationFile_{DAY}_to_{SNOW}.txt"),
        (DAY, SNOW, f"RelocalizationFilesTest/relocalizationFile_{DAY}_to_{SNOW}.txt"),
        ("loop_2_train", "loop_2_test", "reloc_loop_2_train_to_loop_2_test.txt"),
        (DAY, SNOW, f"{DAY}/RelocalizationFilesTest/relocalizationFile_{SNOW}_hard.txt"),
    ],
)
def test_relocalization_files_select_images_and_priors(
    root: Path, tmp_path: Path, day: str, snow: str, name: str
) -> None:
    times = [A + 50_000_000 * k for k in range(50)]
    write_recording(root, DAY, times, [f"{t},{k},0,0,0,0,0,1,1,2" for k, t in enumerate(times)])
    if day != DAY:
        (root / DAY).rename(root / day)
        (root / SNOW).rename(root / snow)
    write_recording(root, "a_drive_elsewhere", (5,), (f"5,{','.join(ROWS[0].split(',')[1:])}",))
    put(root / name, f"{times[25]} {B + 5}\n{times[3]} {B + 5}\n")
    dataset = read(root)
    write_official(dataset, tmp_path / "out")
    written = tmp_path / "out/megloc"
    pose_file = Path(name).name
    assert tables.read_side_tables(written).relocalization == [
        tables.RelocalizationPair(pose_file, image(day, times[25]), image(snow, B + 5)),
        tables.RelocalizationPair(pose_file, image(day, times[3]), image(snow, B + 5)),
    ]
    # only images of the pairs, in the recordings of the file's name
    assert times_of(dataset.query) == {B + 5}
    assert {n.split("/")[0] for n in dataset.mapping.image_names()} == {day}
    # 20 keyframes around each reference: 5 to 45, and 0 to 23
    near = sorted(image(day, t, c) for t in times[:46] for c in ("cam0", "cam1"))
    assert tables.read_side_tables(written).priors == {
        image(snow, B + 5, "cam0"): tuple(near),
        image(snow, B + 5, "cam1"): tuple(near),
    }
    groups = tables.read_side_tables(written).groups
    assert groups[image(snow, B + 5)].scored
    assert not groups[image(snow, B + 5, "cam1")].scored
    protocol = tables.read_side_tables(written).protocol
    assert protocol.pose_file == "mlad"
    assert protocol.thresholds == ((0.1, None), (0.2, None), (0.5, None))
    assert dataset.query_gt is None
    assert not dataset.remarks


def test_pairs_of_2020_have_poses_relative_to_poses_txt(root: Path) -> None:
    (root / DAY / "GNSSPoses.txt").unlink()
    (root / DAY / "Transformations.txt").unlink()
    put(root / DAY / "poses.txt", f"# ts t q\n{A} 100.5 7 3 0 0 0 1\n{B} 101.5 7 3 0 0 0.6 0.8\n")
    folder = root / DAY / "RelocalizationFilesVal"
    put(folder / f"relocalizationFile_{SNOW}.txt", f"{A} {B + 5} 1 2 3 0 0 0.6 0.8\n")
    dataset = read(root)
    center = official(dataset, image(DAY, A)).center()
    np.testing.assert_allclose(center, [100.5, 7, 3], atol=1e-12)
    known = official(dataset, image(SNOW, B + 5))
    turn = Rotation.from_quat([0, 0, 0.6, 0.8]).as_matrix()
    np.testing.assert_allclose(known.rotation_matrix(), turn, atol=1e-12)
    # x_query = R (x_world - (100.5, 7, 3)) + (1, 2, 3)
    at = np.array([[101.0, 8.0, 5.0]])
    np.testing.assert_allclose(known.apply(at)[0], turn @ [0.5, 1, 2] + [1, 2, 3], atol=1e-12)
    assert "poses.txt, whose frame no other recording shares" in dataset.remarks[0]


def test_the_pose_of_a_pair_takes_precedence_over_that_of_the_recording(root: Path) -> None:
    write_recording(root, RAIN, (A + 9,), (f"{A + 9},0,0,0,0,0,0,1,1,2",))
    put(root / f"reloc_{DAY}_to_{RAIN}.txt", f"{A} {A + 9} 0 0 0 0 0 0 1\n")
    dataset = read(root)
    assert pose_of(dataset, image(RAIN, A + 9)) == pose_of(dataset, image(DAY, A))


def test_pairs_of_unknown_images_are_skipped(root: Path) -> None:
    put(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {A + 5}\n77 {B + 5}\n{A} 78\n")
    dataset = read(root)
    assert [pair.query for pair in dataset.relocalization] == [image(SNOW, A + 5)]
    assert "2 pairs of relocalization files are left out" in dataset.remarks[0]
    assert missing_of(dataset) == [root / image(SNOW, 78, c) for c in ("cam0", "cam1")]


def test_recordings_named_by_a_file_may_be_missing(root: Path) -> None:
    put(root / f"reloc_{DAY}_to_{SNOW}.txt", f"{A} {A + 5}\n")
    put(root / f"reloc_{DAY}_to_garage.txt", f"{A} 1\n")
    assert missing_of(read(root)) == [root / "garage"]
    assert not missing_of(read(root, queries=SNOW))
    (root / DAY).rename(root / "renamed")
    with pytest.raises(
        DataError, match=f"none for the map; .*the relocalization files refer to {DAY}"
    ):
        read(root, queries=SNOW)
    (root / "renamed").rename(root / DAY)
    shutil.rmtree(root / SNOW)
    assert missing_of(read(root)) == [root / "garage", root / SNOW]
    put(root / "relocalizationFile_garage.txt", f"{A} 1\n")
    with pytest.raises(DataError, match="does not say which recording is the reference"):
        read(root)


@pytest.fixture
def sample(shared_data: Path, tmp_path: Path) -> Path:
    """The published sample of a recording, as map and as queries."""
    source = shared_data / "kapture_samples/4seasons/TUM"
    root = tmp_path / "sample"
    root.mkdir()
    (root / "calibration").symlink_to(source / "calibration")
    for name in ("a_map", "b_queries"):
        (root / name).symlink_to(next(source.glob("recording_*")))
    return root


@pytest.mark.slow
def test_all_poses_of_the_published_sample_equal_those_of_kapture(sample: Path) -> None:
    folder = sample / "a_map"
    recording = Recording(folder)
    poses = read_keyframe_poses(recording, 1, Missing(sample), on_earth=False)
    assert poses is not None
    frame = LocalFrame.around(poses)
    theirs = import_4seasons_trajectory(
        str(folder / "GNSSPoses.txt"), str(folder / "Transformations.txt")
    )
    ours = frame.cams_from_local(poses)
    assert len(ours) == len(theirs) == 2874
    for timestamp, pose in ours.items():
        assert np.linalg.norm(pose.center()) < 1000
        official, car = frame.world().pose_in_official(pose), theirs[timestamp, "car"]
        np.testing.assert_allclose(official.center(), car.inverse().t_raw, atol=1e-7)
        # quaternions of kapture are not normalised
        dot = np.dot(official.quat_wxyz, car.r_raw) / np.linalg.norm(car.r_raw)
        assert abs(dot) == pytest.approx(1, abs=1e-14)


@pytest.mark.slow
def test_kapture_reads_the_samples_cameras_and_rigs_equally(sample: Path, tmp_path: Path) -> None:
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
        rig_pose, theirs = mapping.rigs["car"][camera], rigs["car", camera]
        np.testing.assert_allclose(rig_pose.translation, theirs.t_raw, atol=1e-12)
        np.testing.assert_allclose(np.abs(rig_pose.quat_wxyz), np.abs(theirs.r_raw), atol=1e-9)
    # the queries are the same images in another folder
    truth = KaptureFolder(tmp_path / "out/query_gt").read()
    assert truth.trajectories == mapping.trajectories
