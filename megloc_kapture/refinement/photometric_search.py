"""Where to begin an alignment: turns of the camera that may be right, found by looking at all.

Gradients lead to the right pose from a few pixels only, of a level on which the light of day and
night has not changed what is seen; coarser levels, which would lead there from further away, show
the light more than the things. So the camera's turns are tried one by one on that level: a small
error of a pose is nearly a turn, as far as the image goes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import focal_px
from megloc_kapture.refinement.photometric_points import ChosenPoints
from megloc_kapture.refinement.photometric_pyramid import Level
from megloc_kapture.values import Camera, RigidTransform

_STEP_PX = 2.0  # of the level, between turns that are tried
_MAX_TURNS = 4000
# turns as near as this many steps are one
_NEAR_STEPS = 2.0

Float64 = NDArray[np.float64]


def best_turns(
    chosen: ChosenPoints,
    level: Level,
    camera: Camera,
    cam_from_world: RigidTransform,
    *,
    max_deg: float,
    count: int,
) -> list[RigidTransform]:
    """The poses, turned by up to ``max_deg``, under which references and query correlate best.

    Parameters
    ----------
    chosen, level : the points of the references, and that level of the query.
    camera, cam_from_world : of the query.

    Returns
    -------
    The given pose, then at most ``count`` turned ones that differ from each other, best first.
    """
    from megloc_kapture.refinement.photometric_kernels import camera_of, correlations

    if max_deg <= 0 or len(chosen.points) == 0:
        return [cam_from_world]
    vectors = turn_grid(level, camera, max_deg)
    quats = _quats(vectors)
    rotations = np.stack([_turn(quat).rotation_matrix() for quat in quats])
    score = np.empty(len(rotations))
    num_groups = int(chosen.groups.max()) + 1
    correlations(
        cam_from_world.apply(chosen.points),
        chosen.values,
        chosen.groups,
        level.values,
        level.valid,
        np.array([level.scale_x, level.scale_y]),
        camera_of(camera),
        rotations,
        np.empty((num_groups, chosen.values.shape[1], 6)),
        score,
    )
    result = [cam_from_world]
    taken: list[Float64] = []
    apart = _NEAR_STEPS * _step_rad(level, camera)
    for row in np.argsort(-score, kind="stable"):
        if len(taken) == count or score[row] <= 0:
            break
        if all(np.linalg.norm(vectors[row] - other) > apart for other in taken):
            taken.append(vectors[row])
            result.append(_turn(quats[row]) @ cam_from_world)
    return result


def turn_grid(level: Level, camera: Camera, max_deg: float) -> Float64:
    """Rotation vectors (K, 3) in radians of the turns that are tried, the shortest first."""
    step = _step_rad(level, camera)
    # about the optical axis a turn moves the image's sides less than one across it moves all
    h, w = level.valid.shape
    steps = np.array([step, step, _STEP_PX / (0.5 * max(h, w))])
    limit = np.radians(max_deg)
    # a finer grid than anyone has time for is made coarser
    volume = 4.0 / 3.0 * np.pi * limit**3 / steps.prod()
    steps *= max(1.0, (volume / _MAX_TURNS) ** (1 / 3))
    sides = [each * np.arange(-(n := int(limit / each)), n + 1) for each in steps]
    vectors = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    lengths = np.linalg.norm(vectors, axis=1)
    vectors, lengths = vectors[lengths <= limit], lengths[lengths <= limit]
    return np.asarray(vectors[np.argsort(lengths, kind="stable")])


def _step_rad(level: Level, camera: Camera) -> float:
    return _STEP_PX / (focal_px(camera) * level.scale_x)


def _quats(vectors: Float64) -> Float64:
    """Quaternions (K, 4) of rotation vectors (K, 3)."""
    half = 0.5 * np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vectors], axis=1)


def _turn(quat: Float64) -> RigidTransform:
    w, x, y, z = quat.tolist()
    return RigidTransform((w, x, y, z), (0.0, 0.0, 0.0))
