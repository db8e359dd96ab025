"""Local features as a stage: stored features, masks and rejected inputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.values import Camera, LocalFeatures

Image = NDArray[np.uint8]
EXTRACTOR = RootSift(RootSiftOptions(max_keypoints=800))


def noise(height: int = 120, width: int = 160, seed: int = 0) -> Image:
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3))
    return np.repeat(np.repeat(coarse, 8, axis=0), 8, axis=1).astype(np.uint8)


def test_masks_with_a_margin_remove_keypoints(small_kapture: Any, tmp_path: Path) -> None:
    folder = small_kapture({"a.png": noise(), "b.png": noise()})
    mask = np.zeros((120, 160, 3), dtype=np.uint8)
    mask[:, 80:] = 255
    write_image(folder.root / "sensors" / "masks" / "a.png.png", mask)
    output = tmp_path / "features"
    counts = extract_local_features([folder], EXTRACTOR, output)
    found = KaptureFolder(folder.root, features_dirs=[output]).keypoints("rootsift")
    masked, free = found.read("a.png"), found.read("b.png")
    assert len(masked) > 10 and masked[:, 0].min() >= 80
    assert free[:, 0].min() < 40
    unmasked = EXTRACTOR.extract(read_image_rgb(folder.image_path("a.png"))).keypoints_px
    removed = int((unmasked[:, 0] < 80).sum())
    assert removed > 10
    assert (counts["images_with_mask"], counts["keypoints_masked"]) == (1, removed)
    extract_local_features([folder], EXTRACTOR, tmp_path / "margin", mask_margin_px=10)
    strict = KaptureFolder(folder.root, features_dirs=[tmp_path / "margin"]).keypoints("rootsift")
    near = masked[:, 0] < 90
    assert near.any()
    np.testing.assert_array_equal(strict.read("a.png"), masked[~near])


def test_damaged_inputs_are_refused(small_kapture: Any, tmp_path: Path) -> None:
    def refused(message: str, *folders: KaptureFolder) -> DataError:
        with pytest.raises(DataError, match=message) as caught:
            extract_local_features(folders, EXTRACTOR, tmp_path / "features")
        assert not (tmp_path / "features").exists()
        return caught.value

    folder = small_kapture({"a.png": noise()})
    other = small_kapture({"a.png": noise()}, name="other")
    refused(r"image a\.png is in two kapture folders", folder, other)
    mask = folder.root / "sensors" / "masks" / "a.png.png"
    write_image(mask, np.zeros((60, 80, 3), dtype=np.uint8))
    assert refused("mask is 80x60, its image 160x120", folder).path == mask
    mask.unlink()
    folder.image_path("a.png").unlink()
    refused(r"a\.png", folder)
    camera = Camera("SIMPLE_PINHOLE", 320, 240, (300.0, 160.0, 120.0))
    larger = small_kapture({"a.png": noise()}, name="larger", camera=camera)
    refused(r"a.png: the image is 160x120, its camera says 320x240", larger)


def test_images_without_features_are_stored(small_kapture: Any, tmp_path: Path) -> None:
    folder = small_kapture({"a.png": noise(), "gray.png": np.full((120, 160, 3), 90, np.uint8)})
    extract_local_features([folder], EXTRACTOR, tmp_path / "features")
    assert folder.keypoints("rootsift").read("gray.png").shape == (0, 2)
    assert folder.descriptors("rootsift").read("gray.png").shape == (0, 128)
    assert folder.keypoints("rootsift").length("a.png") > 0


class Inconsistent:
    """An extractor that returns fewer descriptors than keypoints."""

    name = "inconsistent"

    def extract(self, image: Image, mask: NDArray[np.bool_] | None = None) -> LocalFeatures:
        keypoints_px, descriptors = np.ones((3, 2), np.float32), np.ones((2, 4), np.float32)
        return LocalFeatures(keypoints_px, np.ones(3, np.float32), descriptors)


def test_wrong_features_of_a_plugin_are_refused(small_kapture: Any, tmp_path: Path) -> None:
    folder = small_kapture({"a.png": noise()})
    message = r"'inconsistent' on image a\.png: .*got float32 \(2, 4\), expected .*3, N"
    with pytest.raises(PluginError, match=message):
        extract_local_features([folder], Inconsistent(), tmp_path / "features")
