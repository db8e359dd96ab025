"""Blocks of global features: unit rows of what is read image by image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import FeatureConfig, FeatureReader, FeatureWriter, KaptureVectors

FOLDER = Path("reconstruction/global_features/G")
NAMES = [f"{k % 3}/{k:03d}.jpg" for k in range(300)]


def write(root: Path, rows: NDArray[np.float64]) -> FeatureReader:
    config = FeatureConfig("g", rows.dtype, rows.shape[1], None, "L2")
    with FeatureWriter(root, "global_features", "G", config) as writer:
        for name, row in zip(NAMES, rows, strict=False):
            writer.write(name, row)
    return FeatureReader("global_features", "G", [root / FOLDER])


@pytest.mark.parametrize("dtype", ["float32", "float64", "int32", "uint8"])
def test_rows_are_those_read_one_by_one(tmp_path: Path, dtype: str) -> None:
    rows = np.abs(np.random.default_rng(0).normal(0, 50, (len(NAMES), 5))).astype(dtype)
    features = write(tmp_path, rows)
    images = [NAMES[k] for k in np.random.default_rng(1).permutation(len(NAMES))] + NAMES[:1]
    expected = np.array([features.read(image) for image in images], dtype=np.float32)
    unit = expected / np.linalg.norm(expected, axis=1)[:, None]
    blocks = KaptureVectors(features, images)
    assert len(blocks) == len(images) and blocks.dimension == 5
    np.testing.assert_allclose(blocks.read(0, len(images)), unit, atol=1e-6)
    np.testing.assert_allclose(blocks.read(3, 12), unit[3:12], atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_images_without_a_usable_vector_are_named(tmp_path: Path, bad: float) -> None:
    rows = np.ones((3, 5))
    rows[1, 2] = bad
    features = write(tmp_path, rows)
    with pytest.raises(DataError, match=rf"{NAMES[1]}.* not all values are finite"):
        KaptureVectors(features, NAMES[:3]).read(0, 3)
    with pytest.raises(DataError, match=r"no global_features of type 'G' for image 'no\.jpg'"):
        KaptureVectors(features, ["no.jpg"]).read(0, 1)
    (tmp_path / FOLDER / f"{NAMES[0]}.gfeat").write_bytes(bytes(39))
    with pytest.raises(DataError, match=rf"{NAMES[0]}\.gfeat: 39 bytes are not exactly"):
        KaptureVectors(features, NAMES[:1]).read(0, 1)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-12, 1.0, 1e12, 1e37])
def test_unit_length_whatever_the_length_was(tmp_path: Path, scale: float) -> None:
    rows = np.array([[3, 4], [0, 0], [1, 0]]) * scale
    found = KaptureVectors(write(tmp_path, rows.astype(np.float32)), NAMES[:3]).read(0, 3)
    expected = [[0.6, 0.8], [0, 0], [1, 0]] if scale else np.zeros((3, 2))
    np.testing.assert_allclose(found, expected, atol=1e-6)
