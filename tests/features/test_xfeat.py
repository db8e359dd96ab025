"""XFeat with the published weights: against kornia's extractor, and where keypoints are."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from kornia.feature.xfeat import XFeat as KorniaXFeat
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features.xfeat import XFeat, XFeatOptions
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.values import LocalFeatures

Image = NDArray[np.uint8]
ALL = 100_000


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "xfeat" / "xfeat.onnx")


@pytest.fixture(scope="module")
def photograph(shared_data: Path) -> Image:
    folder = shared_data / "scenes" / "fountain_p11" / "mapping" / "sensors" / "records_data"
    return read_image_rgb(folder / "0003.jpg")


def extractor(weights: str, max_keypoints: int = 1500, **options: float) -> XFeat:
    return XFeat(
        XFeatOptions(weights=weights, max_keypoints=max_keypoints, device="cpu", **options)  # type: ignore[arg-type]
    )


def assert_same(a: LocalFeatures, b: LocalFeatures) -> None:
    np.testing.assert_array_equal(a.keypoints_px, b.keypoints_px)
    np.testing.assert_array_equal(a.scores, b.scores)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)


# ------------------------------------------------------------------ against kornia's


def test_keypoints_scores_and_descriptors_are_kornias(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[:512, :640])
    theirs = KorniaXFeat(top_k=ALL).eval()
    theirs.net.load_state_dict(read_weights(find_weights(weights)), strict=False)
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    expected = {key: value.numpy() for key, value in theirs.detectAndCompute(tensor)[0].items()}
    found = extractor(weights, ALL).extract(image)

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


# ------------------------------------------------------------------ where keypoints are


@pytest.mark.parametrize(("x", "y"), [(200, 300), (600, 200), (900, 600)])
def test_keypoints_of_an_image_that_is_resized_are_where_they_are(
    weights: str, photograph: Image, x: int, y: int
) -> None:
    """OpenCV enlarges as COLMAP counts, by 47 %; XFeat makes multiples of 32 of it again."""
    small = np.ascontiguousarray(photograph[y : y + 64, x : x + 64])
    large = cv2.resize(small, (94, 94), interpolation=cv2.INTER_LINEAR)
    a = extractor(weights, ALL).extract(small).keypoints_px[:, :2]
    b = extractor(weights, ALL).extract(np.asarray(large, np.uint8)).keypoints_px[:, :2] * 64 / 94
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    found = distance.min(axis=1) < 1.5
    assert found.sum() > 20
    offset = (b[distance.argmin(axis=1)] - a)[found]
    # without the half pixel of the resizing, (1 - 64 / 94) / 2 = 0.16, a median would be off too
    assert np.abs(np.median(offset, axis=0)).max() < 1e-3
    assert np.abs(offset.mean(axis=0)).max() < 0.12


def test_a_shifted_image_has_shifted_keypoints(weights: str, photograph: Image) -> None:
    # by multiples of 8: each cell of 8 by 8 pixels has keypoints of its own
    dx, dy = 16, 8
    first = np.ascontiguousarray(photograph[:480, :640])
    second = np.ascontiguousarray(photograph[dy : 480 + dy, dx : 640 + dx])
    a = extractor(weights, ALL).extract(first).keypoints_px[:, :2]
    b = extractor(weights, ALL).extract(second).keypoints_px[:, :2] + np.float32([dx, dy])
    both = np.concatenate([a, b])
    inner = (both >= (dx, dy)).all(axis=1) & (both <= (640, 480)).all(axis=1)
    _, count = np.unique(both[inner], axis=0, return_counts=True)
    # the normalisation is of the whole image, so a few differ
    assert (count == 2).mean() > 0.95


# ------------------------------------------------------------------ the protocol


def test_sorted_with_the_score_as_third_column(weights: str, photograph: Image) -> None:
    found = extractor(weights, 1500).extract(photograph)
    assert found.keypoints_px.shape == (1500, 3) and found.keypoints_px.dtype == np.float32
    assert found.descriptors.shape == (1500, 64) and found.descriptors.dtype == np.float32
    np.testing.assert_array_equal(found.keypoints_px[:, 2], found.scores)
    assert (np.diff(found.scores) <= 0).all() and found.num_masked == 0
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, rtol=1e-5)
    height, width = photograph.shape[:2]
    xy = found.keypoints_px[:, :2]
    assert (xy > 0).all() and (xy < (width, height)).all()
    assert_same(found, extractor(weights, 1500).extract(photograph))


def test_the_mask_comes_before_the_limit(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[100:500, 200:830])  # is resized
    mask = np.ones(image.shape[:2], bool)
    mask[:, 300:] = False
    whole = extractor(weights, ALL).extract(image)
    allowed = whole.keypoints_px[:, 0] < 300
    found = extractor(weights, 200).extract(image, mask)
    np.testing.assert_array_equal(found.keypoints_px, whole.keypoints_px[allowed][:200])
    np.testing.assert_allclose(found.descriptors, whole.descriptors[allowed][:200], atol=1e-6)
    assert found.num_masked == (~allowed).sum() > 100
    nothing = extractor(weights).extract(image, np.zeros_like(mask))
    assert nothing.descriptors.shape == (0, 64) and nothing.num_masked == len(whole.scores)


def test_the_threshold_and_the_window_of_suppression(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[:256, :320])
    default = extractor(weights, ALL).extract(image)
    strict = extractor(weights, ALL, threshold=0.4).extract(image)
    assert 0 < len(strict.scores) < len(default.scores)
    assert {*map(tuple, strict.keypoints_px)} <= {*map(tuple, default.keypoints_px)}
    gap = np.abs(default.keypoints_px[:, None, :2] - default.keypoints_px[:, :2]).max(axis=2)
    assert gap[~np.eye(len(gap), dtype=bool)].min() > 2


@pytest.mark.parametrize("size", [(20, 31), (33, 100)])
def test_small_and_flat_images(weights: str, photograph: Image, size: tuple[int, int]) -> None:
    small = np.ascontiguousarray(photograph[300 : 300 + size[0], 600 : 600 + size[1]])
    for image in (small, np.full_like(small, 90)):
        found = extractor(weights).extract(image)
        assert np.isfinite(found.descriptors).all() and np.isfinite(found.keypoints_px).all()
        assert (found.keypoints_px[:, :2] < size[::-1]).all()


def test_in_half_precision_keypoints_are_whole_pixels(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[:256, :320])
    found = extractor(weights, half_precision=True).extract(image)
    assert found.keypoints_px.dtype == np.float32 and found.descriptors.dtype == np.float32
    assert (found.keypoints_px[:, :2] % 1 == 0.5).all()
    exact = {*map(tuple, extractor(weights).extract(image).keypoints_px[:, :2])}
    assert len(exact & {*map(tuple, found.keypoints_px[:, :2])}) > 0.5 * len(exact)


def test_it_travels_and_names_its_weights(weights: str, photograph: Image) -> None:
    one = extractor(weights)
    image = np.ascontiguousarray(photograph[:128, :128])
    one.extract(image)
    other = pickle.loads(pickle.dumps(one))
    assert len(pickle.dumps(one)) < 10_000
    assert_same(one.extract(image), other.extract(image))
    (name, digest), *more = one.weights().items()
    assert name == "xfeat.onnx" and len(digest) == 64 and not more


def test_a_file_of_another_network_is_refused(shared_data: Path, photograph: Image) -> None:
    other = shared_data / "weights" / "aliked" / "aliked-t16.pth"
    with pytest.raises(DataError, match=r"aliked-t16\.pth: .*does not fit XFeatNetwork"):
        extractor(str(other)).extract(np.ascontiguousarray(photograph[:64, :64]))
