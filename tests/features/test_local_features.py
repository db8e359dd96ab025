"""Rules of all local feature extractors: order, limits, masks, files, and reduction of images."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from images import Image, blobs, texture

from megloc_kapture.errors import DataError
from megloc_kapture.features.aliked import Aliked
from megloc_kapture.features.aslfeat import AslFeat
from megloc_kapture.features.image_bound import (
    BoundedOptions,
    bounded_size,
    extract_bounded,
    on_mask,
)
from megloc_kapture.features.kornia_features import XFeat
from megloc_kapture.features.r2d2 import R2D2
from megloc_kapture.features.rootsift import ColmapSift, RootSift, RootSiftOptions
from megloc_kapture.features.superpoint import SuperPoint
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.plugins import LOCAL_FEATURES
from megloc_kapture.values import LocalFeatures

Make = Callable[..., Any]
ALL = 100_000
KINDS: dict[str, Any] = {
    "rootsift": RootSift,
    "sift": ColmapSift,
    "superpoint": SuperPoint,
    "aslfeat": AslFeat,
    "aliked": Aliked,
    "xfeat": XFeat,
    "r2d2": R2D2,
}


# published weights, and the x, y, width and height of a part of a photograph
PUBLISHED = {
    "aliked": ("aliked/aliked-n16.pth", (400, 300, 192, 128)),
    "xfeat": ("xfeat/xfeat.pt", (400, 300, 192, 128)),
    "r2d2": ("r2d2/r2d2_WASF_N16.pt", (600, 300, 160, 110)),
}
NETWORKS = [name for name in KINDS if "sift" not in name]
DESCRIPTORS = {"superpoint": 256, "xfeat": 64}  # the others have 128


# height and width
FLAT = [(1, 1), (11, 40)]
SMALL = {
    "superpoint": [(7, 100), (8, 8)],
    "xfeat": [(20, 31), (33, 100)],
    "r2d2": [(9, 21), (40, 60)],
}
REFUSALS = {
    "superpoint": "23 missing keys",
    "aslfeat": "missing keys",
    "aliked": "not an ALIKED",
    "xfeat": "does not fit XFeatModel",
    "r2d2": "does not fit R2D2Network",
}


@pytest.fixture(scope="module", params=KINDS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def weights(name: str, request: pytest.FixtureRequest) -> Path | None:
    if name in PUBLISHED:
        return request.getfixturevalue("shared_data") / "weights" / PUBLISHED[name][0]
    names = {"superpoint": "superpoint_v1", "aslfeat": "aslfeat"}
    return request.getfixturevalue("random_weights")[names[name]] if name in names else None


@pytest.fixture(scope="module")
def make(name: str, weights: Path | None) -> Make:

    def made(**options: Any) -> Any:
        if weights is not None:
            options = {"weights": str(weights), "device": "cpu", **options}
        if name == "r2d2":
            options = {"min_size": 130, "max_size": 160, **options}
        return KINDS[name](KINDS[name].Options.model_validate(options))

    return made


@pytest.fixture(scope="module")
def image(name: str, request: pytest.FixtureRequest) -> Image:
    if name not in PUBLISHED:
        return texture(96, 131, sigma_px=1.5)
    x, y, width, height = PUBLISHED[name][1]
    whole = request.getfixturevalue("photograph")
    return np.ascontiguousarray(whole[y : y + height, x : x + width])


@pytest.fixture(scope="module")
def every(make: Make, image: Image) -> LocalFeatures:
    return make(max_keypoints=ALL).extract(image)


def assert_same(a: LocalFeatures, b: LocalFeatures, rows: Any = slice(None)) -> None:
    np.testing.assert_array_equal(a.keypoints_px, b.keypoints_px[rows])
    np.testing.assert_array_equal(a.scores, b.scores[rows])
    np.testing.assert_allclose(a.descriptors, b.descriptors[rows], atol=1e-6)


def assert_well_formed(result: LocalFeatures, name: str) -> None:
    columns, count = 2 if "sift" in name else 3, len(result.scores)
    assert result.keypoints_px.shape == (count, columns)
    assert result.descriptors.shape == (count, DESCRIPTORS.get(name, 128))
    assert result.keypoints_px.dtype == result.scores.dtype == np.float32
    assert result.descriptors.dtype == (np.uint8 if name == "sift" else np.float32)
    assert np.isfinite(result.keypoints_px).all() and np.isfinite(result.scores).all()
    length = np.linalg.norm(result.descriptors.astype(np.float64), axis=1)
    exact = {"rtol": 0.01} if name == "sift" else {"rtol": 0, "atol": 1e-5}
    np.testing.assert_allclose(length, 512.0 if name == "sift" else 1.0, **exact)


def test_the_limit_keeps_the_best(
    name: str, make: Make, image: Image, every: LocalFeatures, weights: Path | None
) -> None:
    assert_well_formed(every, name)
    assert len(every.scores) > 30 and every.num_masked == 0
    assert (every.keypoints_px[:, :2] > 0).all()
    assert (every.keypoints_px[:, :2] < image.shape[1::-1]).all()
    assert (np.diff(every.scores) <= 0).all()
    if name in NETWORKS and name != "r2d2":
        np.testing.assert_array_equal(every.keypoints_px[:, 2], every.scores)
    if name != "sift":  # keeps whole levels
        # a pickled plugin is sent without its network
        packed = pickle.dumps(make(max_keypoints=20))
        assert len(packed) < 10_000
        assert_same(pickle.loads(packed).extract(image), every, slice(20))
    if weights is not None:
        assert make().weights() == {weights.name: hashlib.sha256(weights.read_bytes()).hexdigest()}


def test_masks_precede_the_limit(name: str, make: Make, image: Image, every: LocalFeatures) -> None:
    mask = np.ones(image.shape[:2], bool)
    mask[:, 60:] = False
    x, y = np.floor(every.keypoints_px[:, :2]).astype(int).T
    allowed = mask[y, x]
    assert 10 < allowed.sum() < len(allowed)
    masked = make(max_keypoints=10).extract(image, mask)
    assert_same(masked, every, np.flatnonzero(allowed)[:10])
    assert masked.num_masked == (~allowed).sum()
    nothing = make().extract(image, np.zeros_like(mask))
    assert_well_formed(nothing, name)
    assert len(nothing.scores) == 0 and nothing.num_masked == len(every.scores)


def test_small_and_flat_images_give_valid_features(name: str, make: Make) -> None:
    for size in SMALL.get(name, FLAT):
        for image in (np.full((*size, 3), 90, np.uint8), texture(*size)):
            result = make().extract(image)
            assert_well_formed(result, name)
            assert (result.keypoints_px[:, :2] < size[::-1]).all()
            if name == "superpoint" or name not in SMALL and np.ptp(image) == 0:
                assert len(result.scores) == 0


@pytest.mark.parametrize("name", NETWORKS, scope="module")
def test_missing_and_unsuitable_weights_are_refused(name: str, make: Make, tmp_path: Path) -> None:
    with pytest.raises(MissingWeightsError, match=name):
        KINDS[name]()
    torch.save({"conv1a.weight": torch.zeros(64, 1, 3, 3)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=rf"other\.pth: .*{REFUSALS[name]}"):
        make(weights=str(tmp_path / "other.pth")).extract(texture(40, 60))


def test_images_are_reduced_only_above_the_bound() -> None:
    for size in ((2048, 2048), (3264, 2448)):
        assert bounded_size(*size, 8.0) == size
    assert bounded_size(12000, 9000, 8.0) == (3265, 2449)
    assert bounded_size(100_000_000, 1, 8.0) == (28284271, 1)


def test_keypoints_of_a_reduced_image_keep_their_place() -> None:
    x, y = np.meshgrid(np.arange(50, 380, 50), np.arange(50, 280, 50))
    centres = np.stack([x.ravel(), y.ravel()], axis=1) + 0.5
    image = blobs(centres, 6.0, size=(303, 401))
    whole = RootSift().extract(image)
    half, same = (RootSift(RootSiftOptions(max_megapixels=most)) for most in (0.0306, 0.5))
    result = extract_bounded(half, [(image, None)])[0]
    assert len(result.keypoints_px) > len(centres)
    for features in (whole, result):
        near = np.linalg.norm(centres[:, None] - features.keypoints_px[None, :, :2], axis=2)
        assert near.min(axis=1).max() < 1.0
    unchanged = extract_bounded(same, [(image, None)])[0]
    np.testing.assert_array_equal(unchanged.keypoints_px, whole.keypoints_px)
    np.testing.assert_array_equal(unchanged.descriptors, whole.descriptors)
    # the mask is reduced with the image
    mask = np.ones(image.shape[:2], bool)
    mask[:, :201] = False
    result = extract_bounded(half, [(image, mask)])[0]
    assert len(result.keypoints_px) > 10 and result.num_masked > 10
    assert result.keypoints_px[:, 0].min() >= 201


def test_images_of_plugins_without_the_option_are_bounded_too() -> None:
    class Plain:
        def extract(self, image: Any, mask: Any = None) -> LocalFeatures:
            assert image.shape[0] * image.shape[1] <= 8e6
            corner = np.array([[image.shape[1], image.shape[0], 7.0]], np.float32)
            return LocalFeatures(corner, np.zeros(1, np.float32), np.zeros((1, 4), np.float32))

    result = extract_bounded(Plain(), [(np.zeros((2400, 4800, 3), np.uint8), None)])[0]
    np.testing.assert_allclose(result.keypoints_px, [[4800, 2400, 7]], rtol=1e-6)


def test_all_our_extractors_have_the_option() -> None:
    plugins = entry_points(group=LOCAL_FEATURES)
    ours = [plugin for plugin in plugins if "megloc_kapture." in plugin.value]
    assert len(ours) > 5
    for extractor in ours:
        assert issubclass(extractor.load().Options, BoundedOptions), extractor.name


def test_a_mask_is_read_at_the_pixel_of_a_keypoint() -> None:
    # (2, 1) is the corner of the pixel in column 2, row 1; the far edge belongs to the last pixel
    xy_px = np.array([[1.99, 0.99], [2.0, 1.0], [4.0, 3.0]], np.float32)
    for row, pixel in enumerate([(0, 1), (1, 2), (2, 3)]):
        mask = np.zeros((3, 4), bool)
        mask[pixel] = True
        assert on_mask(mask, xy_px).tolist() == [row == k for k in range(3)]
