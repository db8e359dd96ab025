"""The blocks of ESPNetv2 (Mehta et al., CVPR 2019), under the key names of its checkpoints."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from math import ceil, gcd

import torch
from torch import nn
from torch.nn import functional as F

_BRANCHES = 4
_SCALES = (2.0, 1.5, 1.0, 0.5, 0.1)  # of the pyramid pooling, in the order of its stages
_SMALLEST = 5  # side of the smallest map that is pooled to
_IMAGE_CHANNELS = 3


def convolution(
    channels: int, out: int, size: int, *, stride: int = 1, dilation: int = 1, groups: int = 1
) -> nn.Conv2d:
    """A convolution without bias that keeps the size but for its stride."""
    return nn.Conv2d(
        channels,
        out,
        size,
        stride=stride,
        padding=dilation * (size // 2),
        dilation=dilation,
        groups=groups,
        bias=False,
    )


def encoder_layer(
    channels: int, out: int, size: int, *, stride: int = 1, groups: int = 1, active: bool = True
) -> nn.Sequential:
    """Convolution and normalisation, then an activation with a slope for each channel."""
    layers: dict[str, nn.Module] = {
        "conv": convolution(channels, out, size, stride=stride, groups=groups),
        "bn": nn.BatchNorm2d(out),
    }
    if active:
        layers["act"] = nn.PReLU(out)
    return nn.Sequential(OrderedDict(layers))


def decoder_layer(channels: int, out: int, size: int, *, groups: int = 1) -> nn.Sequential:
    """The same under the names of the decoder."""
    layers = (convolution(channels, out, size, groups=groups), nn.BatchNorm2d(out), nn.PReLU(out))
    return nn.Sequential(OrderedDict(cbr=nn.Sequential(*layers)))


def normalised(channels: int) -> nn.Sequential:
    return nn.Sequential(nn.BatchNorm2d(channels), nn.PReLU(channels))


class Pyramid(nn.Module):
    """EESP: depthwise convolutions of growing dilation, each added to those before it.

    ``dilations``: of the branches, ascending.
    """

    def __init__(self, channels: int, out: int, dilations: Sequence[int], *, stride: int) -> None:
        super().__init__()
        narrow = out // _BRANCHES
        self.proj_1x1 = encoder_layer(channels, narrow, 1, groups=_BRANCHES)
        self.spp_dw = nn.ModuleList(
            nn.Sequential(
                OrderedDict(
                    conv=convolution(
                        narrow, narrow, 3, stride=stride, dilation=dilation, groups=narrow
                    )
                )
            )
            for dilation in dilations
        )
        self.conv_1x1_exp = encoder_layer(out, out, 1, groups=_BRANCHES, active=False)
        self.br_after_cat = nn.Sequential(OrderedDict(bn=nn.BatchNorm2d(out), act=nn.PReLU(out)))
        # where the pyramid makes its input smaller, this has weights but no use
        self.module_act = nn.PReLU(out)
        self._strided = stride > 1

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        narrow = self.proj_1x1(x)
        sums: list[torch.Tensor] = []
        for branch in self.spp_dw:
            found = branch(narrow)
            sums.append(found + sums[-1] if sums else found)
        merged = self.conv_1x1_exp(self.br_after_cat(torch.cat(sums, dim=1)))
        return merged if self._strided else self.module_act(merged + x)


class Smaller(nn.Module):
    """Half the size: mean and pyramid side by side, and the image itself added to both."""

    def __init__(self, channels: int, out: int, dilations: Sequence[int]) -> None:
        super().__init__()
        self.eesp = Pyramid(channels, out - channels, dilations, stride=2)
        self.inp_reinf = nn.Sequential(
            encoder_layer(_IMAGE_CHANNELS, _IMAGE_CHANNELS, 3),
            encoder_layer(_IMAGE_CHANNELS, out, 1, active=False),
        )
        self.act = nn.PReLU(out)

    def forward(self, x: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        found = torch.cat([_halved(x), self.eesp(x)], dim=1)
        while image.shape[-2:] != found.shape[-2:]:
            image = _halved(image)
        return self.act(found + self.inp_reinf(image))


def _halved(x: torch.Tensor) -> torch.Tensor:
    return F.avg_pool2d(x, 3, stride=2, padding=1)


class PyramidPooling(nn.Module):
    """One depthwise convolution at each of five scales, shuffled and merged."""

    def __init__(self, channels: int, narrow: int, out: int, *, last: bool) -> None:
        super().__init__()
        self.projection_layer = decoder_layer(channels, narrow, 1)
        self.stages = nn.ModuleList(convolution(narrow, narrow, 3, groups=narrow) for _ in _SCALES)
        wide = narrow * len(_SCALES)
        self.merge_layer = nn.Sequential(
            nn.Sequential(OrderedDict(br=normalised(wide))),
            # a channel of every scale beside each other; it has no weights
            nn.ChannelShuffle(len(_SCALES)),
            decoder_layer(wide, narrow, 3, groups=narrow),
            nn.Conv2d(narrow, out, 1, bias=last),
        )
        if not last:
            self.br = nn.Sequential(OrderedDict(br=normalised(out)))
        self._last = last

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.projection_layer(x)
        height, width = x.shape[-2:]
        found = []
        for scale, stage in zip(_SCALES, self.stages, strict=True):
            size = (max(ceil(height * scale), _SMALLEST), max(ceil(width * scale), _SMALLEST))
            if scale > 1:
                there = F.interpolate(x, size, mode="bilinear", align_corners=True)
                found.append(F.adaptive_avg_pool2d(stage(there), (height, width)))
            elif scale < 1:
                there = stage(F.adaptive_avg_pool2d(x, size))
                found.append(
                    F.interpolate(there, (height, width), mode="bilinear", align_corners=True)
                )
            else:
                found.append(stage(x))
        merged = self.merge_layer(torch.cat(found, dim=1))
        return merged if self._last else self.br(merged)


class Weighted(nn.Module):
    """Features of the encoder for the decoder, each channel weighted by what the image holds."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.wt_layer = nn.Sequential(
            nn.AdaptiveAvgPool2d(1), nn.Conv2d(channels, out, 1, bias=False), nn.Sigmoid()
        )
        self.expansion_layer = decoder_layer(channels, out, 3, groups=gcd(channels, out))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.expansion_layer(x) * self.wt_layer(x)
