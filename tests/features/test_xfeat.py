"""XFeat with the published weights: against kornia's extractor, and where keypoints are."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from images import Image
from kornia.feature.xfeat import XFeat as KorniaXFeat

from megloc_kapture.features.xfeat import XFeat, XFeatOptions
from megloc_kapture.io.weights import find_weights, read_weights

ALL = 100_000


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "xfeat" / "xfeat.onnx")


def extractor(weights: str, **options: object) -> XFeat:
    given = {"weights": weights, "max_keypoints": ALL, "device": "cpu", **options}
    return XFeat(XFeatOptions.model_validate(given))


def test_keypoints_scores_and_descriptors_are_kornias(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[:512, :640])
    theirs = KorniaXFeat(top_k=ALL).eval()
    theirs.net.load_state_dict(read_weights(find_weights(weights)), strict=False)
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    expected = {key: value.numpy() for key, value in theirs.detectAndCompute(tensor)[0].items()}
    found = extractor(weights).extract(image)

    # theirs has the first pixel's centre at (0, 0), and none on the two pixels of the rim
    xy = expected["keypoints"] + np.float32(0.5)
    order = np.lexsort(xy.T)
    ours = np.lexsort(found.keypoints_px[:, :2].T)
    inner = (found.keypoints_px[ours, :2] > 2).all(axis=1)
    ours = ours[inner & (found.keypoints_px[ours, :2] < (638, 510)).all(axis=1)]
    np.testing.assert_array_equal(found.keypoints_px[ours, :2], xy[order])
    np.testing.assert_allclose(found.scores[ours], expected["scores"][order], atol=1e-5)
    # bicubic sampling of a map with steep edges: 1e-4
    np.testing.assert_allclose(found.descriptors[ours], expected["descriptors"][order], atol=5e-4)


@pytest.mark.parametrize(("x", "y"), [(200, 300), (600, 200), (900, 600)])
def test_keypoints_of_an_image_that_is_resized_are_where_they_are(
    weights: str, photograph: Image, x: int, y: int
) -> None:
    """OpenCV enlarges as COLMAP counts, by 47 %; XFeat makes multiples of 32 of it again."""
    small = np.ascontiguousarray(photograph[y : y + 64, x : x + 64])
    large = cv2.resize(small, (94, 94), interpolation=cv2.INTER_LINEAR)
    a = extractor(weights).extract(small).keypoints_px[:, :2]
    b = extractor(weights).extract(np.asarray(large, np.uint8)).keypoints_px[:, :2] * 64 / 94
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    found = distance.min(axis=1) < 1.5
    assert found.sum() > 20
    offset = (b[distance.argmin(axis=1)] - a)[found]
    # without the half pixel of the resizing, (1 - 64 / 94) / 2 = 0.16, a median would be off too
    assert np.abs(np.median(offset, axis=0)).max() < 1e-3
    assert np.abs(offset.mean(axis=0)).max() < 0.12


def test_the_threshold_and_the_window_of_suppression(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[:256, :320])
    default = extractor(weights).extract(image)
    strict = extractor(weights, threshold=0.4).extract(image)
    assert 0 < len(strict.scores) < len(default.scores)
    assert {*map(tuple, strict.keypoints_px)} <= {*map(tuple, default.keypoints_px)}
    gap = np.abs(default.keypoints_px[:, None, :2] - default.keypoints_px[:, :2]).max(axis=2)
    assert gap[~np.eye(len(gap), dtype=bool)].min() > 2
