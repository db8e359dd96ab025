"""Keypoints out of a dense map of scores: non-maximum suppression, then the best that may be used.

The suppression is SuperPoint's as SuperGlue's authors publish it (and ALIKED's and others' after
it): local maxima stay, their neighbourhoods are struck out, and what is a maximum of the rest stays
too, twice over. With no further rounds it is the plain test against the maximum of the window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional


@dataclass(frozen=True, eq=False)
class SelectedPixels:
    """Pixels of one score map, best first; ties by y, then x.

    Attributes
    ----------
    xy : int64 (N, 2), columns and rows of the map.
    scores : (N,), of the map's type.
    num_masked : pixels that would have been candidates but for the mask.
    """

    xy: torch.Tensor
    scores: torch.Tensor
    num_masked: int


def window_maximum(values: torch.Tensor, radius: int) -> torch.Tensor:
    """Maximum over the square of side 2 radius + 1 around each pixel, clipped to the map.

    Equal to a max pooling of stride 1, but separable and by doubling, so that its cost grows with
    the logarithm of the radius.

    Parameters
    ----------
    values : (..., H, W), floating point or bool.
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

    ALIKED's (Zhao et al., TIM 2023) differentiable keypoint detection.

    Parameters
    ----------
    scores : (H, W).
    xy : int64 (N, 2), columns and rows, no closer to the map's border than the radius.
    radius : of the square, pixels.

    Returns
    -------
    float (N, 2), of the scores' type; a pixel's centre is an integer.
    """
    side = torch.arange(-radius, radius + 1, device=scores.device)
    steps = torch.cartesian_prod(side, side)  # (dy, dx)
    around = scores[xy[:, 1:] + steps[:, 0], xy[:, :1] + steps[:, 1]]
    weights = torch.softmax(around / temperature, dim=1)
    return xy + weights @ steps.flip(1).to(scores.dtype)


def parabola_peak(scores: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """Peak of the paraboloid through the pixels around each, at most half a pixel away per axis.

    One Newton step, -H^-1 g, with the central differences of the score map (Lowe, IJCV 2004,
    section 4); none where the Hessian is singular.

    Parameters
    ----------
    scores : (H, W).
    xy : int64 (N, 2), columns and rows, none at the map's border.

    Returns
    -------
    float (N, 2), of the scores' type; a pixel's centre is an integer.
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
    xy_px : float32 (N, 2), the first pixel's centre at (0.5, 0.5).
    scores : float32 (N,).
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
