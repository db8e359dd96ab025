"""MobileNetV2 (Sandler et al., CVPR 2018) as the trunk of DeepLabV3+, under its key names.

Two things differ from the usual network, and the weights were trained with them: the first
convolution has no padding, and a block pads its input before the expansion rather than its
depthwise convolution, so that the frame around an expanded map is not zero but what the
expansion makes of zeros.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

# expansion, channels, blocks, stride of the first (table 2 of the paper)
_STAGES = (
    (1, 16, 1, 1),
    (6, 24, 2, 2),
    (6, 32, 3, 2),
    (6, 64, 4, 2),
    (6, 96, 3, 1),
    (6, 160, 3, 2),
    (6, 320, 1, 1),
)
_STEM_CHANNELS = 32
_OUTPUT_STRIDE = 16
_NUM_LOW_LEVEL = 4  # the stem and the blocks down to a quarter of the size
LOW_LEVEL_CHANNELS, CHANNELS = 24, 320


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
        layers: list[nn.Module] = [_activated(3, _STEM_CHANNELS, 3, stride=2)]
        channels, reached, dilation = _STEM_CHANNELS, 2, 1
        for expansion, out, blocks, wanted in _STAGES:
            stride, first = wanted, dilation
            if reached == _OUTPUT_STRIDE:
                stride, dilation = 1, dilation * wanted
            reached *= stride
            for block in range(blocks):
                layers.append(
                    InvertedResidual(
                        channels,
                        out,
                        expansion=expansion,
                        stride=stride if block == 0 else 1,
                        dilation=first if block == 0 else dilation,
                    )
                )
                channels = out
        # a slice of a Sequential keeps the numbers of its layers, as the checkpoint has them
        everything = nn.Sequential(*layers)
        self.low_level_features = everything[:_NUM_LOW_LEVEL]
        self.high_level_features = everything[_NUM_LOW_LEVEL:]

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Features at a quarter and a sixteenth of the size, 24 and 320 channels.

        Parameters
        ----------
        image : (B, 3, H, W), normalised as for ImageNet.
        """
        low_level = self.low_level_features(image)
        return low_level, self.high_level_features(low_level)
