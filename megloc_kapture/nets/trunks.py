"""Backbones of published networks, without classifiers, and generalized-mean (GeM) pooling.

VGG-16 (Simonyan and Zisserman, ICLR 2015) and ResNet (He et al., CVPR 2016) have torchvision's
parameter names.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import nn
from torch.nn import functional as F

# channels of each stage's convolutions; each stage ends with max pooling
_VGG_STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
Depth = Literal[50, 101]
RESNET_BLOCKS: dict[Depth, tuple[int, int, int, int]] = {50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}
RESNET_DEPTHS: dict[int, Depth] = {6: 50, 23: 101}
RESNET_WIDTHS, RESNET_EXPANSION = (64, 128, 256, 512), 4
# ImageNet's statistics, RGB in [0, 1]
IMAGENET_MEAN, IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# lower bound of activations, so that powers and gradients stay finite
_MINIMUM = 1e-6


def vgg16_features(*, last: int) -> nn.Sequential:
    """Build VGG-16 (configuration D) up to layer ``last`` of torchvision's ``features``.

    Layer 28 is conv5_3 without its ReLU (512 channels, 1/16 of the image size), and layer 29 is
    that ReLU. Max pooling drops an odd last row or column.
    """
    layers: list[nn.Module] = []
    channels = 3
    for widths in _VGG_STAGES:
        for width in widths:
            # in place: one feature map of a large image takes 200 MB
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
            channels = width
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers[: last + 1])


def imagenet_normalised(image: torch.Tensor) -> torch.Tensor:
    """Normalise RGB images (B, 3, H, W) in [0, 1] by ImageNet's mean and standard deviation."""
    mean = image.new_tensor(IMAGENET_MEAN)[:, None, None]
    return (image - mean) / image.new_tensor(IMAGENET_DEVIATION)[:, None, None]


class Bottleneck(nn.Module):
    """Bottleneck block of a ResNet, with the stride on the 3x3 convolution.

    ``strided_first`` puts the stride on the first 1x1 convolution instead. ``bias`` adds biases to
    the convolutions; ``epsilon`` is added to the variances in batch normalisation.
    """

    def __init__(
        self,
        channels: int,
        width: int,
        *,
        stride: int,
        dilation: int = 1,
        strided_first: bool = False,
        bias: bool = False,
        epsilon: float = 1e-5,
    ) -> None:
        super().__init__()
        out = width * RESNET_EXPANSION
        first, middle = (stride, 1) if strided_first else (1, stride)
        self.conv1 = nn.Conv2d(channels, width, 1, stride=first, bias=bias)
        self.bn1 = nn.BatchNorm2d(width, eps=epsilon)
        self.conv2 = nn.Conv2d(
            width, width, 3, stride=middle, padding=dilation, dilation=dilation, bias=bias
        )
        self.bn2 = nn.BatchNorm2d(width, eps=epsilon)
        self.conv3 = nn.Conv2d(width, out, 1, bias=bias)
        self.bn3 = nn.BatchNorm2d(out, eps=epsilon)
        self.stride = stride
        self.downsample: nn.Module | None = None
        if channels != out:
            shortcut = nn.Conv2d(channels, out, 1, stride=stride, bias=bias)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(out, eps=epsilon))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = F.relu(self.bn2(self.conv2(y)), inplace=True)
        y = self.bn3(self.conv3(y))
        if self.downsample is None:
            y += x[..., :: self.stride, :: self.stride]
        else:
            y += self.downsample(x)
        return F.relu(y, inplace=True)


class ResNet(nn.Module):
    """ResNet-50 or ResNet-101; ``dilated`` gives output stride 16 instead of 32."""

    def __init__(self, depth: Depth, *, dilated: bool = False) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        channels = 64
        sizes = zip(RESNET_WIDTHS, RESNET_BLOCKS[depth], strict=True)
        for number, (width, blocks) in enumerate(sizes, start=1):
            stage_dilation = 2 if dilated and number == 4 else 1
            stage = nn.Sequential()
            for block in range(blocks):
                stride = 2 if number > 1 and block == 0 and stage_dilation == 1 else 1
                dilation = stage_dilation if block else 1
                stage.append(Bottleneck(channels, width, stride=stride, dilation=dilation))
                channels = width * RESNET_EXPANSION
            self.add_module(f"layer{number}", stage)

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Return features (B, C, h, w) of the four stages: C is 256, 512, 1024 and 2048."""
        x = F.relu(self.bn1(self.conv1(image)), inplace=True)
        x = F.max_pool2d(x, 3, stride=2, padding=1)
        features = []
        for number in range(1, 5):
            x = self.get_submodule(f"layer{number}")(x)
            features.append(x)
        return features


def generalized_mean(features: torch.Tensor, power: torch.Tensor | float) -> torch.Tensor:
    """Compute the generalized mean (B, C) of features (B, C, H, W), clamped to at least 1e-6.

    Power 1 gives the mean, large powers approach the maximum; 0 is invalid. The result is float32
    or float64.
    """
    # the third power of 41 overflows in half precision
    values = features if features.dtype == torch.float64 else features.float()
    return values.clamp(min=_MINIMUM).pow(power).mean(dim=(2, 3)).pow(1.0 / power)
