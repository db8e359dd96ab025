"""RobotCar Seasons' twin: layout, truth and import, by the means of kapture and COLMAP."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import kapture
import numpy as np
import pytest
from kapture.algo.pose_operations import world_pose_transform_distance
from kapture.io.csv import kapture_from_dir

from megloc_kapture.datasets.official import write_official
from megloc_kapture.datasets.robotcar.adapter import RobotCar, RobotCarOptions
from megloc_kapture.io.dataset_tables import read_side_tables
from megloc_kapture.io.images import image_size

LAYOUT = "robotcar"

MAX_M, MAX_DEG = 1e-6, 1e-6


def poses_by_image(data: kapture.Kapture) -> dict[str, kapture.PoseTransform]:
    return {
        name: data.trajectories[timestamp, sensor]
        for timestamp, sensor, name in kapture.flatten(data.records_camera)
        if (timestamp, sensor) in data.trajectories
    }


def assert_equal_poses(
    result: dict[str, kapture.PoseTransform], expected: dict[str, kapture.PoseTransform]
) -> None:
    assert result.keys() == expected.keys()
    for name, pose in result.items():
        distance_m, angle = world_pose_transform_distance(pose, expected[name])
        assert distance_m < MAX_M, name
        # kapture's own angle is an arccos, which cannot resolve a microdegree
        assert angle < 1e-4
        relative = (pose.r * expected[name].r.inverse()).components[1:]
        assert np.degrees(2 * np.linalg.norm(relative)) < MAX_DEG, name


@pytest.fixture(scope="module", params=["v1", "v2"])
def theirs(
    request: pytest.FixtureRequest, root: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, dict[str, kapture.Kapture]]:
    """Import the twin by kapture's importer: one kapture per location and role."""
    out = tmp_path_factory.mktemp("kapture") / "out"
    tool = str(Path(sys.executable).with_name("kapture_import_RobotCar_Seasons"))
    command = [tool, "-i", str(root), "-o", str(out), "--image_transfer", "skip"]
    command += ["--skip_reconstruction"] + ["--v1"] * (request.param == "v1")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # it writes no folder for a location without queries
    result = sorted(path for path in out.glob("0*/*") if (path / "sensors").is_dir())
    parts = {f"{path.parent.name}/{path.name}": kapture_from_dir(str(path)) for path in result}
    assert len(parts) >= 3
    return request.param, parts


@pytest.mark.slow
def test_against_kaptures_importer(
    root: Path, theirs: tuple[str, dict[str, kapture.Kapture]], tmp_path: Path
) -> None:
    version, parts = theirs
    options = RobotCarOptions(version=1 if version == "v1" else 2, train_as_map=version == "v2")
    write_official(RobotCar(options).read(root), tmp_path / "out")
    groups = read_side_tables(tmp_path / "out/megloc").groups
    for role in ("mapping", "query"):
        ours = kapture_from_dir(str(tmp_path / "out" / role))
        own_poses = poses_by_image(ours) if role == "mapping" else {}
        records = {}
        for place, part in ((name[:2], part) for name, part in parts.items() if role in name):
            posed = poses_by_image(part) if role == "mapping" else {}
            assert_equal_poses({name: own_poses[name] for name in posed}, posed)
            for timestamp, sensor, name in kapture.flatten(part.records_camera):
                # it records left and right training images as map images, without poses
                if role == "query" or name in posed:
                    records[name] = (timestamp, sensor)
                    assert groups[name].location == f"0{place}/{sensor}"
            for rig, sensor in part.rigs.key_pairs():
                theirs_to_ours = part.rigs[rig, sensor], ours.rigs[rig, sensor]
                assert world_pose_transform_distance(*theirs_to_ours)[0] < MAX_M
            for name, sensor in part.sensors.items():
                # it takes the size of the official images for granted
                params = [float(text) for text in sensor.sensor_params[3:]]
                assert params == [float(text) for text in ours.sensors[name].sensor_params[3:]]
        assert {n: (t, s) for t, s, n in kapture.flatten(ours.records_camera)} == records


def test_layout_has_the_quirks_of_the_original(root: Path, imported: Callable[[str], Path]) -> None:
    first, second = sorted((root / "3D-models/individual/queries_per_location").iterdir())
    assert first.read_bytes().endswith(b".jpg\n\n") and b"\r" not in first.read_bytes()
    assert second.read_bytes().endswith(b".jpg\r\n")
    on_disk = len(list(root.glob("images/overcast-reference/*/*.jpg")))
    assert on_disk == 18  # two more than are in the models
    test_list = (root / "robotcar_v2_test.txt").read_text().split()
    train_list = (root / "robotcar_v2_train.txt").read_text().splitlines()
    assert all(name.startswith("rear/") and name.endswith(".png") for name in test_list)
    assert all("/rear/" in row.split()[0] and len(row.split()) == 17 for row in train_list)
    # the last moments of the rain are in neither
    assert len(test_list) + len(train_list) == 12 - 2
    tables = read_side_tables(imported("robotcar") / "megloc")
    assert list(tables.names.values()) == test_list
    scored = {name for name, group in tables.groups.items() if group.scored}
    assert len(scored) == 10 and tables.names.keys() < scored
    assert all("/rear/" in name for name in scored)
    for path in root.glob("images/*/*/*.jpg"):
        assert int(path.stem) > 1 << 32
        assert image_size(path) == (96, 96)
    assert (root / "intrinsics/rear_intrinsics.txt").read_text().startswith("fx 57.600000\n")
