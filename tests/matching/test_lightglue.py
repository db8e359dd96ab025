"""LightGlue with random weights: the matches of the authors' code and of transformers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from transformers import LightGlueConfig, LightGlueForKeypointMatching, SuperPointConfig

from megloc_kapture.errors import DataError
from megloc_kapture.matching.networks import LightGlue, LightGlueOptions
from megloc_kapture.values import ImageFeatures
from tests.matching import published_lightglue as published

FULL = {"depth_confidence": -1.0, "width_confidence": -1.0}
LAYERS = 2  # of nine: each costs the same


def random_image(number: int, size: int, seed: int) -> ImageFeatures:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(number, size)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    xy = (0.5 + rng.random((number, 2)) * (639, 479)).astype(np.float32)
    return ImageFeatures(xy, descriptors, 640, 480)


def noisy(image: ImageFeatures, seed: int) -> ImageFeatures:
    """Return the keypoints in another order with noisy descriptors, and 40 others."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(image.descriptors))
    extra = random_image(40, image.descriptors.shape[1], seed + 1)
    noise = 0.02 * rng.normal(size=image.descriptors.shape).astype(np.float32)
    xy = np.concatenate([image.keypoints_px[order], extra.keypoints_px])
    descriptors = np.concatenate([image.descriptors[order] + noise, extra.descriptors])
    return replace(image, keypoints_px=xy, descriptors=descriptors)


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
    """Return the network's tensors by the keys of the published files."""
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


def matcher(path: Path, **options: float) -> LightGlue:
    """Build the plugin; by default with all layers and keypoints."""
    return LightGlue(LightGlueOptions(weights=str(path), device="cpu", **FULL | options))  # type: ignore[arg-type]


@pytest.mark.parametrize("setting", range(len(published.CONFIDENCES)))
def test_matches_equal_the_published_code(setting: int, tmp_path: Path) -> None:
    """Including early stops and dropped keypoints."""
    torch.save(published.tensors(), tmp_path / "random.pth")
    depth, width = published.CONFIDENCES[setting]
    plugin = matcher(tmp_path / "random.pth", depth_confidence=depth, width_confidence=width)
    with np.load(published.DATA) as data:
        for pair in range(len(published.PAIRS)):
            images = [
                ImageFeatures(xy + np.float32(0.5), descriptors, *published.IMAGE_SIZE)
                for xy, descriptors in published.features(pair)
            ]
            matches, scores = plugin.match(*images)
            layers, dropped = data[f"stop_{setting}_{pair}"]
            assert (layers < published.LAYERS) == (depth > 0) and (dropped > 0) == (width > 0)
            np.testing.assert_array_equal(matches, data[f"matches_{setting}_{pair}"])
            # random weights amplify the rounding of other processors to 1e-4
            np.testing.assert_allclose(scores, data[f"scores_{setting}_{pair}"], atol=1e-3)


def test_matches_equal_transformers(tmp_path: Path) -> None:
    network = transformers_network()
    torch.save(official_of(network), tmp_path / "superpoint_lightglue.pth")
    a = random_image(190, 256, seed=1)  # both images have as many: theirs is one tensor
    first = replace(a, keypoints_px=a.keypoints_px[:150], descriptors=a.descriptors[:150])
    b = noisy(first, seed=2)
    points = np.stack([a.keypoints_px, b.keypoints_px]) - np.float32(0.5)
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
    matches, scores = matcher(tmp_path / "superpoint_lightglue.pth").match(a, b)
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
    image = random_image(60, 128, seed=1)
    result = []
    # DISK's file has further tensors
    for each in (tensors, used, tensors | {"log_assignment.0.r": torch.zeros(1)}):
        torch.save(each, tmp_path / f"{len(each)}.pth")
        result.append(matcher(tmp_path / f"{len(each)}.pth").match(image, image))
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
    image = random_image(3, 128, seed=0)
    with pytest.raises(DataError, match=rf"it\.pth: .*{message}"):
        matcher(tmp_path / "it.pth").match(image, image)
