"""Descriptors of a map that came without: extracted again, and joined to its keypoints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.errors import DataError
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.plugins import LocalFeatureExtractor
from megloc_kapture.stages.local_features import checked_features, read_image_of, read_mask

# a keypoint that is found again is found at the same place but for rounding
_SAME_PLACE_PX = 0.1
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
        rows = rows_found_again(stored, features.keypoints_px[:, :2])
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


def rows_found_again(
    stored: NDArray[np.float32], extracted: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Row of ``extracted`` (M, 2) for each row of ``stored`` (N, 2), -1 where there is none.

    Several keypoints may stand at one place with different orientations; they are joined in the
    order both have them.
    """
    if len(stored) == len(extracted) and np.allclose(stored, extracted, atol=1e-3):
        return np.arange(len(stored), dtype=np.int64)
    rows = np.full(len(stored), -1, dtype=np.int64)
    if len(extracted) == 0:
        return rows
    near = cKDTree(extracted).query_ball_point(stored, _SAME_PLACE_PX, return_sorted=True)
    used: set[int] = set()
    for row, candidates in enumerate(near):
        for candidate in candidates:
            if candidate not in used:
                used.add(candidate)
                rows[row] = candidate
                break
    return rows
