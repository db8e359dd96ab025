"""DELG's global branch (Cao et al., ECCV 2020): a ResNet, generalized-mean pooling and a layer.

Two forms of its ResNet exist in TensorFlow; convolutions with a bias tell the first:

    keras   the authors' public training code: strides on the first 1x1 convolution of a stage and
            its shortcut, convolutions with bias, epsilon 1e-3, margins as TensorFlow's SAME, a
            maximum pooling without margin (VALID)
    slim    TF-Slim's resnet_v1: strides on the 3x3 convolution of a stage's last block, of all
            stages but the last, convolutions without bias, epsilon 1e-5, margins of half a kernel,
            a maximum pooling padded as SAME

Both have stride 32 and 2048 channels at the end. What the training code calls ``block3_strides``
moves a stride from two 1x1 convolutions to a subsampling before them and changes nothing here.
The module's keys are those of torchvision's ResNet, and ``embedding`` for the last layer;
``scripts/convert_weights.py`` knows the names of TensorFlow's variables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets.runtime import batch_counters, first_few, load_strictly
from megloc_kapture.nets.score_maps import conv_same
from megloc_kapture.nets.trunks import (
    RESNET_BLOCKS,
    RESNET_DEPTHS,
    RESNET_EXPANSION,
    RESNET_WIDTHS,
    Bottleneck,
    Depth,
    generalized_mean,
)

Form = Literal["keras", "slim"]
DESCRIPTOR_SIZE = 2048
_POWER = 3.0  # section 3.2 of the paper: fixed
_EPSILONS: dict[Form, float] = {"keras": 1e-3, "slim": 1e-5}
_LEAST_PX = 5  # a smaller side leaves the pooling without margin nothing


class DelgNet(nn.Module):
    """Image to a vector at one scale; :func:`describe` joins several."""

    def __init__(self, depth: Depth, form: Form) -> None:
        super().__init__()
        self.form = form
        keras, epsilon = form == "keras", _EPSILONS[form]
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, bias=keras)
        self.bn1 = nn.BatchNorm2d(64, eps=epsilon)
        bottleneck = partial(Bottleneck, strided_first=keras, bias=keras, epsilon=epsilon)
        channels, blocks_of = 64, RESNET_BLOCKS[depth]
        for stage, (width, blocks) in enumerate(zip(RESNET_WIDTHS, blocks_of, strict=True), 1):
            # a stage and the block of it that has the stride
            strided = (stage > 1, 0) if keras else (stage < 4, blocks - 1)
            layers = nn.Sequential()
            for block in range(blocks):
                stride = 2 if strided == (True, block) else 1
                layers.append(bottleneck(channels, width, stride=stride))
                channels = width * RESNET_EXPANSION
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

    ``image`` is RGB (B, 3, H, W) in 0 to 255; at each scale it is resized bilinearly, without
    smoothing, to sides rounded to whole pixels, halves to even ones.
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


def delg_from(tensors: Mapping[str, torch.Tensor], where: str) -> DelgNet:
    """Build the network from a converted checkpoint, ready for inference."""
    blocks = {key.split(".")[1] for key in tensors if key.startswith("layer3.")}
    if len(blocks) not in RESNET_DEPTHS:
        raise DataError(
            f"no DELG: {len(blocks)} blocks in the third stage, not 6 (ResNet-50) or 23 "
            f"(ResNet-101); found: {first_few(sorted(tensors), 8)}",
            path=where,
        )
    net = DelgNet(RESNET_DEPTHS[len(blocks)], "keras" if "conv1.bias" in tensors else "slim")
    return load_strictly(net, tensors, where, may_lack=batch_counters(net)).eval()
