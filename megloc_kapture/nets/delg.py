"""DELG's global branch (Cao et al., ECCV 2020): a ResNet, generalized-mean pooling and a layer.

Two forms of its ResNet exist in TensorFlow, and which one a checkpoint is of shows in the names of
its variables (:mod:`megloc_kapture.nets.delg_variables`):

    keras   the authors' public training code: strides on the first 1x1 convolution of a stage and
            its shortcut, convolutions with bias, epsilon 1e-3, margins as TensorFlow's SAME, a
            maximum pooling without margin (VALID)
    slim    TF-Slim's resnet_v1: strides on the 3x3 convolution of a stage's last block, of all
            stages but the last, convolutions without bias, epsilon 1e-5, margins of half a kernel,
            a maximum pooling padded as SAME

Both have stride 32 and 2048 channels at the end. What the training code calls ``block3_strides``
moves a stride from two 1x1 convolutions to a subsampling before them and changes nothing here.
The module's keys are those of torchvision's ResNet, and ``embedding`` for the last layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets.aslfeat import conv_same
from megloc_kapture.nets.gem import generalized_mean
from megloc_kapture.nets.resnet import Depth

Form = Literal["keras", "slim"]

DESCRIPTOR_SIZE = 2048
_POWER = 3.0  # section 3.2 of the paper: fixed
_BLOCKS: dict[Depth, tuple[int, int, int, int]] = {50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}
_WIDTHS = (64, 128, 256, 512)
_EXPANSION = 4
_EPSILONS: dict[Form, float] = {"keras": 1e-3, "slim": 1e-5}
_LEAST_PX = 5  # a smaller side leaves the pooling without margin nothing


class _Block(nn.Module):
    """1x1, 3x3 and 1x1 convolution around a shortcut, the stride where the form has it."""

    def __init__(self, channels: int, width: int, *, form: Form, stride: int) -> None:
        super().__init__()
        out, bias, epsilon = width * _EXPANSION, form == "keras", _EPSILONS[form]
        first, middle = (stride, 1) if form == "keras" else (1, stride)
        self.conv1 = nn.Conv2d(channels, width, 1, stride=first, bias=bias)
        self.bn1 = nn.BatchNorm2d(width, eps=epsilon)
        self.conv2 = nn.Conv2d(width, width, 3, stride=middle, padding=1, bias=bias)
        self.bn2 = nn.BatchNorm2d(width, eps=epsilon)
        self.conv3 = nn.Conv2d(width, out, 1, bias=bias)
        self.bn3 = nn.BatchNorm2d(out, eps=epsilon)
        self.stride = stride
        self.downsample = (
            None
            if channels == out
            else nn.Sequential(
                nn.Conv2d(channels, out, 1, stride=stride, bias=bias),
                nn.BatchNorm2d(out, eps=epsilon),
            )
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = functional.relu(self.bn1(self.conv1(x)), inplace=True)
        y = functional.relu(self.bn2(self.conv2(y)), inplace=True)
        y = self.bn3(self.conv3(y))
        y += (
            x[..., :: self.stride, :: self.stride]
            if self.downsample is None
            else (self.downsample(x))
        )
        return functional.relu(y, inplace=True)


class DelgNet(nn.Module):
    """Image to a vector at one scale; :func:`describe` joins several.

    Parameters
    ----------
    depth : 50 or 101.
    form : which of the two ResNets, see the module's text.
    """

    def __init__(self, depth: Depth, form: Form) -> None:
        super().__init__()
        self.form = form
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, bias=form == "keras")
        self.bn1 = nn.BatchNorm2d(64, eps=_EPSILONS[form])
        channels = 64
        for stage, (width, blocks) in enumerate(zip(_WIDTHS, _BLOCKS[depth], strict=True), 1):
            # a stage and the block of it that has the stride
            strided = (stage > 1, 0) if form == "keras" else (stage < 4, blocks - 1)
            layers = nn.Sequential()
            for block in range(blocks):
                stride = 2 if strided == (True, block) else 1
                layers.append(_Block(channels, width, form=form, stride=stride))
                channels = width * _EXPANSION
            self.add_module(f"layer{stage}", layers)
        self.embedding = nn.Linear(channels, DESCRIPTOR_SIZE)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Vectors (B, 2048), of any length, of RGB images (B, 3, H, W) in [-1, 1]."""
        for number in range(1, 5):
            layer = self.get_submodule(f"layer{number}")
            image = layer(self._stem(image) if number == 1 else image)
        # in half precision the convolutions alone
        with torch.autocast(image.device.type, enabled=False):
            return self.embedding(generalized_mean(image, _POWER))

    def _stem(self, image: torch.Tensor) -> torch.Tensor:
        weight, bias = self.conv1.weight, self.conv1.bias
        if self.form == "keras":
            x = conv_same(image, weight, bias, 2)
        else:
            x = functional.conv2d(image, weight, bias, 2, padding=3)
        x = functional.relu(self.bn1(x), inplace=True)
        if self.form == "slim":
            # SAME: one margin less on the left and at the top where a side is even
            height, width = x.shape[-2:]
            x = functional.pad(x, (width % 2, 1, height % 2, 1))  # 0 is the least after a ReLU
        return functional.max_pool2d(x, 3, stride=2)


def describe(net: DelgNet, image: torch.Tensor, scales: Sequence[float]) -> torch.Tensor:
    """Unit vectors, float32 (B, 2048): the sum of those at several scales (section 4.1).

    Parameters
    ----------
    image : RGB (B, 3, H, W) in 0 to 255; at each scale it is resized bilinearly, without
        smoothing, to sides rounded to whole pixels, halves to even ones.

    Raises
    ------
    DataError : the image is too small for the network at the least scale.
    """
    normalised = (image - 128.0) / 128.0
    total = image.new_zeros(len(image), DESCRIPTOR_SIZE)
    for scale in scales:
        # in the precision of TensorFlow's own product, on which a half can depend
        sides = [round(float(np.float32(n) * np.float32(scale))) for n in image.shape[-2:]]
        if min(sides) < _LEAST_PX:
            raise DataError(
                f"an image of {image.shape[-1]} x {image.shape[-2]} pixels is too small for DELG: "
                f"at scale {scale:g} its sides must be at least {_LEAST_PX}"
            )
        resized = functional.interpolate(
            normalised, sides, mode="bilinear", align_corners=False, antialias=False
        )
        total += functional.normalize(net(resized))
    return functional.normalize(total)
