"""Descriptors of a map that came without: extracted again, and joined to its keypoints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.plugins import LocalFeatureExtractor
from megloc_kapture.stages.found_again import rows_found_again
from megloc_kapture.stages.local_features import checked_features, read_image_of, read_mask

_MIN_FOUND_AGAIN = 0.5


def extract_again(
    kapture_map: KaptureMap, extractor: LocalFeatureExtractor
) -> dict[str, NDArray[Any]]:
    """Descriptors of every map image, one row per stored keypoint; zero where it is not found.

    Raises
    ------
    DataError : an image is missing, or most observed keypoints are not found again: then the map
        was made with another extractor or other options.
    """
    if not kapture_map.has_images():
        raise DataError(
            f"the map has no descriptors of type {kapture_map.local_type!r}, and no images to "
            "extract them from again",
            path=kapture_map.folder.root,
        )
    found: dict[str, NDArray[Any]] = {}
    again = observed = 0
    folder = kapture_map.folder
    for image in kapture_map.images:
        pixels = read_image_of(folder.image_path(image), folder.read().camera_of(image))
        mask = read_mask(folder.root / "sensors" / "masks" / f"{image}.png", pixels.shape[:2])
        features = checked_features(extractor, extractor.extract(pixels, mask), image)
        stored = kapture_map.keypoints_px(image)
        rows = rows_found_again(stored[:, :2], features.keypoints_px[:, :2])
        descriptors = np.zeros((len(stored), features.descriptors.shape[1]), np.float32)
        hit = rows >= 0
        descriptors[hit] = features.descriptors[rows[hit]]
        found[image] = descriptors
        seen, _ = kapture_map.index.observed(image)
        again += int(hit[seen].sum())
        observed += len(seen)
    if again < _MIN_FOUND_AGAIN * observed:
        raise DataError(
            f"the map has no descriptors, and extracting {extractor.name} again finds only "
            f"{again} of {observed} observed keypoints: it was made with other options",
            path=kapture_map.folder.root,
        )
    return found
