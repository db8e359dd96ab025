"""R2D2 with the published weights: against keypoints that kapture's authors extracted."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from megloc_kapture.errors import DataError
from megloc_kapture.features.r2d2 import R2D2, R2D2Options
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import LocalFeatures

Image = NDArray[np.uint8]
ALL = 100_000


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "r2d2" / "r2d2_WASF_N16.pt")


@pytest.fixture(scope="module")
def photograph(shared_data: Path) -> Image:
    """A part of a real image, 240 by 160."""
    folder = shared_data / "scenes" / "fountain_p11" / "mapping" / "sensors" / "records_data"
    return np.ascontiguousarray(read_image_rgb(folder / "0003.jpg")[300:460, 600:840])


@pytest.fixture(scope="module")
def whole(weights: str, photograph: Image) -> LocalFeatures:
    """All features of the photograph."""
    return extractor(weights).extract(photograph)


def extractor(weights: str, max_keypoints: int = ALL, **options: float) -> R2D2:
    chosen = {"min_size": 200, "max_size": 240} | options
    return R2D2(
        R2D2Options(weights=weights, max_keypoints=max_keypoints, device="cpu", **chosen)  # type: ignore[arg-type]
    )


def assert_same(a: LocalFeatures, b: LocalFeatures) -> None:
    np.testing.assert_array_equal(a.keypoints_px, b.keypoints_px)
    np.testing.assert_array_equal(a.scores, b.scores)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)


# ------------------------------------------------------------------ against the authors'


def test_one_level_is_what_the_authors_extracted(shared_data: Path, weights: str) -> None:
    """One level of an image of virtual_gallery, whose makers kept the best 500 of three."""
    folder = KaptureFolder(shared_data / "foreign_maps" / "virtual_gallery" / "query")
    name = folder.read().image_names()[0]
    stored = folder.keypoints("r2d2_500").read(name)
    descriptors = folder.descriptors("r2d2_500").read(name)
    coarsest = stored[:, 2] > 85
    stored, descriptors = stored[coarsest][::-1], descriptors[coarsest][::-1]  # worst came first
    assert len(stored) > 80

    options = {"min_size": 580, "max_size": 700}
    found = extractor(weights, len(stored), **options).extract(
        read_image_rgb(folder.image_path(name))
    )
    # theirs count pixels from the first one's centre on every level, ours from its corner
    ratio = np.array([1920 / 679, 1080 / 382], np.float32)
    offset = found.keypoints_px[:, None, :2] - (stored[:, :2] + ratio / 2)
    distance = np.linalg.norm(offset, axis=2)
    nearest = distance.argmin(axis=0)
    assert len(np.unique(nearest)) == len(stored)
    assert distance.min(axis=0).max() < 0.01
    cosine = (found.descriptors[nearest] * descriptors).sum(axis=1)
    assert cosine.min() > 0.999
    # in the same order, but for scores that are all but equal
    assert np.abs(nearest - np.arange(len(stored))).max() <= 2
    np.testing.assert_allclose(found.keypoints_px[:, 2], stored[0, 2], rtol=1e-3)


# ------------------------------------------------------------------ where keypoints are


def test_keypoints_of_a_level_are_where_they_are(weights: str, photograph: Image) -> None:
    """Each pixel made two by two: on the level of half the size it is the same image."""
    doubled = photograph.repeat(2, axis=0).repeat(2, axis=1)
    a = extractor(weights, max_size=250).extract(photograph)
    b = extractor(weights, min_size=230, max_size=280).extract(doubled)
    assert np.allclose(b.keypoints_px[:, 2], 2 * 32, rtol=1e-3)
    fine = a.keypoints_px[np.isclose(a.keypoints_px[:, 2], 32)]
    distance = np.linalg.norm(fine[:, None, :2] - b.keypoints_px[:, :2] / 2, axis=2)
    found = distance.min(axis=1) < 1.5
    assert found.sum() > 50
    offset = (b.keypoints_px[distance.argmin(axis=1), :2] / 2 - fine[:, :2])[found]
    # counted from the first pixel's centre on every level, it would be a quarter of a pixel
    assert np.abs(np.median(offset, axis=0)).max() < 1e-3
    assert np.abs(offset.mean(axis=0)).max() < 0.1


def test_a_shifted_image_has_shifted_keypoints(weights: str, photograph: Image) -> None:
    dx, dy = 5, 3
    first = np.ascontiguousarray(photograph[:150, :220])
    second = np.ascontiguousarray(photograph[dy : 150 + dy, dx : 220 + dx])
    options = {"min_size": 215, "max_size": 260}
    a = extractor(weights, **options).extract(first).keypoints_px[:, :2]
    b = extractor(weights, **options).extract(second).keypoints_px[:, :2] + np.float32([dx, dy])
    assert (a % 1 == 0.5).all()
    both = np.concatenate([a, b])
    # what sees nothing of either image's rim: half of the network's field of view
    inner = (both > (50, 50)).all(axis=1) & (both < (220 - 50, 150 - 50)).all(axis=1)
    _, count = np.unique(both[inner], axis=0, return_counts=True)
    assert len(count) > 10 and (count == 2).mean() > 0.95


# ------------------------------------------------------------------ the protocol


def test_sorted_with_the_scale_as_third_column(
    weights: str, photograph: Image, whole: LocalFeatures
) -> None:
    found = extractor(weights, 300).extract(photograph)
    assert found.keypoints_px.shape == (300, 3) and found.keypoints_px.dtype == np.float32
    assert found.descriptors.shape == (300, 128) and found.descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, rtol=1e-5)
    assert (np.diff(found.scores) <= 0).all()
    assert (found.scores >= 0.49).all() and (found.scores <= 1).all()
    # the levels of 240 and 202 pixels
    scales = np.unique(found.keypoints_px[:, 2])
    np.testing.assert_allclose(scales, [32, 32 * 240 / 202], rtol=1e-5)
    # and a second time to the last bit
    np.testing.assert_array_equal(found.keypoints_px, whole.keypoints_px[:300])
    np.testing.assert_array_equal(found.descriptors, whole.descriptors[:300])


@pytest.mark.parametrize(
    ("option", "value"), [("min_reliability", 0.999), ("min_repeatability", 0.8)]
)
def test_the_thresholds_are_of_both_maps(
    weights: str, photograph: Image, whole: LocalFeatures, option: str, value: float
) -> None:
    fewer = extractor(weights, **{option: value}).extract(photograph)
    assert 0 < len(fewer.scores) < len(whole.scores)
    assert {*map(tuple, fewer.keypoints_px)} < {*map(tuple, whole.keypoints_px)}


def test_the_mask_comes_before_the_limit(
    weights: str, photograph: Image, whole: LocalFeatures
) -> None:
    mask = np.ones(photograph.shape[:2], bool)
    mask[:, 150:] = False
    allowed = whole.keypoints_px[:, 0] < 150
    found = extractor(weights, 50).extract(photograph, mask)
    np.testing.assert_array_equal(found.keypoints_px, whole.keypoints_px[allowed][:50])
    np.testing.assert_array_equal(found.descriptors, whole.descriptors[allowed][:50])
    assert found.num_masked == (~allowed).sum() > 50


def test_a_mask_may_leave_nothing(weights: str, photograph: Image) -> None:
    image = photograph[:40, :60]
    found = extractor(weights).extract(image, np.zeros(image.shape[:2], bool))
    assert found.descriptors.shape == (0, 128) and found.keypoints_px.shape == (0, 3)
    assert found.num_masked > 0


def test_small_and_flat_images(weights: str, photograph: Image) -> None:
    for image in (photograph[:9, :21], np.full((40, 60, 3), 90, np.uint8)):
        found = extractor(weights).extract(np.ascontiguousarray(image))
        assert found.keypoints_px.shape == (len(found.scores), 3)
        assert np.isfinite(found.descriptors).all()


def test_in_half_precision_most_keypoints_stay(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[:100, :120])
    exact = extractor(weights).extract(image)
    found = extractor(weights, half_precision=True).extract(image)
    assert found.keypoints_px.dtype == np.float32 and found.descriptors.dtype == np.float32
    distance = np.linalg.norm(exact.keypoints_px[:, None] - found.keypoints_px, axis=2)
    assert (distance.min(axis=1) < 1.5).mean() > 0.8


def test_other_weights_make_another_type(shared_data: Path, weights: str) -> None:
    assert extractor(weights).name == "r2d2_WASF_N16"
    other = shared_data / "weights" / "r2d2" / "r2d2_WASF_N8_big.pt"
    assert extractor(str(other)).name == "r2d2_WASF_N8_big"
    assert R2D2.name == "r2d2"


def test_it_travels_and_names_its_weights(weights: str, photograph: Image) -> None:
    one = extractor(weights)
    image = np.ascontiguousarray(photograph[:60, :80])
    one.extract(image)
    other = pickle.loads(pickle.dumps(one))
    assert len(pickle.dumps(one)) < 10_000
    assert_same(one.extract(image), other.extract(image))
    (name, digest), *more = one.weights().items()
    assert name == "r2d2_WASF_N16.pt" and len(digest) == 64 and not more


def test_what_cannot_be_is_refused(shared_data: Path, photograph: Image) -> None:
    with pytest.raises(ValidationError, match=r"max_size is at least 1\.2 times min_size"):
        R2D2Options(min_size=1000, max_size=1024)
    other = shared_data / "weights" / "aliked" / "aliked-t16.pth"
    with pytest.raises(DataError, match=r"aliked-t16\.pth: .*does not fit R2D2Network"):
        extractor(str(other)).extract(photograph[:40, :40])
