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
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.features.xfeat import XFeat, XFeatOptions
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.matching.lightglue import LighterGlue, LighterGlueOptions, normalised_points
from megloc_kapture.nets.lightglue import KeypointBatch, load_lighterglue
from megloc_kapture.values import Camera, ImageFeatures, RigidTransform

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
    return replace(
        image, keypoints_px=image.keypoints_px[order], descriptors=image.descriptors[order]
    )


# ------------------------------------------------------------------ against onnxruntime


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


# ------------------------------------------------------------------ on a real scene


def epipolar_px(
    camera: Camera,
    poses: tuple[RigidTransform, RigidTransform],
    points: tuple[NDArray[np.floating], NDArray[np.floating]],
) -> NDArray[np.float64]:
    """Larger distance (N,) of two matched points to each other's epipolar line, pinhole camera."""
    fx, fy, cx, cy = camera.params
    inverse = np.linalg.inv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    b_from_a = poses[1] @ poses[0].inverse()
    x, y, z = b_from_a.translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    fundamental = inverse.T @ cross @ b_from_a.rotation_matrix() @ inverse
    a, b = (np.column_stack([p, np.ones(len(p))]) for p in points)
    line_b, line_a = a @ fundamental.T, b @ fundamental
    product = np.abs((b * line_b).sum(axis=1))
    return np.maximum(
        product / np.linalg.norm(line_b[:, :2], axis=1),
        product / np.linalg.norm(line_a[:, :2], axis=1),
    )


def test_most_matches_of_a_real_pair_are_right(
    weights: str, features: dict[str, ImageFeatures], fountain: KaptureFolder
) -> None:
    first, second = "0002.jpg", "0003.jpg"
    a, b = features[first], features[second]
    matches, scores = matcher(weights).match(a, b)
    data = fountain.read()
    poses = data.cam_from_world(first), data.cam_from_world(second)
    assert poses[0] is not None and poses[1] is not None
    points = a.keypoints_px[matches[:, 0], :2], b.keypoints_px[matches[:, 1], :2]
    error = epipolar_px(data.camera_of(first), (poses[0], poses[1]), points)
    assert len(matches) > 400
    assert (error < 2).mean() > 0.7
    # and the score says which
    sure = scores > np.median(scores)
    assert (error[sure] < 2).mean() > (error[~sure] < 2).mean()


# ------------------------------------------------------------------ positions


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


def test_a_third_column_makes_no_difference(
    weights: str, features: dict[str, ImageFeatures]
) -> None:
    a, b = features["0002.jpg"], features["0003.jpg"]
    bare = replace(a, keypoints_px=a.keypoints_px[:, :2])
    for ours, theirs in zip(
        matcher(weights).match(a, b), matcher(weights).match(bare, b), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


# ------------------------------------------------------------------ many pairs at once


def test_many_are_the_same_as_one_by_one(weights: str, features: dict[str, ImageFeatures]) -> None:
    one = matcher(weights)
    a = features["0003.jpg"]
    few = replace(
        features["0005.jpg"],
        keypoints_px=features["0005.jpg"].keypoints_px[:40],
        descriptors=features["0005.jpg"].descriptors[:40],
    )
    others = [features["0002.jpg"], random_image(0, seed=0), few]
    for (matches, scores), other in zip(one.match_many(a, others), others, strict=True):
        expected, expected_scores = one.match(a, other)
        np.testing.assert_array_equal(matches, expected)
        np.testing.assert_allclose(scores, expected_scores, atol=1e-5)
    assert one.match_many(a, []) == []


def test_padding_changes_nothing(weights: str, features: dict[str, ImageFeatures]) -> None:
    """What a GPU gets: pairs of different size in one batch."""
    network = load_lighterglue(read_weights(find_weights(weights)), weights)
    a, b = features["0002.jpg"], features["0003.jpg"]
    points = [torch.from_numpy(normalised_points(image)) for image in (a, b)]
    values = [torch.from_numpy(image.descriptors) for image in (a, b)]
    sizes = [(60, 80), (100, 30)]

    def batch(side: int) -> KeypointBatch:
        longest = max(size[side] for size in sizes)
        present = torch.zeros(2, longest, 1, dtype=torch.bool)
        for row, size in enumerate(sizes):
            present[row, : size[side]] = True
        rows = points[side][:longest], values[side][:longest]
        # padding of any value
        return KeypointBatch(rows[0].expand(2, -1, -1), rows[1].expand(2, -1, -1), present)

    with torch.inference_mode():
        together = network(batch(0), batch(1))
        for row, (m, n) in enumerate(sizes):
            alone = network(
                KeypointBatch(points[0][None, :m], values[0][None, :m]),
                KeypointBatch(points[1][None, :n], values[1][None, :n]),
            )
            torch.testing.assert_close(together[row, :m, :n], alone[0], rtol=1e-4, atol=1e-4)
            assert (together[row, m:] == -torch.inf).all()
            assert (together[row, :, n:] == -torch.inf).all()


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


# ------------------------------------------------------------------ checkpoints


def test_the_authors_checkpoint_has_other_names(weights: str, tmp_path: Path) -> None:
    """Six layers under ``matcher.``, with blocks by kind: written here with random values."""
    theirs = KorniaLightGlue(
        None, input_dim=64, descriptor_dim=96, n_layers=6, num_heads=1, flash=False
    )
    renamed = {}
    for key, value in theirs.state_dict().items():
        parts = key.split(".")
        if parts[0] == "transformers":
            parts[:3] = [parts[2], parts[1]]
        renamed["matcher." + ".".join(parts)] = value
    assert "matcher.self_attn.5.Wqkv.weight" in renamed
    torch.save(renamed, tmp_path / "xfeat-lighterglue.pt")
    network = load_lighterglue(
        read_weights(find_weights(str(tmp_path / "xfeat-lighterglue.pt"))), "it"
    )
    assert len(network.parts.transformers) == 6 and network.descriptor_size == 64
    for key, value in network.parts.state_dict().items():
        torch.testing.assert_close(value, theirs.state_dict()[key])


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


def test_beside_the_matcher_the_published_checkpoint_holds_xfeat_alone(shared_data: Path) -> None:
    """The published weights; what normalisation counted went on in training."""
    folder = shared_data / "weights"
    tensors = read_weights(find_weights(str(folder / "lighterglue" / "xfeat-lighterglue.pt")))
    xfeat = read_weights(find_weights(str(folder / "xfeat" / "xfeat.pt")))
    prefix = "extractor.model.net."
    assert {key for key in tensors if not key.startswith("matcher.")} == {prefix + k for k in xfeat}
    learned = [key for key in xfeat if key.endswith((".weight", ".bias"))]
    assert len(learned) > 30
    for key in learned:
        assert torch.equal(tensors[prefix + key], xfeat[key]), key


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


def test_descriptors_of_another_size_are_refused(weights: str) -> None:
    image = random_image(3, seed=0)
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
