"""The SuperGlue plugin with random weights: its input to the network, and rejected features."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.matching.networks import SuperGlue, SuperGlueOptions
from megloc_kapture.nets.superglue import (
    ImageKeypoints,
    SuperGlueNet,
    mutual_matches,
    normalise_keypoints,
    superglue,
)
from megloc_kapture.values import ImageFeatures


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a small network that matches similar descriptors."""
    torch.manual_seed(0)
    net = SuperGlueNet(encoder_sizes=(16, 32, 64), num_layers=4)
    with torch.no_grad():
        for layer in net.gnn.layers:
            layer.get_submodule("mlp.3").get_parameter("weight").mul_(0.5)
        net.final_proj.weight.copy_(10 * torch.eye(64)[:, :, None])
        net.bin_score.fill_(6.0)
    path = tmp_path_factory.mktemp("weights") / "small.pth"
    torch.save(net.state_dict(), path)
    return path


def matcher(weights: Path, **options: object) -> SuperGlue:
    return SuperGlue(
        SuperGlueOptions.model_validate({"weights": str(weights), "device": "cpu", **options})
    )


def unit(values: NDArray[np.float64]) -> NDArray[np.float32]:
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


def image(num: int, seed: int) -> ImageFeatures:
    rng = np.random.default_rng(seed)
    xy = rng.integers(0, [640, 480], (num, 2)) + 0.5
    table = np.column_stack([xy, rng.uniform(0.01, 1, num)]).astype(np.float32)
    return ImageFeatures(table, unit(rng.standard_normal((num, 64))), 640, 480)


def seen_again(first: ImageFeatures, num: int, seed: int) -> ImageFeatures:
    """Return the image again: half of it new, in another order and of another size."""
    rng = np.random.default_rng(seed)
    other = image(num, seed + 100)
    half = num // 2
    table, descriptors = other.keypoints_px.copy(), other.descriptors.copy()
    table[:half] = first.keypoints_px[:half]
    noise = rng.standard_normal((half, 64)) / 8
    descriptors[:half] = unit(first.descriptors[:half] + 0.3 * noise)
    order = rng.permutation(num)
    return ImageFeatures(table[order], descriptors[order], 800, 500)


def test_matches_equal_the_networks_on_normalised_pixels(weights: Path) -> None:
    a = image(80, 0)
    b = seen_again(a, 60, 1)
    matches, scores = matcher(weights).match(a, b)
    net = superglue(torch.load(weights, weights_only=True), "w").eval()
    sides = [
        ImageKeypoints(
            normalise_keypoints(
                torch.from_numpy(side.keypoints_px[:, :2]) - 0.5, side.width, side.height
            ),
            torch.from_numpy(side.keypoints_px[:, 2]),
            torch.from_numpy(side.descriptors),
        )
        for side in (a, b)
    ]
    with torch.inference_mode():
        expected, expected_scores = mutual_matches(net([(sides[0], sides[1])], 100)[0], 0.2)
    np.testing.assert_array_equal(matches, expected.numpy())
    np.testing.assert_array_equal(scores, expected_scores.numpy())
    assert matches.dtype == np.int64 and scores.dtype == np.float32
    right = (a.keypoints_px[matches[:, 0]] == b.keypoints_px[matches[:, 1]]).all(axis=1)
    assert right.sum() == 30  # all that are in both
    assert len(matches) < 50
    assert (np.diff(matches[:, 0]) > 0).all()
    assert scores.min() > 0.2
    strict, _ = matcher(weights, match_threshold=float(np.median(scores))).match(a, b)
    assert 0 < len(strict) < len(matches)


def test_matches_of_many_images_equal_those_of_single_pairs(weights: Path) -> None:
    a = image(80, 0)
    others = [seen_again(a, 60, 1), image(0, 2), seen_again(a, 90, 3), image(1, 4)]
    plugin = matcher(weights)
    alone = [plugin.match(a, other) for other in others]
    for (matches, scores), result in zip(alone, plugin.match_many(a, others), strict=True):
        np.testing.assert_array_equal(result[0], matches)
        np.testing.assert_allclose(result[1], scores, atol=1e-5)
    assert len(alone[0][0]) > 15 and len(alone[2][0]) > 15
    assert plugin.match_many(a, []) == []
    nothing = ImageFeatures(np.zeros((0, 3), np.float32), np.zeros((0, 0)), 640, 480)
    for first, second in ((image(0, 0), a), (a, image(0, 0)), (nothing, a)):
        matches, scores = plugin.match(first, second)
        assert matches.shape == (0, 2) and matches.dtype == np.int64
        assert scores.shape == (0,) and scores.dtype == np.float32


def test_unusable_features_are_named(weights: Path) -> None:
    good = image(9, 0)
    plugin = matcher(weights)
    bare = ImageFeatures(good.keypoints_px[:, :2], good.descriptors, 640, 480)
    with pytest.raises(DataError, match=r"x, y, score.*\(9, 2\) \(superpoint"):
        plugin.match(good, bare)
    for value in (0.0, 1.5, -0.2, np.nan):
        table = good.keypoints_px.copy()
        table[4, 2] = value
        with pytest.raises(DataError, match=f"score as the third column.*has {value:g}"):
            plugin.match(ImageFeatures(table, good.descriptors, 640, 480), good)
    short = ImageFeatures(good.keypoints_px, good.descriptors[:, :32], 640, 480)
    with pytest.raises(DataError, match=r"small\.pth.*64 dimensions.*\(9, 32\)"):
        plugin.match(good, short)
