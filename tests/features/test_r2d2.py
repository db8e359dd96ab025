"""R2D2 against keypoints that kapture's authors extracted, and its layers written down."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from images import Image
from published import random_tensors
from pydantic import ValidationError
from torch.nn import functional

from megloc_kapture.features.r2d2 import R2D2, R2D2Options, load_r2d2, pyramid_levels
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


def test_one_level_equals_the_authors_keypoints(shared_data: Path, weights: str) -> None:
    """One level of an image of virtual_gallery, whose makers kept the best 500 of three."""
    folder = KaptureFolder(shared_data / "foreign_maps" / "virtual_gallery" / "query")
    name = folder.read().image_names()[0]
    stored = folder.keypoints("r2d2_500").read(name)
    descriptors = folder.descriptors("r2d2_500").read(name)
    coarsest = stored[:, 2] > 85
    stored, descriptors = stored[coarsest][::-1], descriptors[coarsest][::-1]  # worst came first
    assert len(stored) > 80

    plugin = extractor(weights, max_keypoints=len(stored), min_size=580, max_size=700)
    result = plugin.extract(read_image_rgb(folder.image_path(name)))
    # theirs count pixels from the first one's centre on every level, ours from its corner
    ratio = np.array([1920 / 679, 1080 / 382], np.float32)
    offset = result.keypoints_px[:, None, :2] - (stored[:, :2] + ratio / 2)
    distance = np.linalg.norm(offset, axis=2)
    nearest = distance.argmin(axis=0)
    assert len(np.unique(nearest)) == len(stored)
    assert distance.min(axis=0).max() < 0.01
    cosine = (result.descriptors[nearest] * descriptors).sum(axis=1)
    assert cosine.min() > 0.999
    # in the same order, but for scores that are all but equal
    assert np.abs(nearest - np.arange(len(stored))).max() <= 2
    np.testing.assert_allclose(result.keypoints_px[:, 2], stored[0, 2], rtol=1e-3)


def test_keypoints_of_a_level_are_where_they_are(weights: str, cropped: Image) -> None:
    """Each pixel made two by two: on the level of half the size it is the same image."""
    doubled = cropped.repeat(2, axis=0).repeat(2, axis=1)
    a = extractor(weights, max_size=250).extract(cropped)
    b = extractor(weights, min_size=230, max_size=280).extract(doubled)
    assert np.allclose(b.keypoints_px[:, 2], 2 * 32, rtol=1e-3)
    fine = a.keypoints_px[np.isclose(a.keypoints_px[:, 2], 32)]
    distance = np.linalg.norm(fine[:, None, :2] - b.keypoints_px[:, :2] / 2, axis=2)
    result = distance.min(axis=1) < 1.5
    assert result.sum() > 50
    offset = (b.keypoints_px[distance.argmin(axis=1), :2] / 2 - fine[:, :2])[result]
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


def test_a_pyramid_has_a_level() -> None:
    with pytest.raises(ValidationError, match=r"max_size is at least 1\.2 times min_size"):
        R2D2Options(min_size=1000, max_size=1024)


def by_hand(
    tensors: dict[str, torch.Tensor], image: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The layers as a table: convolution, padding, dilation, whether a ReLU follows."""
    x = (image - torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)) / (
        torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)
    )
    table = [
        *((0, 1, 1, True), (3, 1, 1, True), (6, 1, 1, True), (9, 2, 2, True), (12, 2, 2, True)),
        *((15, 4, 4, True), (18, 2, 4, False), (20, 4, 8, False), (22, 8, 16, None)),
    ]
    for index, padding, dilation, relu in table:
        weight, bias = tensors[f"ops.{index}.weight"], tensors[f"ops.{index}.bias"]
        x = functional.conv2d(x, weight, bias, padding=padding, dilation=dilation)
        if relu is None:
            break
        mean = tensors[f"ops.{index + 1}.running_mean"].view(-1, 1, 1)
        variance = tensors[f"ops.{index + 1}.running_var"].view(-1, 1, 1)
        x = (x - mean) / (variance + 1e-5).sqrt()
        x = x.clamp(min=0) if relu else x
    clf = functional.conv2d(x**2, tensors["clf.weight"], tensors["clf.bias"])
    sal = functional.conv2d(x**2, tensors["sal.weight"], tensors["sal.bias"]).exp().log1p()
    reliability = clf[:, 1:].exp() / clf.exp().sum(1, keepdim=True)
    return x, reliability, sal / (1 + sal)


@pytest.mark.parametrize("size", [(40, 56), (33, 47)])
def test_maps_equal_the_layers_by_hand(size: tuple[int, int]) -> None:
    tensors = random_tensors("r2d2_WASF_N16", 1)
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        result = load_r2d2(tensors, "r")(image)
        expected = by_hand(tensors, image)
    for ours, theirs in zip(result, expected, strict=True):
        assert ours.shape[-2:] == size
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def sizes(height: int, width: int, smallest: int, largest: int) -> list[tuple[int, int]]:
    levels = pyramid_levels(torch.zeros(1, 1, height, width), min_size=smallest, max_size=largest)
    return [(level.shape[-1], level.shape[-2]) for level in levels]


def test_four_levels_an_octave_between_two_sizes() -> None:
    result = sizes(480, 640, 256, 1024)
    assert result == [(640, 480), (538, 404), (453, 339), (381, 285), (320, 240), (269, 202)]
    # levels that are too large are made, but not given
    assert sizes(1080, 1920, 600, 1024) == [(960, 540), (807, 454), (679, 382)]
    # an image that is smaller than the smallest level is taken as it is
    assert sizes(60, 80, 256, 1024) == [(80, 60)]
    # a strip ends before it vanishes
    assert sizes(1, 400, 1, 1024)[-1][1] == 1


def test_a_ramp_stays_in_its_place() -> None:
    # the value of a pixel is its centre's x, the first one's 0.5: so it is on every level, scaled
    width = 640
    image = (torch.arange(width) + 0.5).expand(1, 1, 480, width)
    for level in pyramid_levels(image, min_size=256, max_size=1024):
        x = (torch.arange(level.shape[-1]) + 0.5) * width / level.shape[-1]
        inner = slice(2, -2)
        torch.testing.assert_close(level[0, 0, 100, inner], x[inner], atol=0.02, rtol=0)
