"""DINOv2's trunk against transformers' on the same weights, its positions against plain loops."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from transformers import Dinov2Config, Dinov2Model

from megloc_kapture.nets.megaloc import DinoV2

CHANNELS, DEPTH, HEADS, GRID = 24, 3, 4, 5


def randomised(seed: int = 0) -> DinoV2:
    """A small trunk in which nothing is trivial: norms, layer scale, positions."""
    generator = torch.Generator().manual_seed(seed)
    net = DinoV2(channels=CHANNELS, depth=DEPTH, heads=HEADS, grid=GRID)
    with torch.no_grad():
        for name, value in net.named_parameters():
            value.normal_(0.0, 0.3, generator=generator)
            if name.endswith("gamma") or "norm" in name and name.endswith("weight"):
                value.add_(0.8)
    return net.eval()


def as_transformers(net: DinoV2) -> Dinov2Model:
    """transformers' model with the same weights; every one of its weights is set."""
    config = Dinov2Config(
        hidden_size=CHANNELS,
        num_hidden_layers=DEPTH,
        num_attention_heads=HEADS,
        image_size=14 * GRID,
        patch_size=14,
    )
    theirs = Dinov2Model(config).eval()
    ours = net.state_dict()
    renamed = {
        "embeddings.cls_token": ours["cls_token"],
        "embeddings.mask_token": torch.zeros(1, CHANNELS),
        "embeddings.position_embeddings": ours["pos_embed"],
        "embeddings.patch_embeddings.projection.weight": ours["patch_embed.proj.weight"],
        "embeddings.patch_embeddings.projection.bias": ours["patch_embed.proj.bias"],
        "layernorm.weight": ours["norm.weight"],
        "layernorm.bias": ours["norm.bias"],
    }
    for i in range(DEPTH):
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


def test_tokens_are_transformers() -> None:
    net = randomised()
    theirs = as_transformers(net)
    image = torch.randn(2, 3, 14 * GRID, 14 * GRID, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        expected = theirs(image).last_hidden_state
    assert expected.std() > 0.3  # the comparison says something
    torch.testing.assert_close(tokens_of(net, image), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("size", [(42, 98), (98, 42), (112, 70)])
def test_at_other_sizes_only_the_positions_differ_from_transformers(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    net = randomised(2)
    theirs = as_transformers(net)
    image = torch.randn(1, 3, *size, generator=torch.Generator().manual_seed(3))
    found = tokens_of(net, image)
    with torch.inference_mode():
        by_its_own_rule = theirs(image).last_hidden_state
        monkeypatch.setattr(
            theirs.embeddings,
            "interpolate_pos_encoding",
            lambda _, height, width: net.positions(height // 14, width // 14),
        )
        expected = theirs(image).last_hidden_state
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    # its rule is near the official one, and not it
    distance = (found - by_its_own_rule).abs().max()
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
    net = randomised(4)
    learnt = net.pos_embed.detach().double().numpy()[0]
    maps = learnt[1:].reshape(GRID, GRID, CHANNELS)
    expected = np.einsum("ri,cj,ijk->rck", weights(rows, GRID), weights(columns, GRID), maps)
    found = net.positions(rows, columns).detach().numpy()[0]
    np.testing.assert_allclose(found[0], learnt[0], atol=1e-7)
    np.testing.assert_allclose(found[1:].reshape(rows, columns, CHANNELS), expected, atol=1e-5)


def test_at_the_learnt_size_positions_are_as_learnt() -> None:
    net = randomised()
    torch.testing.assert_close(net.positions(GRID, GRID), net.pos_embed, rtol=0, atol=0)


@given(st.integers(1, 90), st.integers(1, 90))
@settings(max_examples=60)
def test_every_size_has_as_many_positions_as_patches(rows: int, columns: int) -> None:
    net = DinoV2(channels=1, depth=0, heads=1)
    assert net.positions(rows, columns).shape == (1, 1 + rows * columns, 1)


def test_what_fills_no_patch_is_left_out() -> None:
    net = randomised()
    image = torch.randn(1, 3, 75, 95, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(tokens_of(net, image), tokens_of(net, image[:, :, :70, :84]))
    assert tokens_of(net, image).shape == (1, 1 + 5 * 6, CHANNELS)


def test_vit_b_has_as_many_parameters_as_transformers() -> None:
    with torch.device("meta"):
        ours = DinoV2()
        theirs = Dinov2Model(Dinov2Config(image_size=518, patch_size=14))
    mask_token = 768
    count = sum(p.numel() for p in ours.parameters())
    assert count == sum(p.numel() for p in theirs.parameters()) - mask_token == 86_579_712
