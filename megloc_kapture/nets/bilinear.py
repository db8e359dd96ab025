"""Bilinear reading of maps at any places, as weighted sums of rows of a table of pixels."""

from __future__ import annotations

import torch
from torch.nn import functional


def corners_around(
    y: torch.Tensor,
    x: torch.Tensor,
    size: tuple[int, int],
    amplitude: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The four pixels around each place and their weights; what lies outside weighs nothing.

    Parameters
    ----------
    y, x : any shape S, rows and columns; a pixel's centre is an integer.
    size : (H, W) of the map.
    amplitude : shape S or None, a factor on the weights.

    Returns
    -------
    indices : int64 (number of S, 4), row by row; always within the map.
    weights : (number of S, 4), of the places' type.
    """
    height, width = size
    top, left = torch.floor(y), torch.floor(x)
    below, right = y - top, x - left
    # more than a pixel off the map all weights are zero, however far; so that no integer overflows
    row = top.clamp(-2, height).long()
    column = left.clamp(-2, width).long()
    weights_y = [
        (1 - below) * ((row >= 0) & (row < height)),
        below * ((row >= -1) & (row < height - 1)),
    ]
    weights_x = [
        (1 - right) * ((column >= 0) & (column < width)),
        right * ((column >= -1) & (column < width - 1)),
    ]
    if amplitude is not None:
        weights_y = [weight * amplitude for weight in weights_y]
    rows = [(row + step).clamp(0, height - 1) * width for step in (0, 1)]
    columns = [(column + step).clamp(0, width - 1) for step in (0, 1)]
    corners = [(i, j) for i in (0, 1) for j in (0, 1)]
    indices = torch.stack([rows[i] + columns[j] for i, j in corners], dim=-1)
    weights = torch.stack([weights_y[i] * weights_x[j] for i, j in corners], dim=-1)
    return indices.view(-1, 4), weights.view(-1, 4)


def read_bilinear(
    table: torch.Tensor,
    y: torch.Tensor,
    x: torch.Tensor,
    size: tuple[int, int],
    amplitude: torch.Tensor | None = None,
) -> torch.Tensor:
    """Read a map bilinearly, zero outside.

    Parameters
    ----------
    table : (H W, C), the channels of each pixel, row by row; of the places' type.
    y, x, size, amplitude : see :func:`corners_around`.

    Returns
    -------
    (number of S, C).
    """
    indices, weights = corners_around(y, x, size, amplitude)
    return functional.embedding_bag(indices, table, mode="sum", per_sample_weights=weights)


def pixel_table(values: torch.Tensor) -> torch.Tensor:
    """A map (C, H, W) as (H W, C), at least float32; no copy if it lies channels-last."""
    exact = values.to(torch.promote_types(values.dtype, torch.float32))
    return exact.permute(1, 2, 0).reshape(-1, len(values))
