"""How far poses are from the map images that they were estimated from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.evaluation.results import Poses, are_ranked
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.io.tables import QueryStatus
from megloc_kapture.values import RigidTransform


@dataclass(frozen=True, slots=True)
class NearCandidates:
    """Distances of a pose from the map images it was estimated from.

    Parameters
    ----------
    first_m, first_deg : distance to the first candidate's camera centre, and the angle between
        the two viewing directions; NaN where nobody ranked the candidates.
    nearest : the candidate whose centre is nearest.
    nearest_m, nearest_deg : the same for it.
    """

    first_m: float
    first_deg: float
    nearest: str
    nearest_m: float
    nearest_deg: float


def near_candidates(
    poses: Poses,
    statuses: Mapping[str, QueryStatus],
    images: Sequence[str],
    map_poses: Poses,
) -> dict[str, NearCandidates]:
    """Image -> the first and the nearest of its candidates that have a pose in the map.

    Parameters
    ----------
    poses : ``cam_from_world`` of ``images`` at least.
    statuses : rows of ``status.csv``, for the candidates; images may be absent.
    images : whose candidates to look at; those without any are left out.
    map_poses : ``cam_from_world`` of the map's images, in the same frame.
    """
    index_of = {name: index for index, name in enumerate(map_poses)}
    known = {
        image: [index_of[c] for c in statuses[image].candidates if c in index_of]
        for image in images
        if image in statuses
    }
    known = {image: candidates for image, candidates in known.items() if candidates}
    if not known:
        return {}
    counts = np.array([len(candidates) for candidates in known.values()])
    candidates = np.concatenate([np.array(c, dtype=np.int64) for c in known.values()])
    centers, directions = _centers_and_directions([poses[image] for image in known])
    map_centers, map_directions = _centers_and_directions(list(map_poses.values()))
    owner = np.repeat(np.arange(len(known)), counts)
    distance_m = np.linalg.norm(centers[owner] - map_centers[candidates], axis=1)
    cosine = np.einsum("ij,ij->i", directions[owner], map_directions[candidates])
    angle_deg = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    names = list(map_poses)
    ranked = are_ranked(status.candidates for status in statuses.values())
    found = {}
    firsts = np.concatenate([[0], np.cumsum(counts)[:-1]]).tolist()
    for image, first, count in zip(known, firsts, counts.tolist(), strict=True):
        nearest = first + int(np.argmin(distance_m[first : first + count]))
        found[image] = NearCandidates(
            first_m=float(distance_m[first]) if ranked else math.nan,
            first_deg=float(angle_deg[first]) if ranked else math.nan,
            nearest=names[int(candidates[nearest])],
            nearest_m=float(distance_m[nearest]),
            nearest_deg=float(angle_deg[nearest]),
        )
    return found


def _centers_and_directions(
    poses: Sequence[RigidTransform],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Camera centres (N, 3) and unit viewing directions (N, 3) in the world."""
    quats, translations = stack_poses(poses)
    directions = rotate(invert_quats(quats), np.array([0.0, 0.0, 1.0]))
    return camera_centers(quats, translations), directions
