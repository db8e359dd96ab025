"""DeepLabV3+ trained on Cityscapes as a segmenter of people and vehicles.

The network (Chen et al., ECCV 2018) has output stride 16, a ResNet-101 or MobileNetV2 backbone and
the parameter names of VainF's checkpoints. As in all public checkpoints, the convolutions of the
head are not depthwise separable.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn
from torch.nn import functional as F

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import reduced_size
from megloc_kapture.nets.runtime import (
    Checkpointed,
    NetworkOptions,
    image_tensor,
    inference,
    load_strictly,
)
from megloc_kapture.nets.trunks import ResNet, imagenet_normalised

Backbone = Literal["resnet101", "mobilenet"]

# in the order of cityscapesScripts' train ids; the categories human and vehicle come last
CITYSCAPES_CLASSES = (
    *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign"),
    *("vegetation", "terrain", "sky"),
    *("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"),
)
CITYSCAPES_DYNAMIC = frozenset(CITYSCAPES_CLASSES[11:])
_MAX_SIZE_PX = 2048  # larger images are reduced to this longer side, Cityscapes' image width
_WIDTH = 256
_LOW_LEVEL_WIDTH = 48
_DILATIONS = (6, 12, 18)
# MobileNetV2 (table 2 of the paper): expansion, channels, blocks, stride and dilation of the first
# block, dilation of the others; the sixth stage is dilated instead of strided
_MOBILENET_STAGES = (
    *((1, 16, 1, 1, 1, 1), (6, 24, 2, 2, 1, 1), (6, 32, 3, 2, 1, 1), (6, 64, 4, 2, 1, 1)),
    *((6, 96, 3, 1, 1, 1), (6, 160, 3, 1, 1, 2), (6, 320, 1, 1, 2, 2)),
)
_NUM_LOW_LEVEL = 4  # the stem and the blocks down to 1/4 resolution


class DeepLabOptions(NetworkOptions):
    """Options of DeepLabV3+."""

    weights: str = Field(
        default="deeplabv3plus-resnet101",
        description="deeplabv3plus-resnet101, deeplabv3plus-mobilenet, or a file; the backbone "
        "is recognized by its parameter names",
    )


class DeepLab(Checkpointed[DeepLabOptions]):
    """Segmenter of the 19 Cityscapes classes at the image's resolution."""

    name = "deeplabv3plus"
    classes = CITYSCAPES_CLASSES
    dynamic = CITYSCAPES_DYNAMIC
    Options = DeepLabOptions

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return labels uint8 (H, W), indices into ``classes``, of an RGB image uint8 (H, W, 3)."""
        height, width = image.shape[:2]
        size = reduced_size(width, height, _MAX_SIZE_PX)
        if size != (width, height):
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        network, device = self.network(_deeplab)
        with inference(device, self.options.half_precision):
            logits = network(image_tensor(image, device))[0].float()
            return most_likely(logits, height, width).cpu().numpy()


def _deeplab(tensors: Mapping[str, torch.Tensor], where: str) -> DeepLabV3Plus:
    network = DeepLabV3Plus(backbone_of(tensors, where), num_classes=len(CITYSCAPES_CLASSES))
    load_strictly(network, tensors, where)
    return network.eval()


def backbone_of(keys: Collection[str], where: str) -> Backbone:
    """Return the backbone of a checkpoint with these parameter names."""
    for key in keys:
        if key.startswith("backbone.layer1."):
            return "resnet101"
        if key.startswith("backbone.low_level_features."):
            return "mobilenet"
    raise DataError(
        "this file is not a DeepLabV3+ checkpoint: no keys backbone.layer1.* (ResNet-101) or "
        "backbone.low_level_features.* (MobileNetV2)",
        path=where,
    )


def _activated(
    channels: int,
    out: int,
    size: int,
    kind: type[nn.ReLU | nn.ReLU6] = nn.ReLU,
    *,
    stride: int = 1,
    padding: int = 0,
    dilation: int = 1,
    groups: int = 1,
) -> nn.Sequential:
    layer = nn.Conv2d(channels, out, size, stride, padding, dilation, groups, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(out), kind(inplace=True))


class Head(nn.Module):
    """Classifier of low-level features and an atrous spatial pyramid, at 1/4 resolution.

    The pyramid has five branches, which are concatenated and projected; the last is a global
    average, equal at all pixels.
    """

    def __init__(self, channels: int, low_level_channels: int, num_classes: int) -> None:
        super().__init__()
        self.project = _activated(low_level_channels, _LOW_LEVEL_WIDTH, 1)
        branches = [_activated(channels, _WIDTH, 1)]
        branches += [
            _activated(channels, _WIDTH, 3, padding=rate, dilation=rate) for rate in _DILATIONS
        ]
        whole = nn.Sequential(nn.AdaptiveAvgPool2d(1), *_activated(channels, _WIDTH, 1))
        convs = nn.ModuleList([*branches, whole])
        project = _activated(len(convs) * _WIDTH, _WIDTH, 1)
        self.aspp = nn.ModuleDict({"convs": convs, "project": project})
        self.classifier = _activated(_LOW_LEVEL_WIDTH + _WIDTH, _WIDTH, 3, padding=1)
        self.classifier.append(nn.Conv2d(_WIDTH, num_classes, 1))

    def forward(self, low_level: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        fine = self.project(low_level)
        *local, whole = (branch(features) for branch in self.aspp["convs"].children())
        pyramid = torch.cat([*local, whole.expand_as(local[0])], dim=1)
        coarse = F.interpolate(
            self.aspp["project"](pyramid),
            size=fine.shape[-2:],
            mode="bilinear",
            align_corners=False,
        )
        return self.classifier(torch.cat([fine, coarse], dim=1))


class InvertedResidual(nn.Module):
    """1x1 expansion, 3x3 depthwise convolution, and 1x1 projection without activation."""

    def __init__(
        self, channels: int, out: int, *, expansion: int, stride: int, dilation: int
    ) -> None:
        super().__init__()
        wide = channels * expansion
        layers: list[nn.Module] = []
        if expansion != 1:
            layers.append(_activated(channels, wide, 1, nn.ReLU6))
        layers += [
            _activated(wide, wide, 3, nn.ReLU6, stride=stride, dilation=dilation, groups=wide),
            nn.Conv2d(wide, out, 1, bias=False),
            nn.BatchNorm2d(out),
        ]
        self.conv = nn.Sequential(*layers)
        self._frame = dilation
        self._residual = stride == 1 and channels == out

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.conv(F.pad(x, (self._frame,) * 4))
        return x + y if self._residual else y


class MobileNetV2(nn.Module):
    """MobileNetV2 (Sandler et al., CVPR 2018) without the classifier, at output stride 16.

    As in the training of the weights, the first convolution has no padding, and blocks pad their
    input before the expansion, so that the expanded border is not zero.
    """

    def __init__(self) -> None:
        super().__init__()
        channels = 32
        layers: list[nn.Module] = [_activated(3, channels, 3, nn.ReLU6, stride=2)]
        for expansion, out, blocks, stride, first, others in _MOBILENET_STAGES:
            for block in range(blocks):
                step, dilation = (1, others) if block else (stride, first)
                sizes = {"expansion": expansion, "stride": step, "dilation": dilation}
                layers.append(InvertedResidual(channels, out, **sizes))
                channels = out
        # slices of a Sequential keep the layer numbers, as in the checkpoint
        everything = nn.Sequential(*layers)
        self.low_level_features = everything[:_NUM_LOW_LEVEL]
        self.high_level_features = everything[_NUM_LOW_LEVEL:]

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return 24 channels at 1/4 size and 320 at 1/16 of normalised images (B, 3, H, W)."""
        low_level = self.low_level_features(image)
        return low_level, self.high_level_features(low_level)


class DeepLabV3Plus(nn.Module):
    """DeepLabV3+, which computes logits per class at about 1/4 resolution."""

    def __init__(self, backbone: Backbone, *, num_classes: int) -> None:
        super().__init__()
        self.backbone: nn.Module
        if backbone == "resnet101":
            self.backbone = ResNet(101, dilated=True)
            self.classifier = Head(2048, 256, num_classes)
        else:
            self.backbone = MobileNetV2()
            self.classifier = Head(320, 24, num_classes)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return logits (B, classes, h, w) of RGB images (B, 3, H, W) in [0, 1]."""
        features = self.backbone(imagenet_normalised(image))
        return self.classifier(features[0], features[-1])


def most_likely(logits: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Return the argmax uint8 (height, width) of upscaled logits (C, h, w), one class at a time."""
    best = logits.new_full((height, width), -torch.inf)
    label = torch.zeros((height, width), dtype=torch.uint8, device=logits.device)
    for number, channel in enumerate(logits):
        scaled = F.interpolate(
            channel[None, None], size=(height, width), mode="bilinear", align_corners=False
        )[0, 0]
        better = scaled > best
        label[better] = number
        torch.maximum(best, scaled, out=best)
    return label
