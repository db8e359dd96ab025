"""Trunks of published networks without their classifiers, and generalized-mean pooling.

AlexNet (Krizhevsky, "One weird trick for parallelizing convolutional neural networks", arXiv
1404.5997, one tower), SqueezeNet 1.1 (Iandola et al., arXiv 1602.07360), VGG-16 (Simonyan and
Zisserman, ICLR 2015) and ResNet (He et al., CVPR 2016) have torchvision's names, MobileNetV2
(Sandler et al., CVPR 2018) those of DeepLabV3+.

The ResNet is the variant with the stride on a bottleneck's 3x3 convolution, which torchvision and
the networks trained on top of its weights use; strides may be exchanged for dilations, as DeepLab
does.

Two things differ from the usual MobileNetV2, and the weights were trained with them: the first
convolution has no padding, and a block pads its input before the expansion rather than its
depthwise convolution, so that the frame around an expanded map is not zero but what the
expansion makes of zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
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
# expansion, channels, blocks, stride of the first (table 2 of the paper)
_MOBILENET_STAGES = (
    *((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2)),
    *((6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1)),
)
_MOBILENET_STEM_CHANNELS = 32
_OUTPUT_STRIDE = 16
_NUM_LOW_LEVEL = 4  # the stem and the blocks down to a quarter of the size
MOBILENET_LOW_LEVEL_CHANNELS, MOBILENET_CHANNELS = 24, 320
# smaller activations count as this, so that powers and their gradients stay finite
_MINIMUM = 1e-6


class AlexNetFeatures(nn.Sequential):
    """AlexNet up to the ReLU of its fifth convolution, layer 11 of torchvision's ``features``.

    Takes (B, 3, H, W), at least 63 x 63 pixels.
    """

    def __init__(self) -> None:
        layers = [
            *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, stride=2)),
            *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, stride=2)),
        ]
        for channels, out in ((192, 384), (384, 256), (256, 256)):
            layers += [nn.Conv2d(channels, out, 3, padding=1), nn.ReLU()]
        super().__init__(*layers)


class Fire(nn.Module):
    """A fire module: 1x1 convolutions to few channels, then 1x1 and 3x3 beside each other."""

    def __init__(self, channels: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = F.relu(self.squeeze(x))
        return F.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1))


class SqueezeNetFeatures(nn.Sequential):
    """SqueezeNet 1.1 up to its eighth fire module, layer 12 of torchvision's ``features``.

    Takes (B, 3, H, W), at least 17 x 17 pixels.
    """

    def __init__(self) -> None:
        first = nn.Conv2d(3, 64, 3, stride=2), nn.ReLU()
        pool = nn.MaxPool2d(3, stride=2, ceil_mode=True)
        middle = Fire(64, 16, 64), Fire(128, 16, 64), pool, Fire(128, 32, 128), Fire(256, 32, 128)
        last = Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)
        super().__init__(*first, pool, *middle, pool, *last)


class Vgg16Features(nn.Sequential):
    """VGG-16 (configuration D) up to a layer, numbered as torchvision's ``features``.

    Every convolution is 3x3 with a border of zeros and a bias, followed by a ReLU; stages end in a
    2x2 maximum with stride 2, which drops an odd last row or column. Keys of the state dict are
    ``{i}.weight`` and ``{i}.bias``. ``last``: number of the last layer, 0 to 30: 28 is conv5_3
    without its ReLU (512 channels, 1/16 of the size), 29 is that ReLU, 30 is the fifth pooling.
    """

    def __init__(self, *, last: int = 30) -> None:
        layers: list[nn.Module] = []
        channels = 3
        for widths in _VGG_STAGES:
            for width in widths:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
            layers.append(nn.MaxPool2d(2))
        if not 0 <= last < len(layers):
            raise ValueError(f"last is {last}, not of 0 to {len(layers) - 1}")
        super().__init__(*layers[: last + 1])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Activation (B, C, h, w) after the last layer, of (B, 3, H, W), which stays as it is."""
        return self.taps(x, (len(self) - 1,))[0]

    def taps(self, x: torch.Tensor, indices: Sequence[int]) -> list[torch.Tensor]:
        """Activations (B, C, h, w) after chosen layers, in the order of the indices.

        ``x`` (B, 3, H, W), normalised as the weights want it, stays as it is; layers after the last
        one are not run. Raises ValueError for an index that is none of a layer's.
        """
        wrong = sorted(set(indices) - set(range(len(self))))
        if wrong or not indices:
            raise ValueError(f"layers {wrong} are not of 0 to {len(self) - 1}")
        found: dict[int, torch.Tensor] = {}
        for number, layer in enumerate(list(self)[: max(indices) + 1]):
            # the maps of a large image have 200 MB: where nobody wants the one before, a ReLU
            # needs none of its own
            if isinstance(layer, nn.ReLU) and number - 1 not in found:
                x = torch.relu_(x)
            else:
                x = layer(x)
            if number in indices:
                found[number] = x
        return [found[number] for number in indices]


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

    Where the strides have come to ``output_stride`` before the last stage, the further ones become
    dilations: the first block of such a stage keeps the dilation before it.
    """

    def __init__(self, depth: Depth, *, output_stride: Literal[8, 16, 32] = 32) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        channels, reached, dilation = 64, 4, 1
        for number, (width, blocks) in enumerate(
            zip(RESNET_WIDTHS, RESNET_BLOCKS[depth], strict=True), 1
        ):
            stride, first = 1 if number == 1 else 2, dilation
            if reached * stride > output_stride:
                stride, dilation = 1, dilation * stride
            reached *= stride
            stage = nn.Sequential()
            for block in range(blocks):
                steps, reach = (1, dilation) if block else (stride, first)
                stage.append(Bottleneck(channels, width, stride=steps, dilation=reach))
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


def _activated(
    channels: int, out: int, size: int, *, stride: int = 1, dilation: int = 1, groups: int = 1
) -> nn.Sequential:
    convolution = nn.Conv2d(
        channels, out, size, stride=stride, dilation=dilation, groups=groups, bias=False
    )
    return nn.Sequential(convolution, nn.BatchNorm2d(out), nn.ReLU6(inplace=True))


class InvertedResidual(nn.Module):
    """Expansion by 1x1, depthwise 3x3, projection by 1x1 without activation."""

    def __init__(
        self, channels: int, out: int, *, expansion: int, stride: int, dilation: int
    ) -> None:
        super().__init__()
        wide = channels * expansion
        layers: list[nn.Module] = [] if expansion == 1 else [_activated(channels, wide, 1)]
        layers += [
            _activated(wide, wide, 3, stride=stride, dilation=dilation, groups=wide),
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
    """The layers before the classifier, at output stride 16."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [_activated(3, _MOBILENET_STEM_CHANNELS, 3, stride=2)]
        channels, reached, dilation = _MOBILENET_STEM_CHANNELS, 2, 1
        for expansion, out, blocks, wanted in _MOBILENET_STAGES:
            stride, first = wanted, dilation
            if reached == _OUTPUT_STRIDE:
                stride, dilation = 1, dilation * wanted
            reached *= stride
            for block in range(blocks):
                steps, reach = (1, dilation) if block else (stride, first)
                layers.append(
                    InvertedResidual(
                        channels, out, expansion=expansion, stride=steps, dilation=reach
                    )
                )
                channels = out
        # a slice of a Sequential keeps the numbers of its layers, as the checkpoint has them
        everything = nn.Sequential(*layers)
        self.low_level_features = everything[:_NUM_LOW_LEVEL]
        self.high_level_features = everything[_NUM_LOW_LEVEL:]

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Features at a quarter and a sixteenth of the size, 24 and 320 channels.

        ``image`` is (B, 3, H, W), see :func:`imagenet_normalised`.
        """
        low_level = self.low_level_features(image)
        return low_level, self.high_level_features(low_level)


def generalized_mean(features: torch.Tensor, power: torch.Tensor | float) -> torch.Tensor:
    """The power mean (B, C) of each channel over all pixels: 1 is the mean, infinity the maximum.

    ``features`` (B, C, H, W) may be of any precision, and count as 1e-6 below it; the result is
    float32, float64 where they are. ``power`` is one number, not 0.
    """
    # a third power leaves the range of half precision at 41
    values = features if features.dtype == torch.float64 else features.float()
    return values.clamp(min=_MINIMUM).pow(power).mean(dim=(2, 3)).pow(1.0 / power)
