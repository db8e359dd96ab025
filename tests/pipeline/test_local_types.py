"""Descriptors of a map that came without are extracted again."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.io.images import write_image
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.local_types import extract_again


@pytest.fixture
def stripped(map_copy: Path) -> Path:
    """Our map without its descriptors."""
    shutil.rmtree(map_copy / "reconstruction" / "descriptors")
    return map_copy


def again(opened: KaptureMap, extractor: RootSift) -> dict[str, NDArray[Any]]:
    """The descriptors of the map's only type."""
    return extract_again(opened, opened.keypoints["rootsift"], extractor)


def test_the_same_options_give_the_same_descriptors(workspace: Path, stripped: Path) -> None:
    original = KaptureMap.open(workspace / "map")
    found = again(KaptureMap.open(stripped), RootSift(RootSiftOptions(max_keypoints=800)))
    assert sorted(found) == original.images
    for image, descriptors in found.items():
        np.testing.assert_array_equal(
            descriptors, original.keypoints["rootsift"].descriptors(image)
        )


def test_other_options_find_what_is_there(workspace: Path, stripped: Path) -> None:
    original = KaptureMap.open(workspace / "map")
    found = again(KaptureMap.open(stripped), RootSift(RootSiftOptions(max_keypoints=400)))
    for image, descriptors in found.items():
        stored = original.keypoints["rootsift"].descriptors(image)
        known = descriptors.any(axis=1)
        assert 300 < known.sum() <= 400
        np.testing.assert_array_equal(descriptors[known], stored[known])


def test_a_map_of_another_extractor_is_refused(stripped: Path) -> None:
    opened = KaptureMap.open(stripped)
    with pytest.raises(DataError, match=r"finds only \d+ of \d+ observed keypoints"):
        again(opened, RootSift(RootSiftOptions(contrast_threshold=0.2)))


def test_without_images_there_is_nothing_to_extract_from(stripped: Path) -> None:
    (stripped / "sensors" / "records_data").unlink()
    opened = KaptureMap.open(stripped)
    with pytest.raises(DataError, match="no descriptors of type 'rootsift', and no images"):
        again(opened, RootSift())


@pytest.mark.slow
def test_masks_are_used_as_they_were(stripped: Path) -> None:
    mask = np.zeros((1024, 1536), np.uint8)
    for image in KaptureMap.open(stripped).images:
        write_image(stripped / "sensors" / "masks" / f"{image}.png", mask)
    with pytest.raises(DataError, match=r"finds only 0 of \d+ observed keypoints"):
        again(KaptureMap.open(stripped), RootSift(RootSiftOptions(max_keypoints=800)))
