"""Position and rotation error of estimated poses against true ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.poses import invert, rotation_angles_deg, stack_poses
from megloc_kapture.values import RigidTransform


@dataclass(frozen=True, eq=False, slots=True)
class PoseErrors:
    """Errors of N queries, in the order of ``names``.

    A query without an estimated pose has infinite errors, both of them: it lies beyond every
    threshold, sorts last, and raises a median instead of leaving it. Neither array holds NaN.

    Parameters
    ----------
    names : the queries.
    position_m : float64 (N,), distance between the camera centres, metres.
    angle_deg : float64 (N,), angle of the rotation between the two, degrees in [0, 180].
    """

    names: tuple[str, ...]
    position_m: NDArray[np.float64]
    angle_deg: NDArray[np.float64]

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(N,) whether the query has an estimated pose."""
        return np.isfinite(self.position_m)


def pose_errors(
    estimated: Mapping[str, RigidTransform],
    truth: Mapping[str, RigidTransform],
    names: Iterable[str] | None = None,
) -> PoseErrors:
    """Errors of ``estimated`` for the queries ``names``, by default all of ``truth``, sorted.

    Parameters
    ----------
    estimated, truth : ``cam_from_world`` by image name, in one frame, metres. Estimates of images
        that are not asked for are left alone.
    names : must all be in ``truth``.
    """
    listed = tuple(sorted(truth) if names is None else names)
    position_m = np.full(len(listed), np.inf)
    angle_deg = np.full(len(listed), np.inf)
    found = [i for i, name in enumerate(listed) if name in estimated]
    if found:
        # compared as world_from_cam, step by step as kapture does: figures then agree to the last
        # bit, and so do the queries that lie exactly on a threshold
        quats, centers = invert(*stack_poses(estimated[listed[i]] for i in found))
        true_quats, true_centers = invert(*stack_poses(truth[listed[i]] for i in found))
        position_m[found] = np.linalg.norm(centers - true_centers, axis=1)
        angle_deg[found] = rotation_angles_deg(quats, true_quats)
    return PoseErrors(listed, position_m, angle_deg)
