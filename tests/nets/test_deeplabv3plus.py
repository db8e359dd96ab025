"""DeepLabV3+: keys, sizes, the head's parts, and a checkpoint that does not fit."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from megloc_kapture.errors import DataError
from megloc_kapture.nets.deeplabv3plus import (
    AtrousPyramid,
    Backbone,
    DeepLabV3Plus,
    Head,
    backbone_of,
    most_likely,
)
from megloc_kapture.nets.loading import load_strictly

KEYS = Path(__file__).parent / "keys"


def frozen_keys(backbone: Backbone) -> dict[str, tuple[int, ...]]:
    """Key -> shape, as the published checkpoint has them."""
    rows = (KEYS / f"deeplabv3plus-{backbone}.txt").read_text().splitlines()
    pairs = (row.split() for row in rows)
    return {key: () if s == "scalar" else tuple(map(int, s.split("x"))) for key, s in pairs}


def after_first(layers: nn.Sequential) -> nn.Sequential:
    return nn.Sequential(*list(layers)[1:])


@pytest.mark.parametrize(
    ("backbone", "parameters"), [("resnet101", 58_753_459), ("mobilenet", 5_225_203)]
)
def test_keys_and_shapes_are_the_published_ones(backbone: Backbone, parameters: int) -> None:
    with torch.device("meta"):
        network = DeepLabV3Plus(backbone, num_classes=19)
    found = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    assert found == frozen_keys(backbone)
    assert sum(p.numel() for p in network.parameters()) == parameters
    assert backbone_of(found, "w.pth") == backbone


def test_a_checkpoint_goes_in_whole_or_not_at_all() -> None:
    tensors = {
        key: torch.rand(shape) if shape else torch.tensor(7)
        for key, shape in frozen_keys("mobilenet").items()
    }
    network = DeepLabV3Plus("mobilenet", num_classes=19)
    load_strictly(network, tensors, "w.pth")
    for key, value in network.state_dict().items():
        torch.testing.assert_close(value, tensors[key])
    lost = tensors.pop("classifier.aspp.convs.4.1.weight")
    with pytest.raises(
        DataError, match=r"w\.pth: .*missing.*classifier\.aspp\.convs\.4\.1\.weight"
    ):
        load_strictly(network, tensors, "w.pth")
    tensors["classifier.aspp.convs.4.0.weight"] = lost
    with pytest.raises(DataError, match=r"unexpected.*classifier\.aspp\.convs\.4\.0\.weight"):
        load_strictly(network, tensors, "w.pth")
    other_classes = DeepLabV3Plus("mobilenet", num_classes=21)
    with pytest.raises(DataError, match=r"classifier\.classifier\.3\.bias is \(19,\), not \(21,\)"):
        load_strictly(other_classes, network.state_dict(), "w.pth")
    with pytest.raises(DataError, match=r"w\.pth: no DeepLabV3\+"):
        backbone_of(["conv1a.weight"], "w.pth")


@pytest.mark.parametrize("size", [(64, 96), (65, 97), (33, 131)])
@pytest.mark.parametrize("backbone", ["resnet101", "mobilenet"])
def test_logits_stand_at_a_quarter_of_any_size(backbone: Backbone, size: tuple[int, int]) -> None:
    network = DeepLabV3Plus(backbone, num_classes=19).eval()
    with torch.inference_mode():
        logits = network(torch.rand(1, 3, *size))
    # the first convolution of this MobileNetV2 has no padding: two pixels less
    lost = 2 if backbone == "mobilenet" else 0
    expected = [(length - lost + 3) // 4 for length in size]
    assert logits.shape == (1, 19, *expected)
    assert torch.isfinite(logits).all()


def test_the_pyramid_works_where_there_is_one_place() -> None:
    torch.manual_seed(0)
    pyramid = AtrousPyramid(8).eval()
    x = torch.randn(1, 8, 1, 1)
    with torch.inference_mode():
        found = pyramid(x)
        # one place: a dilated kernel sees it with its middle alone, and it is its own mean
        middles = [
            after_first(branch)(F.conv2d(x, branch[0].weight[:, :, 1:2, 1:2]))
            for branch in pyramid.convs[1:4]
        ]
        pooled = after_first(pyramid.convs[4])(x)
        everything = torch.cat([pyramid.convs[0](x), *middles, pooled], dim=1)
        torch.testing.assert_close(found, pyramid.project(everything))
    assert found.shape == (1, 256, 1, 1)


def test_the_pyramids_pooling_is_the_mean_everywhere() -> None:
    torch.manual_seed(0)
    pooling = AtrousPyramid(8).eval().convs[4]
    x = torch.randn(1, 8, 5, 7)
    with torch.inference_mode():
        found = pooling(x)
        value = after_first(pooling)(x.mean(dim=(2, 3), keepdim=True))
        # the published network scales the one value bilinearly
        scaled = F.interpolate(value, size=(5, 7), mode="bilinear", align_corners=False)
    torch.testing.assert_close(found, scaled)


def test_the_heads_low_level_features_come_first() -> None:
    torch.manual_seed(0)
    head = Head(8, 6, 3).eval()
    first: nn.Conv2d = head.classifier[0]
    with torch.no_grad():
        first.weight[:, 48:] = 0.0  # blind to the pyramid
    low_level = torch.randn(1, 6, 9, 11)
    with torch.inference_mode():
        one = head(low_level, torch.randn(1, 8, 3, 3))
        other = head(low_level, torch.randn(1, 8, 3, 3))
        elsewhere = head(torch.randn(1, 6, 9, 11), torch.randn(1, 8, 3, 3))
    torch.testing.assert_close(one, other)
    assert not torch.allclose(one, elsewhere)


@pytest.mark.parametrize("size", [(40, 60), (37, 53), (9, 200)])
def test_classes_are_those_of_all_logits_at_full_size(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    logits = torch.randn(19, 10, 14)
    logits[7] = logits[3]  # equal everywhere: the first counts
    whole = F.interpolate(logits[None], size=size, mode="bilinear", align_corners=False)[0]
    found = most_likely(logits, *size)
    assert found.dtype == torch.uint8
    assert torch.equal(found.long(), whole.argmax(dim=0))
    assert (found == 3).any() and not (found == 7).any()
