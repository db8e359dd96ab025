"""XFeat's network (Potje et al., CVPR 2024, section 3), with the official checkpoint's keys.

The fine matcher of the semi-dense variant is left out: nothing here refines matches by offsets.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.nets.runtime import batch_counters, load_strictly

STRIDE = 32
"""Width and height of an input are multiples of it."""
CELL = 8
"""Side in pixels of the cells of the coarse maps."""
DESCRIPTOR_SIZE = 64


class BasicLayer(nn.Module):
    """Convolution without bias, normalisation without affine part, ReLU."""

    def __init__(self, inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(outputs, affine=False),
            nn.ReLU(inplace=True),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layer(x)


class XFeatNetwork(nn.Module):
    """Descriptors, keypoints and reliability of images, all on a grid of 8 by 8 pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm2d(1)
        self.skip1 = nn.Sequential(nn.AvgPool2d(4, stride=4), nn.Conv2d(1, 24, 1))
        first = BasicLayer(1, 4), BasicLayer(4, 8, stride=2)
        self.block1 = nn.Sequential(*first, BasicLayer(8, 8), BasicLayer(8, 24, stride=2))
        self.block2 = nn.Sequential(BasicLayer(24, 24), BasicLayer(24, 24))
        self.block3 = nn.Sequential(
            BasicLayer(24, 64, stride=2), BasicLayer(64, 64), BasicLayer(64, 64, kernel=1)
        )
        self.block4 = nn.Sequential(
            BasicLayer(64, 64, stride=2), BasicLayer(64, 64), BasicLayer(64, 64)
        )
        self.block5 = nn.Sequential(
            BasicLayer(64, 128, stride=2),
            BasicLayer(128, 128),
            BasicLayer(128, 128),
            BasicLayer(128, 64, kernel=1),
        )
        self.block_fusion = nn.Sequential(
            BasicLayer(64, 64), BasicLayer(64, 64), nn.Conv2d(64, DESCRIPTOR_SIZE, 1)
        )
        self.heatmap_head = nn.Sequential(
            BasicLayer(64, 64, kernel=1),
            BasicLayer(64, 64, kernel=1),
            nn.Conv2d(64, 1, 1),
            nn.Sigmoid(),
        )
        self.keypoint_head = nn.Sequential(
            *(BasicLayer(CELL**2, CELL**2, kernel=1) for _ in range(3)),
            nn.Conv2d(CELL**2, CELL**2 + 1, 1),
        )

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Dense maps of images, float (B, C, H, W), H and W multiples of 32.

        The channels are averaged. Returns features (B, 64, H/8, W/8), not normalised; logits
        (B, 65, H/8, W/8), of each pixel of a cell (channel 8 y + x), and of no keypoint; and
        reliability (B, 1, H/8, W/8), in [0, 1].
        """
        grey = self.norm(images.mean(dim=1, keepdim=True))
        x3 = self.block3(self.block2(self.block1(grey) + self.skip1(grey)))
        x4 = self.block4(x3)
        x5 = self.block5(x4)
        features = self.block_fusion(x3 + _enlarged(x4, x3) + _enlarged(x5, x3))
        logits = self.keypoint_head(functional.pixel_unshuffle(grey, CELL))
        return features, logits, self.heatmap_head(features)


def load_xfeat(tensors: Mapping[str, torch.Tensor], where: str) -> XFeatNetwork:
    """The network of a checkpoint, for inference; a fine matcher in it is left out.

    Raises DataError that names the keys that do not fit.
    """
    network = XFeatNetwork()
    used = {key: value for key, value in tensors.items() if not key.startswith("fine_matcher.")}
    return load_strictly(network, used, where, may_lack=batch_counters(network)).eval()


def keypoint_scores(logits: torch.Tensor) -> torch.Tensor:
    """Probability of a keypoint at each pixel, (B, 1, H, W), of logits (B, 65, H/8, W/8)."""
    return functional.pixel_shuffle(logits.float().softmax(dim=1)[:, :-1], CELL)


def sample_at_pixels(
    values: torch.Tensor, xy: torch.Tensor, size: tuple[int, int], *, mode: str
) -> torch.Tensor:
    """Values (N, C) of a coarse map (1, C, h, w) at pixels (N, 2), as XFeat samples them.

    The pixel (x, y), the first one's centre at (0, 0), of an image of ``size`` (H, W) is read at w
    x / (W - 1) - 0.5 and h y / (H - 1) - 0.5 of the map, half a pixel of the image from where it
    belongs; the network was trained so. ``mode`` is "bilinear" or "bicubic".
    """
    height, width = size
    last = torch.tensor([width - 1, height - 1], dtype=torch.float32, device=values.device)
    grid = 2 * xy.to(last) / last - 1
    found = functional.grid_sample(values.float(), grid[None, None], mode=mode, align_corners=False)
    return found[0, :, 0].T


def descriptors_at(features: torch.Tensor, xy: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Descriptors (N, 64) of unit length at pixels; see :func:`sample_at_pixels`."""
    normalised = functional.normalize(features.float(), dim=1)
    return functional.normalize(sample_at_pixels(normalised, xy, size, mode="bicubic"), dim=1)


def _enlarged(values: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return functional.interpolate(values, like.shape[-2:], mode="bilinear", align_corners=False)
