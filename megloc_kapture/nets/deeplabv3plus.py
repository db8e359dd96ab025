"""DeepLabV3+ (Chen et al., ECCV 2018) at output stride 16, under the keys of VainF's checkpoints.

ResNet-101 or MobileNetV2 below; the head's convolutions are plain ones, as those of all public
checkpoints are.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal

import torch
from torch import nn
from torch.nn import functional as F

from megloc_kapture.errors import DataError
from megloc_kapture.nets.trunks import (
    MOBILENET_CHANNELS,
    MOBILENET_LOW_LEVEL_CHANNELS,
    MobileNetV2,
    ResNet,
    imagenet_normalised,
)

Backbone = Literal["resnet101", "mobilenet"]

_WIDTH = 256
_LOW_LEVEL_WIDTH = 48
_DILATIONS = (6, 12, 18)


def backbone_of(keys: Collection[str], where: str) -> Backbone:
    """Trunk that the keys of a checkpoint are of; raises DataError that names the file."""
    for key in keys:
        if key.startswith("backbone.layer1."):
            return "resnet101"
        if key.startswith("backbone.low_level_features."):
            return "mobilenet"
    raise DataError(
        "no DeepLabV3+: keys backbone.layer1.* (ResNet-101) or backbone.low_level_features.* "
        "(MobileNetV2) expected",
        path=where,
    )


def _activated(channels: int, out: int, size: int, *, dilation: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(
        channels, out, size, padding=dilation * (size // 2), dilation=dilation, bias=False
    )
    return nn.Sequential(convolution, nn.BatchNorm2d(out), nn.ReLU(inplace=True))


class Pooling(nn.Sequential):
    """The mean of the whole map, projected and spread over the map again."""

    def __init__(self, channels: int) -> None:
        super().__init__(nn.AdaptiveAvgPool2d(1), *_activated(channels, _WIDTH, 1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        pooled = x
        for layer in self:
            pooled = layer(pooled)
        return pooled.expand(-1, -1, *x.shape[-2:])


class AtrousPyramid(nn.Module):
    """Atrous spatial pyramid pooling: five branches of different dilation, projected together."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        branches = [_activated(channels, _WIDTH, 1)]
        branches += [_activated(channels, _WIDTH, 3, dilation=rate) for rate in _DILATIONS]
        self.convs = nn.ModuleList([*branches, Pooling(channels)])
        self.project = _activated(len(self.convs) * _WIDTH, _WIDTH, 1)
        self.project.append(nn.Dropout(0.1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.project(torch.cat([branch(x) for branch in self.convs], dim=1))


class Head(nn.Module):
    """The pyramid, brought to a quarter of the image's size and sharpened by low-level features."""

    def __init__(self, channels: int, low_level_channels: int, num_classes: int) -> None:
        super().__init__()
        self.project = _activated(low_level_channels, _LOW_LEVEL_WIDTH, 1)
        self.aspp = AtrousPyramid(channels)
        self.classifier = _activated(_LOW_LEVEL_WIDTH + _WIDTH, _WIDTH, 3)
        self.classifier.append(nn.Conv2d(_WIDTH, num_classes, 1))

    def forward(self, low_level: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        fine = self.project(low_level)
        coarse = F.interpolate(
            self.aspp(features), size=fine.shape[-2:], mode="bilinear", align_corners=False
        )
        return self.classifier(torch.cat([fine, coarse], dim=1))


class DeepLabV3Plus(nn.Module):
    """Image to a logit per class, at about a quarter of its size."""

    def __init__(self, backbone: Backbone, *, num_classes: int) -> None:
        super().__init__()
        self.backbone: nn.Module
        if backbone == "resnet101":
            self.backbone = ResNet(101, output_stride=16)
            self.classifier = Head(2048, 256, num_classes)
        else:
            self.backbone = MobileNetV2()
            self.classifier = Head(MOBILENET_CHANNELS, MOBILENET_LOW_LEVEL_CHANNELS, num_classes)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Logits (B, classes, h, w) of an RGB image (B, 3, H, W) in [0, 1]."""
        features = self.backbone(imagenet_normalised(image))
        return self.classifier(features[0], features[-1])


def most_likely(logits: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Class of each pixel: the largest of logits (C, h, w), scaled bilinearly; of equals the first.

    Class by class: of a full-size map for every class, which is the largest thing there is in
    memory where the image is large, only two are held. Returns uint8 (height, width).
    """
    best = logits.new_full((height, width), -torch.inf)
    label = torch.zeros((height, width), dtype=torch.uint8, device=logits.device)
    for number, one in enumerate(logits):
        scaled = F.interpolate(
            one[None, None], size=(height, width), mode="bilinear", align_corners=False
        )[0, 0]
        better = scaled > best
        label[better] = number
        torch.maximum(best, scaled, out=best)
    return label
