"""Normal equations of a pose with a gain and a bias per reference and channel.

The block of gains and biases is diagonal in references and channels and is eliminated (Schur's
complement), so that a step costs a system of six unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of pose, gains and biases.

    Attributes
    ----------
    pose, mixed, own, pose_gradient, own_gradient : see ``photometric_kernels.normal_equations``;
        ``pose`` is whole.
    mean_cost : robust cost of a point.
    count : of points that are seen.
    """

    pose: Float64
    mixed: Float64
    own: Float64
    pose_gradient: Float64
    own_gradient: Float64
    mean_cost: float
    count: int

    @classmethod
    def of(cls, sums: tuple[Float64, ...], cost: float, count: int) -> NormalEquations:
        pose, mixed, own, pose_gradient, own_gradient = sums
        pose = pose + pose.T
        pose[np.diag_indices(6)] *= 0.5  # both halves have it
        return cls(pose, mixed, own, pose_gradient, own_gradient, cost / max(count, 1), count)

    def reduced(self, damping: float = 0.0) -> tuple[Float64, Float64, Float64] | None:
        """Matrix (6, 6) and gradient (6,) of the pose without gains and biases, and what those are
        multiplied by, (G, C, 6, 2)."""
        # a reference that is not seen has nothing to say: its block is still invertible
        gain, bias = _solve_pairs(self.own[:, :, None], self.mixed)
        projection = np.stack([gain, bias], axis=-1)
        matrix = self.pose - np.einsum("gcpi,gcqi->pq", projection, self.mixed)
        matrix = 0.5 * (matrix + matrix.T)
        matrix = matrix + damping * np.diag(np.diagonal(self.pose))
        gradient = self.pose_gradient - np.einsum("gcpi,gci->p", projection, self.own_gradient)
        if not np.isfinite(matrix).all():
            return None
        return matrix, gradient, np.asarray(projection, np.float64)

    def step(self, damping: float) -> tuple[Float64, Float64, Float64] | None:
        """Steps of pose (6,), gains and biases (G, C); None where they are not determined."""
        reduced = self.reduced(damping)
        if reduced is None:
            return None
        matrix, gradient, _ = reduced
        try:
            pose_step = np.asarray(np.linalg.solve(matrix, -gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        gain_step, bias_step = self.nuisance_step(pose_step)
        return pose_step, gain_step, bias_step

    def nuisance_step(self, pose_step: Float64 | None = None) -> tuple[Float64, Float64]:
        """Steps of gains and biases (G, C) beside a step of the pose (6,), or while it stays."""
        right = -self.own_gradient
        if pose_step is not None:
            right = right - np.einsum("gcpi,p->gci", self.mixed, pose_step)
        return _solve_pairs(self.own, right)


def empty_sums(num_groups: int, channels: int) -> tuple[Float64, ...]:
    """What ``photometric_kernels.normal_equations`` fills."""
    shapes = [(6, 6), (num_groups, channels, 6, 2), (num_groups, channels, 3), (6,)]
    return tuple(np.zeros(shape) for shape in (*shapes, (num_groups, channels, 2)))


def _solve_pairs(own: Float64, right: Float64) -> tuple[Float64, Float64]:
    """Both unknowns (...) of 2x2 systems: gain gain, gain bias, bias bias (..., 3); right (..., 2).

    A ridge keeps those invertible that are zero.
    """
    first, cross, second = np.moveaxis(own, -1, 0)
    ridge = 1e-9 * (first + second) + 1e-12
    first, second = first + ridge, second + ridge
    determinant = first * second - cross * cross
    gain = (second * right[..., 0] - cross * right[..., 1]) / determinant
    bias = (first * right[..., 1] - cross * right[..., 0]) / determinant
    return gain, bias
