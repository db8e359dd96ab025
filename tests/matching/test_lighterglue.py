"""LighterGlue with its published first three layers: against onnxruntime, and on a real scene."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from kornia.feature import LightGlue as KorniaLightGlue

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.features.xfeat import XFeat, XFeatOptions
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.matching.networks import LighterGlue, LighterGlueOptions, normalised_points
from megloc_kapture.matching.verification import essential_matrix
from megloc_kapture.nets.lightglue import load_lighterglue
from megloc_kapture.values import ImageFeatures

IMAGES = ("0002.jpg", "0003.jpg", "0005.jpg")


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "lighterglue" / "lighterglue_L3.onnx")


@pytest.fixture(scope="module")
def fountain(shared_data: Path) -> KaptureFolder:
    return KaptureFolder(shared_data / "scenes" / "fountain_p11" / "mapping")


@pytest.fixture(scope="module")
def features(shared_data: Path, fountain: KaptureFolder) -> dict[str, ImageFeatures]:
    """XFeat's of three neighbouring images."""
    weights = str(shared_data / "weights" / "xfeat" / "xfeat.onnx")
    extractor = XFeat(XFeatOptions(weights=weights, max_keypoints=1500, device="cpu"))
    found = {}
    for name in IMAGES:
        image = read_image_rgb(fountain.image_path(name))
        local = extractor.extract(image)
        size = image.shape[1], image.shape[0]
        found[name] = ImageFeatures(local.keypoints_px, local.descriptors, *size)
    return found


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


@pytest.mark.parametrize("pair", [("0003.jpg", "0005.jpg"), ("0002.jpg", "0003.jpg")])
def test_matches_are_those_of_the_onnx_file(
    weights: str, features: dict[str, ImageFeatures], pair: Sequence[str]
) -> None:
    a, b = (features[name] for name in pair)
    session = onnxruntime.InferenceSession(weights, providers=["CPUExecutionProvider"])
    theirs, their_scores = session.run(
        None,
        {
            "kpts0": normalised_points(a)[None],
            "kpts1": normalised_points(b)[None],
            "desc0": a.descriptors[None],
            "desc1": b.descriptors[None],
        },
    )
    # the file has no threshold
    expected = {(i, j): s for (i, j), s in zip(theirs.tolist(), their_scores, strict=True)}
    matches, scores = matcher(weights).match(a, b)
    assert matches.dtype == np.int64 and scores.dtype == np.float32
    found = {(i, j): s for (i, j), s in zip(matches.tolist(), scores, strict=True)}
    assert len(found) > 300
    assert found.keys() == {pair for pair, score in expected.items() if score > 0.1}
    assert max(abs(expected[pair] - score) for pair, score in found.items()) < 1e-4
    everything, _ = matcher(weights, threshold=0).match(a, b)
    assert {*map(tuple, everything.tolist())} == expected.keys()


def test_most_matches_of_a_real_pair_are_right(
    weights: str, features: dict[str, ImageFeatures], fountain: KaptureFolder
) -> None:
    first, second = "0002.jpg", "0003.jpg"
    a, b = features[first], features[second]
    matches, scores = matcher(weights).match(a, b)
    bare = replace(a, keypoints_px=a.keypoints_px[:, :2])  # the third column makes no difference
    np.testing.assert_array_equal(matcher(weights).match(bare, b)[1], scores)
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
    assert len(matches) > 400
    assert (error < 2).mean() > 0.7
    # and the score says which
    sure = scores > np.median(scores)
    assert (error[sure] < 2).mean() > (error[~sure] < 2).mean()


def test_positions_are_normalised_as_in_training() -> None:
    xy = np.array([[0.5, 0.5], [960.5, 540.5], [1919.5, 1079.5]], np.float32)
    image = ImageFeatures(xy, np.zeros((3, 64), np.float32), 1920, 1080)
    expected = [[-1, -540 / 960], [0, 0], [959 / 960, 539 / 960]]
    np.testing.assert_allclose(normalised_points(image), expected, atol=1e-6)


def test_positions_on_the_rim_are_clamped(weights: str) -> None:
    image = random_image(50, seed=1)
    rim = image.keypoints_px.copy()
    rim[:3, :2] = [[0.0, 0.0], [0.2, 479.9], [640.0, 480.0]]
    on_rim = replace(image, keypoints_px=rim)
    points = normalised_points(on_rim)
    assert points.min() == -1 and points.max() < 1
    # half a pixel at most
    exact = (rim[:, :2] - 0.5 - np.array([320, 240])) / 320
    assert np.abs(points - exact).max() <= 0.5 / 320 + 1e-6
    matches, _ = matcher(weights).match(on_rim, on_rim)
    assert len(matches) > 0


def test_many_are_the_same_as_one_by_one(weights: str, features: dict[str, ImageFeatures]) -> None:
    one = matcher(weights)
    a = features["0003.jpg"]
    some = features["0005.jpg"]
    few = replace(some, keypoints_px=some.keypoints_px[:40], descriptors=some.descriptors[:40])
    others = [features["0002.jpg"], random_image(0, seed=0), few]
    for (matches, scores), other in zip(one.match_many(a, others), others, strict=True):
        expected, expected_scores = one.match(a, other)
        np.testing.assert_array_equal(matches, expected)
        # float32: what is rounded differs by processor; in double, see LightGlue's tests
        np.testing.assert_allclose(scores, expected_scores, atol=1e-4)
    assert one.match_many(a, []) == []


def test_the_order_of_keypoints_does_not_matter(weights: str) -> None:
    a = random_image(200, seed=3)
    b = shuffled(a, seed=4)
    matches, scores = matcher(weights).match(a, b)
    assert len(matches) > 150 and (np.diff(matches[:, 0]) > 0).all()
    np.testing.assert_array_equal(a.descriptors[matches[:, 0]], b.descriptors[matches[:, 1]])
    assert len(np.unique(matches[:, 1])) == len(matches)
    back, back_scores = matcher(weights).match(b, a)
    assert {*map(tuple, back[:, ::-1].tolist())} == {*map(tuple, matches.tolist())}
    np.testing.assert_allclose(np.sort(scores), np.sort(back_scores), atol=1e-4)


def test_half_precision_keeps_most_matches(
    weights: str, features: dict[str, ImageFeatures]
) -> None:
    a, b = features["0002.jpg"], features["0003.jpg"]
    exact = {*map(tuple, matcher(weights).match(a, b)[0].tolist())}
    half, scores = matcher(weights, half_precision=True).match(a, b)
    found = {*map(tuple, half.tolist())}
    assert scores.dtype == np.float32
    assert len(exact & found) > 0.9 * len(exact | found)


def test_the_published_checkpoint_begins_with_the_onnx_file(
    weights: str, shared_data: Path
) -> None:
    """Its first three layers, their assignment, and what stands before them are the same values."""
    path = shared_data / "weights" / "lighterglue" / "xfeat-lighterglue.pt"
    network = load_lighterglue(read_weights(find_weights(str(path))), path.name)
    assert len(network.parts.transformers) == 6 and network.descriptor_size == 64
    whole = network.parts.state_dict()
    three = load_lighterglue(read_weights(find_weights(weights)), weights).parts.state_dict()
    used = [
        key
        for key in three
        if key.startswith(("input_proj.", "posenc.", "transformers.", "log_assignment.2."))
    ]
    assert len(used) == 73
    for key in used:
        torch.testing.assert_close(three[key], whole[key], rtol=0, atol=0, msg=key)


def test_other_keys_beside_the_matcher_are_refused(shared_data: Path) -> None:
    path = shared_data / "weights" / "lighterglue" / "xfeat-lighterglue.pt"
    tensors = read_weights(find_weights(str(path)))
    for key in ("extractor.head.weight", "optimizer.step", "matcher.extra"):
        unknown = key.removeprefix("matcher.")
        with pytest.raises(DataError, match=rf"l\.pt: .*1 unexpected keys: {unknown}$"):
            load_lighterglue({**tensors, key: torch.zeros(1)}, "l.pt")


def test_what_does_not_fit_is_named(weights: str, shared_data: Path) -> None:
    tensors = read_weights(find_weights(weights))
    lost = tensors.pop("onnx::MatMul_1005")
    with pytest.raises(DataError, match=r"l\.onnx: .*onnx::MatMul_1005"):
        load_lighterglue(tensors, "l.onnx")
    with pytest.raises(DataError, match=r"transformers\.1\.self_attn\.out_proj\.weight is \(9"):
        load_lighterglue(tensors | {"onnx::MatMul_1005": lost[:, :9]}, "l.onnx")
    other = str(shared_data / "weights" / "aliked" / "aliked-t16.pth")
    image = random_image(3, seed=0)
    with pytest.raises(DataError, match=r"aliked-t16\.pth: .*it has no layers"):
        matcher(other).match(image, image)
    wide = replace(image, descriptors=np.zeros((3, 128), np.float32))
    with pytest.raises(DataError, match="descriptors of 64 values, the features' have 128"):
        matcher(weights).match(image, wide)


def test_without_kornia_it_says_what_to_install(
    weights: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "kornia", None)
    with pytest.raises(OptionError, match=r"pip install 'megloc-kapture\[kornia\]'"):
        matcher(weights)


def test_what_is_global_is_left_alone(weights: str) -> None:
    conf = dict(KorniaLightGlue.default_conf)
    before = torch.backends.cuda.flash_sdp_enabled()
    try:
        for flash in (True, False):
            torch.backends.cuda.enable_flash_sdp(flash)
            load_lighterglue(read_weights(find_weights(weights)), weights)
            assert torch.backends.cuda.flash_sdp_enabled() == flash
    finally:
        torch.backends.cuda.enable_flash_sdp(before)
    assert KorniaLightGlue.default_conf == conf


def test_it_travels_and_names_its_weights(weights: str) -> None:
    one = matcher(weights)
    image = random_image(30, seed=0)
    expected = one.match(image, image)
    other = pickle.loads(pickle.dumps(one))
    assert len(pickle.dumps(one)) < 10_000
    for ours, theirs in zip(other.match(image, image), expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [*one.weights()] == ["lighterglue_L3.onnx"]
