"""SuperGlue and its optimal transport against transformers on the same random weights.

The weights are peaky, so that attention and matches depend on few keypoints.
"""

from __future__ import annotations

import pytest
import torch
from published import random_features, seen_again, superglue_input
from transformers import SuperGlueConfig, SuperGlueForKeypointMatching
from transformers.models.superglue.modeling_superglue import log_optimal_transport as in_logarithm

from megloc_kapture.nets.superglue import (
    ImageKeypoints,
    SuperGlueNet,
    log_optimal_transport,
    mutual_matches,
    superglue,
)

WIDTH, HEIGHT = 640, 480
THRESHOLD = 0.2
# a quarter of the published width, and 6 of 18 layers: the same code in a tenth of the time
SIZE, ENCODER, LAYERS = 64, (8, 16, 32, 64, 64), 6
NOISE = 0.7 / SIZE**0.5


def peaky_weights() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    result = {}
    for key, shape in SuperGlueNet(ENCODER, LAYERS).state_dict().items():
        sizes = tuple(shape.shape)
        value = torch.randn(sizes, generator=generator)
        if len(sizes) == 3:
            value *= sizes[1] ** -0.5
        elif ".1.weight" in key or key.endswith("running_var"):
            value = 0.5 + torch.rand(sizes, generator=generator)
        else:
            value *= 0.1
        if ".proj.0." in key or ".proj.1." in key:
            value *= 12.0  # queries and keys
        elif ".mlp.3." in key:
            value *= 0.2
        result[key] = value
    result["bin_score"] = torch.tensor(2.0)
    result["final_proj.weight"] = result["final_proj.weight"] + 7.0 * torch.eye(SIZE)[:, :, None]
    return result


def transformers_model(weights: dict[str, torch.Tensor]) -> SuperGlueForKeypointMatching:
    """Rename the weights, and sort channels by attention head."""
    # row h * (SIZE / 4) + d of its projections is row d * 4 + h of the official ones
    order = torch.arange(SIZE).view(SIZE // 4, 4).T.flatten()
    renamed = {}
    for key, value in weights.items():
        name, value = key, value.squeeze(-1) if value.ndim == 3 else value
        if ".attn.proj." in key:
            value = value[order]
        elif key.endswith(".attn.merge.weight"):
            value = value[:, order]
        if key.startswith("kenc.encoder."):
            index, kind = key.removeprefix("kenc.encoder.").split(".")
            layer, part = divmod(int(index), 3)
            part_name = "" if layer == 4 else (".linear", ".batch_norm")[part]
            name = f"keypoint_encoder.encoder.{layer}{part_name}.{kind}"
        for ours, theirs in (
            ("attn.proj.0", "attention.self.query"),
            ("attn.proj.1", "attention.self.key"),
            ("attn.proj.2", "attention.self.value"),
            ("attn.merge", "attention.output.dense"),
            ("mlp.0", "mlp.0.linear"),
            ("mlp.1", "mlp.0.batch_norm"),
            ("mlp.3", "mlp.1"),
        ):
            name = name.replace(f".{ours}.", f".{theirs}.")
        if key.startswith("final_proj."):
            name = f"final_projection.{key}"
        renamed[name] = value
    config = SuperGlueConfig(
        matching_threshold=THRESHOLD,
        hidden_size=SIZE,
        keypoint_encoder_sizes=list(ENCODER[:-1]),
        gnn_layers_types=["self", "cross"] * (LAYERS // 2),
        attn_implementation="eager",
    )
    model = SuperGlueForKeypointMatching(config).eval()
    expected_keys = {k for k in model.state_dict() if not k.startswith("keypoint_detector.")}
    assert expected_keys == set(renamed)
    model.load_state_dict(renamed, strict=False)
    return model


def transformers_matches(
    model: SuperGlueForKeypointMatching, a: ImageKeypoints, b: ImageKeypoints
) -> tuple[torch.Tensor, torch.Tensor]:
    """Partner in b of each keypoint of a, or -1, and scores."""
    half = torch.tensor([WIDTH, HEIGHT]) / 2
    matches, scores, _, _ = model._match_image_pair(
        torch.stack([image.xy * 0.7 * WIDTH + half for image in (a, b)])[None],
        torch.stack([a.descriptors, b.descriptors])[None],
        torch.stack([a.scores, b.scores])[None],
        HEIGHT,
        WIDTH,
    )
    return matches[0, 0], scores[0, 0]


def partners(assignment: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return partners and scores like :func:`transformers_matches`."""
    matches, scores = mutual_matches(assignment, THRESHOLD)
    partner = torch.full((len(assignment) - 1,), -1)
    values = torch.zeros(len(assignment) - 1)
    partner[matches[:, 0]], values[matches[:, 0]] = matches[:, 1], scores
    return partner, values


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    return peaky_weights()


@pytest.fixture(scope="module")
def net(weights: dict[str, torch.Tensor]) -> SuperGlueNet:
    return superglue(weights, "w.pth").eval()


@torch.inference_mode()
def test_matches_equal_transformers(net: SuperGlueNet, weights: dict[str, torch.Tensor]) -> None:
    first = random_features(150, SIZE, 0)
    a, b = map(superglue_input, (first, seen_again(first, 0, kept=110, noise=NOISE)))
    partner, scores = partners(net([(a, b)], 100)[0])
    expected, expected_scores = transformers_matches(transformers_model(weights), a, b)
    result = partner >= 0
    assert 40 < result.sum() < 150
    assert partner.tolist() == expected.tolist()
    torch.testing.assert_close(scores, expected_scores * result, rtol=0, atol=1e-5)


@torch.inference_mode()
def test_a_batch_of_pairs_of_any_sizes_gives_the_matches_of_each_pair(net: SuperGlueNet) -> None:
    a = random_features(150, SIZE, 0)
    features = [
        (a, seen_again(a, 0, kept=110, noise=NOISE)),
        (a, random_features(1, SIZE, 2)),
        (random_features(3, SIZE, 3), a),
        (a, seen_again(a, 4, kept=60, new=30, noise=NOISE)),
    ]
    pairs = [(superglue_input(first), superglue_input(second)) for first, second in features]
    together = net(pairs, 100)
    for pair, result in zip(pairs, together, strict=True):
        alone = net([pair], 100)[0]
        assert result.shape == alone.shape == (len(pair[0].scores) + 1, len(pair[1].scores) + 1)
        torch.testing.assert_close(result.exp(), alone.exp(), rtol=1e-4, atol=1e-5)
        matches, _ = mutual_matches(result, THRESHOLD)
        assert torch.equal(matches, mutual_matches(alone, THRESHOLD)[0])
    assert len(mutual_matches(together[0], THRESHOLD)[0]) > 30


@torch.inference_mode()
def test_half_precision_ends_before_the_transport(net: SuperGlueNet) -> None:
    first = random_features(150, SIZE, 9)
    a, b = map(superglue_input, (first, seen_again(first, 10, kept=110, noise=NOISE)))
    whole = net([(a, b)], 100)[0]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = net([(a, b)], 100)[0]
    assert half.dtype == torch.float32
    assert not torch.equal(half, whole)
    # the columns come last, so they are normalised to float32's precision
    torch.testing.assert_close(half.exp().sum(0)[:-1], torch.ones(150), rtol=0, atol=1e-4)
    agreeing = (partners(half)[0] == partners(whole)[0]).float().mean()
    assert agreeing > 0.95


# scores beyond a thousand: an exponential alone over- and underflows
@pytest.mark.parametrize(
    ("scale", "iterations", "bin_score"), [(0.1, 1, 2.3), (10.0, 2, -300.0), (300.0, 100, 300.0)]
)
def test_transport_equals_transformers(scale: float, iterations: int, bin_score: float) -> None:
    scores = scale * torch.randn((60, 45), generator=torch.Generator().manual_seed(0))
    dustbin = torch.tensor(bin_score)
    expected = in_logarithm(scores[None].double(), dustbin.double(), iterations)[0]
    exactly = log_optimal_transport([scores.double()], dustbin.double(), iterations)[0]
    torch.testing.assert_close(exactly, expected, rtol=1e-12, atol=1e-9)
    result = log_optimal_transport([scores], dustbin, iterations)[0]
    assert result.dtype == torch.float32
    torch.testing.assert_close(result.double(), expected, rtol=3e-7, atol=3e-5)
    inner = result[:-1, :-1].double().exp()
    torch.testing.assert_close(inner, expected[:-1, :-1].exp(), rtol=0, atol=1e-5)
