"""ALIKED's sparse deformable descriptor head (Zhao et al., IEEE TIM 2023, section III-C)."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.nets.bilinear import corners_around

_PATCH = 3  # side of the square of pixels that says where to look, in pixels
_VALUES_AT_ONCE = {"cpu": 1 << 23, "cuda": 1 << 28}


class Features(Protocol):
    """A dense map of features that is read pixel by pixel."""

    @property
    def scores(self) -> torch.Tensor:
        """(H, W), of the map's size."""
        ...

    def features_at(self, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Unit features (N, D) of pixels, int64 (N,) rows and columns."""
        ...


class DescriptorHead(nn.Module):
    """Features around a keypoint to the places that its descriptor is gathered from."""

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

    def forward(self, features: Features, xy: torch.Tensor) -> torch.Tensor:
        """Descriptors of unit length, float32 (N, D).

        Parameters
        ----------
        xy : float (N, 2), x and y in a map of at least 4 pixels a side; a pixel's centre is an
            integer.
        """
        size = self.agg_weights.shape[1]
        at_once = _VALUES_AT_ONCE[xy.device.type] // (4 * self.positions * size)
        parts = [self._describe(features, part) for part in torch.split(xy, max(at_once, 1))]
        return torch.cat(parts)

    def _describe(self, features: Features, xy: torch.Tensor) -> torch.Tensor:
        height, width = features.scores.shape
        number, size = len(xy), self.agg_weights.shape[1]
        # the patch is centred on the pixel the keypoint lies in. As published, it keeps off the
        # last row and column
        left = (xy[:, 0].long() - 1).clamp(0, width - 1 - _PATCH)
        top = (xy[:, 1].long() - 1).clamp(0, height - 1 - _PATCH)
        side = torch.arange(_PATCH, device=xy.device)
        rows = (top[:, None, None] + side[:, None]).expand(-1, -1, _PATCH)
        columns = (left[:, None, None] + side).expand(-1, _PATCH, -1)
        patch = features.features_at(rows.reshape(-1), columns.reshape(-1))
        patch = patch.view(number, _PATCH, _PATCH, size).permute(0, 3, 1, 2)
        limit = max(height, width) / 4
        offsets = (
            self.offset_conv(patch).float().clamp(-limit, limit).view(number, 2, self.positions)
        )
        x, y = (xy[:, :, None] + offsets).unbind(1)
        indices, weights = corners_around(y, x, (height, width))
        corners = features.features_at(
            indices.reshape(-1).div(width, rounding_mode="floor"), indices.reshape(-1) % width
        )
        read = torch.einsum("nkc,nk->nc", corners.view(-1, 4, size), weights)
        mixed = functional.selu(read @ self.sf_conv.weight[:, :, 0, 0].T)
        gathered = mixed.view(number, self.positions * size) @ self.agg_weights.view(-1, size)
        return functional.normalize(gathered.float(), dim=1)
