"""kapture's own console tools read what we write."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir
from kloc import kapture_tool

from megloc_kapture.io.kapture import KaptureFolder

pytestmark = pytest.mark.slow


def read_pose_file(path: Path) -> dict[str, np.ndarray]:
    """``name qw qx qy qz tx ty tz`` per line; quaternions with w not negative."""
    poses = {}
    for name, *numbers in map(str.split, path.read_text().splitlines()):
        poses[name] = np.array(numbers, dtype=np.float64)
        poses[name][:4] *= math.copysign(1.0, poses[name][0])
    return poses


def test_kaptures_pose_file_equals_ours(fountain_workspace: Path, tmp_path: Path) -> None:
    exported = tmp_path / "exported.txt"
    localized = fountain_workspace / "localized"
    kapture_tool("kapture_export_LTVL2020", "-i", localized, "-o", exported, "--full_file_name")
    ours = next((fountain_workspace / "submissions").glob("*.txt"))
    expected, result = read_pose_file(exported), read_pose_file(ours)
    assert len(expected) == 4
    assert result.keys() == expected.keys()
    for name, pose in result.items():
        np.testing.assert_allclose(pose, expected[name], rtol=0, atol=1e-9)


def test_kaptures_colmap_export_reads_our_map(fountain_workspace: Path, tmp_path: Path) -> None:
    ours = fountain_workspace / "map"
    database, model = tmp_path / "colmap.db", tmp_path / "model"
    kapture_tool(
        "kapture_export_colmap", "-i", ours, "-db", database, "-txt", model, "-kpt", "rootsift"
    )
    lines = (model / "points3D.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    points = KaptureFolder(ours).points3d()
    assert len(rows) == len(points) > 500
    exported = np.array([row[1:4] for row in rows], dtype=np.float64)
    order = np.argsort([int(row[0]) for row in rows])
    np.testing.assert_allclose(exported[order], points[:, :3], atol=1e-6)
    observed = sum((len(row) - 8) // 2 for row in rows)
    assert observed == len(KaptureFolder(ours).observations()["rootsift"].point_ids)


def test_kapture_reads_the_whole_workspace(fountain_workspace: Path) -> None:
    for part, images in (("mapping", 7), ("query", 4), ("map", 7), ("localized", 4)):
        data = kapture_from_dir(str(fountain_workspace / part))
        assert len(data.records_camera.data_list()) == images, part
