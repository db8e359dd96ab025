"""Trunks of published networks without their classifiers, and generalized-mean pooling.

VGG-16 (Simonyan and Zisserman, ICLR 2015) and ResNet (He et al., CVPR 2016), under torchvision's
names. The ResNet is the variant with the stride on a bottleneck's 3x3 convolution, which
torchvision and the networks trained on top of its weights use.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import nn
from torch.nn import functional as F

# widths of the 3x3 convolutions of each of the five stages; a pooling ends each stage
_VGG_STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
Depth = Literal[50, 101]
RESNET_BLOCKS: dict[Depth, tuple[int, int, int, int]] = {50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}
RESNET_DEPTHS: dict[int, Depth] = {6: 50, 23: 101}  # by the blocks of the third stage
RESNET_WIDTHS, RESNET_EXPANSION = (64, 128, 256, 512), 4
# of the images of ImageNet, RGB in [0, 1]
IMAGENET_MEAN, IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# smaller activations count as this, so that powers and their gradients stay finite
_MINIMUM = 1e-6


class Vgg16Features(nn.Sequential):
    """VGG-16 (configuration D) up to a layer, numbered as torchvision's ``features``.

    Every convolution is 3x3 with a border of zeros and a bias, followed by a ReLU; stages end in a
    2x2 maximum with stride 2, which drops an odd last row or column. Keys of the state dict are
    ``{i}.weight`` and ``{i}.bias``. ``last``: number of the last layer: 28 is conv5_3 without its
    ReLU (512 channels, 1/16 of the size), 29 is that ReLU.
    """

    def __init__(self, *, last: int) -> None:
        layers: list[nn.Module] = []
        channels = 3
        for widths in _VGG_STAGES:
            for width in widths:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
            layers.append(nn.MaxPool2d(2))
        super().__init__(*layers[: last + 1])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Activation (B, C, h, w) after the last layer, of (B, 3, H, W), which stays as it is."""
        for layer in self:
            # the maps of a large image have 200 MB: a ReLU needs none of its own
            x = torch.relu_(x) if isinstance(layer, nn.ReLU) else layer(x)
        return x


def imagenet_normalised(image: torch.Tensor) -> torch.Tensor:
    """An RGB image (B, 3, H, W) in [0, 1], shifted and scaled as networks from ImageNet take it."""
    mean = image.new_tensor(IMAGENET_MEAN)[:, None, None]
    return (image - mean) / image.new_tensor(IMAGENET_DEVIATION)[:, None, None]


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolution around a shortcut; the stride is on the 3x3.

    ``strided_first``: the stride is on the first 1x1 instead; ``bias`` and ``epsilon``: of the
    convolutions, and of the normalisations after them.
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
    """ResNet-50 or ResNet-101 without its classifier.

    ``dilated``: the stride of the last stage is a dilation of its blocks but the first instead, so
    that the output stride is 16, not 32.
    """

    def __init__(self, depth: Depth, *, dilated: bool = False) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        channels = 64
        sizes = zip(RESNET_WIDTHS, RESNET_BLOCKS[depth], strict=True)
        for number, (width, blocks) in enumerate(sizes, start=1):
            reach = 2 if dilated and number == 4 else 1
            stage = nn.Sequential()
            for block in range(blocks):
                stride = 2 if number > 1 and block == 0 and reach == 1 else 1
                dilation = reach if block else 1
                stage.append(Bottleneck(channels, width, stride=stride, dilation=dilation))
                channels = width * RESNET_EXPANSION
            self.add_module(f"layer{number}", stage)

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Features of the four stages, 256, 512, 1024 and 2048 channels.

        ``image`` is (B, 3, H, W), see :func:`imagenet_normalised`.
        """
        x = F.relu(self.bn1(self.conv1(image)), inplace=True)
        x = F.max_pool2d(x, 3, stride=2, padding=1)
        features = []
        for number in range(1, 5):
            x = self.get_submodule(f"layer{number}")(x)
            features.append(x)
        return features


def generalized_mean(features: torch.Tensor, power: torch.Tensor | float) -> torch.Tensor:
    """The power mean (B, C) of each channel over all pixels: 1 is the mean, infinity the maximum.

    ``features`` (B, C, H, W) may be of any precision, and count as 1e-6 below it; the result is
    float32, float64 where they are. ``power`` is one number, not 0.
    """
    # a third power leaves the range of half precision at 41
    values = features if features.dtype == torch.float64 else features.float()
    return values.clamp(min=_MINIMUM).pow(power).mean(dim=(2, 3)).pow(1.0 / power)
