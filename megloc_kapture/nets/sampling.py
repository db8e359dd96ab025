"""Reading maps between their pixels: bilinear sampling, and deformable convolution by it.

Bilinear reading of maps at any positions, as weighted sums of rows of a table of pixels.

Deformable convolution (Dai et al., ICCV 2017; with amplitudes: Zhu et al., CVPR 2019, eq. 1).

Every tap of the kernel reads the input bilinearly at its own position plus an offset, zero outside:

    y(p) = sum_k w_k m_k(p) x(p + p_k + offset_k(p))

A bilinear reading is the weighted sum of four rows of a table that has one row of channels per
pixel, which is what ``embedding_bag`` computes, one contiguous row after the other; a product with
the kernel as a matrix follows. On a processor this is several times faster than ``grid_sample``,
whose channels lie far apart (benchmarks/speed/deformable.py).
"""

from __future__ import annotations

import torch
from torch.nn import functional

from megloc_kapture.errors import DataError

# values gathered at once: what a processor's cache holds; on a GPU what is worth a launch
_VALUES_AT_ONCE = {"cpu": 1 << 20, "cuda": 1 << 27}


def corners_around(
    y: torch.Tensor,
    x: torch.Tensor,
    size: tuple[int, int],
    amplitude: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The four pixels around each position and their weights; what lies outside weighs nothing.

    Parameters
    ----------
    y, x : any shape S, rows and columns; a pixel's centre is an integer.
    size : (H, W) of the map.
    amplitude : shape S or None, a factor on the weights.

    Returns
    -------
    indices : int64 (number of S, 4), row by row; always within the map.
    weights : (number of S, 4), of the type of the positions.
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
    table : (H W, C), the channels of each pixel, row by row; of the type of the positions.
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


def deform_conv2d(
    x: torch.Tensor,
    offset: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor | None = None,
    mask: torch.Tensor | None = None,
    *,
    stride: int = 1,
    padding: int = 0,
    dilation: int = 1,
) -> torch.Tensor:
    """Deformable convolution with torchvision's meaning of every argument.

    Parameters
    ----------
    x : (B, C, H, W); fastest in channels-last memory, which is also that of the result.
    offset : (B, 2 K, H', W'), pixels of the input: (dy, dx) of one tap after the other, the K taps
        of the kernel row by row.
    weight : (D, C, kernel height, kernel width).
    bias : (D,) or None.
    mask : (B, K, H', W') or None, the amplitude that each reading is multiplied by.

    Returns
    -------
    (B, D, H', W'). Places and weights of the readings are never in half precision.

    Raises
    ------
    DataError : shapes that do not belong together.
    """
    batch, channels, height, width = x.shape
    kernel_height, kernel_width = weight.shape[2:]
    taps = kernel_height * kernel_width
    out_height = _out_size(height, kernel_height, stride, padding, dilation)
    out_width = _out_size(width, kernel_width, stride, padding, dilation)
    for name, tensor, expected in (
        ("weight", weight, (len(weight), channels, kernel_height, kernel_width)),
        ("offset", offset, (batch, 2 * taps, out_height, out_width)),
        ("mask", mask, (batch, taps, out_height, out_width)),
    ):
        if tensor is not None and tuple(tensor.shape) != expected:
            raise DataError(
                f"deformable convolution: {name} is {tuple(tensor.shape)}, not {expected}"
            )
    exact = torch.promote_types(x.dtype, torch.float32)
    tap = torch.arange(taps, device=x.device)
    row, column = (
        torch.arange(count, device=x.device)[:, None] * stride - padding
        for count in (out_height, out_width)
    )
    tap_rows = (row + tap // kernel_width * dilation).to(exact)  # (H', K), without the offsets
    tap_columns = (column + tap % kernel_width * dilation).to(exact)  # (W', K)
    matrix = weight.permute(2, 3, 1, 0).reshape(taps * channels, -1)
    by_tap = offset.to(exact).view(batch, taps, 2, out_height, out_width).permute(0, 2, 3, 4, 1)
    rows_at_once = max(_VALUES_AT_ONCE[x.device.type] // (out_width * taps * channels), 1)
    images = []
    for b in range(batch):
        table = pixel_table(x[b])
        strips = []
        for start in range(0, out_height, rows_at_once):
            part = slice(start, start + rows_at_once)
            places_y = by_tap[b, 0, part] + tap_rows[part, None]
            places_x = by_tap[b, 1, part] + tap_columns
            amplitude = None if mask is None else mask[b, :, part].to(exact).permute(1, 2, 0)
            read = read_bilinear(table, places_y, places_x, (height, width), amplitude)
            strips.append(read.view(-1, taps * channels) @ matrix)
        images.append(torch.cat(strips).view(out_height, out_width, -1))
    result = torch.stack(images)
    if bias is not None:
        result = result + bias
    return result.permute(0, 3, 1, 2)


def _out_size(size: int, kernel: int, stride: int, padding: int, dilation: int) -> int:
    return (size + 2 * padding - dilation * (kernel - 1) - 1) // stride + 1
