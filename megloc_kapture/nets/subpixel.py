"""Where the maximum of a score map lies between its pixels."""

from __future__ import annotations

import torch


def soft_argmax(
    scores: torch.Tensor, xy: torch.Tensor, radius: int, temperature: float
) -> torch.Tensor:
    """Mean place in the square around each pixel, weighted by exp(score / temperature).

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
