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
