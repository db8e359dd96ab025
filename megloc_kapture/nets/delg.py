"""DELG's global branch (Cao et al., ECCV 2020): a ResNet, GeM pooling and a linear layer.

The ResNet has two forms in TensorFlow; a checkpoint has the form "keras" if its convolutions have
a bias::

    keras   the authors' training code: stride 2 on the first 1x1 convolution of stages 2 to 4 and
            on its shortcut, bias, epsilon 1e-3, padding SAME, max pooling without padding (VALID)
    slim    TF-Slim's resnet_v1: stride 2 on the 3x3 convolution of the last block of stages 1 to
            3, no bias, epsilon 1e-5, padding by half a kernel, max pooling with padding SAME

Both have an output stride of 32 and 2048 channels. The keys are torchvision's, see
``scripts/convert_weights.py``.
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
_POWER = 3.0  # of GeM pooling, fixed in section 3.2 of the paper
_EPSILONS: dict[Form, float] = {"keras": 1e-3, "slim": 1e-5}
_LEAST_PX = 5  # smaller sides vanish in the unpadded pooling


class DelgNet(nn.Module):
    def __init__(self, depth: Depth, form: Form, scales: Sequence[float] = (1.0,)) -> None:
        super().__init__()
        self.form, self.scales = form, scales
        keras, epsilon = form == "keras", _EPSILONS[form]
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, bias=keras)
        self.bn1 = nn.BatchNorm2d(64, eps=epsilon)
        bottleneck = partial(Bottleneck, strided_first=keras, bias=keras, epsilon=epsilon)
        channels, blocks_of = 64, RESNET_BLOCKS[depth]
        for stage, (width, blocks) in enumerate(zip(RESNET_WIDTHS, blocks_of, strict=True), 1):
            strided = (stage > 1, 0) if keras else (stage < 4, blocks - 1)
            layers = nn.Sequential()
            for block in range(blocks):
                stride = 2 if strided == (True, block) else 1
                layers.append(bottleneck(channels, width, stride=stride))
                channels = width * RESNET_EXPANSION
            self.add_module(f"layer{stage}", layers)
        self.embedding = nn.Linear(channels, DESCRIPTOR_SIZE)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Sum the unit-norm vectors of all scales and normalise (section 4.1): float32 (B, 2048).

        ``image`` is RGB (B, 3, H, W) in [0, 255], resized bilinearly without antialiasing; sides
        are rounded half to even.
        """
        normalised = (image - 128.0) / 128.0
        total = image.new_zeros(len(image), DESCRIPTOR_SIZE)
        for scale in self.scales:
            # compute in float32 as TensorFlow does: the precision can decide the rounding of a half
            sides = [round(float(np.float32(n) * np.float32(scale))) for n in image.shape[-2:]]
            if min(sides) < _LEAST_PX:
                raise DataError(
                    f"an image of {image.shape[-1]} x {image.shape[-2]} pixels is too small for "
                    f"DELG: at scale {scale:g} its sides must be at least {_LEAST_PX}"
                )
            resized = functional.interpolate(
                normalised, sides, mode="bilinear", align_corners=False, antialias=False
            )
            total += functional.normalize(self.at_one_scale(resized))
        return functional.normalize(total)

    def at_one_scale(self, image: torch.Tensor) -> torch.Tensor:
        """Compute unnormalised vectors (B, 2048) of RGB images (B, 3, H, W) in [-1, 1]."""
        for number in range(1, 5):
            layer = self.get_submodule(f"layer{number}")
            image = layer(self._stem(image) if number == 1 else image)
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
            # SAME: an even side is not padded on the left or at the top
            height, width = x.shape[-2:]
            x = functional.pad(x, (width % 2, 1, height % 2, 1))  # 0 is the minimum after a ReLU
        return functional.max_pool2d(x, 3, stride=2)


def delg_from(
    tensors: Mapping[str, torch.Tensor], where: str, scales: Sequence[float] = (1.0,)
) -> DelgNet:
    blocks = {key.split(".")[1] for key in tensors if key.startswith("layer3.")}
    if len(blocks) not in RESNET_DEPTHS:
        raise DataError(
            f"not DELG: {len(blocks)} blocks in the third stage, not 6 (ResNet-50) or 23 "
            f"(ResNet-101); found: {first_few(sorted(tensors), 8)}",
            path=where,
        )
    form: Form = "keras" if "conv1.bias" in tensors else "slim"
    net = DelgNet(RESNET_DEPTHS[len(blocks)], form, scales)
    return load_strictly(net, tensors, where, may_lack=batch_counters(net)).eval()
