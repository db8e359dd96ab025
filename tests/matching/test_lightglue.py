"""LightGlue with official checkpoints' keys and random values: the published code's matches,
transformers', and kornia's own.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kornia.feature import LightGlue as KorniaLightGlue
from transformers import LightGlueConfig, LightGlueForKeypointMatching, SuperPointConfig

from megloc_kapture.errors import DataError
from megloc_kapture.matching.networks import LightGlue, LightGlueOptions
from megloc_kapture.values import ImageFeatures
from tests.matching import published_lightglue as published

FULL = {"depth_confidence": -1.0, "width_confidence": -1.0}
SIZES = [256, 128]  # SuperPoint's descriptors, ALIKED's
LAYERS = 2  # of nine: each costs the same


def random_network(size: int) -> KorniaLightGlue:
    """kornia's network with weights that match like with like, so that there are matches."""
    torch.manual_seed(0)
    network = KorniaLightGlue(
        None, input_dim=size, n_layers=LAYERS, flash=False, filter_threshold=0.1, **FULL
    ).eval()
    with torch.no_grad():
        last = network.log_assignment[-1]
        last.final_proj.weight.mul_(8)
        last.matchability.bias.fill_(4)
    return network


def official(network: KorniaLightGlue) -> dict[str, torch.Tensor]:
    """Its tensors by the keys of the published files: blocks by kind."""
    tensors = {}
    for key, value in network.state_dict().items():
        parts = key.split(".")
        if parts[0] == "transformers":
            parts[:3] = [parts[2], parts[1]]
        tensors[".".join(parts)] = value
    return tensors


def random_image(number: int, size: int, seed: int) -> ImageFeatures:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(number, size)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    xy = (0.5 + rng.random((number, 2)) * (639, 479)).astype(np.float32)
    return ImageFeatures(xy, descriptors, 640, 480)


def noisy(image: ImageFeatures, seed: int) -> ImageFeatures:
    """The same keypoints in another order, a little changed, and some others."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(image.descriptors))
    extra = random_image(40, image.descriptors.shape[1], seed + 1)
    noise = 0.02 * rng.normal(size=image.descriptors.shape).astype(np.float32)
    xy = np.concatenate([image.keypoints_px[order], extra.keypoints_px])
    descriptors = np.concatenate([image.descriptors[order] + noise, extra.descriptors])
    return replace(image, keypoints_px=xy, descriptors=descriptors)


@pytest.fixture(scope="module", params=SIZES, ids=["superpoint", "aliked"])
def size(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture(scope="module")
def checkpoint(size: int, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / f"lightglue_{size}.pth"
    torch.save(official(random_network(size)), path)
    return path


def transformers_network() -> LightGlueForKeypointMatching:
    """transformers' LightGlue for SuperPoint, at full depth and width, with random weights."""
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
    """Its tensors by the keys of the published files."""
    tensors = {"posenc.Wr.weight": network.positional_encoder.projector.weight}

    def add(name: str, layer: torch.nn.Module) -> None:
        for kind, value in layer.named_parameters():
            tensors[f"{name}.{kind}"] = value

    for i, layer in enumerate(network.transformer_layers):
        own, cross = layer.self_attention, layer.cross_attention
        cross.k_proj.load_state_dict(cross.q_proj.state_dict())  # one projection for both
        for kind in ("weight", "bias"):
            # each value of each head: its query, its key, its value
            parts = [getattr(p, kind) for p in (own.q_proj, own.k_proj, own.v_proj)]
            tensors[f"self_attn.{i}.Wqkv.{kind}"] = torch.stack(parts, dim=1).flatten(0, 1)
        add(f"self_attn.{i}.out_proj", own.o_proj)
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
    """All layers and keypoints, unless the options say otherwise."""
    return LightGlue(LightGlueOptions(weights=str(path), device="cpu", **FULL | options))  # type: ignore[arg-type]


def assert_refused(tensors: dict[str, torch.Tensor], folder: Path, message: str) -> None:
    torch.save(tensors, folder / "it.pth")
    image = random_image(3, 128, seed=0)
    with pytest.raises(DataError, match=message):
        matcher(folder / "it.pth").match(image, image)


@pytest.mark.parametrize("setting", range(len(published.CONFIDENCES)))
def test_matches_equal_the_published_code(setting: int, tmp_path: Path) -> None:
    """Also where it stops early and drops keypoints."""
    torch.save(published.tensors(), tmp_path / "random.pth")
    depth, width = published.CONFIDENCES[setting]
    one = matcher(tmp_path / "random.pth", depth_confidence=depth, width_confidence=width)
    with np.load(published.DATA) as data:
        for pair in range(len(published.PAIRS)):
            images = [
                ImageFeatures(xy + np.float32(0.5), descriptors, *published.IMAGE_SIZE)
                for xy, descriptors in published.features(pair)
            ]
            matches, scores = one.match(*images)
            layers, dropped = data[f"stop_{setting}_{pair}"]
            assert (layers < published.LAYERS) == (depth > 0) and (dropped > 0) == (width > 0)
            np.testing.assert_array_equal(matches, data[f"matches_{setting}_{pair}"])
            np.testing.assert_allclose(scores, data[f"scores_{setting}_{pair}"], atol=1e-4)


def test_the_authors_thresholds_are_the_default() -> None:
    options = LightGlueOptions()
    thresholds = options.depth_confidence, options.width_confidence, options.threshold
    assert thresholds == (0.95, 0.99, 0.1)


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


def test_matches_are_kornias(checkpoint: Path, size: int) -> None:
    a = random_image(150, size, seed=1)
    b = noisy(a, seed=2)
    with torch.inference_mode():
        result = random_network(size)(
            {
                name: {
                    # the networks know the first pixel's centre as (0, 0)
                    "keypoints": torch.from_numpy(image.keypoints_px - 0.5)[None],
                    "descriptors": torch.from_numpy(image.descriptors)[None],
                    "image_size": torch.tensor([[image.width, image.height]]),
                }
                for name, image in (("image0", a), ("image1", b))
            }
        )
    matches, scores = matcher(checkpoint).match(a, b)
    assert len(matches) > 50
    np.testing.assert_array_equal(matches, result["matches"][0].numpy())
    np.testing.assert_allclose(scores, result["scores"][0].numpy(), atol=1e-4)


def test_unused_tensors_of_disks_file_are_ignored(tmp_path: Path) -> None:
    tensors = official(random_network(128))
    image = random_image(60, 128, seed=1)
    result = []
    for name, more in (("plain", {}), ("disk", {"log_assignment.0.r": torch.zeros(1)})):
        torch.save(tensors | more, tmp_path / f"{name}.pth")
        result.append(matcher(tmp_path / f"{name}.pth").match(image, image)[0])
    np.testing.assert_array_equal(*result)


def test_a_file_may_lack_unused_tensors(checkpoint: Path, size: int, tmp_path: Path) -> None:
    kept = {
        key: value
        for key, value in official(random_network(size)).items()
        if not key.startswith(("token_confidence", "confidence_thresholds", "log_assignment.0"))
    }
    torch.save(kept, tmp_path / "short.pth")
    a = random_image(60, size, seed=1)
    for ours, theirs in zip(
        matcher(tmp_path / "short.pth").match(a, a), matcher(checkpoint).match(a, a), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("key", "kept", "message"),
    [
        ("log_assignment.1.final_proj.bias", 0, r"missing keys: log_assignment\.1\.final_proj\.b"),
        ("cross_attn.0.to_v.bias", 0, r"missing keys: transformers\.0\.cross_attn\.to_v\.bias"),
        ("self_attn.1.Wqkv.bias", 9, r"transformers\.1\.self_attn\.Wqkv\.bias is \(9,\), not \(7"),
    ],
)
def test_mismatched_weights_are_named(
    size: int, tmp_path: Path, key: str, kept: int, message: str
) -> None:
    tensors = official(random_network(size))
    value = tensors.pop(key)
    if kept:
        tensors[key] = value[:kept].clone()
    assert_refused(tensors, tmp_path, r"it\.pth: .*" + message)


def test_weights_of_features_with_scale_and_angle_are_refused(tmp_path: Path) -> None:
    network = KorniaLightGlue(None, input_dim=128, n_layers=1, flash=False, add_scale_ori=True)
    assert_refused(official(network), tmp_path, r"posenc\.Wr\.weight is \(32, 4\), not \(32, 2\)")
