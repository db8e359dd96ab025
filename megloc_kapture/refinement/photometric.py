"""Photometric alignment: the pose under which reference images, lifted by depth, fit the query.

At each level of the pyramids, coarse to fine, the residuals ``gain_i I(px(T X)) + bias_i - r`` of
all references i together are minimised over the pose T and a gain and a bias per reference and
channel, by Levenberg's and Marquardt's steps. Gain and bias stand on the query's side: what least
squares leave is then the references' variance times ``1 - correlation^2``, so that the alignment
maximises correlation, as ECC does (Evangelidis and Psarakis, PAMI 2008), and gains nothing from
moving into flat parts of the query. The loss is Geman and McClure's, whose scale follows the
residuals: what one image shows and the other does not has no say.

The normal equations' block of gains and biases is diagonal in references and channels and is
eliminated (Schur's complement), so that a step costs a system of six unknowns.
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
LOSS_SCALE = 2.0  # of the loss, in standard deviations
_NUISANCE_STEPS = 3
_NUISANCE_POINTS = 6000  # for two numbers of each reference
_MIN_GAIN = 0.05
# cells of the query, along its longer side, in which residuals may depend on each other
_CELLS = 10
_MAX_STEPS = 12
_LAST_GAIN = 1e-5  # share of the cost
_DAMPING = 1e-3
_MOST_DAMPING = 1e2
# points from which a cell tells whether it looks like the references, and how well it then must, as
# a share of what a good one does
_CELL_POINTS = 20
_AGREES = 0.5


@dataclass(frozen=True, eq=False)
class Alignment:
    """A pose ``cam_from_world`` of the query with what belongs to it at one level."""

    cam_from_world: RigidTransform
    # gains, biases: float64 (G, C), of the references
    gains: Float64
    biases: Float64
    deviation: float  # robust standard deviation of the residuals

    @property
    def squared_scale(self) -> float:
        """Square of the loss' scale."""
        return (LOSS_SCALE * self.deviation) ** 2

    def moved(
        self, cam_from_world: RigidTransform, gain_step: Float64, bias_step: Float64
    ) -> Alignment:
        """Another pose, and gains and biases by steps (G, C); a gain stays positive."""
        gains = np.maximum(self.gains + gain_step, _MIN_GAIN)
        return Alignment(cam_from_world, gains, self.biases + bias_step, self.deviation)


class LevelProblem:
    """The residuals of chosen points at one level of the query, as functions of the pose.

    Parameters
    ----------
    chosen : points of the references.
    level, camera : of the query; the camera is at its full size.
    near : about its ``cam_from_world``, for how far away the points are.
    num_groups : references, also those of which there is no point; else as the points have them.
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
        """The same of some points, a mask (N,) or rows."""
        return self._of(self.chosen.subset(which), self.level)

    def thinned(self, most: int) -> LevelProblem:
        """The same of at most so many points, still evenly spread."""
        few = len(self.chosen.points) <= most
        return self if few else self._of(self.chosen.thinned(most), self.level)

    def within(self, mask: NDArray[np.bool_]) -> LevelProblem:
        """The same on some pixels of the query, bool (H, W)."""
        size = self.level.valid.shape[1::-1]
        seen = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        return self._of(self.chosen, replace(self.level, valid=self.level.valid & seen))

    def rows(self, at: Alignment) -> Float64:
        """Residuals and derivatives, (N, C, 8), as ``photometric_kernels.evaluate`` has them."""
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
        """Gains, biases and deviation that fit best while the pose stays; by some of the points."""
        few = self.thinned(_NUISANCE_POINTS)
        values, groups = few.chosen.values, few.chosen.groups
        shape = (self.num_groups, values.shape[1])
        at = Alignment(cam_from_world, np.ones(shape), np.zeros(shape), np.inf)
        rows = few.rows(at)
        seen = ~np.isnan(rows[..., 0])
        rows[~seen] = np.nan  # what lies there was never written, and might warn
        for _ in range(_NUISANCE_STEPS):
            steps = few.system_of(rows, at.squared_scale).nuisance_step()
            at = at.moved(cam_from_world, *steps)
            found = at.gains[groups] * rows[..., 7] + at.biases[groups] - values
            rows[..., 0] = np.where(seen, found, np.nan)
            at = replace(at, deviation=_deviation(rows))
        return at

    def system_of(self, rows: Float64, squared_scale: float) -> NormalEquations:
        """Normal equations of what :meth:`rows` gave, for the squared scale of the loss."""
        from megloc_kapture.refinement.photometric_kernels import normal_equations

        sums = empty_sums(self.num_groups, rows.shape[1])
        cost, count = normal_equations(rows, self.chosen.groups, squared_scale, sums)
        return NormalEquations.of(sums, cost, count)

    def system_at(self, at: Alignment, squared_scale: float) -> NormalEquations:
        """Normal equations at an alignment, for the squared scale of the loss."""
        from megloc_kapture.refinement.photometric_kernels import evaluated_equations

        sums = empty_sums(self.num_groups, self.chosen.values.shape[1])
        cost, count = evaluated_equations(*self._arguments(at), squared_scale, sums)
        return NormalEquations.of(sums, cost, count)

    def px_per_step(self) -> Float64:
        """Approximate motion of points per unit of the pose, pixels of the level: (6,)."""
        focal = focal_px(self.camera) * self.level.scale_x
        return np.array([focal] * 3 + [focal / self._depth_m] * 3)

    def cells(self, cam_from_world: RigidTransform, seen: NDArray[Any]) -> NDArray[np.int64]:
        """Cells of a grid over the query, int64 (K,), in which the points ``seen`` are projected.

        ``seen`` is a mask (N,) or rows (K,); residuals of one cell may depend on each other.
        """
        cell_px = max(self.camera.width, self.camera.height) / _CELLS
        px = project(self.camera, cam_from_world, self.chosen.points[seen])
        row_column = (px // cell_px).astype(np.int64)
        return np.asarray(row_column[:, 1] * (_CELLS + 1) + row_column[:, 0])


def _deviation(rows: Float64) -> float:
    """Robust standard deviation of residuals (N, C, 8), from their median."""
    magnitudes = np.sqrt(np.square(rows[..., 0]).mean(1))
    seen = magnitudes[~np.isnan(magnitudes)]
    return float(deviation_by_median(seen)) if len(seen) else 0.0


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of pose, gains and biases."""

    # pose, mixed, own, pose_gradient, own_gradient: see ``photometric_kernels.normal_equations``;
    # ``pose`` is whole
    pose: Float64
    mixed: Float64
    own: Float64
    pose_gradient: Float64
    own_gradient: Float64
    # mean_cost, count: robust cost of a point, and of how many points that are seen
    mean_cost: float
    count: int

    @classmethod
    def of(cls, sums: tuple[Float64, ...], cost: float, count: int) -> NormalEquations:
        pose, mixed, own, pose_gradient, own_gradient = sums
        pose = pose + pose.T
        pose[np.diag_indices(6)] *= 0.5  # both halves have it
        return cls(pose, mixed, own, pose_gradient, own_gradient, cost / max(count, 1), count)

    def reduced(self, damping: float = 0.0) -> tuple[Float64, Float64, Float64] | None:
        """Matrix (6, 6) and gradient (6,) of the pose without gains and biases.

        Third what those are multiplied by, (G, C, 6, 2). None where a number is not finite.
        """
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
        return pose_step, *self.nuisance_step(pose_step)

    def nuisance_step(self, pose_step: Float64 | None = None) -> tuple[Float64, Float64]:
        """Steps of gains and biases (G, C) beside a step of the pose (6,), or while it stays."""
        right = -self.own_gradient
        if pose_step is not None:
            right = right - np.einsum("gcpi,p->gci", self.mixed, pose_step)
        return _solve_pairs(self.own, right)


def empty_sums(num_groups: int, channels: int) -> tuple[Float64, ...]:
    """Zero sums, as ``photometric_kernels.normal_equations`` adds to."""
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


def minimise(
    problem: LevelProblem, start: Alignment, *, last_step_px: float, rounds: int = 2
) -> Alignment:
    """The alignment of least cost near one, to a step of so many pixels of the level.

    Each round has a scale of the loss of its own.
    """
    at = start
    for _ in range(rounds):
        at = _levenberg_marquardt(problem, at, last_step_px)
        at = replace(at, deviation=_deviation(problem.rows(at)))
    return at


def _levenberg_marquardt(problem: LevelProblem, at: Alignment, last_step_px: float) -> Alignment:
    scale2 = at.squared_scale
    if not scale2 > 0:
        return at  # residuals are zero: there is nothing to gain
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
        # of means: points that leave the image neither cost nor pay
        small = float(np.abs(pose_step) @ reach) < last_step_px
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
    """Mask (N,) of the points in cells of the query that look like the references.

    What stands in front of a scene is not a few odd residuals but a whole part of the image, in
    which nothing correlates.
    """
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
    told = count >= _CELL_POINTS
    if told.sum() > 0:
        limit = _AGREES * float(np.percentile(correlation[told], 75))
        keep[seen] = ~told[cells] | (correlation[cells] >= limit)
    return keep
