"""The matches of a query with a map image, and which of them fit a pair of poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.io.kapture_store import FeatureReader, MatchesReader
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.values import Camera, RigidTransform

# how far a match may lie beside its epipolar line and still fit
_MAX_ERROR_PX = 8.0


@dataclass(frozen=True, eq=False)
class MatchLines:
    """Matched pixels of two images.

    Attributes
    ----------
    query_px, map_px : float64 (M, 2).
    """

    query_px: NDArray[np.float64]
    map_px: NDArray[np.float64]


class StoredMatches:
    """Reads the matches that a run left in its workspace; knows none where there are none.

    Of several types of keypoints the first one counts that has matches, and keypoints on both
    sides.

    Raises
    ------
    DataError : broken files; of every method.
    """

    def __init__(self, around: Surroundings) -> None:
        self._matches: MatchesReader | None = None
        self._keypoints: tuple[FeatureReader, FeatureReader] | None = None
        queries, mapping = around.queries, around.mapping
        if queries is None or mapping is None:
            return
        drawn = set(queries.types("keypoints")) & set(mapping.types("keypoints"))
        # those of a guided pyramid hold the others
        for name in sorted(
            queries.types("matches"), key=lambda name: (base_type(name) == name, name)
        ):
            if name in drawn:
                self._matches = queries.matches(name)
                self._keypoints = (queries.keypoints(name), mapping.keypoints(name))
                return

    def count(self, query: str, image: str) -> int | None:
        """Matches of a pair; None where nothing is known of it."""
        found = self._indices(query, image)
        return None if found is None else len(found)

    def lines(self, query: str, image: str) -> MatchLines | None:
        """Matches of a pair as pixels; None where nothing is known of it."""
        indices = self._indices(query, image)
        if indices is None or self._keypoints is None:
            return None
        pixels = []
        for reader, name, chosen in zip(self._keypoints, (query, image), indices.T, strict=True):
            if name not in reader:
                return None
            keypoints = reader.read(name)
            if len(chosen) and chosen.max() >= len(keypoints):
                return None
            pixels.append(np.asarray(keypoints[chosen, :2], dtype=np.float64))
        return MatchLines(pixels[0], pixels[1])

    def _indices(self, query: str, image: str) -> NDArray[np.int64] | None:
        if self._matches is None or (query, image) not in self._matches:
            return None
        return self._matches.read(query, image)[0]


def fits_poses(
    lines: MatchLines,
    query_camera: Camera,
    map_camera: Camera,
    map_from_query: RigidTransform,
) -> NDArray[np.bool_]:
    """(M,) whether each match lies within 8 pixels of its epipolar line in the query.

    Where the two cameras stand in one place every match fits.
    """
    rays = bearing_rays(query_camera, lines.query_px)
    map_rays = bearing_rays(map_camera, lines.map_px)
    t = np.array(map_from_query.translation)
    # x_map^T [t] R x_query = 0: the plane of both centres and the map's ray, seen by the query
    normals = np.cross(map_rays, t) @ map_from_query.rotation_matrix()
    length = np.linalg.norm(normals[:, :2], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        beside = np.abs(np.einsum("ij,ij->i", normals, rays)) / length
    return np.asarray(~(beside * focal_px(query_camera) > _MAX_ERROR_PX))
