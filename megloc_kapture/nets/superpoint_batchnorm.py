"""SuperPoint with batch normalisation, the MIT-licensed retraining (rpautrat/SuperPoint).

The same topology as :mod:`megloc_kapture.nets.superpoint` with a normalisation *after* each
activation; state-dict keys are those of its own ``superpoint_v6_from_tf.pth``. Its descriptors are
not those that SuperGlue's weights were trained with.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.nets.loading import load_strictly
from megloc_kapture.nets.superpoint import (
    CELL_PX,
    DESCRIPTOR_SIZE,
    DescriptorSampling,
    pixel_scores,
)

_EPSILON = 1e-3  # TensorFlow's default, which it was trained with


class _Block(nn.Module):
    """Convolution, activation, normalisation, in this order."""

    def __init__(self, channels_in: int, channels_out: int, size: int, *, relu: bool = True):
        super().__init__()
        self.conv = nn.Conv2d(channels_in, channels_out, size, padding=size // 2)
        self.bn = nn.BatchNorm2d(channels_out, eps=_EPSILON)
        self.relu = relu

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.conv(x)
        return self.bn(functional.relu_(x) if self.relu else x)


class SuperPointBatchNormNet(nn.Module):
    """The network: gray image to scores per pixel and descriptors per cell of 8 x 8 pixels."""

    official_sampling: DescriptorSampling = "exact"

    def __init__(self) -> None:
        super().__init__()
        pool = nn.MaxPool2d(2)
        self.backbone = nn.Sequential(
            nn.Sequential(_Block(1, 64, 3), _Block(64, 64, 3), pool),
            nn.Sequential(_Block(64, 64, 3), _Block(64, 64, 3), pool),
            nn.Sequential(_Block(64, 128, 3), _Block(128, 128, 3), pool),
            nn.Sequential(_Block(128, 128, 3), _Block(128, 128, 3)),
        )
        self.detector = nn.Sequential(
            _Block(128, 256, 3), _Block(256, CELL_PX**2 + 1, 1, relu=False)
        )
        self.descriptor = nn.Sequential(
            _Block(128, 256, 3), _Block(256, DESCRIPTOR_SIZE, 1, relu=False)
        )

    def forward(self, gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Scores (B, 8h, 8w) and descriptors (B, 256, h, w) of gray images (B, 1, H, W)."""
        features = self.backbone(gray)
        descriptors = functional.normalize(self.descriptor(features), dim=1)
        return pixel_scores(self.detector(features)), descriptors


def is_superpoint_batchnorm(tensors: Mapping[str, torch.Tensor]) -> bool:
    """Whether the keys are those of this network."""
    return any(key.startswith("backbone.") for key in tensors)


def superpoint_batchnorm(tensors: Mapping[str, torch.Tensor], where: str) -> SuperPointBatchNormNet:
    """The network with the weights of a checkpoint.

    Raises
    ------
    DataError : names the keys of ``where`` that do not fit.
    """
    net = SuperPointBatchNormNet()
    counters = [key for key in net.state_dict() if key.endswith("num_batches_tracked")]
    load_strictly(net, tensors, where, may_lack=counters)
    return net
