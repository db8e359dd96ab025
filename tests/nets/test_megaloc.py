"""MegaLoc: its published file, pixels against PIL, SALAD by loops, DINOv2 against transformers'."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import nn
from transformers import Dinov2Config, Dinov2Model

from megloc_kapture.errors import OptionError
from megloc_kapture.nets import megaloc
from megloc_kapture.nets.megaloc import DinoV2, MegaLocNet, Salad, assignment, megaloc_from, squared

CHANNELS, CLUSTERS, SIZE, TOKEN = 6, 4, 5, 3  # of SALAD
DINO_CHANNELS, DINO_DEPTH, DINO_HEADS, DINO_GRID = 24, 3, 4, 5


def small() -> MegaLocNet:
    return MegaLocNet(
        DinoV2(channels=8, depth=2, heads=2, grid=5),
        clusters=4,
        cluster_size=3,
        token_size=2,
        descriptor_size=10,
    )


def test_parts_follow_each_other() -> None:
    torch.manual_seed(0)
    network = small().eval()
    image = torch.rand(2, 3, 42, 56)
    mean, deviation = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])
    with torch.inference_mode():
        result = network(image)
        normalised = (image - mean[:, None, None]) / deviation[:, None, None]
        aggregated = network.aggregator["agg"](*network.backbone(normalised))
        linear = network.aggregator["linear"]
        expected = aggregated @ linear.weight.T + linear.bias
        expected = expected / expected.pow(2).sum(1, keepdim=True).sqrt()
    torch.testing.assert_close(result, expected)
    torch.testing.assert_close(result.norm(dim=1), torch.ones(2))
    assert (result[0] - result[1]).abs().max() > 1e-4


@pytest.mark.parametrize("older", [False, True])
def test_both_published_layouts_are_read(older: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(1)
    kept = small()
    tensors = dict(kept.state_dict())
    if older:
        trunk = [key for key in tensors if key.startswith("backbone.")]
        for key in trunk:
            tensors[key.replace("backbone.", "backbone.model.")] = tensors.pop(key)
        tensors["backbone.model.mask_token"] = torch.zeros(1, 8)
    monkeypatch.setattr(megaloc, "MegaLocNet", small)
    network = megaloc_from(tensors, "w")
    assert not network.training
    for key, value in kept.state_dict().items():
        torch.testing.assert_close(network.state_dict()[key], value, rtol=0, atol=0)


@pytest.mark.parametrize("size", [(57, 43), (20, 31), (28, 28), (1, 1), (101, 9)])
def test_images_are_scaled_as_pil_scales(size: tuple[int, int]) -> None:
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    result = squared(image, 28)[0]
    for channel, plane in zip(result, image[0], strict=True):
        expected = Image.fromarray(plane.numpy()).resize((28, 28), Image.Resampling.BILINEAR)
        np.testing.assert_allclose(channel.numpy(), np.asarray(expected), atol=1e-5)


def randomised(seed: int = 0) -> Salad:
    torch.manual_seed(seed)
    net = Salad(CHANNELS, clusters=CLUSTERS, cluster_size=SIZE, token_size=TOKEN, hidden=7)
    with torch.no_grad():
        for value in net.parameters():
            value.normal_(0.0, 0.8)
        net.dust_bin.fill_(0.7)
    return net.eval()


def random_input(seed: int = 1, rows: int = 3, columns: int = 4) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    patches = torch.randn(2, CHANNELS, rows, columns, generator=generator)
    return patches, torch.randn(2, CHANNELS, generator=generator)


def sinkhorn_by_loops(scores: NDArray[np.float64], dustbin: float) -> NDArray[np.float64]:
    """Shares of one image, (clusters, patches), from the plain exponentials.

    Each of N patches has the mass 1 / (N + K), each of K clusters too, the dustbin
    (N - K) / (N + K); at the end all is multiplied by N + K.
    """
    clusters, patches = scores.shape
    mass = 1 / (patches + clusters)
    kernel = np.exp(np.vstack([scores, np.full((1, patches), dustbin)]))
    taken = [mass] * clusters + [mass * (patches - clusters)]
    u, v = [1.0] * (clusters + 1), [1.0] * patches
    for _ in range(3):
        for k in range(clusters + 1):
            u[k] = taken[k] / sum(kernel[k, i] * v[i] for i in range(patches))
        for i in range(patches):
            v[i] = mass / sum(kernel[k, i] * u[k] for k in range(clusters + 1))
    plan = [[kernel[k, i] * u[k] * v[i] for i in range(patches)] for k in range(clusters)]
    return np.array(plan) * (patches + clusters)


def perceptron(layers: nn.Sequential, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear, ReLU, linear, of one vector."""
    first, last = (layer for layer in layers if hasattr(layer, "weight"))
    for layer in (first, last):
        weight = layer.weight.detach().double().numpy().reshape(len(layer.bias), -1)
        x = weight @ x + layer.bias.detach().double().numpy()
        if layer is first:
            x = np.maximum(x, 0)
    return x


def unit(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return x / math.sqrt((x**2).sum())


def test_the_vector_is_the_papers() -> None:
    net = randomised()
    patches, whole = random_input()
    result = net(patches, whole).detach().numpy()
    assert result.dtype == np.float32 and result.shape == (2, TOKEN + SIZE * CLUSTERS)
    for image in range(2):
        rows = patches[image].flatten(1).T.double().numpy()
        scores = np.array([perceptron(net.score, row) for row in rows]).T
        features = np.array([perceptron(net.cluster_features, row) for row in rows])
        shares = sinkhorn_by_loops(scores, net.dust_bin.item())
        summed = np.zeros((SIZE, CLUSTERS))
        for k in range(CLUSTERS):
            for i in range(len(rows)):
                summed[:, k] += shares[k, i] * features[i]
            summed[:, k] = unit(summed[:, k])
        token = unit(perceptron(net.token_features, whole[image].double().numpy()))
        expected = unit(np.concatenate([token, summed.ravel()]))
        np.testing.assert_allclose(result[image], expected, atol=2e-6)


def test_no_patch_gives_more_than_it_has_and_huge_scores_stay_numbers() -> None:
    generator = torch.Generator().manual_seed(3)
    scores = 300 * torch.randn(2, 64, 529, generator=generator)
    shares = assignment(scores, torch.tensor(-200.0))
    assert shares.isfinite().all() and (shares >= 0).all()
    assert shares.sum(1).max() < 1 + 1e-4
    assert shares.sum() > 10


def test_it_needs_more_patches_than_clusters() -> None:
    net = randomised()
    with pytest.raises(OptionError, match="an image of 4 patches is too small for 4 clusters"):
        net(*random_input(rows=2, columns=2))
    assert net(*random_input(rows=1, columns=5)).isfinite().all()


def small_trunk(seed: int = 0) -> DinoV2:
    """A small trunk in which nothing is trivial: norms, layer scale, positions."""
    generator = torch.Generator().manual_seed(seed)
    net = DinoV2(channels=DINO_CHANNELS, depth=DINO_DEPTH, heads=DINO_HEADS, grid=DINO_GRID)
    with torch.no_grad():
        for name, value in net.named_parameters():
            value.normal_(0.0, 0.3, generator=generator)
            if name.endswith("gamma") or "norm" in name and name.endswith("weight"):
                value.add_(0.8)
    return net.eval()


def as_transformers(net: DinoV2) -> Dinov2Model:
    """transformers' model with the same weights; every one of its weights is set."""
    config = Dinov2Config(
        hidden_size=DINO_CHANNELS,
        num_hidden_layers=DINO_DEPTH,
        num_attention_heads=DINO_HEADS,
        image_size=14 * DINO_GRID,
        patch_size=14,
    )
    theirs = Dinov2Model(config).eval()
    ours = net.state_dict()
    renamed = {
        "embeddings.cls_token": ours["cls_token"],
        "embeddings.mask_token": torch.zeros(1, DINO_CHANNELS),
        "embeddings.position_embeddings": ours["pos_embed"],
        "embeddings.patch_embeddings.projection.weight": ours["patch_embed.proj.weight"],
        "embeddings.patch_embeddings.projection.bias": ours["patch_embed.proj.bias"],
        "layernorm.weight": ours["norm.weight"],
        "layernorm.bias": ours["norm.bias"],
    }
    for i in range(DINO_DEPTH):
        here, there = f"blocks.{i}.", f"encoder.layer.{i}."
        for end in ("weight", "bias"):
            for part in ("norm1", "norm2", "mlp.fc1", "mlp.fc2"):
                renamed[f"{there}{part}.{end}"] = ours[f"{here}{part}.{end}"]
            for part, value in zip("qkv", ours[f"{here}attn.qkv.{end}"].chunk(3), strict=True):
                renamed[f"{there}attention.{part}_proj.{end}"] = value
            renamed[f"{there}attention.o_proj.{end}"] = ours[f"{here}attn.proj.{end}"]
        for k in (1, 2):
            renamed[f"{there}layer_scale{k}.lambda1"] = ours[f"{here}ls{k}.gamma"]
    theirs.load_state_dict(renamed, strict=True)
    return theirs


def tokens_of(net: DinoV2, image: torch.Tensor) -> torch.Tensor:
    """As transformers orders them: the whole's first, then the patches', row by row."""
    with torch.inference_mode():
        patches, whole = net(image)
    return torch.cat([whole[:, None], patches.flatten(2).transpose(1, 2)], dim=1)


@pytest.mark.parametrize("size", [(42, 98), (98, 42), (112, 70)])
def test_at_other_sizes_only_the_positions_differ_from_transformers(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    net = small_trunk(2)
    theirs = as_transformers(net)
    image = torch.randn(1, 3, *size, generator=torch.Generator().manual_seed(3))
    result = tokens_of(net, image)
    with torch.inference_mode():
        by_its_own_rule = theirs(image).last_hidden_state
        monkeypatch.setattr(
            theirs.embeddings,
            "interpolate_pos_encoding",
            lambda _, height, width: net.positions(height // 14, width // 14),
        )
        expected = theirs(image).last_hidden_state
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)
    # its rule is near the official one, and not it
    distance = (result - by_its_own_rule).abs().max()
    assert 1e-3 < distance < 1.0


def cubic(distance: float) -> float:
    """Keys' kernel with a = -0.75, which torch takes."""
    x = abs(distance)
    if x <= 1:
        return 1.25 * x**3 - 2.25 * x**2 + 1
    return -0.75 * x**3 + 3.75 * x**2 - 6 * x + 3 if x < 2 else 0.0


def weights(length: int, learnt: int) -> NDArray[np.float64]:
    """Matrix (length, learnt) of the bicubic reading whose scale is (length + 0.1) / learnt."""
    matrix = np.zeros((length, learnt))
    for k in range(length):
        place = (k + 0.5) * learnt / (length + 0.1) - 0.5
        for tap in range(math.floor(place) - 1, math.floor(place) + 3):
            matrix[k, min(max(tap, 0), learnt - 1)] += cubic(place - tap)
    return matrix


@pytest.mark.parametrize(("rows", "columns"), [(3, 7), (9, 2), (5, 6), (1, 1), (4, 4)])
def test_positions_are_read_bicubically_with_dinov2s_offset(rows: int, columns: int) -> None:
    net = small_trunk(4)
    learnt = net.pos_embed.detach().double().numpy()[0]
    maps = learnt[1:].reshape(DINO_GRID, DINO_GRID, DINO_CHANNELS)
    expected = np.einsum(
        "ri,cj,ijk->rck", weights(rows, DINO_GRID), weights(columns, DINO_GRID), maps
    )
    result = net.positions(rows, columns).detach().numpy()[0]
    np.testing.assert_allclose(result[0], learnt[0], atol=1e-7)
    np.testing.assert_allclose(
        result[1:].reshape(rows, columns, DINO_CHANNELS), expected, atol=1e-5
    )


def test_incomplete_patches_are_left_out() -> None:
    net = small_trunk()
    image = torch.randn(1, 3, 75, 95, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(tokens_of(net, image), tokens_of(net, image[:, :, :70, :84]))
    assert tokens_of(net, image).shape == (1, 1 + 5 * 6, DINO_CHANNELS)
