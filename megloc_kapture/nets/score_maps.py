"""Dense maps of networks: maxima of scores, readings between pixels, deformable convolution.

Non-maximum suppression is SuperPoint's as SuperGlue's authors publish it (and ALIKED's and others'
after it): local maxima stay, their neighbourhoods are struck out, and what is a maximum of the rest
stays too, twice over. With no further rounds it is the plain test against the window's maximum.

In deformable convolution (Dai et al., ICCV 2017; with amplitudes: Zhu et al., CVPR 2019, eq. 1)
every tap reads the input bilinearly at its own position plus an offset, zero outside:

    y(p) = sum_k w_k m_k(p) x(p + p_k + offset_k(p))

A bilinear reading is the weighted sum of four rows of a table that has one row of channels per
pixel, which is what ``embedding_bag`` computes, one contiguous row after the other; a product with
the kernel as a matrix follows. On a processor this is several times faster than ``grid_sample``,
whose channels lie far apart (benchmarks/speed/deformable.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from megloc_kapture.errors import DataError

# values gathered at once: what a processor's cache holds; on a GPU what is worth a launch
_VALUES_AT_ONCE = {"cpu": 1 << 20, "cuda": 1 << 27}


@dataclass(frozen=True, eq=False)
class SelectedPixels:
    """Pixels of one score map, best first; ties by y, then x."""

    # xy, scores: int64 (N, 2), columns and rows of the map, and (N,), of the map's type
    xy: torch.Tensor
    scores: torch.Tensor
    num_masked: int  # pixels that would have been candidates but for the mask


def window_maximum(values: torch.Tensor, radius: int) -> torch.Tensor:
    """Maximum over the square of side 2 radius + 1 around each pixel, clipped to the map.

    Equal to a max pooling of stride 1 of (..., H, W), floating point or bool, but separable and by
    doubling, so that its cost grows with the logarithm of the radius.
    """
    lowest = False if values.dtype == torch.bool else -float("inf")
    for axis in (-1, -2):
        padding = [radius, radius] if axis == -1 else [0, 0, radius, radius]
        values = functional.pad(values, padding, value=lowest)
        reach, side = 1, 2 * radius + 1  # each entry is the maximum of `reach` entries from it on
        while reach < side:
            step = min(reach, side - reach)
            length = values.shape[axis] - step
            values = torch.maximum(
                values.narrow(axis, 0, length), values.narrow(axis, step, length)
            )
            reach += step
    return values


def suppress_non_maxima(scores: torch.Tensor, radius: int, *, rounds: int = 2) -> torch.Tensor:
    """Scores where they are the largest within a square of the radius, zero elsewhere.

    Parameters
    ----------
    scores : (..., H, W), not negative. Equal neighbours that are both largest are both kept.
    radius : pixels; 0 keeps every score.
    rounds : how often, after the first maxima, those of what they do not suppress are added.
    """
    if radius == 0:
        return scores
    kept = scores == window_maximum(scores, radius)
    for _ in range(rounds):
        suppressed = window_maximum(kept, radius)
        rest = scores.masked_fill(suppressed, 0.0)
        kept |= (rest == window_maximum(rest, radius)) & ~suppressed
    return scores.masked_fill(~kept, 0.0)


def select_pixels(
    scores: torch.Tensor,
    *,
    threshold: float,
    border: int = 0,
    mask: NDArray[np.bool_] | None = None,
    max_keypoints: int | None = None,
) -> SelectedPixels:
    """The best pixels of a score map that the mask allows.

    Parameters
    ----------
    scores : (H, W), after non-maximum suppression.
    threshold : a candidate's score is larger than it.
    border : columns and rows at each side of the map that hold no candidates.
    mask : bool (H or more, W or more), True where pixels may be used, or None; applied before the
        best are selected.
    max_keypoints : the best that are kept; None keeps all.
    """
    height, width = scores.shape
    inner = scores[border : max(height - border, border), border : max(width - border, border)]
    yx = torch.nonzero(inner > threshold) + border  # in the order of y, then x
    num_masked = 0
    if mask is not None:
        allowed = torch.from_numpy(np.ascontiguousarray(mask[:height, :width])).to(scores.device)
        usable = allowed[yx[:, 0], yx[:, 1]]
        num_masked = len(yx) - int(usable.sum())
        yx = yx[usable]
    values = scores[yx[:, 0], yx[:, 1]]
    order = torch.sort(values, descending=True, stable=True).indices[:max_keypoints]
    return SelectedPixels(yx[order].flip(1), values[order], num_masked)


def soft_argmax(
    scores: torch.Tensor, xy: torch.Tensor, radius: int, temperature: float
) -> torch.Tensor:
    """Mean position in the square around each pixel, weighted by exp(score / temperature).

    ALIKED's (Zhao et al., TIM 2023) differentiable keypoint detection. ``scores`` are (H, W);
    ``xy`` int64 (N, 2), columns and rows, lie no closer to the map's border than the radius of the
    square. Returns (N, 2) of the scores' type; a pixel's centre is an integer.
    """
    side = torch.arange(-radius, radius + 1, device=scores.device)
    steps = torch.cartesian_prod(side, side)  # (dy, dx)
    around = scores[xy[:, 1:] + steps[:, 0], xy[:, :1] + steps[:, 1]]
    weights = torch.softmax(around / temperature, dim=1)
    return xy + weights @ steps.flip(1).to(scores.dtype)


def parabola_peak(scores: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """Peak of the paraboloid through the pixels around each, at most half a pixel away per axis.

    One Newton step, -H^-1 g, with the central differences of the score map (H, W) (Lowe, IJCV 2004,
    section 4); none where the Hessian is singular. ``xy`` is int64 (N, 2), columns and rows, none
    at the map's border. Returns (N, 2) of the scores' type; a pixel's centre is an integer.
    """
    x, y = xy.unbind(1)

    def at(dx: int, dy: int) -> torch.Tensor:
        return scores[y + dy, x + dx]

    gradient_x = (at(1, 0) - at(-1, 0)) / 2
    gradient_y = (at(0, 1) - at(0, -1)) / 2
    xx = at(1, 0) - 2 * at(0, 0) + at(-1, 0)
    yy = at(0, 1) - 2 * at(0, 0) + at(0, -1)
    mixed = (at(-1, -1) + at(1, 1) - at(1, -1) - at(-1, 1)) / 4
    determinant = xx * yy - mixed * mixed
    safe = torch.where(determinant == 0, torch.inf, determinant)
    step_x = (mixed * gradient_y - yy * gradient_x) / safe
    step_y = (mixed * gradient_x - xx * gradient_y) / safe
    return xy + torch.stack([step_x, step_y], dim=1).clamp(-0.5, 0.5)


def select_keypoints(
    xy_px: NDArray[np.float32],
    scores: NDArray[np.float32],
    *,
    size: tuple[int, int],
    mask: NDArray[np.bool_] | None,
    max_keypoints: int,
) -> tuple[NDArray[np.int64], int]:
    """Rows of the best keypoints, best first, ties by y, then x; and how many the mask removed.

    Parameters
    ----------
    xy_px, scores : float32 (N, 2), the first pixel's centre at (0.5, 0.5), and (N,).
    size : (H, W) of the image.
    mask : bool (H, W), True where keypoints may be, or None; applied before the best are selected.
    """
    rows = np.arange(len(xy_px))
    num_masked = 0
    if mask is not None:
        # rounding may put a keypoint of a resized image onto the image's last edge
        last = np.array([size[1] - 1, size[0] - 1])
        column, row = np.clip(xy_px.astype(np.int64), 0, last).T
        allowed = mask[row, column]
        rows = rows[allowed]
        num_masked = len(allowed) - len(rows)
    order = np.lexsort((xy_px[rows, 0], xy_px[rows, 1], -scores[rows]))
    return rows[order[:max_keypoints]], num_masked


def corners_around(
    y: torch.Tensor, x: torch.Tensor, size: tuple[int, int], amplitude: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """The four pixels around each position and their weights; what lies outside weighs nothing.

    Returns ``indices`` and ``weights``: int64 (number of S, 4), row by row, always within the map;
    and their weights, of the type of the positions.

    Parameters
    ----------
    y, x : any shape S, rows and columns; a pixel's centre is an integer.
    size : (H, W) of the map.
    amplitude : shape S or None, a factor on the weights.
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
    """Readings (number of S, C) of a map, bilinear, zero outside.

    ``table`` is (H W, C), the channels of each pixel, row by row, of the type of the positions; the
    rest is as of :func:`corners_around`.
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

    Returns (B, D, H', W'). Positions and weights of the readings are never in half precision.
    Raises DataError for shapes that do not belong together.

    Parameters
    ----------
    x : (B, C, H, W); fastest in channels-last memory, which is also that of the result.
    offset : (B, 2 K, H', W'), pixels of the input: (dy, dx) of one tap after the other, the K taps
        of the kernel row by row.
    weight, bias : (D, C, kernel height, kernel width), and (D,) or None.
    mask : (B, K, H', W') or None, the amplitude that each reading is multiplied by.
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
