"""ALIKED's network: its keys, and kornia's implementation of the same weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from published import published_shapes

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.aliked import AlikedNet, aliked_from

# numbers that the published files hold, and the size of the descriptors
VARIANTS = {
    "aliked-t16": (192_588, 64),
    "aliked-n16": (678_324, 128),
    "aliked-n16rot": (678_324, 128),
    "aliked-n32": (980_468, 128),
}


def random_tensors(variant: str, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for key, shape in published_shapes(variant).items():
        fan_in = max(1, int(torch.tensor(shape[1:]).prod())) if len(shape) == 4 else 4
        values = torch.randn(shape, generator=generator) / fan_in**0.5
        if key.endswith("running_var") or (".bn" in key and key.endswith("weight")):
            values = values.abs() + 0.5
        elif key.endswith("num_batches_tracked"):
            values = torch.tensor(3)
        elif "offset_conv" in key:
            values = 3 * values  # readings some pixels away
        tensors[key] = values
    return tensors


def published(shared_data: Path, variant: str) -> dict[str, torch.Tensor]:
    return read_weights(find_weights(str(shared_data / "weights" / "aliked" / f"{variant}.pth")))


def kornias(variant: str, tensors: dict[str, torch.Tensor], **options: Any) -> torch.nn.Module:
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


@pytest.mark.parametrize("variant", VARIANTS)
def test_keys_are_those_of_the_published_files(variant: str) -> None:
    numbers, size = VARIANTS[variant]
    net = aliked_from(random_tensors(variant), variant)
    found = {key: tuple(values.shape) for key, values in net.state_dict().items()}
    assert found == published_shapes(variant)
    assert len(found) == 76
    assert sum(values.numel() for values in net.state_dict().values()) == numbers
    assert net.descriptor_size == size and not net.training


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_published_files_load(shared_data: Path, variant: str) -> None:
    tensors = published(shared_data, variant)
    assert {key: tuple(values.shape) for key, values in tensors.items()} == published_shapes(
        variant
    )
    net = aliked_from(tensors, variant)
    for key, values in net.state_dict().items():
        assert torch.equal(values, tensors[key])


@pytest.mark.parametrize("size", [(64, 96), (75, 101), (33, 40)])
@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n32"])
def test_random_weights_give_kornias_maps(variant: str, size: tuple[int, int]) -> None:
    tensors = random_tensors(variant)
    image = texture(*size)
    with torch.inference_mode():
        features, scores = kornias(variant, tensors).extract_dense_map(image)
        our_scores, our_features = dense_features(aliked_from(tensors, variant), image)
    assert scores.std() > 1e-3  # the weights say something
    # readings some pixels off in maps of this size: 1e-4 is what float32 leaves of them
    assert (our_scores - scores[0, 0]).abs().max() < 1e-4
    assert (our_features - features[0]).abs().max() < 1e-4


@pytest.mark.parametrize("variant", VARIANTS)
def test_published_weights_give_kornias_maps(shared_data: Path, variant: str) -> None:
    tensors = published(shared_data, variant)
    image = texture(150, 203)
    with torch.inference_mode():
        features, scores = kornias(variant, tensors).extract_dense_map(image)
        our_scores, our_features = dense_features(aliked_from(tensors, variant), image)
    assert scores.max() > 0.3
    assert (our_scores - scores[0, 0]).abs().max() < 2e-5
    assert (our_features - features[0]).abs().max() < 1e-5


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
    tensors = random_tensors("aliked-t16")
    net = aliked_from(tensors, "t16")
    image = texture(64, 96)
    with torch.inference_mode():
        full = net(image)[0].scores
        with torch.autocast("cpu", dtype=torch.bfloat16):
            half = net(image)[0].scores
    assert half.dtype == torch.float32
    assert 0 < (full - half).abs().max() < 0.1


def test_a_missing_key_is_named() -> None:
    tensors = random_tensors("aliked-t16")
    del tensors["block3.conv1.offset_conv.bias"]
    with pytest.raises(DataError, match=r"x\.pth.*block3\.conv1\.offset_conv\.bias"):
        aliked_from(tensors, "x.pth")


@pytest.mark.parametrize("key", ["block1.conv1.weight", "conv4.weight", "desc_head.agg_weights"])
def test_a_file_of_something_else_is_refused(key: str) -> None:
    tensors = random_tensors("aliked-t16")
    del tensors[key]
    with pytest.raises(DataError, match=key):
        aliked_from(tensors, "x.pth")


def test_a_wrong_shape_is_named() -> None:
    tensors = random_tensors("aliked-t16")
    tensors["score_head.2.weight"] = torch.zeros(4, 8, 1, 1)
    with pytest.raises(DataError, match=r"score_head\.2\.weight is \(4, 8, 1, 1\)"):
        aliked_from(tensors, "x.pth")
