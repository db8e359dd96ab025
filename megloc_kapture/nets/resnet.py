"""ResNet trunks (He et al., CVPR 2016) under torchvision's key names.

The variant with the stride on a bottleneck's 3x3 convolution, which torchvision and the networks
trained on top of its weights use; strides may be exchanged for dilations, as DeepLab does.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import nn
from torch.nn import functional as F

Depth = Literal[50, 101]

_BLOCKS: dict[Depth, tuple[int, int, int, int]] = {50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}
_WIDTHS = (64, 128, 256, 512)
_EXPANSION = 4
# of the images of ImageNet, RGB in [0, 1]
IMAGENET_MEAN, IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def imagenet_normalised(image: torch.Tensor) -> torch.Tensor:
    """An RGB image (B, 3, H, W) in [0, 1], shifted and scaled as networks from ImageNet take it."""
    mean = image.new_tensor(IMAGENET_MEAN)[:, None, None]
    return (image - mean) / image.new_tensor(IMAGENET_DEVIATION)[:, None, None]


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolution around a shortcut; the stride is on the 3x3."""

    def __init__(self, channels: int, width: int, *, stride: int, dilation: int) -> None:
        super().__init__()
        out = width * _EXPANSION
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(
            width, width, 3, stride=stride, padding=dilation, dilation=dilation, bias=False
        )
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out)
        self.downsample = (
            None
            if stride == 1 and channels == out
            else nn.Sequential(
                nn.Conv2d(channels, out, 1, stride=stride, bias=False), nn.BatchNorm2d(out)
            )
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = F.relu(self.bn2(self.conv2(y)), inplace=True)
        y = self.bn3(self.conv3(y))
        y += x if self.downsample is None else self.downsample(x)
        return F.relu(y, inplace=True)


class ResNet(nn.Module):
    """ResNet-50 or ResNet-101 without its classifier.

    Parameters
    ----------
    depth : 50 or 101.
    output_stride : of the last stage. Where the strides before it have come to this, the further
        ones become dilations: the first block of such a stage keeps the dilation before it.
    """

    def __init__(self, depth: Depth, *, output_stride: Literal[8, 16, 32] = 32) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        channels, reached, dilation = 64, 4, 1
        for number, (width, blocks) in enumerate(zip(_WIDTHS, _BLOCKS[depth], strict=True), 1):
            stride, first = 1 if number == 1 else 2, dilation
            if reached * stride > output_stride:
                stride, dilation = 1, dilation * stride
            reached *= stride
            stage = nn.Sequential()
            for block in range(blocks):
                stage.append(
                    Bottleneck(
                        channels,
                        width,
                        stride=stride if block == 0 else 1,
                        dilation=first if block == 0 else dilation,
                    )
                )
                channels = width * _EXPANSION
            self.add_module(f"layer{number}", stage)

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Features of the four stages, 256, 512, 1024 and 2048 channels.

        Parameters
        ----------
        image : (B, 3, H, W), see :func:`imagenet_normalised`.
        """
        x = F.relu(self.bn1(self.conv1(image)), inplace=True)
        x = F.max_pool2d(x, 3, stride=2, padding=1)
        features = []
        for number in range(1, 5):
            x = self.get_submodule(f"layer{number}")(x)
            features.append(x)
        return features
