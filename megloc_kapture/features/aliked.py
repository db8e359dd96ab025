"""ALIKED local features (Zhao et al., IEEE TIM 2023), with the official parameter names.

The network is for inference only: batch normalisation is folded into the convolutions. The features
of all levels (64 or 128 channels) are never concatenated at full resolution: the score head's first
layer, a matrix product per pixel, is applied to each level before upsampling, and descriptors read
the features around keypoints only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.features.network import Images, LocalNetwork, LocalNetworkOptions, Masks
from megloc_kapture.nets.runtime import image_tensor, in_fast_layout, inference, load_strictly
from megloc_kapture.nets.score_maps import (
    corners_around,
    deform_conv2d,
    pixel_table,
    read_bilinear,
    select_pixels,
    soft_argmax,
    suppress_non_maxima,
    with_norm,
)
from megloc_kapture.values import LocalFeatures

_NMS_RADIUS = 2  # pixels, as published
_TEMPERATURE = 0.1  # softmax temperature of the sub-pixel position, as in training
_MULTIPLE = 32
# image rows per strip in the score head's first layer; a strip of two rows fits the CPU's cache
_STRIP_ROWS = 2
_PATCH = 3
_VALUES_AT_ONCE = {"cpu": 1 << 23, "cuda": 1 << 28}


class AlikedOptions(LocalNetworkOptions):
    weights: str = Field(
        default="aliked-n16",
        description="aliked-t16 (64-d), aliked-n16, aliked-n16rot, aliked-n32, or a file",
    )
    threshold: float = Field(default=0.2, ge=0, lt=1, description="smallest score of a keypoint")


class Aliked(LocalNetwork[AlikedOptions]):
    """ALIKED keypoints (x, y, score) with unit-norm descriptors, float32 (N, 64 or 128)."""

    name = "aliked"
    Options = AlikedOptions

    def __init__(self, options: AlikedOptions | None = None) -> None:
        super().__init__(options)
        # each model has its own feature type, since descriptors of different models do not match
        self.name = Path(self._weights.name).stem

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        net, device = self.network(aliked_from)
        with inference(device, self.options.half_precision):
            maps = net(torch.cat([image_tensor(image, device) for image in images]))
        with inference(device):
            return [self._selected(net, *each) for each in zip(maps, masks, strict=True)]

    def _selected(
        self, net: AlikedNet, maps: AlikedMaps, mask: NDArray[np.bool_] | None
    ) -> LocalFeatures:
        scores = maps.scores
        pixels, _ = select_pixels(
            suppress_non_maxima(scores, _NMS_RADIUS),
            threshold=self.options.threshold,
            border=_NMS_RADIUS,
        )
        xy = soft_argmax(scores, pixels, _NMS_RADIUS, _TEMPERATURE)
        height, width = scores.shape
        read = read_bilinear(scores.reshape(-1, 1), xy[:, 1], xy[:, 0], (height, width))
        # the first pixel's centre is (0, 0) in the network, (0.5, 0.5) in COLMAP
        xy_px = xy.cpu().numpy() + np.float32(0.5)
        score = read[:, 0].cpu().numpy()
        return self._best(
            np.column_stack([xy_px, score]),
            score,
            lambda rows: net.desc_head(maps, xy[rows.to(xy.device)]),
            mask,
        )


class AlikedNet(nn.Module):
    """Network from image to score map and features, with the keys of ``aliked-*.pth``."""

    def __init__(self, channels: tuple[int, int, int, int], positions: int) -> None:
        super().__init__()
        first, *others = channels
        self.descriptor_size = channels[-1]
        self.block1 = _Block(3, first, deformable=False, residual=False)
        self.block2 = _Block(first, others[0], deformable=False)
        self.block3 = _Block(others[0], others[1], deformable=True)
        self.block4 = _Block(others[1], others[2], deformable=True)
        quarter = self.descriptor_size // 4
        self.conv1 = nn.Conv2d(first, quarter, 1, bias=False)
        self.conv2 = nn.Conv2d(others[0], quarter, 1, bias=False)
        self.conv3 = nn.Conv2d(others[1], quarter, 1, bias=False)
        self.conv4 = nn.Conv2d(others[2], quarter, 1, bias=False)
        self.score_head = nn.Sequential(
            nn.Conv2d(self.descriptor_size, 8, 1, bias=False),
            nn.SELU(inplace=True),
            nn.Conv2d(8, 4, 3, padding=1, bias=False),
            nn.SELU(inplace=True),
            nn.Conv2d(4, 4, 3, padding=1, bias=False),
            nn.SELU(inplace=True),
            nn.Conv2d(4, 1, 3, padding=1, bias=False),
        )
        self.desc_head = DescriptorHead(self.descriptor_size, positions)

    def forward(self, images: torch.Tensor) -> list[AlikedMaps]:
        """Compute the maps of RGB images (B, 3, H, W) in [0, 1]."""
        height, width = images.shape[2:]
        extra_y, extra_x = -height % _MULTIPLE, -width % _MULTIPLE
        top, left = extra_y // 2, extra_x // 2
        margins = (left, extra_x - left, top, extra_y - top)
        padded = functional.pad(images, margins, mode="replicate")
        level1 = self.block1(in_fast_layout(padded))
        level2 = self.block2(functional.avg_pool2d(level1, 2))
        level3 = self.block3(functional.avg_pool2d(level2, 4))
        level4 = self.block4(functional.avg_pool2d(level3, 4))
        coarse = [
            functional.selu(tap(level), inplace=True)
            for tap, level in ((self.conv2, level2), (self.conv3, level3), (self.conv4, level4))
        ]
        maps = []
        for k in range(len(images)):
            levels = [level[k : k + 1] for level in coarse]
            fine = _channels_last(level1[k])
            # half precision would make neighbouring scores equal, and equal maxima are all kept
            with torch.autocast(images.device.type, enabled=False):
                scores = torch.sigmoid(self._score_logits(fine, levels)[0, 0])
            scores = scores[top : top + height, left : left + width]
            coarse_last = [_channels_last(level[0]) for level in levels]
            maps.append(AlikedMaps(self, scores, (top, left), fine, coarse_last))
        return maps

    def _score_logits(self, fine: torch.Tensor, coarse: list[torch.Tensor]) -> torch.Tensor:
        first, *others = (
            weight[:, :, 0, 0].T
            for weight in self.get_parameter("score_head.0.weight").chunk(4, dim=1)
        )
        height, width = fine.shape[:2]
        sums: torch.Tensor | None = None
        for level, weight in zip(coarse, others, strict=True):
            reduced = (level.float().permute(0, 2, 3, 1) @ weight).permute(0, 3, 1, 2)
            enlarged = functional.interpolate(
                reduced, (height, width), mode="bilinear", align_corners=True
            )
            sums = enlarged if sums is None else sums.add_(enlarged)
        assert sums is not None
        by_pixel = sums.permute(0, 2, 3, 1).reshape(height * width, -1)
        # on a CPU, a strip stays in the cache; on a GPU, strips would only add kernel launches
        at_once = (_STRIP_ROWS if by_pixel.device.type == "cpu" else height) * width
        for strip, into in zip(
            torch.split(fine.flatten(0, 1), at_once), torch.split(by_pixel, at_once), strict=True
        ):
            into += self.fine_tap(strip.float()) @ first
        return self.score_head[1:](by_pixel.view(1, height, width, -1).permute(0, 3, 1, 2))

    def fine_tap(self, level1: torch.Tensor) -> torch.Tensor:
        """Return the finest level's features (N, D / 4) for activations (N, C) of ``block1``."""
        return functional.selu(level1 @ self.conv1.weight[:, :, 0, 0].T, inplace=True)


@dataclass(frozen=True, eq=False)
class AlikedMaps:
    """Score map of an image, float32 (H, W) in (0, 1), and feature levels (h, w, C) to sample."""

    _net: AlikedNet
    scores: torch.Tensor
    _origin: tuple[int, int]  # row and column of the image's first pixel in the padded image
    _fine: torch.Tensor
    _coarse: list[torch.Tensor]

    def features_at(self, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Return unit-norm features (N, D) of pixels, given as int64 (N,) rows and columns."""
        row, column = rows + self._origin[0], columns + self._origin[1]
        height, width = self._fine.shape[:2]
        parts = [self._net.fine_tap(self._fine[row, column])]
        for level in self._coarse:
            h, w = level.shape[:2]
            # align_corners: the corner pixels of both maps coincide
            y = (row.to(level.dtype) * ((h - 1) / (height - 1))).clamp(max=h - 1)
            x = (column.to(level.dtype) * ((w - 1) / (width - 1))).clamp(max=w - 1)
            parts.append(read_bilinear(level.flatten(0, 1), y, x, (h, w)))
        return functional.normalize(torch.cat(parts, dim=1), dim=1)


def _channels_last(features: torch.Tensor) -> torch.Tensor:
    return pixel_table(features).view(*features.shape[1:], -1)


class _Block(nn.Module):
    def __init__(
        self, inputs: int, outputs: int, *, deformable: bool, residual: bool = True
    ) -> None:
        super().__init__()
        make = _deformable_conv if deformable else _conv
        self.conv1 = make(inputs, outputs)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = make(outputs, outputs)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = nn.Conv2d(inputs, outputs, 1) if residual else None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        inner = functional.selu(_normalised(x, self.conv1, self.bn1), inplace=True)
        result = _normalised(inner, self.conv2, self.bn2)
        if self.downsample is not None:
            result = result + self.downsample(x)
        return functional.selu(result, inplace=True)


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)


def _deformable_conv(inputs: int, outputs: int) -> nn.ModuleDict:
    offset = nn.Conv2d(inputs, 18, 3, padding=1)
    return nn.ModuleDict({"offset_conv": offset, "regular_conv": _conv(inputs, outputs)})


def _normalised(
    x: torch.Tensor, conv: nn.Conv2d | nn.ModuleDict, norm: nn.BatchNorm2d
) -> torch.Tensor:
    if isinstance(conv, nn.Conv2d):
        return functional.conv2d(x, *with_norm(conv.weight, norm), padding=1)
    limit = max(x.shape[2:]) / 4
    offset = conv["offset_conv"](x).clamp(-limit, limit)
    return deform_conv2d(x, offset, *with_norm(conv.get_parameter("regular_conv.weight"), norm))


def aliked_from(tensors: Mapping[str, torch.Tensor], where: str) -> AlikedNet:
    """Build the network in eval mode, with its variant inferred from the checkpoint's shapes."""
    try:
        first = tensors["block1.conv1.weight"].shape[0]
        second, third, fourth = (tensors[f"conv{level}.weight"].shape[1] for level in (2, 3, 4))
        positions = tensors["desc_head.agg_weights"].shape[0]
    except (KeyError, IndexError) as error:
        raise DataError(f"this file is not an ALIKED checkpoint: no {error}", path=where) from error
    net = AlikedNet((first, second, third, fourth), positions)
    return load_strictly(net, tensors, where).eval()


class DescriptorHead(nn.Module):
    def __init__(self, size: int, positions: int) -> None:
        super().__init__()
        self.positions = positions
        self.agg_weights = nn.Parameter(torch.zeros(positions, size, size))
        self.offset_conv = nn.Sequential(
            nn.Conv2d(size, 2 * positions, _PATCH),
            nn.SELU(inplace=True),
            nn.Conv2d(2 * positions, 2 * positions, 1),
        )
        self.sf_conv = nn.Conv2d(size, size, 1, bias=False)

    def forward(self, maps: AlikedMaps, xy: torch.Tensor) -> torch.Tensor:
        """Return unit-norm descriptors float32 (N, D) at xy (N, 2).

        The centre of the first pixel is (0, 0).
        """
        size = self.agg_weights.shape[1]
        at_once = _VALUES_AT_ONCE[xy.device.type] // (4 * self.positions * size)
        parts = [self._describe(maps, part) for part in torch.split(xy, max(at_once, 1))]
        return torch.cat(parts)

    def _describe(self, maps: AlikedMaps, xy: torch.Tensor) -> torch.Tensor:
        height, width = maps.scores.shape
        number, size = len(xy), self.agg_weights.shape[1]
        # the patch is centred on the keypoint's pixel, but clamped as in the published code, which
        # excludes the last row and column
        left = (xy[:, 0].long() - 1).clamp(0, width - 1 - _PATCH)
        top = (xy[:, 1].long() - 1).clamp(0, height - 1 - _PATCH)
        side = torch.arange(_PATCH, device=xy.device)
        rows = (top[:, None, None] + side[:, None]).expand(-1, -1, _PATCH)
        columns = (left[:, None, None] + side).expand(-1, _PATCH, -1)
        patch = maps.features_at(rows.reshape(-1), columns.reshape(-1))
        patch = patch.view(number, _PATCH, _PATCH, size).permute(0, 3, 1, 2)
        limit = max(height, width) / 4
        offsets = (
            self.offset_conv(patch).float().clamp(-limit, limit).view(number, 2, self.positions)
        )
        x, y = (xy[:, :, None] + offsets).unbind(1)
        indices, weights = corners_around(y, x, (height, width))
        corners = maps.features_at(
            indices.reshape(-1).div(width, rounding_mode="floor"), indices.reshape(-1) % width
        )
        read = torch.einsum("nkc,nk->nc", corners.view(-1, 4, size), weights)
        mixed = functional.selu(read @ self.sf_conv.weight[:, :, 0, 0].T)
        gathered = mixed.view(number, self.positions * size) @ self.agg_weights.view(-1, size)
        return functional.normalize(gathered.float(), dim=1)
