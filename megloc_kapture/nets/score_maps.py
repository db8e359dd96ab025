"""Dense score maps: non-maximum suppression, interpolation, special convolutions.

Non-maximum suppression is SuperPoint's as published by SuperGlue's authors: maxima suppress their
neighbourhood; then, twice, maxima of the remaining pixels are added. In deformable convolution (Dai
et al., ICCV 2017; with amplitudes: Zhu et al., CVPR 2019, eq. 1) every tap reads the input
bilinearly, zero outside::

    y(p) = sum_k w_k m_k(p) x(p + p_k + offset_k(p))

with weights w_k, amplitudes m_k and tap positions p_k. ``embedding_bag`` interpolates four rows of
a pixel-by-channel table, and a matrix product applies w_k. On a CPU this is several times faster
than ``grid_sample``.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

CELL_PX = 8
_EDGE_STEP = 3  # pixels between the samples of the edge test's second differences
# number of values gathered at once: fits the cache of a CPU, and occupies a GPU
_VALUES_AT_ONCE = {"cpu": 1 << 20, "cuda": 1 << 27}


def pixel_scores(logits: torch.Tensor) -> torch.Tensor:
    """Convert a detector's logits (B, 65, h, w) of 8 x 8 cells to scores (B, 8h, 8w).

    As in SuperPoint and XFeat, channel c is pixel (c // 8, c % 8) of a cell, and the last channel
    is "no keypoint".
    """
    probabilities = functional.softmax(logits.float(), dim=1)
    return functional.pixel_shuffle(probabilities[:, :-1], CELL_PX)[:, 0]


def window_maximum(values: torch.Tensor, radius: int) -> torch.Tensor:
    """Return the maximum over the square of side 2 radius + 1 around each pixel of (..., H, W)."""
    lowest = False if values.dtype == torch.bool else -float("inf")
    for axis in (-1, -2):
        padding = [radius, radius] if axis == -1 else [0, 0, radius, radius]
        values = functional.pad(values, padding, value=lowest)
        reach, side = 1, 2 * radius + 1  # an entry is the maximum of itself and the next reach - 1
        while reach < side:
            step = min(reach, side - reach)
            length = values.shape[axis] - step
            values = torch.maximum(
                values.narrow(axis, 0, length), values.narrow(axis, step, length)
            )
            reach += step
    return values


def suppress_non_maxima(scores: torch.Tensor, radius: int, *, rounds: int = 2) -> torch.Tensor:
    """Keep scores that are maximal within a square; set the others to zero.

    Parameters
    ----------
    scores : (..., H, W), not negative. Equal neighbouring maxima are both kept.
    radius : pixels; 0 keeps every score.
    rounds : rounds of adding maxima among unsuppressed pixels.
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
    scores: torch.Tensor, *, threshold: float, border: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Select the pixels of a score map (H, W) above a threshold, row by row.

    Return columns and rows, int64 (N, 2), and scores (N,). The outer ``border`` pixels of the map
    are never selected.
    """
    height, width = scores.shape
    inner = scores[border : max(height - border, border), border : max(width - border, border)]
    y, x = (torch.nonzero(inner > threshold) + border).unbind(1)
    return torch.stack([x, y], dim=1), scores[y, x]


def soft_argmax(
    scores: torch.Tensor, xy: torch.Tensor, radius: int, temperature: float
) -> torch.Tensor:
    """Average positions around each pixel, weighted by exp(score / temperature).

    This is ALIKED's differentiable keypoint detection (Zhao et al., TIM 2023). ``scores`` are
    (H, W); ``xy`` int64 (N, 2) are columns and rows, at least ``radius`` from the border. Returns
    positions (N, 2); the centre of the first pixel is (0, 0).
    """
    side = torch.arange(-radius, radius + 1, device=scores.device)
    steps = torch.cartesian_prod(side, side)
    around = scores[xy[:, 1:] + steps[:, 0], xy[:, :1] + steps[:, 1]]
    weights = torch.softmax(around / temperature, dim=1)
    return xy + weights @ steps.flip(1).to(scores.dtype)


def parabola_peak(scores: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """Find the peak of a paraboloid fitted around each pixel, at most half a pixel away per axis.

    It takes one Newton step on the score map (H, W) with central differences (Lowe, IJCV 2004,
    section 4), or none if the Hessian is singular. ``xy`` int64 (N, 2) are columns and rows, not on
    the border. Returns positions (N, 2); the centre of the first pixel is (0, 0).
    """
    x, y = xy.unbind(1)
    gradient_x = (scores[y, x + 1] - scores[y, x - 1]) / 2
    gradient_y = (scores[y + 1, x] - scores[y - 1, x]) / 2
    xx, yy, mixed = _second_differences(scores, xy, 1)
    determinant = xx * yy - mixed * mixed
    safe = torch.where(determinant == 0, torch.inf, determinant)
    step_x = (mixed * gradient_y - yy * gradient_x) / safe
    step_y = (mixed * gradient_x - xx * gradient_y) / safe
    return xy + torch.stack([step_x, step_y], dim=1).clamp(-0.5, 0.5)


def on_no_edge(scores: torch.Tensor, xy: torch.Tensor, max_ratio: float) -> torch.Tensor:
    """Return a mask (N,) of pixels not on edges of the score map (Lowe, IJCV 2004, section 4.1).

    Parameters
    ----------
    scores : (H, W).
    xy : int64 (N, 2), columns and rows, 3 pixels or more from the map's border.
    max_ratio : largest ratio of the larger principal curvature to the smaller.
    """
    xx, yy, mixed = _second_differences(scores, xy, _EDGE_STEP)
    determinant = xx * yy - mixed * mixed
    trace = xx + yy
    return (determinant > 0) & (trace * trace <= determinant * ((max_ratio + 1) ** 2 / max_ratio))


def _second_differences(
    scores: torch.Tensor, xy: torch.Tensor, step: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    x, y = xy.unbind(1)

    def at(dx: int, dy: int) -> torch.Tensor:
        return scores[y + dy, x + dx]

    xx = at(step, 0) - 2 * at(0, 0) + at(-step, 0)
    yy = at(0, step) - 2 * at(0, 0) + at(0, -step)
    mixed = (at(-step, -step) + at(step, step) - at(step, -step) - at(-step, step)) / 4
    return xx, yy, mixed


def corners_around(
    y: torch.Tensor, x: torch.Tensor, size: tuple[int, int], amplitude: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return flat indices and weights, (N, 4) each, for bilinear interpolation at N positions.

    Indices are always within the map; pixels outside have weight zero.

    Parameters
    ----------
    y, x : rows and columns, any shape with N elements; the centre of the first pixel is (0, 0).
    size : (H, W) of the map.
    amplitude : factors on the weights, of the same shape, or None.
    """
    height, width = size
    top, left = torch.floor(y), torch.floor(x)
    below, right = y - top, x - left
    # clamping prevents integer overflow; weights are zero more than a pixel outside the map
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
    """Interpolate a table (H W, C) bilinearly, zero outside; see :func:`corners_around`."""
    indices, weights = corners_around(y, x, size, amplitude)
    return functional.embedding_bag(indices, table, mode="sum", per_sample_weights=weights)


def pixel_table(values: torch.Tensor) -> torch.Tensor:
    """Reshape (C, H, W) to (H W, C), in float32 or float64; channels-last memory is not copied."""
    exact = values.to(torch.promote_types(values.dtype, torch.float32))
    return exact.permute(1, 2, 0).reshape(-1, len(values))


def norm_factors(norm: nn.BatchNorm2d) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scale and shift (C,) of a trained batch normalisation."""
    assert norm.running_mean is not None and norm.running_var is not None
    scale = torch.rsqrt(norm.running_var + norm.eps)
    if not norm.affine:
        return scale, -norm.running_mean * scale
    scale = norm.weight * scale
    return scale, norm.bias - norm.running_mean * scale


def with_norm(weight: torch.Tensor, norm: nn.BatchNorm2d) -> tuple[torch.Tensor, torch.Tensor]:
    """Fold a batch normalisation into the convolution before it; return weight and bias."""
    scale, shift = norm_factors(norm)
    return weight * scale[:, None, None, None], shift


def conv_same(
    x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, stride: int
) -> torch.Tensor:
    """Convolve with TensorFlow's SAME padding, which at stride 2 is asymmetric for even sides."""
    margins: list[int] = []
    for size, kernel in zip(x.shape[:1:-1], weight.shape[:1:-1], strict=True):
        total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
        margins += [total // 2, total - total // 2]
    left, right, top, bottom = margins
    if left == right and top == bottom:
        return functional.conv2d(x, weight, bias, stride, padding=(top, left))
    return functional.conv2d(functional.pad(x, margins), weight, bias, stride)


def deform_conv2d(
    x: torch.Tensor,
    offset: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor | None = None,
    mask: torch.Tensor | None = None,
) -> torch.Tensor:
    """Apply a 3x3 deformable convolution with padding 1, like torchvision; return (B, D, H, W).

    Parameters
    ----------
    x : (B, C, H, W); fastest in channels-last memory. The result is channels-last.
    offset : (B, 18, H, W), pixels: (dy, dx) per tap, taps row by row.
    weight, bias : (D, C, 3, 3), and (D,) or None.
    mask : (B, 9, H, W) or None, amplitudes.
    """
    batch, channels, height, width = x.shape
    exact = torch.promote_types(x.dtype, torch.float32)
    tap = torch.arange(9, device=x.device)
    row, column = (torch.arange(count, device=x.device)[:, None] for count in (height, width))
    tap_rows = (row + tap // 3 - 1).to(exact)  # (H, 9), without the offsets
    tap_columns = (column + tap % 3 - 1).to(exact)  # (W, 9)
    matrix = weight.permute(2, 3, 1, 0).reshape(9 * channels, -1)
    by_tap = offset.to(exact).view(batch, 9, 2, height, width).permute(0, 2, 3, 4, 1)
    rows_at_once = max(_VALUES_AT_ONCE[x.device.type] // (width * 9 * channels), 1)
    images = []
    for b in range(batch):
        table = pixel_table(x[b])
        strips = []
        for start in range(0, height, rows_at_once):
            part = slice(start, start + rows_at_once)
            places_y = by_tap[b, 0, part] + tap_rows[part, None]
            places_x = by_tap[b, 1, part] + tap_columns
            amplitude = None if mask is None else mask[b, :, part].to(exact).permute(1, 2, 0)
            read = read_bilinear(table, places_y, places_x, (height, width), amplitude)
            strips.append(read.view(-1, 9 * channels) @ matrix)
        images.append(torch.cat(strips).view(height, width, -1))
    result = torch.stack(images)
    if bias is not None:
        result = result + bias
    return result.permute(0, 3, 1, 2)
