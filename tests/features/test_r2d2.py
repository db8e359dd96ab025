"""R2D2 with the published weights: against keypoints that kapture's authors extracted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from images import Image
from pydantic import ValidationError

from megloc_kapture.features.r2d2 import R2D2, R2D2Options
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "r2d2" / "r2d2_WASF_N16.pt")


@pytest.fixture(scope="module")
def cropped(photograph: Image) -> Image:
    return np.ascontiguousarray(photograph[300:460, 600:840])


def extractor(weights: str, **options: object) -> R2D2:
    given = {"max_keypoints": 100_000, "device": "cpu", "min_size": 200, "max_size": 240}
    return R2D2(R2D2Options.model_validate(given | {"weights": weights, **options}))


def test_one_level_is_what_the_authors_extracted(shared_data: Path, weights: str) -> None:
    """One level of an image of virtual_gallery, whose makers kept the best 500 of three."""
    folder = KaptureFolder(shared_data / "foreign_maps" / "virtual_gallery" / "query")
    name = folder.read().image_names()[0]
    stored = folder.keypoints("r2d2_500").read(name)
    descriptors = folder.descriptors("r2d2_500").read(name)
    coarsest = stored[:, 2] > 85
    stored, descriptors = stored[coarsest][::-1], descriptors[coarsest][::-1]  # worst came first
    assert len(stored) > 80

    plugin = extractor(weights, max_keypoints=len(stored), min_size=580, max_size=700)
    found = plugin.extract(read_image_rgb(folder.image_path(name)))
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


def test_keypoints_of_a_level_are_where_they_are(weights: str, cropped: Image) -> None:
    """Each pixel made two by two: on the level of half the size it is the same image."""
    doubled = cropped.repeat(2, axis=0).repeat(2, axis=1)
    a = extractor(weights, max_size=250).extract(cropped)
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


def test_scales_and_the_thresholds_of_both_maps(weights: str, cropped: Image) -> None:
    whole = extractor(weights).extract(cropped)
    assert (whole.scores >= 0.49).all() and (whole.scores <= 1).all()
    # the levels of 240 and 202 pixels
    scales = np.unique(whole.keypoints_px[:, 2])
    np.testing.assert_allclose(scales, [32, 32 * 240 / 202], rtol=1e-5)
    for option, value in (("min_reliability", 0.999), ("min_repeatability", 0.8)):
        fewer = extractor(weights, **{option: value}).extract(cropped)
        assert 0 < len(fewer.scores) < len(whole.scores)
        assert {*map(tuple, fewer.keypoints_px)} < {*map(tuple, whole.keypoints_px)}


def test_other_weights_make_another_type(shared_data: Path, weights: str) -> None:
    assert extractor(weights).name == "r2d2_WASF_N16"
    other = shared_data / "weights" / "r2d2" / "r2d2_WASF_N8_big.pt"
    assert extractor(str(other)).name == "r2d2_WASF_N8_big"
    assert R2D2.name == "r2d2"


def test_a_pyramid_has_a_level() -> None:
    with pytest.raises(ValidationError, match=r"max_size is at least 1\.2 times min_size"):
        R2D2Options(min_size=1000, max_size=1024)
