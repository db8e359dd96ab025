"""MegaLoc: its keys and the size of its file, what its parts are given, and pixels against PIL."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights.registry import lookup
from megloc_kapture.nets import megaloc
from megloc_kapture.nets.dinov2 import DinoV2
from megloc_kapture.nets.megaloc import MegaLocNet, megaloc_from, squared

KEYS = Path(__file__).parent / "keys" / "megaloc.txt"


def frozen_keys() -> dict[str, tuple[int, ...]]:
    pairs = (row.split() for row in KEYS.read_text().splitlines())
    return {key: () if s == "scalar" else tuple(map(int, s.split("x"))) for key, s in pairs}


def small() -> MegaLocNet:
    return MegaLocNet(
        DinoV2(channels=8, depth=2, heads=2, grid=5),
        clusters=4,
        cluster_size=3,
        token_size=2,
        descriptor_size=10,
    )


def test_keys_and_shapes_are_the_published_ones() -> None:
    with torch.device("meta"):
        network = MegaLocNet()
    found = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    assert found == frozen_keys()
    assert sum(p.numel() for p in network.parameters()) == 228_639_553


def test_float32_under_these_keys_fills_the_published_file_to_the_byte() -> None:
    """safetensors: 8 bytes, a JSON that names every tensor and its place, padded, the numbers."""
    end, header = 0, {}
    for key, shape in sorted(frozen_keys().items()):
        start, end = end, end + 4 * int(np.prod(shape, dtype=int))
        header[key] = {"dtype": "F32", "shape": list(shape), "data_offsets": [start, end]}
    length = len(json.dumps(header, separators=(",", ":")))
    published = lookup("megaloc").files[0]
    assert 8 + -(-length // 8) * 8 + end == published.size


def test_the_whole_network_gives_8448_components() -> None:
    with torch.device("meta"):
        network = MegaLocNet().eval()
        found = network(torch.empty(2, 3, 322, 322))
    assert found.shape == (2, 8448) and found.dtype == torch.float32


def test_parts_follow_each_other() -> None:
    torch.manual_seed(0)
    network = small().eval()
    image = torch.rand(2, 3, 42, 56)
    mean, deviation = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])
    with torch.inference_mode():
        found = network(image)
        normalised = (image - mean[:, None, None]) / deviation[:, None, None]
        aggregated = network.aggregator["agg"](*network.backbone(normalised))
        linear = network.aggregator["linear"]
        expected = aggregated @ linear.weight.T + linear.bias
        expected = expected / expected.pow(2).sum(1, keepdim=True).sqrt()
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(2))
    assert (found[0] - found[1]).abs().max() > 1e-4


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


def test_other_files_are_refused_by_the_names_of_their_keys(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(megaloc, "MegaLocNet", small)
    tensors = dict(small().state_dict())
    lost = tensors.pop("aggregator.agg.dust_bin")
    with pytest.raises(DataError, match=r"w\.pth: .*1 missing keys: aggregator\.agg\.dust_bin"):
        megaloc_from(tensors, "w.pth")
    tensors |= {"aggregator.agg.dust_bin": lost, "aggregator.linear.bias": torch.zeros(9)}
    with pytest.raises(DataError, match=r"aggregator\.linear\.bias is \(9,\), not \(10,\)"):
        megaloc_from(tensors, "w.pth")


@pytest.mark.parametrize("size", [(57, 43), (20, 31), (28, 28), (1, 1), (101, 9)])
def test_images_are_scaled_as_pil_scales(size: tuple[int, int]) -> None:
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    found = squared(image, 28)[0]
    for channel, plane in zip(found, image[0], strict=True):
        expected = Image.fromarray(plane.numpy()).resize((28, 28), Image.Resampling.BILINEAR)
        np.testing.assert_allclose(channel.numpy(), np.asarray(expected), atol=1e-5)


def test_a_large_image_is_filtered_before_it_is_made_small() -> None:
    # stripes a pixel wide become their mean, instead of one of them
    image = torch.zeros(1, 3, 40, 280)
    image[..., ::2] = 1.0
    inner = squared(image, 28)[..., 2:-2]
    torch.testing.assert_close(inner, torch.full_like(inner, 0.5), rtol=0, atol=0.01)
    plain = functional.interpolate(image, (28, 28), mode="nearest")[..., 2:-2]
    assert (plain - 0.5).abs().min() == 0.5
