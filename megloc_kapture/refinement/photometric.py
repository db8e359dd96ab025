"""Photometric alignment of a query with reference images that have depth.

At each pyramid level, coarse to fine, the residuals ``gain_i I(px(T X)) + bias_i - r`` are
minimised over the pose T and a gain and a bias per reference i and channel, by Levenberg-Marquardt.
I is the query, and X a point of reference i with value r. Since gain and bias apply to the query,
this maximises correlation, as ECC does (Evangelidis and Psarakis, PAMI 2008). The loss is
Geman-McClure's, with a scale from the residuals. The Schur complement eliminates gains and biases,
which leaves six unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import focal_px, project
from megloc_kapture.geometry.poses import deviation_by_median, perturbed
from megloc_kapture.refinement.pyramid import ChosenPoints, Level
from megloc_kapture.values import Camera, RigidTransform

Float64 = NDArray[np.float64]
MIN_POINTS = 50
LOSS_SCALE = 2.0
_NUISANCE_STEPS = 3
_NUISANCE_POINTS = 6000
_MIN_GAIN = 0.05
# cells along the query's longer side; residuals within a cell may be correlated
_CELLS = 10
_MAX_STEPS = 12
_LAST_GAIN = 1e-5
_DAMPING = 1e-3
_MOST_DAMPING = 1e2
# smallest number of points for the correlation of a cell; smallest correlation of an unoccluded
# cell, as a share of the cells' 75th percentile
_CELL_POINTS = 20
_AGREES = 0.5


@dataclass(frozen=True, eq=False)
class Alignment:
    """A pose ``cam_from_world`` of the query with its gains and biases at one level."""

    cam_from_world: RigidTransform
    # gains, biases: float64 (G, C), per reference and channel
    gains: Float64
    biases: Float64
    deviation: float  # robust standard deviation of the residuals

    @property
    def squared_scale(self) -> float:
        return (LOSS_SCALE * self.deviation) ** 2

    def moved(
        self, cam_from_world: RigidTransform, gain_step: Float64, bias_step: Float64
    ) -> Alignment:
        """Return an alignment with a new pose, and steps (G, C) added; gains stay positive."""
        gains = np.maximum(self.gains + gain_step, _MIN_GAIN)
        return Alignment(cam_from_world, gains, self.biases + bias_step, self.deviation)


class LevelProblem:
    """Residuals of chosen points at one level of the query, as functions of the pose.

    ``near`` is an approximate pose, from which the depth of the points is taken; ``num_groups`` is
    the number of references, including those without points.
    """

    def __init__(
        self,
        chosen: ChosenPoints,
        level: Level,
        camera: Camera,
        near: RigidTransform,
        *,
        num_groups: int | None = None,
    ) -> None:
        from megloc_kapture.refinement.photometric_kernels import camera_of

        self._near = near
        depths = near.apply(chosen.points)[:, 2]
        ahead = depths[depths > 0]
        self._depth_m = float(np.median(ahead)) if len(ahead) else 1.0
        self.chosen = chosen
        self.camera = camera
        self.level = level
        present = int(chosen.groups.max()) + 1 if len(chosen.groups) else 0
        self.num_groups = present if num_groups is None else num_groups
        scale_xy = np.array([level.scale_x, level.scale_y])
        self._query = level.values, level.valid, scale_xy, camera_of(camera)

    def _of(self, chosen: ChosenPoints, level: Level) -> LevelProblem:
        return LevelProblem(chosen, level, self.camera, self._near, num_groups=self.num_groups)

    def subset(self, which: NDArray[Any]) -> LevelProblem:
        return self._of(self.chosen.subset(which), self.level)

    def thinned(self, most: int) -> LevelProblem:
        count = len(self.chosen.points)
        return self if count <= most else self.subset(np.arange(0, count, -(-count // most)))

    def within(self, mask: NDArray[np.bool_]) -> LevelProblem:
        size = self.level.valid.shape[1::-1]
        seen = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        return self._of(self.chosen, replace(self.level, valid=self.level.valid & seen))

    def rows(self, at: Alignment) -> Float64:
        """Return residuals and derivatives (N, C, 8), see ``photometric_kernels.evaluate``."""
        from megloc_kapture.refinement.photometric_kernels import evaluate

        out = np.empty((*self.chosen.values.shape, 8))
        evaluate(*self._arguments(at), out)
        return out

    def _arguments(self, at: Alignment) -> tuple[Any, ...]:
        pose = at.cam_from_world
        placed = pose.rotation_matrix(), np.array(pose.translation), at.gains, at.biases
        chosen = self.chosen.points, self.chosen.values, self.chosen.groups
        return chosen, self._query, placed

    def nuisance_at(self, cam_from_world: RigidTransform) -> Alignment:
        """Fit gains, biases and deviation at a fixed pose, on a subset of the points."""
        few = self.thinned(_NUISANCE_POINTS)
        values, groups = few.chosen.values, few.chosen.groups
        shape = (self.num_groups, values.shape[1])
        at = Alignment(cam_from_world, np.ones(shape), np.zeros(shape), np.inf)
        rows = few.rows(at)
        seen = ~np.isnan(rows[..., 0])
        rows[~seen] = np.nan
        for _ in range(_NUISANCE_STEPS):
            steps = few.system_of(rows, at.squared_scale).nuisance_step()
            at = at.moved(cam_from_world, *steps)
            residuals = at.gains[groups] * rows[..., 7] + at.biases[groups] - values
            rows[..., 0] = np.where(seen, residuals, np.nan)
            at = replace(at, deviation=_deviation(rows))
        return at

    def system_of(self, rows: Float64, squared_scale: float) -> NormalEquations:
        from megloc_kapture.refinement.photometric_kernels import normal_equations

        sums = empty_sums(self.num_groups, rows.shape[1])
        cost, count = normal_equations(rows, self.chosen.groups, squared_scale, sums)
        return NormalEquations.of(sums, cost, count)

    def system_at(self, at: Alignment, squared_scale: float) -> NormalEquations:
        from megloc_kapture.refinement.photometric_kernels import evaluated_equations

        sums = empty_sums(self.num_groups, self.chosen.values.shape[1])
        cost, count = evaluated_equations(*self._arguments(at), squared_scale, sums)
        return NormalEquations.of(sums, cost, count)

    def px_per_step(self) -> Float64:
        """Return the approximate motion of points, in pixels of the level, per unit of the pose.

        It has shape (6,), rotation first.
        """
        focal = focal_px(self.camera) * self.level.scale_x
        return np.array([focal] * 3 + [focal / self._depth_m] * 3)

    def cells(self, cam_from_world: RigidTransform, seen: NDArray[Any]) -> NDArray[np.int64]:
        """Return grid cells, int64 (K,), of the points ``seen``, a mask (N,) or rows (K,)."""
        cell_px = max(self.camera.width, self.camera.height) / _CELLS
        px = project(self.camera, cam_from_world, self.chosen.points[seen])
        row_column = (px // cell_px).astype(np.int64)
        return np.asarray(row_column[:, 1] * (_CELLS + 1) + row_column[:, 0])


def _deviation(rows: Float64) -> float:
    magnitudes = np.sqrt(np.square(rows[..., 0]).mean(1))
    seen = magnitudes[~np.isnan(magnitudes)]
    return float(deviation_by_median(seen)) if len(seen) else 0.0


@dataclass(frozen=True, eq=False)
class NormalEquations:
    # pose, mixed, own, pose_gradient, own_gradient: see ``photometric_kernels.normal_equations``;
    # ``pose`` is the full matrix
    pose: Float64
    mixed: Float64
    own: Float64
    pose_gradient: Float64
    own_gradient: Float64
    mean_cost: float
    count: int

    @classmethod
    def of(cls, sums: tuple[Float64, ...], cost: float, count: int) -> NormalEquations:
        pose, mixed, blocks, pose_gradient, own_gradient = sums
        pose = pose + pose.T
        pose[np.diag_indices(6)] *= 0.5  # the diagonal is in both halves
        return cls(pose, mixed, blocks, pose_gradient, own_gradient, cost / max(count, 1), count)

    def reduced(self, damping: float = 0.0) -> tuple[Float64, Float64, Float64] | None:
        # the ridge keeps the block of an invisible reference invertible
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
        """Return steps of pose (6,), gains and biases (G, C); None if undetermined."""
        reduced = self.reduced(damping)
        if reduced is None:
            return None
        matrix, gradient, _ = reduced
        try:
            pose_step = np.asarray(np.linalg.solve(matrix, -gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        return pose_step, *self.nuisance_step(pose_step)

    def nuisance_step(self, pose_step: Float64 | None = None) -> tuple[Float64, Float64]:
        """Return steps of gains and biases (G, C) for a step of the pose (6,), by default zero."""
        right = -self.own_gradient
        if pose_step is not None:
            right = right - np.einsum("gcpi,p->gci", self.mixed, pose_step)
        return _solve_pairs(self.own, right)


def empty_sums(num_groups: int, channels: int) -> tuple[Float64, ...]:
    shapes = [(6, 6), (num_groups, channels, 6, 2), (num_groups, channels, 3), (6,)]
    return tuple(np.zeros(shape) for shape in (*shapes, (num_groups, channels, 2)))


def _solve_pairs(blocks: Float64, right: Float64) -> tuple[Float64, Float64]:
    """Solve symmetric 2x2 systems (..., 3) for right sides (..., 2), with a ridge.

    A system is stored as its entries (gain, gain), (gain, bias) and (bias, bias).
    """
    first, cross, second = np.moveaxis(blocks, -1, 0)
    ridge = 1e-9 * (first + second) + 1e-12
    first, second = first + ridge, second + ridge
    determinant = first * second - cross * cross
    gain = (second * right[..., 0] - cross * right[..., 1]) / determinant
    bias = (first * right[..., 1] - cross * right[..., 0]) / determinant
    return gain, bias


def minimise(
    problem: LevelProblem, start: Alignment, *, last_step_px: float, rounds: int = 2
) -> Alignment:
    """Minimise the cost until steps are below ``last_step_px``; each round rescales the loss."""
    at = start
    for _ in range(rounds):
        at = _levenberg_marquardt(problem, at, last_step_px)
        at = replace(at, deviation=_deviation(problem.rows(at)))
    return at


def _levenberg_marquardt(problem: LevelProblem, at: Alignment, last_step_px: float) -> Alignment:
    scale2 = at.squared_scale
    if not scale2 > 0:
        return at
    reach = problem.px_per_step()
    system = problem.system_at(at, scale2)
    damping = _DAMPING
    for _ in range(_MAX_STEPS):
        if system.count < MIN_POINTS:
            return at
        step = system.step(damping)
        if step is None:
            return at
        pose_step, gain_step, bias_step = step
        trial = at.moved(perturbed(at.cam_from_world, pose_step), gain_step, bias_step)
        new = problem.system_at(trial, scale2)
        small = float(np.abs(pose_step) @ reach) < last_step_px
        # compare mean costs, so that points leaving the image do not look like an improvement
        if new.count >= MIN_POINTS and new.mean_cost < system.mean_cost:
            small = small or new.mean_cost > (1.0 - _LAST_GAIN) * system.mean_cost
            at, system = trial, new
            damping = max(0.1 * damping, 1e-9)
        else:
            damping = max(10.0 * damping, _DAMPING)
        if small or damping > _MOST_DAMPING:
            return at
    return at


def unoccluded_points(problem: LevelProblem, at: Alignment) -> NDArray[np.bool_]:
    """Return a mask (N,), False for points in cells where query and references do not correlate."""
    rows = problem.rows(at)
    seen = np.flatnonzero(~np.isnan(rows[:, 0, 0]))
    keep = np.ones(len(rows), np.bool_)
    if len(seen) == 0:
        return keep
    cells = problem.cells(at.cam_from_world, seen)
    groups = problem.chosen.groups[seen]
    ours = rows[seen, :, 7] * at.gains[groups] + at.biases[groups]
    theirs = problem.chosen.values[seen]
    count = np.bincount(cells)
    filled = np.maximum(count, 1)[:, None]

    def summed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        channels = [np.bincount(cells, channel, len(count)) for channel in values.T]
        return np.stack(channels, axis=1)

    ours = ours - (summed(ours) / filled)[cells]
    theirs = theirs - (summed(theirs) / filled)[cells]
    product = summed(ours**2).sum(1) * summed(theirs**2).sum(1)
    correlation = summed(ours * theirs).sum(1) / np.sqrt(np.maximum(product, 1e-30))
    judged = count >= _CELL_POINTS
    if judged.sum() > 0:
        limit = _AGREES * float(np.percentile(correlation[judged], 75))
        keep[seen] = ~judged[cells] | (correlation[cells] >= limit)
    return keep
