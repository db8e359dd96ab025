"""SqueezeNet 1.1 (Iandola et al., arXiv 1602.07360) without its classifier, torchvision's names."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F


class Fire(nn.Module):
    """A fire module: 1x1 convolutions to few channels, then 1x1 and 3x3 beside each other.

    Parameters
    ----------
    squeezed, expanded : channels between, and of each of the two halves of the result.
    """

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

    Takes (B, 3, H, W), at least 17 x 17 pixels. Keys of the state dict are ``0.weight``,
    ``0.bias`` and ``{i}.{squeeze,expand1x1,expand3x3}.{weight,bias}`` for i of 3, 4, 6, 7, 9 to 12.
    """

    def __init__(self) -> None:
        super().__init__(
            nn.Conv2d(3, 64, 3, stride=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2, ceil_mode=True),
            Fire(64, 16, 64),
            Fire(128, 16, 64),
            nn.MaxPool2d(3, stride=2, ceil_mode=True),
            Fire(128, 32, 128),
            Fire(256, 32, 128),
            nn.MaxPool2d(3, stride=2, ceil_mode=True),
            Fire(256, 48, 192),
            Fire(384, 48, 192),
            Fire(384, 64, 256),
            Fire(512, 64, 256),
        )
