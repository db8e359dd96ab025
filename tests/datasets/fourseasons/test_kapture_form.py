"""4Seasons in kapture folders that kapture's own importer made, beside its official layout."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from fourseasons_files import DAY, SNOW, read, write, write_calibration, write_recording
from kapture_forms import fourseasons_with_kapture

from megloc_kapture.datasets.fourseasons.adapter import FourSeasons
from megloc_kapture.datasets.official import OfficialDataset, write_official
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import RigidTransform

RELOCALIZATION = f"relocalizationFile_{DAY}_to_{SNOW}.txt"
# kapture's importer reads them as floats, which hold whole seconds to the nanosecond
MAP_TIMES = tuple(10**9 * (1_600_000_000 + number) for number in range(4))
QUERY_TIMES = tuple(10**9 * (1_610_000_000 + number) for number in range(3))
TRANSFORMATIONS = """# transform_S_AS: translation vector, rotation quaternion
0.5,0,0.25,0,0.6,0,0.8
# transform_w_gpsw: translation vector, rotation quaternion
10,20,30,0,0,0.28,0.96
# transform_e_gpsw: translation vector, rotation quaternion
4178000,857000,4724000,0.36,0.48,0,0.8
# GNSS scale
0.96
"""


@pytest.fixture(scope="module")
def official(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("official") / "4Seasons"
    for name, times in ((DAY, MAP_TIMES), (SNOW, QUERY_TIMES)):
        rows = [
            f"{time},{2 * i},{0.5 * i},{-0.1 * i},0,{0.6 if i % 2 else -0.6},0,0.8,0.96,2"
            for i, time in enumerate(times)
        ]
        folder = write_recording(root, name, times, rows)
        write(folder / "Transformations.txt", TRANSFORMATIONS)
        write(folder / "times.txt", "".join(f"{t} {t // 10**9}.0 0.25\n" for t in times))
    write_calibration(root / "calibration")
    pinhole = "Pinhole 5.1 5.2 4.25 1.71 0.0 0.0 0.0 0.0\n8 4\ncrop\n8 4\n"
    write(root / "calibration/undistorted_calib_1.txt", pinhole)
    pairs = [(MAP_TIMES[1], QUERY_TIMES[2]), (MAP_TIMES[3], QUERY_TIMES[0])]
    write(root / RELOCALIZATION, "".join(f"{a} {b}\n" for a, b in pairs))
    return root


@pytest.fixture(scope="module")
def downloaded(official: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kapture") / "4seasons"
    fourseasons_with_kapture(official, root)
    shutil.copyfile(official / RELOCALIZATION, root / RELOCALIZATION)
    return root


def on_earth(dataset: OfficialDataset) -> dict[str, RigidTransform]:
    assert dataset.query_gt is not None
    poses = dataset.mapping.poses() | dataset.query_gt.poses()
    return {name: dataset.world.pose_in_official(pose) for name, pose in poses.items()}


def assert_same(found: OfficialDataset, expected: OfficialDataset) -> None:
    """Each has a local frame of its own."""
    for part in ("mapping", "query"):
        ours, theirs = getattr(found, part), getattr(expected, part)
        assert ours.records_camera == theirs.records_camera and ours.sensors == theirs.sensors
        for camera, pose in theirs.rigs["car"].items():
            own = ours.rigs["car"][camera]
            np.testing.assert_allclose(own.translation, pose.translation, atol=1e-12)
    for table in ("groups", "priors", "relocalization", "protocol"):
        assert getattr(found, table) == getattr(expected, table), table
    poses, others = on_earth(found), on_earth(expected)
    assert poses.keys() == others.keys() and len(poses) == 2 * (len(MAP_TIMES) + 2)
    for name, pose in others.items():
        mine = poses[name]
        np.testing.assert_allclose(mine.rotation_matrix(), pose.rotation_matrix(), atol=1e-9)
        np.testing.assert_allclose(mine.center(), pose.center(), rtol=0, atol=1e-6)


def test_the_same_dataset_in_both_forms(official: Path, downloaded: Path, tmp_path: Path) -> None:
    found = read(downloaded)
    assert_same(found, read(official))
    assert len(found.relocalization) == 2
    # small numbers in a frame whose z is up
    centers = np.array([pose.center() for pose in found.mapping.poses().values()])
    assert np.abs(centers).max() < 20
    up = np.array(found.world.pose_in_official(RigidTransform.identity()).rotation_matrix())[2]
    earth = next(iter(on_earth(found).values())).center()
    assert up @ earth / np.linalg.norm(earth) > 0.9999
    write_official(found, tmp_path / "out")
    for part in ("mapping", "query"):
        folder = KaptureFolder(tmp_path / "out" / part)
        for name in folder.read().image_names():
            assert folder.image_path(name).samefile(official / name)


def test_recordings_in_the_root(official: Path, downloaded: Path, tmp_path: Path) -> None:
    for name in (DAY, SNOW):
        shutil.copytree(downloaded / "records" / name, tmp_path / name, symlinks=True)
    shutil.copyfile(official / RELOCALIZATION, tmp_path / DAY / RELOCALIZATION)
    assert_same(read(tmp_path), read(official))


def test_input_files_are_what_is_read(downloaded: Path) -> None:
    files = list(FourSeasons().input_files(downloaded))
    assert all(path.is_file() for path in files) and len(set(files)) == len(files)
    names = {str(path.relative_to(downloaded)) for path in files}
    sensors = f"records/{SNOW}/sensors"
    assert f"{sensors}/records_data/undistorted_images/cam1/{QUERY_TIMES[0]}.png" in names
    assert {RELOCALIZATION, f"{sensors}/trajectories.txt"} <= names


def test_a_recording_without_poses_is_a_query(root: Path) -> None:
    (root / "records" / SNOW / "sensors/trajectories.txt").unlink()
    dataset = read(root)
    assert dataset.query_gt is None and len(dataset.relocalization) == 2
    with pytest.raises(DataError, match=r"depth needs the scale .* GNSSPoses\.txt"):
        read(root, depth=True)


def test_poses_that_are_nowhere_on_earth(root: Path) -> None:
    table = root / "records" / DAY / "sensors/trajectories.txt"
    head, rows = table.read_text().splitlines()[:2], MAP_TIMES
    table.write_text("\n".join([*head, *(f"{time}, car, 1, 0, 0, 0, 1, 2, 3" for time in rows)]))
    with pytest.raises(DataError, match="not on earth") as caught:
        read(root)
    assert str(table) in str(caught.value)


@pytest.mark.parametrize("tables", [["rigs"], ["sensors", "rigs", "records_camera"]])
def test_a_car_of_other_cameras(root: Path, tables: list[str]) -> None:
    for table in tables:
        path = root / "records" / DAY / f"sensors/{table}.txt"
        lines = path.read_text().splitlines(keepends=True)
        path.write_text("".join(line for line in lines if "cam1" not in line))
    with pytest.raises(DataError, match="no cameras cam0 and cam1 on one rig"):
        FourSeasons().check(root)
