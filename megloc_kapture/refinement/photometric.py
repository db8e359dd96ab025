"""Photometric alignment: the pose under which reference images, lifted by depth, fit the query.

At each level of the pyramids, coarse to fine, the residuals ``gain_i I(px(T X)) + bias_i - r`` of
all references i together are minimised over the pose T and a gain and a bias per reference and
channel. Gain and bias stand on the query's side: what least squares leave is then the references'
variance times ``1 - correlation^2``, so that the alignment maximises correlation, as ECC does
(Evangelidis and Psarakis, PAMI 2008), and gains nothing from moving into flat parts of the query.
The loss is Geman and McClure's, whose scale follows the residuals: what one image shows and the
other does not has no say.

This module has the residuals; others minimise them, judge them, and say how certain a pose is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import focal_px, project
from megloc_kapture.refinement.photometric_equations import NormalEquations, empty_sums
from megloc_kapture.refinement.photometric_points import ChosenPoints
from megloc_kapture.refinement.photometric_pyramid import Level
from megloc_kapture.values import Camera, RigidTransform

Float64 = NDArray[np.float64]

MIN_POINTS = 50
LOSS_SCALE = 2.0  # of the loss, in standard deviations
_NUISANCE_STEPS = 3
_NUISANCE_POINTS = 6000  # for two numbers of each reference
_MIN_GAIN = 0.05
# the deviation of a normal variable over the median of its magnitude
_MEDIAN_TO_DEVIATION = 1.4826
# cells of the query, along its longer side, in which residuals may depend on each other
_CELLS = 10


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

        self._near = near
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

    def subset(self, which: NDArray[Any]) -> LevelProblem:
        """The same of some points, a mask (N,) or rows."""
        return LevelProblem(
            self.chosen.subset(which),
            self.level,
            self.camera,
            self._near,
            num_groups=self.num_groups,
        )

    def thinned(self, most: int) -> LevelProblem:
        """The same of at most so many points, still evenly spread."""
        step = max(1, -(-len(self.chosen.points) // most))
        return self.subset(np.arange(0, len(self.chosen.points), step)) if step > 1 else self

    def rows(self, at: Alignment) -> Float64:
        """Residuals and derivatives, (N, C, 8), as ``photometric_kernels.evaluate`` has them."""
        from megloc_kapture.refinement.photometric_kernels import evaluate

        out = np.empty((*self.chosen.values.shape, 8))
        evaluate(*self._arguments(at), out)
        return out

    def _arguments(self, at: Alignment) -> tuple[Any, ...]:
        return (
            self.chosen.points,
            self.chosen.values,
            self.chosen.groups,
            self.level.values,
            self.level.valid,
            self._scale_xy,
            self._packed,
            at.cam_from_world.rotation_matrix(),
            np.array(at.cam_from_world.translation),
            at.gains,
            at.biases,
        )

    def nuisance_at(self, cam_from_world: RigidTransform) -> Alignment:
        """Gains, biases and deviation that fit best while the pose stays; by some of the points."""
        return self.thinned(_NUISANCE_POINTS)._nuisance_at(cam_from_world)

    def _nuisance_at(self, cam_from_world: RigidTransform) -> Alignment:
        shape = (self.num_groups, self.chosen.values.shape[1])
        at = Alignment(cam_from_world, np.ones(shape), np.zeros(shape), np.inf)
        rows = self.rows(at)
        for _ in range(_NUISANCE_STEPS):
            steps = self.system_of(rows, at.squared_scale).nuisance_step()
            at = at.moved(cam_from_world, *steps)
            groups = self.chosen.groups
            rows[..., 0] = np.where(
                np.isnan(rows[..., 0]),
                np.nan,
                at.gains[groups] * rows[..., 7] + at.biases[groups] - self.chosen.values,
            )
            at = Alignment(cam_from_world, at.gains, at.biases, _deviation(rows))
        return at

    def deviation(self, at: Alignment) -> float:
        """Robust standard deviation of the residuals, from their median."""
        return _deviation(self.rows(at))

    def system_of(self, rows: Float64, squared_scale: float) -> NormalEquations:
        """Normal equations of what :meth:`rows` gave, for the squared scale of the loss."""
        from megloc_kapture.refinement.photometric_kernels import normal_equations

        sums = empty_sums(self.num_groups, rows.shape[1])
        cost, count = normal_equations(rows, self.chosen.groups, squared_scale, *sums)
        return NormalEquations.of(sums, cost, count)

    def system_at(self, at: Alignment, squared_scale: float) -> NormalEquations:
        """Normal equations at an alignment, for the squared scale of the loss."""
        from megloc_kapture.refinement.photometric_kernels import evaluated_equations

        sums = empty_sums(self.num_groups, self.chosen.values.shape[1])
        cost, count = evaluated_equations(*self._arguments(at), squared_scale, *sums)
        return NormalEquations.of(sums, cost, count)

    def px_per_step(self) -> Float64:
        """Pixels of the level by which about the pose's six parameters move points: (6,)."""
        focal = focal_px(self.camera) * self.level.scale_x
        return np.array([focal] * 3 + [focal / self._depth_m] * 3)

    def cells(self, cam_from_world: RigidTransform, seen: NDArray[Any]) -> NDArray[np.int64]:
        """Of those points, a mask (N,) or rows, the number of the query's cell that each is in."""
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


def _deviation(rows: Float64) -> float:
    magnitudes = np.sqrt(np.square(rows[..., 0]).mean(1))
    seen = magnitudes[~np.isnan(magnitudes)]
    return _MEDIAN_TO_DEVIATION * float(np.median(seen)) if len(seen) else 0.0
