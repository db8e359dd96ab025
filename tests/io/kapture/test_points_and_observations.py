"""3D points, their covariances and observations: round trips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.io.colmap import load_pycolmap
from megloc_kapture.io.kapture import points, write_ply
from megloc_kapture.io.kapture.points import (
    COVARIANCES_FILE,
    Observations,
    read_observations,
    read_point_covariances,
    read_points3d,
    write_observations,
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


# -------------------------------------------------------------------------------- observations


def plain(observations: dict[str, Observations]) -> dict[str, list[tuple[int, str, int]]]:
    """Observations as rows of point, image and keypoint."""
    rows = {}
    for keypoints_type, of_type in observations.items():
        assert of_type.keypoints_type == keypoints_type
        assert list(of_type.image_names) == sorted(set(of_type.image_names))
        ids = (of_type.point_ids, of_type.image_ids, of_type.keypoint_ids)
        assert tuple(array.dtype for array in ids) == (np.int64, np.int32, np.int32)
        rows[keypoints_type] = [
            (point, of_type.image_names[image], keypoint)
            for point, image, keypoint in zip(*(array.tolist() for array in ids), strict=True)
        ]
        assert {image for _, image, _ in rows[keypoints_type]} == set(of_type.image_names)
    return rows


def random_observations(count: int, keypoints_type: str = "T 1") -> Observations:
    names = tuple(sorted(f"séquence {i % 3}/{'x' * (i % 40)}{i}.jpg" for i in range(50)))
    return Observations(
        keypoints_type,
        names,
        np.sort(RNG.integers(0, count, count)),
        np.r_[np.arange(50), RNG.integers(0, 50, count - 50)].astype(np.int32),
        np.r_[RNG.integers(0, 2**31, count - 1), 2**31 - 1].astype(np.int32),
    )


def test_observations_read_back_equal_across_borders_of_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(points, "_BLOCK_CHARACTERS", 500)
    written = {name: random_observations(500, name) for name in ("T 1", "sift")}
    write_observations(tmp_path, written)
    path = tmp_path / "reconstruction/observations.txt"
    read = read_observations(path)
    assert list(read) == ["T 1", "sift"]
    assert plain(read) == plain(written)
