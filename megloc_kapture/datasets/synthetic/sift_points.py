"""Sparse models of a rendered world as real ones are made: SIFT, matches, triangulation.

What is known exactly about the world replaces what structure from motion has to find out: poses
and cameras are the true ones, and a match stays where the depth says that it is one. Points and
keypoints have the errors of real ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.sparse_points import SparsePoints
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.io.colmap import (
    DatabaseFeatures,
    MapImage,
    normalized_from_px,
    px_from_cam,
    triangulate,
    write_feature_database,
)
from megloc_kapture.matching.nearest_neighbours import NearestNeighbourOptions, match_nearest
from megloc_kapture.values import LocalFeatures

_MATCHING = NearestNeighbourOptions(max_ratio=0.8)  # as COLMAP's matcher
_MAX_ERROR_PX = 2.0
_MIN_SHARED = 20  # features of one image that have one of the other at the same place
_GREY = 128

Features = Mapping[str, LocalFeatures]
Depths = Mapping[str, NDArray[np.float32]]


def sift_points(shots: Sequence[Shot], features: Features, depths_m: Depths) -> SparsePoints:
    """Points triangulated from features that see the same spot and look alike.

    Parameters
    ----------
    shots : of cameras that COLMAP knows; poses in any frame in metres.
    features, depths_m : of each shot by image name; depth float32 (H, W) along the optical axis, 0
        where nothing is seen.

    Returns
    -------
    ``xyz`` in the frame of the shots' poses, all grey; at least three images see a point;
    ``image_ids`` count in ``shots``, ``feature_ids`` are rows of the features.
    """
    images = [
        MapImage(shot.name, shot.camera, shot.cam_from_world, features[shot.name].keypoints_px)
        for shot in shots
    ]
    world = [_world_points(shot, features[shot.name], depths_m[shot.name]) for shot in shots]
    matches = {}
    for i, j in combinations(range(len(shots)), 2):
        # other places stand behind walls
        if shots[i].place == shots[j].place:
            found = _matches(shots[j], features[shots[i].name], features[shots[j].name], world[i])
            agree = _near(shots[i], features[shots[i].name], world[j], found[:, ::-1])
            matches[i, j] = found[agree]
    points = triangulate(images, matches)
    keypoints = [image.keypoints_px for image in images]
    rows = zip(points.image_ids.tolist(), points.keypoint_ids.tolist(), strict=True)
    xy_px = [keypoints[image][keypoint] for image, keypoint in rows]
    return SparsePoints(
        xyz=points.xyz,
        rgb=np.full((len(points.xyz), 3), _GREY, np.uint8),
        point_ids=points.point_ids,
        image_ids=points.image_ids.astype(np.int32),
        feature_ids=points.keypoint_ids.astype(np.int32),
        xy_px=np.array(xy_px, np.float32).reshape(-1, 2),
    )


def write_sift_database(path: Path, shots: Mapping[str, Shot], features: Features) -> None:
    """Write COLMAP's database of the shots' features, under the names given, in their order.

    Raises
    ------
    OutputError : cannot be written.
    """
    write_feature_database(
        path,
        (
            DatabaseFeatures(
                name,
                shot.camera,
                features[shot.name].keypoints_px,
                features[shot.name].descriptors,
            )
            for name, shot in shots.items()
        ),
    )


def _world_points(
    shot: Shot, features: LocalFeatures, depth_m: NDArray[np.float32]
) -> NDArray[np.float64]:
    """What each feature shows, float64 (N, 3); NaN where there is no depth."""
    xy = features.keypoints_px
    last = np.array(depth_m.shape[::-1]) - 1
    column, row = np.clip(xy.astype(np.int64), 0, last).T
    z = depth_m[row, column].astype(np.float64)
    z[z <= 0] = np.nan
    rays = normalized_from_px(shot.camera, xy)
    return shot.cam_from_world.inverse().apply(
        np.column_stack([rays, np.ones(len(z))]) * z[:, None]
    )


def _matches(
    shot: Shot, features: LocalFeatures, others: LocalFeatures, world: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Matches (K, 2) of ``features``, which show ``world``, with those of another shot."""
    px = px_from_cam(shot.camera, shot.cam_from_world.apply(world))
    inside = ((px > 0) & (px < (shot.camera.width, shot.camera.height))).all(axis=1)
    if inside.sum() < _MIN_SHARED:
        return np.zeros((0, 2), np.int64)
    matches, _ = match_nearest(features.descriptors, others.descriptors, _MATCHING)
    return matches[_near(shot, others, world, matches)]


def _near(
    shot: Shot, features: LocalFeatures, world: NDArray[np.float64], matches: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Whether what a match's first shows is projected to its second, a feature of the shot."""
    px = px_from_cam(shot.camera, shot.cam_from_world.apply(world[matches[:, 0]]))
    error = np.linalg.norm(px - features.keypoints_px[matches[:, 1]], axis=1)
    return np.asarray(error <= _MAX_ERROR_PX)  # NaN is not
