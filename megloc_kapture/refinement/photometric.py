"""Photometric alignment: the pose under which reference images, lifted by depth, fit the query.

At each level of the pyramids, coarse to fine, the residuals ``gain_i I(px(T X)) + bias_i - r`` of
all references i together are minimised over the pose T and a gain and a bias per reference and
channel. Gain and bias stand on the query's side: what least squares leave is then the references'
variance times ``1 - correlation^2``, so that the alignment maximises correlation, as ECC does
(Evangelidis and Psarakis, PAMI 2008), and gains nothing from moving into flat parts of the query.
Their block of the normal equations is diagonal in references and channels and is eliminated
(Schur's complement). The loss is Geman and McClure's, whose scale follows the residuals: what one
image shows and the other does not has no say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import focal_px, project
from megloc_kapture.refinement.photometric_points import ChosenPoints
from megloc_kapture.refinement.photometric_pyramid import Level
from megloc_kapture.values import Camera, RigidTransform

Float64 = NDArray[np.float64]

MIN_POINTS = 50
_MAX_STEPS = 12
_LAST_GAIN = 1e-5  # share of the cost
_DAMPING = 1e-3
_MOST_DAMPING = 1e2
_NUISANCE_STEPS = 3
_MIN_GAIN = 0.05
# the deviation of a normal variable over the median of its magnitude
_MEDIAN_TO_DEVIATION = 1.4826
# the loss' scale in standard deviations
_LOSS_SCALE = 2.0
# by about how many pixels of the level points move to either side of a difference
_CURVATURE_PX = 0.5
_CHANGE = 0.5  # of the residuals there at most, in their deviations
# how far alignments are tried again, in steps that change the image by that much
_BESIDE = (-4.0, -2.0, 0.0, 2.0, 4.0)
# eigenvalue over the largest, in units that move points as far, from which a pose is determined
_LEAST_CURVATURE = 1e-7
# of the normal equations, that the objective's own curvature must have
_LEAST_SHARE = 0.02
# cells of the query, along its longer side, in which residuals may depend on each other
_CELLS = 10
# points from which a cell tells whether it looks like the references, and how well it then must, as
# a share of what a good one does
_CELL_POINTS = 20
_AGREES = 0.5


@dataclass(frozen=True, eq=False)
class Alignment:
    """A pose with what belongs to it at one level.

    Attributes
    ----------
    cam_from_world : of the query.
    gains, biases : float64 (G, C), of the references.
    deviation : robust standard deviation of the residuals.
    """

    cam_from_world: RigidTransform
    gains: Float64
    biases: Float64
    deviation: float


@dataclass(frozen=True, eq=False)
class Fit:
    """How well a pose fits.

    Attributes
    ----------
    cost : mean of the robust loss, over the square of its scale: 0 to 0.5.
    correlation : of the query's values with the references', over all points and channels.
    count : of points that are seen.
    """

    cost: float
    correlation: float
    count: int


class LevelProblem:
    """The residuals of chosen points at one level of the query, as functions of the pose.

    Parameters
    ----------
    chosen : points of the references.
    level : of the query.
    camera : of the query, at its full size.
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

        depths = near.apply(chosen.points)[:, 2]
        ahead = depths[depths > 0]
        self._depth_m = float(np.median(ahead)) if len(ahead) else 1.0
        self.chosen = chosen
        self.camera = camera
        self.level = level
        present = int(chosen.groups.max()) + 1 if len(chosen.groups) else 0
        self.num_groups = present if num_groups is None else num_groups
        self._packed = camera_of(camera)
        self._scale_xy = np.array([level.scale_x, level.scale_y])

    def rows(self, cam_from_world: RigidTransform, gains: Float64, biases: Float64) -> Float64:
        """Residuals and derivatives, (N, C, 8), as ``photometric_kernels.evaluate`` has them."""
        from megloc_kapture.refinement.photometric_kernels import evaluate

        out = np.empty((*self.chosen.values.shape, 8))
        evaluate(*self._arguments(cam_from_world, gains, biases), out)
        return out

    def _arguments(
        self, cam_from_world: RigidTransform, gains: Float64, biases: Float64
    ) -> tuple[Any, ...]:
        return (
            self.chosen.points,
            self.chosen.values,
            self.chosen.groups,
            self.level.values,
            self.level.valid,
            self._scale_xy,
            self._packed,
            cam_from_world.rotation_matrix(),
            np.array(cam_from_world.translation),
            gains,
            biases,
        )

    def nuisance_at(self, cam_from_world: RigidTransform) -> Alignment:
        """Gains, biases and deviation that fit best while the pose stays."""
        shape = (self.num_groups, self.chosen.values.shape[1])
        gains, biases = np.ones(shape), np.zeros(shape)
        rows = self.rows(cam_from_world, gains, biases)
        scale2 = np.inf
        deviation = 0.0
        for _ in range(_NUISANCE_STEPS):
            gain_step, bias_step = self._system(rows, scale2).nuisance_step()
            gains, biases = np.maximum(gains + gain_step, _MIN_GAIN), biases + bias_step
            query = rows[..., 7]
            groups = self.chosen.groups
            rows[..., 0] = np.where(
                np.isnan(rows[..., 0]),
                np.nan,
                gains[groups] * query + biases[groups] - self.chosen.values,
            )
            deviation = _deviation(rows)
            scale2 = (_LOSS_SCALE * deviation) ** 2
        return Alignment(cam_from_world, gains, biases, deviation)

    def compared(self, old: RigidTransform, new: RigidTransform) -> tuple[Fit, Fit]:
        """How well two poses fit, on the points that both see, each with its own gains and biases.

        Both with the loss' scale of the new one.
        """
        fits, hidden = [], np.zeros(len(self.chosen.points), np.bool_)
        for pose in (old, new):
            at = self.nuisance_at(pose)
            rows = self.rows(pose, at.gains, at.biases)
            hidden |= np.isnan(rows[:, 0, 0])
            fits.append((rows, at.deviation))
        deviation = fits[1][1]
        for rows, _ in fits:
            rows[hidden, :, 0] = np.nan
        return self._fit(fits[0][0], deviation), self._fit(fits[1][0], deviation)

    def correlation(self, at: Alignment) -> float:
        """Of the query's values with the references'; see :class:`Fit`."""
        rows = self.rows(at.cam_from_world, at.gains, at.biases)
        return _correlation(rows, self.chosen, self.num_groups)

    def _system(self, rows: Float64, squared_scale: float) -> NormalEquations:
        from megloc_kapture.refinement.photometric_kernels import normal_equations

        sums = _sums(self.num_groups, rows.shape[1])
        cost, count = normal_equations(rows, self.chosen.groups, squared_scale, *sums)
        return NormalEquations.of(sums, cost, count)

    def system_at(self, at: Alignment, squared_scale: float) -> NormalEquations:
        """Normal equations at an alignment, for the squared scale of the loss."""
        from megloc_kapture.refinement.photometric_kernels import evaluated_equations

        sums = _sums(self.num_groups, self.chosen.values.shape[1])
        arguments = self._arguments(at.cam_from_world, at.gains, at.biases)
        cost, count = evaluated_equations(*arguments, squared_scale, *sums)
        return NormalEquations.of(sums, cost, count)

    def _fit(self, rows: Float64, deviation: float) -> Fit:
        squared_scale = (_LOSS_SCALE * max(deviation, 1e-12)) ** 2
        system = self._system(rows, squared_scale)
        return Fit(
            system.mean_cost / squared_scale,
            _correlation(rows, self.chosen, self.num_groups),
            system.count,
        )

    def minimised(
        self, start: Alignment, *, last_step_px: float = 0.01, rounds: int = 2
    ) -> Alignment:
        """The alignment of least cost near one, to a step of so many pixels of the level.

        Each round has a scale of the loss of its own.
        """
        at = start
        for _ in range(rounds):
            at = self._levenberg_marquardt(at, last_step_px)
            rows = self.rows(at.cam_from_world, at.gains, at.biases)
            at = replace(at, deviation=_deviation(rows))
        return at

    def _levenberg_marquardt(self, at: Alignment, last_step_px: float) -> Alignment:
        scale2 = (_LOSS_SCALE * at.deviation) ** 2
        if not scale2 > 0:
            return at  # residuals are zero: there is nothing to gain
        reach = self._px_per_step()
        system = self.system_at(at, scale2)
        damping = _DAMPING
        for _ in range(_MAX_STEPS):
            if system.count < MIN_POINTS:
                return at
            step = system.step(damping)
            if step is None:
                return at
            pose_step, gain_step, bias_step = step
            trial = Alignment(
                perturbed(at.cam_from_world, pose_step),
                np.maximum(at.gains + gain_step, _MIN_GAIN),
                at.biases + bias_step,
                at.deviation,
            )
            new = self.system_at(trial, scale2)
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

    def _px_per_step(self) -> Float64:
        """Pixels of the level by which about the pose's six parameters move points."""
        focal = focal_px(self.camera) * self.level.scale_x
        return np.array([focal] * 3 + [focal / self._depth_m] * 3)

    def agreeing(self, at: Alignment) -> NDArray[np.bool_]:
        """Points (N,) of the cells of the query that look like the references, others left out.

        What stands in front of a scene is not a few odd residuals but a whole part of the image,
        in which nothing correlates.
        """
        rows = self.rows(at.cam_from_world, at.gains, at.biases)
        seen = np.flatnonzero(~np.isnan(rows[:, 0, 0]))
        keep = np.ones(len(rows), np.bool_)
        if len(seen) == 0:
            return keep
        cells = self._cells(at.cam_from_world, seen)
        ours = rows[seen, :, 7] * at.gains[self.chosen.groups[seen]]
        ours = ours + at.biases[self.chosen.groups[seen]]
        theirs = self.chosen.values[seen]
        count = np.bincount(cells)
        filled = np.maximum(count, 1)[:, None]

        def summed(values: Float64) -> Float64:
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

    def covariance(self, at: Alignment) -> Float64 | None:
        """Covariance (6, 6) of the pose, as of ``Pose``; None where it is not determined.

        The sandwich of the objective's curvature with the scores of cells of the query, each taken
        as one observation (Liang and Zeger, Biometrika 1986): what neighbouring residuals have in
        common (blur, light, the query's noise seen by several references) makes it larger as it
        must. The curvature is that of the objective about the pose and not of its normal
        equations, in which the query's noise passes for gradients. Errors that the whole image
        shares, of the map's poses and depths or of the calibration, are not in the residuals and
        thus not in the covariance.
        """
        rows = self.rows(at.cam_from_world, at.gains, at.biases)
        scale2 = (_LOSS_SCALE * max(at.deviation, 1e-12)) ** 2
        groups = self.chosen.groups
        system = self._system(rows, scale2)
        reduced = system.reduced()
        if system.count < MIN_POINTS or reduced is None:
            return None
        inverse = self._inverse_curvature(at, scale2, system)
        if inverse is None:
            return None
        seen = ~np.isnan(rows[:, 0, 0])
        rows, groups = rows[seen], groups[seen]
        weight = (1.0 + np.square(rows[..., 0]).mean(1) / scale2) ** -2 / rows.shape[1]
        projection = reduced[2]
        # the derivative by the pose where gain and bias follow it
        own = np.stack([rows[..., 7], np.ones(rows.shape[:2])], axis=-1)
        derivative = rows[..., 1:7] - np.einsum("ncpi,nci->ncp", projection[groups], own)
        score = np.einsum("n,nc,ncp->np", weight, rows[..., 0], derivative)
        cells = self._cells(at.cam_from_world, seen)
        sums = np.zeros((int(cells.max()) + 1, 6))
        np.add.at(sums, cells, score)
        occupied = len(np.unique(cells))
        if occupied <= 6:
            return None
        scatter = sums.T @ sums * occupied / (occupied - 6)
        return np.asarray(inverse @ scatter @ inverse)

    def _even_steps(self, system: NormalEquations) -> tuple[Float64, float] | None:
        """Steps (6, 6), in columns, that change the image alike, by about _CURVATURE_PX.

        They are uncorrelated by the normal equations; the first is the one that the image
        determines least. Also by how much each changes the residuals, squared and weighted.
        """
        reduced = system.reduced()
        if reduced is None:
            return None
        usual = _CURVATURE_PX / self._px_per_step()
        scaled = reduced[0] * np.outer(usual, usual)
        values, vectors = np.linalg.eigh(scaled)
        if not values[0] > _LEAST_CURVATURE * values[-1]:
            return None
        change = float(np.trace(scaled)) / 6.0
        return usual[:, None] * vectors * np.sqrt(change / values), change

    def beside(self, at: Alignment) -> list[Alignment]:
        """Alignments that look much the same, those of the least cost first.

        They are off by pixels along the two directions that the image determines least.
        """
        scale2 = (_LOSS_SCALE * at.deviation) ** 2
        found = self._even_steps(self.system_at(at, scale2)) if scale2 > 0 else None
        if found is None:
            return []
        first, second = found[0][:, 0], found[0][:, 1]
        poses = [
            perturbed(at.cam_from_world, a * first + b * second)
            for a in _BESIDE
            for b in _BESIDE
            if a or b
        ]
        others = [replace(at, cam_from_world=pose) for pose in poses]
        costs = [self.system_at(each, scale2).mean_cost for each in others]
        return [others[k] for k in np.argsort(costs, kind="stable")]

    def _inverse_curvature(
        self, at: Alignment, squared_scale: float, system: NormalEquations
    ) -> Float64 | None:
        """Inverse (6, 6) of the second derivatives by the pose; None where it is no minimum.

        Differences are taken along :meth:`_even_steps`.
        """
        found = self._even_steps(system)
        if found is None:
            return None
        steps, change = found
        # not so far that the loss takes the change for outliers
        weights = float(system.own[..., 2].sum())
        nearer = min(1.0, (_CHANGE * at.deviation) ** 2 * weights / change)
        steps, change = steps * np.sqrt(nearer), change * nearer
        columns = []
        for step in steps.T:
            ends = []
            for sign in (1.0, -1.0):
                moved = replace(at, cam_from_world=perturbed(at.cam_from_world, sign * step))
                reduced = self.system_at(moved, squared_scale).reduced()
                if reduced is None:
                    return None
                ends.append(reduced[1])
            columns.append(steps.T @ (ends[0] - ends[1]) / 2.0)
        curvature = 0.5 * (np.array(columns) + np.array(columns).T)
        values, vectors = np.linalg.eigh(curvature)
        # normal equations would have six values of ``change``
        if not values[0] > _LEAST_SHARE * change:
            return None
        half = steps @ (vectors / np.sqrt(values))
        return np.asarray(half @ half.T)

    def _cells(self, cam_from_world: RigidTransform, seen: NDArray[Any]) -> NDArray[np.int64]:
        cell_px = max(self.camera.width, self.camera.height) / _CELLS
        px = project(self.camera, cam_from_world, self.chosen.points[seen])
        row_column = (px // cell_px).astype(np.int64)
        return np.asarray(row_column[:, 1] * (_CELLS + 1) + row_column[:, 0])


def perturbed(cam_from_world: RigidTransform, step: Float64) -> RigidTransform:
    """``exp(omega) R`` and ``exp(omega) t + v`` of a step (omega, v), radians and metres."""
    angle = float(np.linalg.norm(step[:3]))
    # sin(x / 2) / x, through its limit
    half_sinc = 0.5 * float(np.sinc(0.5 * angle / np.pi))
    x, y, z = (half_sinc * step[:3]).tolist()
    tx, ty, tz = step[3:].tolist()
    return RigidTransform((float(np.cos(0.5 * angle)), x, y, z), (tx, ty, tz)) @ cam_from_world


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
        pose = np.triu(pose) + np.triu(pose, 1).T
        return cls(pose, mixed, own, pose_gradient, own_gradient, cost / max(count, 1), count)

    def reduced(self, damping: float = 0.0) -> tuple[Float64, Float64, Float64] | None:
        """Matrix (6, 6) and gradient (6,) of the pose without gains and biases, and what those are
        multiplied by, (G, C, 6, 2)."""
        blocks = np.empty((*self.own.shape[:2], 2, 2))
        blocks[..., 0, 0], blocks[..., 1, 1] = self.own[..., 0], self.own[..., 2]
        blocks[..., 0, 1] = blocks[..., 1, 0] = self.own[..., 1]
        # a reference that is not seen has nothing to say: its block must only be invertible
        trace = blocks[..., 0, 0] + blocks[..., 1, 1]
        blocks += (1e-9 * trace + 1e-12)[..., None, None] * np.eye(2)
        projection = np.linalg.solve(blocks, self.mixed.swapaxes(-1, -2)).swapaxes(-1, -2)
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


def _sums(num_groups: int, channels: int) -> tuple[Float64, ...]:
    """What ``photometric_kernels.normal_equations`` fills."""
    shapes = [(6, 6), (num_groups, channels, 6, 2), (num_groups, channels, 3), (6,)]
    return tuple(np.zeros(shape) for shape in (*shapes, (num_groups, channels, 2)))


def _solve_pairs(own: Float64, right: Float64) -> tuple[Float64, Float64]:
    """Solutions (G, C) of 2x2 systems: gain gain, gain bias, bias bias (G, C, 3)."""
    first, cross, second = np.moveaxis(own, -1, 0)
    ridge = 1e-9 * (first + second) + 1e-12
    first, second = first + ridge, second + ridge
    determinant = first * second - cross * cross
    gain = (second * right[..., 0] - cross * right[..., 1]) / determinant
    bias = (first * right[..., 1] - cross * right[..., 0]) / determinant
    return gain, bias


def _deviation(rows: Float64) -> float:
    magnitudes = np.sqrt(np.square(rows[..., 0]).mean(1))
    seen = magnitudes[~np.isnan(magnitudes)]
    return _MEDIAN_TO_DEVIATION * float(np.median(seen)) if len(seen) else 0.0


def _correlation(rows: Float64, chosen: ChosenPoints, num_groups: int) -> float:
    """Correlation of two sets of values whose means are those of each reference and channel."""
    seen = ~np.isnan(rows[:, 0, 0])
    query, reference, groups = rows[seen][..., 7], chosen.values[seen], chosen.groups[seen]
    together = apart_query = apart_reference = 0.0
    for group in range(num_groups):
        ours = groups == group
        if not ours.any():
            continue
        a = query[ours] - query[ours].mean(0)
        b = reference[ours] - reference[ours].mean(0)
        together += float((a * b).sum())
        apart_query += float((a * a).sum())
        apart_reference += float((b * b).sum())
    product = apart_query * apart_reference
    return together / float(np.sqrt(product)) if product > 0 else 0.0
