"""Blocks of global features: unit rows of the vectors of each image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import FeatureConfig, FeatureReader, FeatureWriter
from megloc_kapture.io.kapture.features import KaptureVectors

FOLDER = Path("reconstruction/global_features/G")
NAMES = [f"{k % 3}/{k:03d}.jpg" for k in range(40)]


def write(root: Path, rows: NDArray[np.floating]) -> FeatureReader:
    config = FeatureConfig("g", rows.dtype, rows.shape[1], None, "L2")
    writer = FeatureWriter(root, "global_features", "G", config)
    for name, row in zip(NAMES, rows, strict=False):
        writer.write(name, row)
    return FeatureReader("global_features", "G", [root / FOLDER])


def test_blocks_hold_unit_rows_in_the_order_of_the_images(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(0, 50, (len(NAMES), 5))
    features = write(tmp_path, rows)
    images = [NAMES[k] for k in np.random.default_rng(1).permutation(len(NAMES))] + NAMES[:1]
    expected = np.array([features.read(image) for image in images], dtype=np.float32)
    unit = expected / np.linalg.norm(expected, axis=1)[:, None]
    blocks = KaptureVectors(features, images)
    assert blocks.shape == (len(images), 5)
    np.testing.assert_allclose(blocks[:], unit, atol=1e-6)
    np.testing.assert_allclose(blocks[3:12], unit[3:12], atol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1.0, 1e37])
def test_rows_have_unit_length_at_any_scale(tmp_path: Path, scale: float) -> None:
    rows = np.array([[3, 4], [0, 0], [1, 0]]) * scale
    read = KaptureVectors(write(tmp_path, rows.astype(np.float32)), NAMES[:3])[:3]
    expected = [[0.6, 0.8], [0, 0], [1, 0]] if scale else np.zeros((3, 2))
    np.testing.assert_allclose(read, expected, atol=1e-6)


def test_images_without_a_usable_vector_are_named(tmp_path: Path) -> None:
    rows = np.ones((3, 5))
    rows[1, 2] = np.nan
    features = write(tmp_path, rows)
    with pytest.raises(DataError, match=rf"{NAMES[1]}.* not all values are finite"):
        KaptureVectors(features, NAMES[:3])[:3]
    with pytest.raises(DataError, match=r"no global_features of type 'G' for image 'no\.jpg'"):
        KaptureVectors(features, ["no.jpg"])[:1]
