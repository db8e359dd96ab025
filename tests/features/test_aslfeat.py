"""ASLFeat keypoints: hand-made score maps, random weights, and TensorFlow's keypoints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from images import random_image, texture

from megloc_kapture.features import aslfeat
from megloc_kapture.features.aslfeat import AslFeat, AslFeatOptions
from megloc_kapture.nets.aslfeat import AslFeatMaps
from megloc_kapture.values import LocalFeatures

# what make_reference.py of it has written
TENSORFLOW = Path(__file__).parent.parent / "nets" / "data" / "aslfeat"
OnMaps = Callable[..., LocalFeatures]


def extractor(weights: Path, **options: object) -> AslFeat:
    given = {"weights": str(weights), "device": "cpu", **options}
    return AslFeat(AslFeatOptions.model_validate(given))


@pytest.fixture
def on_maps(monkeypatch: pytest.MonkeyPatch, aslfeat_weights: Path) -> OnMaps:
    """Extracts where the network answers with given maps."""

    def extracted(scores: torch.Tensor, features: torch.Tensor | None = None) -> LocalFeatures:
        height, width = scores.shape
        if features is None:
            features = torch.ones(128, -(-height // 4), -(-width // 4))
        given = (lambda _: [AslFeatMaps(scores, features)]), torch.device("cpu")
        monkeypatch.setattr(aslfeat.AslFeat, "network", lambda *_: given)
        image = np.zeros((height, width, 3), np.uint8)
        image[0] = 255  # an image without any contrast is not looked at
        return extractor(aslfeat_weights).extract(image)

    return extracted


def blobs(centres: list[tuple[float, float]], heights: list[float]) -> torch.Tensor:
    """Score map of 60 x 80 with round peaks of 2 px around (x, y), integers at pixel centres."""
    rows, columns = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    scores = torch.full((60, 80), 0.1)
    for (x, y), height in zip(centres, heights, strict=True):
        scores += (height - 0.1) * torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8)
    return scores


def test_the_centre_of_a_blob(on_maps: OnMaps) -> None:
    # a blob on a pixel's centre lies a half further in COLMAP's coordinates
    centres = [(20.0, 30.0), (50.3, 20.0), (60.25, 45.6)]
    found = on_maps(blobs(centres, [2.0, 1.5, 1.0]))
    assert len(found.scores) == 3
    expected = np.array(centres) + 0.5
    assert np.abs(found.keypoints_px[:, :2] - expected).max() < 0.05
    np.testing.assert_allclose(found.keypoints_px[0, :2], [20.5, 30.5], atol=1e-4)
    np.testing.assert_allclose(found.scores[0], 2.0, atol=1e-3)


def test_weak_peaks_and_peaks_at_the_border_are_left_out(on_maps: OnMaps) -> None:
    centres = [(4.0, 30.0), (5.0, 45.0), (75.0, 20.0), (74.0, 40.0), (40.0, 30.0)]
    scores = blobs(centres, [2.0, 1.5, 2.0, 1.2, 0.4])
    found = on_maps(scores)
    np.testing.assert_allclose(found.keypoints_px[:, :2], [[5.5, 45.5], [74.5, 40.5]], atol=0.01)


def test_a_flat_map_and_a_straight_edge_give_nothing(on_maps: OnMaps) -> None:
    assert len(on_maps(torch.ones(60, 80)).scores) == 0
    edge = torch.ones(60, 80)
    edge += 2 * torch.exp(-((torch.arange(80.0) - 40) ** 2) / 8)
    assert len(on_maps(edge).scores) == 0
    assert len(on_maps(edge.T.contiguous()).scores) == 0


def test_a_descriptor_is_read_at_a_quarter_of_the_pixel(on_maps: OnMaps) -> None:
    rows, columns = torch.meshgrid(torch.arange(15.0), torch.arange(20.0), indexing="ij")
    features = torch.zeros(128, 15, 20)
    features[0], features[1], features[2] = rows, columns, 1.0
    x, y = 41.2, 22.3
    found = on_maps(blobs([(x, y)], [2.0]), features)
    descriptor = found.descriptors[0]
    assert np.linalg.norm(descriptor) == pytest.approx(1, abs=1e-6)
    at = found.keypoints_px[0, :2] - 0.5
    np.testing.assert_allclose(descriptor[:2] / descriptor[2], at[::-1] / 4, atol=1e-4)


def test_several_scales_add_keypoints_inside_the_border(aslfeat_weights: Path) -> None:
    image = texture(300, 400)
    one = extractor(aslfeat_weights, max_keypoints=100_000).extract(image)
    several = extractor(aslfeat_weights, max_keypoints=100_000, multi_scale=True).extract(image)
    assert len(several.scores) > len(one.scores) > 20
    # those of the whole image are among them, unchanged
    known = {tuple(row) for row in several.keypoints_px.tolist()}
    assert {tuple(row) for row in one.keypoints_px.tolist()} <= known
    xy = one.keypoints_px[:, :2]
    assert xy.min() > 5 and (xy < (400 - 5, 300 - 5)).all() and one.scores.min() > 0.5


@pytest.mark.parametrize("image", ["even", "odd"])
def test_keypoints_are_tensorflows(image: str) -> None:
    outputs = np.load(TENSORFLOW / "reference.npz")
    gray = outputs[f"{image}/image"]
    found = extractor(TENSORFLOW / "aslfeat.tar.gz").extract(np.repeat(gray[..., None], 3, 2))
    assert len(found.scores) > 40
    # the published network puts the first pixel's centre at (0, 0)
    np.testing.assert_allclose(
        found.keypoints_px[:, :2] - 0.5, outputs[f"{image}/keypoints"], rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(found.scores, outputs[f"{image}/scores"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        found.descriptors, outputs[f"{image}/descriptors"], rtol=0, atol=1e-5
    )


# 0.3 of the size, and of the longer side 128 pixels, is the smallest; each level is 1/sqrt(2)
@pytest.mark.parametrize(
    ("longer", "sizes"),
    [
        (100, [(50, 100)]),
        (200, [(100, 200)]),
        (300, [(150, 300), (106, 212)]),
        (1000, [(500, 1000), (354, 707), (250, 500)]),
    ],
)
def test_sizes_of_the_scales(longer: int, sizes: list[tuple[int, int]]) -> None:
    gray = np.random.default_rng(0).uniform(0, 255, (longer // 2, longer)).astype(np.float32)
    assert [level.shape for level in aslfeat._scales(gray)] == sizes


def test_keypoints_of_small_scales_lie_where_they_are_in_the_image(
    monkeypatch: pytest.MonkeyPatch, aslfeat_weights: Path
) -> None:
    # the network marks the brightest pixel of what it is given: a spot is found on every scale
    def net(gray: torch.Tensor) -> list[AslFeatMaps]:
        features = torch.ones(128, -(-gray.shape[2] // 4), -(-gray.shape[3] // 4))
        return [AslFeatMaps(gray[0, 0] / 255, features)]

    monkeypatch.setattr(aslfeat.AslFeat, "network", lambda *_: (net, torch.device("cpu")))
    y, x = np.mgrid[:500, :1000] + 0.5
    spot = 250 * np.exp(-((x - 700.5) ** 2 + (y - 300.5) ** 2) / (2 * 5.0**2))
    image = np.repeat(spot.round().astype(np.uint8)[..., None], 3, axis=2)
    found = extractor(aslfeat_weights, multi_scale=True, threshold=0.4).extract(image)
    assert len(found.scores) == 3
    np.testing.assert_allclose(found.keypoints_px[:, :2], [[700.5, 300.5]] * 3, atol=0.1)


@pytest.mark.parametrize("size", [(8, 30), (11, 11), (11, 200), (13, 12)])
def test_the_smallest_images(aslfeat_weights: Path, size: tuple[int, int]) -> None:
    features = extractor(aslfeat_weights, threshold=0.0).extract(random_image(*size))
    assert features.keypoints_px.shape == (len(features.scores), 3)
