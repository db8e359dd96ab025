"""LighterGlue with its published weights on a real scene, and mismatched weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from megloc_kapture.errors import DataError
from megloc_kapture.features.kornia_features import XFeat, XFeatOptions
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.matching.networks import LighterGlue, LighterGlueOptions
from megloc_kapture.matching.verification import essential_matrix
from megloc_kapture.nets.kornia_networks import load_lighterglue
from megloc_kapture.values import ImageFeatures

IMAGES = ("0002.jpg", "0003.jpg")


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "lighterglue" / "xfeat-lighterglue.pt")


@pytest.fixture(scope="module")
def fountain(shared_data: Path) -> KaptureFolder:
    return KaptureFolder(shared_data / "scenes" / "fountain_p11" / "mapping")


@pytest.fixture(scope="module")
def features(shared_data: Path, fountain: KaptureFolder) -> dict[str, ImageFeatures]:
    """Extract XFeat from two neighbouring images."""
    weights = str(shared_data / "weights" / "xfeat" / "xfeat.pt")
    extractor = XFeat(XFeatOptions(weights=weights, max_keypoints=1000, device="cpu"))
    result = {}
    for name in IMAGES:
        image = read_image_rgb(fountain.image_path(name))
        local = extractor.extract(image)
        size = image.shape[1], image.shape[0]
        result[name] = ImageFeatures(local.keypoints_px, local.descriptors, *size)
    return result


def matcher(weights: str, **options: float) -> LighterGlue:
    return LighterGlue(LighterGlueOptions(weights=weights, device="cpu", **options))  # type: ignore[arg-type]


def random_image(number: int, seed: int, size: tuple[int, int] = (640, 480)) -> ImageFeatures:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(number, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    xy = (rng.random((number, 2)) * size).astype(np.float32)
    return ImageFeatures(np.column_stack([xy, xy[:, 0]]), descriptors, *size)


def shuffled(image: ImageFeatures, seed: int) -> ImageFeatures:
    order = np.random.default_rng(seed).permutation(len(image.descriptors))
    xy, descriptors = image.keypoints_px[order], image.descriptors[order]
    return replace(image, keypoints_px=xy, descriptors=descriptors)


def test_most_matches_of_a_real_pair_are_right(
    weights: str, features: dict[str, ImageFeatures], fountain: KaptureFolder
) -> None:
    first, second = "0002.jpg", "0003.jpg"
    a, b = features[first], features[second]
    matches, scores = matcher(weights).match(a, b)
    assert matches.dtype == np.int64 and scores.dtype == np.float32
    data = fountain.read()
    camera, poses = data.camera_of(first), data.poses()
    essential = essential_matrix(poses[second] @ poses[first].inverse())
    rays_a = bearing_rays(camera, a.keypoints_px[matches[:, 0], :2])
    rays_b = bearing_rays(camera, b.keypoints_px[matches[:, 1], :2])
    line_b, line_a = rays_a @ essential.T, rays_b @ essential
    # the larger distance of two matched points to each other's epipolar line, pinhole camera
    slopes = [np.linalg.norm(line[:, :2] / camera.params[:2], axis=1) for line in (line_a, line_b)]
    error = np.abs((rays_b * line_b).sum(axis=1)) / np.minimum(*slopes)
    assert camera.model == "PINHOLE"
    assert len(matches) > 300
    assert (error < 2).mean() > 0.7


def test_the_order_of_keypoints_does_not_matter(weights: str) -> None:
    a = random_image(200, seed=3)
    rim = a.keypoints_px.copy()
    rim[:3, :2] = [[0.0, 0.0], [0.2, 479.9], [640.0, 480.0]]  # clamped: kornia refuses them
    a = replace(a, keypoints_px=rim)
    b = shuffled(a, seed=4)
    matches, scores = matcher(weights).match(a, b)
    assert len(matches) > 150 and (np.diff(matches[:, 0]) > 0).all()
    np.testing.assert_array_equal(a.descriptors[matches[:, 0]], b.descriptors[matches[:, 1]])
    assert len(np.unique(matches[:, 1])) == len(matches)
    back, back_scores = matcher(weights).match(b, a)
    assert {*map(tuple, back[:, ::-1].tolist())} == {*map(tuple, matches.tolist())}
    np.testing.assert_allclose(np.sort(scores), np.sort(back_scores), atol=1e-4)


def test_mismatched_weights_are_named(weights: str, shared_data: Path) -> None:
    tensors = read_weights(find_weights(weights))
    for key in ("extractor.head.weight", "optimizer.step", "matcher.extra"):
        unknown = key.removeprefix("matcher.")
        with pytest.raises(DataError, match=rf"l\.pt: .*1 unexpected keys: {unknown}$"):
            load_lighterglue({**tensors, key: torch.zeros(1)}, "l.pt")
    other = str(shared_data / "weights" / "aliked" / "aliked-t16.pth")
    image = random_image(3, seed=0)
    with pytest.raises(DataError, match=r"aliked-t16\.pth: .*it has no layers"):
        matcher(other).match(image, image)
    wide = replace(image, descriptors=np.zeros((3, 128), np.float32))
    with pytest.raises(DataError, match="descriptors of 64 dimensions, but the features have 128"):
        matcher(weights).match(image, wide)
