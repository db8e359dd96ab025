"""Descriptors of a map that came without are extracted again."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.io.images import write_image
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.local_types import extract_again


@pytest.fixture
def stripped(map_copy: Path) -> KaptureMap:
    """Our map, of 800 keypoints an image, without its descriptors."""
    shutil.rmtree(map_copy / "reconstruction" / "descriptors")
    return KaptureMap.open(map_copy)


def again(opened: KaptureMap, **options: float) -> dict[str, np.ndarray]:
    """The descriptors of the map's only type, by an extractor of these options."""
    extractor = RootSift(RootSiftOptions(**options))  # type: ignore[arg-type]
    return extract_again(opened, opened.keypoints["rootsift"], extractor)


@pytest.mark.parametrize("number", [800, 400])
def test_what_is_found_again_has_the_descriptors_it_had(
    workspace: Path, stripped: KaptureMap, number: int
) -> None:
    original = KaptureMap.open(workspace / "map")
    found = again(stripped, max_keypoints=number)
    assert sorted(found) == original.images
    for image, descriptors in found.items():
        known = descriptors.any(axis=1)
        assert 0.75 * number < known.sum() <= number
        stored = original.keypoints["rootsift"].descriptors(image)
        np.testing.assert_array_equal(descriptors[known], stored[known])
        assert number < 800 or known.all()


def test_a_map_of_another_extractor_or_without_images_is_refused(stripped: KaptureMap) -> None:
    with pytest.raises(DataError, match=r"finds only \d+ of \d+ observed keypoints"):
        again(stripped, contrast_threshold=0.2)
    (stripped.folder.root / "sensors" / "records_data").unlink()
    with pytest.raises(DataError, match="no descriptors of type 'rootsift', and no images"):
        again(KaptureMap.open(stripped.folder.root))


@pytest.mark.slow
def test_masks_are_used_as_they_were(stripped: KaptureMap) -> None:
    root = stripped.folder.root
    for image in stripped.images:
        write_image(root / "sensors" / "masks" / f"{image}.png", np.zeros((300, 400), np.uint8))
    with pytest.raises(DataError, match=r"finds only 0 of \d+ observed keypoints"):
        again(KaptureMap.open(root), max_keypoints=800)
