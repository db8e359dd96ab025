"""SuperGlue, LightGlue and LighterGlue: matches, batches, and rejected weights and features."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from published import plugin, random_features, seen_again, superglue_input
from transformers import LightGlueConfig, LightGlueForKeypointMatching, SuperPointConfig

from megloc_kapture.errors import DataError
from megloc_kapture.features.kornia_features import XFeat
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.matching.networks import (
    LighterGlue,
    LightGlue,
    SuperGlue,
)
from megloc_kapture.matching.verification import ray_slopes, sampson_error_px
from megloc_kapture.nets.kornia_networks import load_lighterglue
from megloc_kapture.nets.superglue import (
    SuperGlueNet,
    mutual_matches,
    superglue,
)
from megloc_kapture.values import ImageFeatures
from tests.matching import published_lightglue as published

LAYERS = 2  # of nine: each costs the same


@pytest.fixture(scope="module")
def superglue_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def test_matches_equal_the_networks_on_normalised_pixels(superglue_weights: Path) -> None:
    a = random_features(80, 64, 0)
    b = replace(seen_again(a, 1, kept=30, new=30, noise=0.0375), width=800, height=500)
    matches, scores = plugin(SuperGlue, superglue_weights).match(a, b)
    net = superglue(torch.load(superglue_weights, weights_only=True), "w").eval()
    with torch.inference_mode():
        assignment = net([(superglue_input(a), superglue_input(b))], 100)[0]
        expected, expected_scores = mutual_matches(assignment, 0.2)
    np.testing.assert_array_equal(matches, expected.numpy())
    np.testing.assert_array_equal(scores, expected_scores.numpy())
    assert matches.dtype == np.int64 and scores.dtype == np.float32
    right = (a.keypoints_px[matches[:, 0]] == b.keypoints_px[matches[:, 1]]).all(axis=1)
    assert right.sum() == 30  # all that are in both
    assert len(matches) < 50
    assert (np.diff(matches[:, 0]) > 0).all()
    assert scores.min() > 0.2
    median = float(np.median(scores))
    strict, _ = plugin(SuperGlue, superglue_weights, match_threshold=median).match(a, b)
    assert 0 < len(strict) < len(matches)


def test_matches_of_many_images_equal_those_of_single_pairs(superglue_weights: Path) -> None:
    a = random_features(80, 64, 0)
    again = seen_again(a, 1, kept=30), seen_again(a, 3, kept=45, new=45)
    others = [again[0], random_features(0, 64, 2), again[1], random_features(1, 64, 4)]
    network = plugin(SuperGlue, superglue_weights)
    alone = [network.match(a, other) for other in others]
    for (matches, scores), result in zip(alone, network.match_many(a, others), strict=True):
        np.testing.assert_array_equal(result[0], matches)
        np.testing.assert_allclose(result[1], scores, atol=1e-5)
    assert len(alone[0][0]) > 15 and len(alone[2][0]) > 15
    assert network.match_many(a, []) == []
    empty = random_features(0, 64, 0)
    nothing = replace(empty, descriptors=np.zeros((0, 0)))
    for first, second in ((empty, a), (a, empty), (nothing, a)):
        matches, scores = network.match(first, second)
        assert matches.shape == (0, 2) and matches.dtype == np.int64
        assert scores.shape == (0,) and scores.dtype == np.float32


def test_unusable_features_are_named(superglue_weights: Path) -> None:
    good = random_features(9, 64, 0)
    network = plugin(SuperGlue, superglue_weights)
    bare = ImageFeatures(good.keypoints_px[:, :2], good.descriptors, 640, 480)
    with pytest.raises(DataError, match=r"x, y, score.*\(9, 2\) \(superpoint"):
        network.match(good, bare)
    for value in (0.0, 1.5, -0.2, np.nan):
        table = good.keypoints_px.copy()
        table[4, 2] = value
        with pytest.raises(DataError, match=f"score as the third column.*has {value:g}"):
            network.match(ImageFeatures(table, good.descriptors, 640, 480), good)
    short = ImageFeatures(good.keypoints_px, good.descriptors[:, :32], 640, 480)
    with pytest.raises(DataError, match=r"small\.pth.*64 dimensions.*\(9, 32\)"):
        network.match(good, short)


FULL = {"depth_confidence": -1.0, "width_confidence": -1.0}


def transformers_network() -> LightGlueForKeypointMatching:
    """Build transformers' LightGlue for SuperPoint, with random weights."""
    config = LightGlueConfig(
        keypoint_detector_config=SuperPointConfig(),
        num_hidden_layers=LAYERS,
        depth_confidence=-1.0,
        width_confidence=-1.0,
        attn_implementation="eager",
    )
    network = LightGlueForKeypointMatching(config).eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, value in network.named_parameters():
            if not name.startswith("keypoint_detector") and "layer_norm" not in name:
                spread = 0.7 / value.shape[-1] ** 0.5
                value.copy_(torch.randn(value.shape, generator=generator) * spread)
        last = network.match_assignment_layers[-1]
        last.final_projection.weight.mul_(3)
        last.matchability.bias.fill_(4)
    return network


def official_of(network: LightGlueForKeypointMatching) -> dict[str, torch.Tensor]:
    tensors = {"posenc.Wr.weight": network.positional_encoder.projector.weight}

    def add(name: str, layer: torch.nn.Module) -> None:
        for kind, value in layer.named_parameters():
            tensors[f"{name}.{kind}"] = value

    for i, layer in enumerate(network.transformer_layers):
        attention, cross = layer.self_attention, layer.cross_attention
        projections = attention.q_proj, attention.k_proj, attention.v_proj
        cross.k_proj.load_state_dict(cross.q_proj.state_dict())  # one projection for both
        for kind in ("weight", "bias"):
            # query, key and value alternate
            parts = [getattr(p, kind) for p in projections]
            tensors[f"self_attn.{i}.Wqkv.{kind}"] = torch.stack(parts, dim=1).flatten(0, 1)
        add(f"self_attn.{i}.out_proj", attention.o_proj)
        add(f"cross_attn.{i}.to_qk", cross.q_proj)
        add(f"cross_attn.{i}.to_v", cross.v_proj)
        add(f"cross_attn.{i}.to_out", cross.o_proj)
        for block, perceptron in (("self_attn", layer.self_mlp), ("cross_attn", layer.cross_mlp)):
            add(f"{block}.{i}.ffn.0", perceptron.fc1)
            add(f"{block}.{i}.ffn.1", perceptron.layer_norm)
            add(f"{block}.{i}.ffn.3", perceptron.fc2)
    for i, assignment in enumerate(network.match_assignment_layers):
        add(f"log_assignment.{i}.final_proj", assignment.final_projection)
        add(f"log_assignment.{i}.matchability", assignment.matchability)
    for i, confidence in enumerate(network.token_confidence):
        add(f"token_confidence.{i}.token.0", confidence.token)
    return tensors


@pytest.mark.parametrize("setting", range(len(published.CONFIDENCES)))
def test_matches_equal_the_published_code(setting: int, tmp_path: Path) -> None:
    """Including early stops and dropped keypoints."""
    torch.save(published.tensors(), tmp_path / "random.pth")
    depth, width = published.CONFIDENCES[setting]
    confidences = {"depth_confidence": depth, "width_confidence": width}
    network = plugin(LightGlue, tmp_path / "random.pth", **confidences)
    with np.load(published.DATA) as data:
        for pair in range(len(published.PAIRS)):
            images = [
                ImageFeatures(xy + np.float32(0.5), descriptors, *published.IMAGE_SIZE)
                for xy, descriptors in published.features(pair)
            ]
            matches, scores = network.match(*images)
            layers, dropped = data[f"stop_{setting}_{pair}"]
            assert (layers < published.LAYERS) == (depth > 0) and (dropped > 0) == (width > 0)
            np.testing.assert_array_equal(matches, data[f"matches_{setting}_{pair}"])
            # random weights amplify the rounding of other processors to 1e-4
            np.testing.assert_allclose(scores, data[f"scores_{setting}_{pair}"], atol=1e-3)


def test_matches_equal_transformers(tmp_path: Path) -> None:
    network = transformers_network()
    torch.save(official_of(network), tmp_path / "superpoint_lightglue.pth")
    a = random_features(190, 256, 1)  # both images have as many: theirs is one tensor
    first = replace(a, keypoints_px=a.keypoints_px[:150], descriptors=a.descriptors[:150])
    b = seen_again(first, 2)
    points = np.stack([a.keypoints_px[:, :2], b.keypoints_px[:, :2]]) - np.float32(0.5)
    with torch.inference_mode():
        partner, their_scores, *_ = network._match_image_pair(
            torch.from_numpy(points)[None],
            torch.from_numpy(np.stack([a.descriptors, b.descriptors]))[None],
            height=480,
            width=640,
            mask=torch.ones(1, 2, 190, dtype=torch.int),
        )
    rows = torch.nonzero(partner[0] > -1)[:, 0]
    expected = torch.stack([rows, partner[0, rows].long()], dim=1).numpy()
    matches, scores = plugin(LightGlue, tmp_path / "superpoint_lightglue.pth", **FULL).match(a, b)
    assert len(matches) > 50 and scores.min() < 0.5 < scores.max()
    np.testing.assert_array_equal(matches, expected)
    np.testing.assert_allclose(scores, their_scores[0, rows].numpy(), atol=1e-4)


def test_unused_tensors_may_be_added_or_missing(tmp_path: Path) -> None:
    tensors = published.tensors()
    used = {
        key: value
        for key, value in tensors.items()
        if not key.startswith(("token_confidence", "log_assignment.0"))
    }
    image = random_features(60, 128, 1)
    result = []
    # DISK's file has further tensors
    for each in (tensors, used, tensors | {"log_assignment.0.r": torch.zeros(1)}):
        torch.save(each, tmp_path / f"{len(each)}.pth")
        network = plugin(LightGlue, tmp_path / f"{len(each)}.pth", **FULL)
        result.append(network.match(image, image))
    for matches, scores in result[1:]:
        np.testing.assert_array_equal(matches, result[0][0])
        np.testing.assert_array_equal(scores, result[0][1])


@pytest.mark.parametrize(
    ("key", "kept", "message"),
    [
        ("log_assignment.3.final_proj.bias", None, r"missing keys: log_assignment\.3\.final_proj"),
        # weights for features with scale and angle
        (
            "posenc.Wr.weight",
            np.s_[:, [0, 1, 0, 1]],
            r"posenc\.Wr\.weight is \(32, 4\), not \(32, 2\)",
        ),
    ],
)
def test_mismatched_weights_are_named(tmp_path: Path, key: str, kept: Any, message: str) -> None:
    tensors = dict(published.tensors())
    value = tensors.pop(key)
    if kept is not None:
        tensors[key] = value[kept].clone()
    torch.save(tensors, tmp_path / "it.pth")
    image = random_features(3, 128, 0)
    with pytest.raises(DataError, match=rf"it\.pth: .*{message}"):
        plugin(LightGlue, tmp_path / "it.pth", **FULL).match(image, image)


@pytest.fixture(scope="module")
def lighterglue_weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "lighterglue" / "xfeat-lighterglue.pt")


def test_most_matches_of_a_real_pair_are_right(
    lighterglue_weights: str, shared_data: Path, fountain: Path
) -> None:
    folder, names = KaptureFolder(fountain / "mapping"), ("0002.jpg", "0003.jpg")
    extractor = plugin(XFeat, shared_data / "weights/xfeat/xfeat.pt", max_keypoints=1000)
    both = []
    for name in names:
        image = read_image_rgb(folder.image_path(name))
        local = extractor.extract(image)
        both.append(ImageFeatures(local.keypoints_px, local.descriptors, *image.shape[1::-1]))
    matches, scores = plugin(LighterGlue, lighterglue_weights).match(*both)
    assert matches.dtype == np.int64 and scores.dtype == np.float32
    data, seen = folder.read(), []
    for side, image in enumerate(both):
        px = image.keypoints_px[matches[:, side], :2]
        camera = data.camera_of(names[side])
        rays = bearing_rays(camera, px)
        seen += [rays, ray_slopes(camera, px, rays)]
    first, second = (data.poses()[name] for name in names)
    assert len(matches) > 300
    assert (sampson_error_px(*seen, second @ first.inverse()) < 1.4).mean() > 0.7


def test_the_order_of_keypoints_does_not_matter(lighterglue_weights: str) -> None:
    a = random_features(200, 64, 3)
    rim = a.keypoints_px.copy()
    rim[:3, :2] = [[0.0, 0.0], [0.2, 479.9], [640.0, 480.0]]  # clamped: kornia refuses them
    a = replace(a, keypoints_px=rim)
    b = seen_again(a, 4, new=0, noise=0.0)
    matches, scores = plugin(LighterGlue, lighterglue_weights).match(a, b)
    assert len(matches) > 150 and (np.diff(matches[:, 0]) > 0).all()
    np.testing.assert_array_equal(a.descriptors[matches[:, 0]], b.descriptors[matches[:, 1]])
    assert len(np.unique(matches[:, 1])) == len(matches)
    back, back_scores = plugin(LighterGlue, lighterglue_weights).match(b, a)
    assert {*map(tuple, back[:, ::-1].tolist())} == {*map(tuple, matches.tolist())}
    np.testing.assert_allclose(np.sort(scores), np.sort(back_scores), atol=1e-4)


def test_mismatched_lighterglue_is_named(lighterglue_weights: str, shared_data: Path) -> None:
    tensors = read_weights(find_weights(lighterglue_weights))
    for key in ("extractor.head.weight", "optimizer.step", "matcher.extra"):
        unknown = key.removeprefix("matcher.")
        with pytest.raises(DataError, match=rf"l\.pt: .*1 unexpected keys: {unknown}$"):
            load_lighterglue({**tensors, key: torch.zeros(1)}, "l.pt")
    other = str(shared_data / "weights" / "aliked" / "aliked-t16.pth")
    image = random_features(3, 64, 0)
    with pytest.raises(DataError, match=r"aliked-t16\.pth: .*it has no layers"):
        plugin(LighterGlue, other).match(image, image)
    wide = replace(image, descriptors=np.zeros((3, 128), np.float32))
    with pytest.raises(DataError, match="descriptors of 64 dimensions, but the features have 128"):
        plugin(LighterGlue, lighterglue_weights).match(image, wide)
