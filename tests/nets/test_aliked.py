"""ALIKED's network against kornia's implementation of the same weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from published import Tensors, random_tensors

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.aliked import AlikedNet, aliked_from


def calm_tensors(variant: str) -> Tensors:
    """Random ones that magnify rounding less."""
    tensors = random_tensors(variant)
    for key, values in tensors.items():
        if values.ndim > 1:
            values *= 0.5**0.5
        elif key.endswith(("running_var", "weight")):
            values *= 0.5
            values += 0.25
        if "offset_conv" in key:
            values *= 3  # readings some pixels away
    return tensors


def published(shared_data: Path, variant: str) -> Tensors:
    return read_weights(find_weights(str(shared_data / "weights" / "aliked" / f"{variant}.pth")))


def kornias(variant: str, tensors: Tensors, **options: Any) -> torch.nn.Module:
    feature = pytest.importorskip("kornia.feature")
    net = feature.ALIKED(variant, **options)
    missing, unexpected = net.load_state_dict(tensors, strict=False)
    assert missing == ["dkd.hw_grid"] and not unexpected
    return net.eval()


def texture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Colours that change smoothly, with edges; (1, 3, H, W) in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, height // 6 + 2, width // 6 + 2, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)
    return torch.where(fine > 0.5, fine, fine * 0.5)


def dense_features(net: AlikedNet, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Score map (H, W) and all features (D, H, W)."""
    maps = net(image)[0]
    height, width = maps.scores.shape
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    features = maps.features_at(rows.reshape(-1), columns.reshape(-1))
    return maps.scores, features.T.reshape(-1, height, width)


@pytest.mark.parametrize("size", [(64, 96), (75, 101), (33, 40)])
@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n32"])
def test_random_weights_give_kornias_maps(variant: str, size: tuple[int, int]) -> None:
    tensors = calm_tensors(variant)
    image = texture(*size)
    with torch.inference_mode():
        features, scores = kornias(variant, tensors).extract_dense_map(image)
        our_scores, our_features = dense_features(aliked_from(tensors, variant), image)
    assert scores.std() > 1e-3  # the weights say something
    # readings some pixels off in maps of this size: 1e-4 is what float32 leaves of them
    assert (our_scores - scores[0, 0]).abs().max() < 1e-4
    assert (our_features - features[0]).abs().max() < 1e-4


@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n16"])
def test_descriptors_are_kornias_everywhere(shared_data: Path, variant: str) -> None:
    tensors = published(shared_data, variant)
    image = texture(96, 128)
    generator = torch.Generator().manual_seed(1)
    # all over the map, its border included
    xy = torch.rand(200, 2, generator=generator) * torch.tensor([127.0, 95.0])
    net = aliked_from(tensors, variant)
    theirs = kornias(variant, tensors)
    with torch.inference_mode():
        features, _ = theirs.extract_dense_map(image)
        normalised = xy / torch.tensor([127.0, 95.0]) * 2 - 1
        expected = theirs.desc_head(features, [normalised])[0][0]
        found = net.desc_head(net(image)[0], xy)
    assert (found - expected).abs().max() < 2e-5
    assert (found.norm(dim=1) - 1).abs().max() < 1e-5


def test_half_precision_stays_near() -> None:
    tensors = calm_tensors("aliked-t16")
    net = aliked_from(tensors, "t16")
    image = texture(64, 96)
    with torch.inference_mode():
        full = net(image)[0].scores
        with torch.autocast("cpu", dtype=torch.bfloat16):
            half = net(image)[0].scores
    assert half.dtype == torch.float32
    assert 0 < (full - half).abs().max() < 0.1


@pytest.mark.parametrize("key", ["block1.conv1.weight", "conv4.weight", "desc_head.agg_weights"])
def test_a_file_of_something_else_is_refused(key: str) -> None:
    tensors = random_tensors("aliked-t16")
    del tensors[key]
    with pytest.raises(DataError, match=rf"x\.pth: .*no ALIKED checkpoint.*{key}"):
        aliked_from(tensors, "x.pth")
