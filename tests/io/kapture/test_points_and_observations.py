"""3D points and their covariances; test_interop.py has the observations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.io.colmap import load_pycolmap
from megloc_kapture.io.kapture.points import (
    COVARIANCES_FILE,
    read_point_covariances,
    read_points3d,
    write_ply,
    write_point_covariances,
    write_points3d,
)

VERSION = "# kapture format: 1.1\n"
POINTS = VERSION + "# X, Y, Z, R, G, B\n"
RNG = np.random.default_rng(0)


def file(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# -------------------------------------------------------------------------------------- points


@pytest.mark.parametrize("columns", [3, 6])
def test_points_read_back_with_every_digit(tmp_path: Path, columns: int) -> None:
    bits = RNG.integers(0, 2**63, (200, columns)).view(np.float64)
    points = np.where(np.isfinite(bits), bits, 1 / 3)
    write_points3d(tmp_path, points)
    read = read_points3d(tmp_path / "reconstruction/points3d.txt")
    assert read.shape == (200, 6) and read.dtype == np.float64
    assert np.array_equal(read[:, :columns], points)
    assert not read[:, columns:].any()


@pytest.mark.parametrize("content", ["", POINTS + "\n\n# only comments"])
def test_a_file_without_rows_has_no_points(tmp_path: Path, content: str) -> None:
    read = read_points3d(file(tmp_path / "p.txt", content))
    assert read.shape == (0, 6)


def test_covariances_read_back_and_are_read_only(tmp_path: Path) -> None:
    assert read_point_covariances(tmp_path, 3) is None
    values = np.arange(18.0).reshape(3, 6)
    values[1] = np.nan
    write_point_covariances(tmp_path, values)
    actual = read_point_covariances(tmp_path, 3)
    assert actual is not None and not actual.flags.writeable
    np.testing.assert_array_equal(actual, values)
    np.testing.assert_array_equal(np.load(tmp_path / COVARIANCES_FILE), values)


# ---------------------------------------------------------------------------------------------- PLY

XYZ = np.random.default_rng(0).normal(size=(20, 3))
COLOURS = np.random.default_rng(1).integers(0, 256, (20, 3)).astype(np.uint8)


def test_colmap_reads_the_ply(tmp_path: Path) -> None:
    pycolmap = load_pycolmap()
    write_ply(tmp_path / "points.ply", XYZ, COLOURS, deviation=np.arange(20))
    reconstruction = pycolmap.Reconstruction()
    reconstruction.import_PLY(str(tmp_path / "points.ply"))
    points = [reconstruction.points3D[number] for number in sorted(reconstruction.points3D)]
    # COLMAP keeps them in single precision
    np.testing.assert_allclose([point.xyz for point in points], XYZ, rtol=1e-6)
    np.testing.assert_array_equal([point.color for point in points], COLOURS)
