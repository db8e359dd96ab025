"""PLY files: COLMAP reads them, and no digit of a world frame is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.io.ply import write_ply

XYZ = np.random.default_rng(0).normal(size=(100, 3))
COLOURS = np.random.default_rng(1).integers(0, 256, (100, 3)).astype(np.uint8)


def test_colmap_reads_what_was_written(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_ply(tmp_path / "points.ply", XYZ, COLOURS, deviation=np.arange(100))
    reconstruction = pycolmap.Reconstruction()
    reconstruction.import_PLY(str(tmp_path / "points.ply"))
    points = [reconstruction.points3D[number] for number in sorted(reconstruction.points3D)]
    # COLMAP keeps them in single precision
    np.testing.assert_allclose([point.xyz for point in points], XYZ, rtol=1e-6)
    np.testing.assert_array_equal([point.color for point in points], COLOURS)


def test_points_far_from_the_origin_keep_their_digits(tmp_path: Path) -> None:
    far = XYZ + [4.2e6, 6.6e5, 4.7e6]
    write_ply(tmp_path / "points.ply", far, COLOURS, deviation=np.arange(100), kept=np.ones(100))
    header, _, body = (tmp_path / "points.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[1:] for line in header.decode().splitlines() if "property" in line]
    assert names == [
        *(["double", axis] for axis in "xyz"),
        *(["uchar", colour] for colour in ("red", "green", "blue")),
        ["float", "deviation"],
        ["float", "kept"],
    ]
    rows = np.frombuffer(body, np.dtype("<f8, <f8, <f8, u1, u1, u1, <f4, <f4"))
    np.testing.assert_array_equal(np.stack([rows[f"f{k}"] for k in range(3)], axis=1), far)
    np.testing.assert_array_equal(rows["f6"], np.arange(100))


def test_no_point_is_a_file_as_well(tmp_path: Path) -> None:
    write_ply(tmp_path / "points.ply", np.zeros((0, 3)), np.zeros((0, 3)))
    assert b"element vertex 0\n" in (tmp_path / "points.ply").read_bytes()


def test_different_lengths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="differ in length"):
        write_ply(tmp_path / "points.ply", XYZ, COLOURS, deviation=[1.0])
    assert not (tmp_path / "points.ply").exists()
