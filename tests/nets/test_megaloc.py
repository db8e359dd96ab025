"""MegaLoc: resampling against PIL, SALAD against its equations, DINOv2 against transformers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from published import small_megaloc
from torch.nn import functional
from transformers import Dinov2Config, Dinov2Model

from megloc_kapture.errors import OptionError
from megloc_kapture.nets import megaloc
from megloc_kapture.nets.megaloc import DinoV2, Salad, assignment, megaloc_from, squared

CHANNELS, CLUSTERS, SIZE, TOKEN = 6, 4, 5, 3  # of SALAD
DINO_CHANNELS, DINO_DEPTH, DINO_HEADS, DINO_GRID = 24, 3, 4, 5


def test_the_vector_is_normalised_and_linear_in_the_aggregated_tokens() -> None:
    torch.manual_seed(0)
    network = small_megaloc().eval()
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
    kept = small_megaloc()
    tensors = dict(kept.state_dict())
    if older:
        trunk = [key for key in tensors if key.startswith("backbone.")]
        for key in trunk:
            tensors[key.replace("backbone.", "backbone.model.")] = tensors.pop(key)
        tensors["backbone.model.mask_token"] = torch.zeros(1, 12)
    monkeypatch.setattr(megaloc, "MegaLocNet", small_megaloc)
    network = megaloc_from(tensors, "w")
    assert not network.training
    for key, value in kept.state_dict().items():
        torch.testing.assert_close(network.state_dict()[key], value, rtol=0, atol=0)


@pytest.mark.parametrize("size", [(20, 31), (28, 28), (101, 9)])
def test_images_are_scaled_as_by_pil(size: tuple[int, int]) -> None:
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    result = squared(image, 28)[0]
    for channel, plane in zip(result, image[0], strict=True):
        expected = Image.fromarray(plane.numpy()).resize((28, 28), Image.Resampling.BILINEAR)
        np.testing.assert_allclose(channel.numpy(), np.asarray(expected), atol=1e-5)


def random_salad() -> Salad:
    torch.manual_seed(0)
    net = Salad(CHANNELS, clusters=CLUSTERS, cluster_size=SIZE, token_size=TOKEN, hidden=7)
    with torch.no_grad():
        for value in net.parameters():
            value.normal_(0.0, 0.8)
        net.dust_bin.fill_(0.7)
    return net.eval()


def random_input(rows: int = 3, columns: int = 4) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(1)
    patches = torch.randn(2, CHANNELS, rows, columns, generator=generator)
    return patches, torch.randn(2, CHANNELS, generator=generator)


def sinkhorn(scores: NDArray[np.float64], dustbin: float) -> NDArray[np.float64]:
    """Shares (clusters, patches) of one image, from the plain exponentials.

    Each of N patches has the mass 1 / (N + K), each of K clusters too, the dustbin
    (N - K) / (N + K); the result is multiplied by N + K.
    """
    clusters, patches = scores.shape
    mass = 1 / (patches + clusters)
    kernel = np.exp(np.vstack([scores, np.full((1, patches), dustbin)]))
    rows = np.array([mass] * clusters + [mass * (patches - clusters)])
    v = np.ones(patches)
    for _ in range(3):
        u = rows / (kernel @ v)
        v = mass / (u @ kernel)
    return (u[:, None] * kernel * v)[:clusters] * (patches + clusters)


def test_the_vector_equals_the_equations_of_salad() -> None:
    net = random_salad()
    patches, whole = random_input()
    result = net(patches, whole).detach().numpy()
    assert result.dtype == np.float32 and result.shape == (2, TOKEN + SIZE * CLUSTERS)
    exact = random_salad().double()
    scores, features = exact.score(patches.double()), exact.cluster_features(patches.double())
    tokens = exact.token_features(whole.double()).detach().numpy()
    for image in range(2):
        shares = sinkhorn(scores[image].flatten(1).detach().numpy(), net.dust_bin.item())
        summed = features[image].flatten(1).detach().numpy() @ shares.T
        summed /= np.linalg.norm(summed, axis=0)
        token = tokens[image] / np.linalg.norm(tokens[image])
        expected = np.concatenate([token, summed.ravel()])
        expected /= np.linalg.norm(expected)
        np.testing.assert_allclose(result[image], expected, atol=2e-6)


def test_shares_of_huge_scores_are_finite_and_at_most_one() -> None:
    generator = torch.Generator().manual_seed(3)
    scores = 300 * torch.randn(1, 64, 529, generator=generator)
    shares = assignment(scores, torch.tensor(-200.0))
    assert shares.isfinite().all() and (shares >= 0).all()
    assert shares.sum(1).max() < 1 + 1e-4
    assert shares.sum() > 5


def test_an_image_needs_more_patches_than_clusters() -> None:
    net = random_salad()
    with pytest.raises(OptionError, match="an image of 4 patches is too small for 4 clusters"):
        net(*random_input(rows=2, columns=2))
    assert net(*random_input(rows=1, columns=5)).isfinite().all()


def small_trunk(seed: int = 0) -> DinoV2:
    generator = torch.Generator().manual_seed(seed)
    net = DinoV2(channels=DINO_CHANNELS, depth=DINO_DEPTH, heads=DINO_HEADS, grid=DINO_GRID)
    with torch.no_grad():
        for name, value in net.named_parameters():
            value.normal_(0.0, 0.3, generator=generator)
            if name.endswith("gamma") or "norm" in name and name.endswith("weight"):
                value.add_(0.8)
    return net.eval()


def as_transformers(net: DinoV2) -> Dinov2Model:
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
        old, new = f"blocks.{i}.", f"encoder.layer.{i}."
        for end in ("weight", "bias"):
            for part in ("norm1", "norm2", "mlp.fc1", "mlp.fc2"):
                renamed[f"{new}{part}.{end}"] = ours[f"{old}{part}.{end}"]
            for part, value in zip("qkv", ours[f"{old}attn.qkv.{end}"].chunk(3), strict=True):
                renamed[f"{new}attention.{part}_proj.{end}"] = value
            renamed[f"{new}attention.o_proj.{end}"] = ours[f"{old}attn.proj.{end}"]
        for k in (1, 2):
            renamed[f"{new}layer_scale{k}.lambda1"] = ours[f"{old}ls{k}.gamma"]
    theirs.load_state_dict(renamed, strict=True)
    return theirs


def tokens_of(net: DinoV2, image: torch.Tensor) -> torch.Tensor:
    """Tokens in the order of transformers: the image's first, then the patches' by row."""
    with torch.inference_mode():
        patches, whole = net(image)
    return torch.cat([whole[:, None], patches.flatten(2).transpose(1, 2)], dim=1)


def test_tokens_equal_transformers_with_the_same_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    net = small_trunk(2)
    theirs = as_transformers(net)
    image = torch.randn(1, 3, 42, 98, generator=torch.Generator().manual_seed(3))
    # transformers interpolates positions by another rule than DINOv2's authors
    monkeypatch.setattr(
        theirs.embeddings,
        "interpolate_pos_encoding",
        lambda _, height, width: net.positions(height // 14, width // 14),
    )
    with torch.inference_mode():
        expected = theirs(image).last_hidden_state
    torch.testing.assert_close(tokens_of(net, image), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("rows", "columns"), [(3, 7), (9, 2)])
def test_positions_are_interpolated_with_the_offset_of_dinov2(rows: int, columns: int) -> None:
    net = small_trunk(4)
    learnt = net.pos_embed.detach()
    maps = learnt[0, 1:].T.view(1, DINO_CHANNELS, DINO_GRID, DINO_GRID)
    factors = ((rows + 0.1) / DINO_GRID, (columns + 0.1) / DINO_GRID)
    expected = functional.interpolate(maps, scale_factor=factors, mode="bicubic")
    result = net.positions(rows, columns).detach()
    torch.testing.assert_close(result[0, 0], learnt[0, 0])
    torch.testing.assert_close(result[0, 1:].T, expected[0].flatten(1), rtol=0, atol=1e-5)
