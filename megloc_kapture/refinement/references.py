"""Map images that a pose may be refined against, by where they look."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.values import RigidTransform

_FORWARD = np.array([0.0, 0.0, 1.0])


class ReferenceImages:
    """Finds map images that may show what a camera sees.

    Parameters
    ----------
    poses : ``cam_from_world`` of the map's images.

    Attributes
    ----------
    names : of the images, sorted.
    """

    def __init__(self, poses: Mapping[str, RigidTransform]) -> None:
        self.names = tuple(sorted(poses))
        quats, translations = stack_poses([poses[name] for name in self.names])
        self._centers = camera_centers(quats, translations)
        self._directions = rotate(invert_quats(quats), _FORWARD)

    def near(
        self,
        cam_from_world: RigidTransform,
        first: Sequence[str],
        *,
        max_references: int,
        max_angle_deg: float = 60.0,
        min_distance_m: float = 0.0,
    ) -> list[str]:
        """Images that look a camera's way, nearest first; half of them, at least, of ``first``.

        Parameters
        ----------
        first : images that the pose comes from: they are known to match.
        max_angle_deg : between the viewing directions; images beyond it stay out.
        min_distance_m : of the centres; images within it stay out, unit of the map.
        """
        forward = cam_from_world.rotation_matrix()[2]
        facing = self._directions @ forward >= np.cos(np.deg2rad(max_angle_deg))
        distances = np.linalg.norm(self._centers - cam_from_world.center(), axis=1)
        usable = facing & (distances >= min_distance_m)
        order = [int(at) for at in np.argsort(distances, kind="stable") if usable[at]]
        known = set(first)
        chosen = [at for at in order if self.names[at] in known][: (max_references + 1) // 2]
        chosen += [at for at in order if at not in set(chosen)][: max_references - len(chosen)]
        return [self.names[at] for at in chosen]
