"""Sparse models of a rendered world: exact tracks, or triangulated SIFT features.

The official layouts include a model. Exact points are lifted from rendered depth and projected, so
the model is as exact as float32 pixels allow. SIFT models have exact poses, cameras and matches,
but points and keypoints with realistic errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.nvm import NvmModel
from megloc_kapture.features.rootsift import ColmapSift
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.colmap import (
    MapImage,
    colmap_camera,
    load_pycolmap,
    px_from_cam,
    triangulate,
)
from megloc_kapture.io.colmap_model import SparsePoints
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.matching.nearest_neighbours import NearestNeighbourOptions, match_nearest
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, LocalFeatures
from megloc_twins.frames import Frame
from megloc_twins.options import JPEG_QUALITY, ModelTwinOptions
from megloc_twins.rasterization import intrinsics, project, sample_grid
from megloc_twins.render import RenderedFrame, render_frames

_BORDER_PX = 2.0  # smallest distance of a feature from the image border
# tolerated difference of a point's depth from its pixel's, relative plus absolute; slanted
# surfaces need it
_DEPTH_TOLERANCE = 0.01
_DEPTH_TOLERANCE_M = 0.02
_GREY = 128  # depth maps have no colours
_MATCHING = NearestNeighbourOptions(max_ratio=0.8)  # as COLMAP's matcher
_MAX_ERROR_PX = 2.0
_MIN_SHARED = 20  # images are matched if at least this many features are visible in both

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Depth = NDArray[np.float32]
Features = Mapping[str, LocalFeatures]
Depths = Mapping[str, Depth]


def exact_tracks(
    frames: Sequence[Frame], depths_m: Depths, *, points_per_frame: int, rng: np.random.Generator
) -> SparsePoints:
    """Create sparse points seen in at least two frames, with exact observations.

    Pixels with depth are drawn at random in every frame, lifted to world points and projected into
    all frames of the same place whose depth agrees.

    Parameters
    ----------
    frames : PINHOLE, SIMPLE_PINHOLE or SIMPLE_RADIAL cameras.
    depths_m : float32 (H, W) along the optical axis by image name, one for each frame, 0 without a
        surface.
    points_per_frame : number of pixels drawn in each frame; a pixel that no other frame sees gives
        no point.

    Returns
    -------
    Grey points with ``xyz`` in the world of the poses and observations sorted by point, then image.
    ``image_ids`` index ``frames``, ``feature_ids`` count from 0 in each image, ``xy_px`` are the
    projections rounded to float32.
    """
    parts = [SparsePoints.none()]
    for frame in frames:
        # walls hide other places
        here = [index for index, other in enumerate(frames) if other.place == frame.place]
        points = _lifted(frame, depths_m[frame.name], points_per_frame, rng)
        seen, px = _observations([frames[index] for index in here], depths_m, points)
        enough = seen.sum(1) >= 2
        of_point, of_image = np.nonzero(seen[enough])
        found = _grey_points(
            points[enough], of_point, of_image, of_image, px[enough][of_point, of_image]
        )
        parts.append(replace(found, image_ids=np.array(here, np.int32)[found.image_ids]))
    joined = SparsePoints.joined(parts)
    feature_ids = np.empty_like(joined.image_ids)
    for image in np.unique(joined.image_ids):
        of_image = joined.image_ids == image
        feature_ids[of_image] = np.arange(np.count_nonzero(of_image))
    return replace(joined, feature_ids=feature_ids)


def _grey_points(
    xyz: Floats,
    point_ids: NDArray[np.int64],
    image_ids: NDArray[np.int64],
    feature_ids: NDArray[np.int64],
    xy_px: NDArray[np.floating[Any]],
) -> SparsePoints:
    return SparsePoints(
        xyz=xyz,
        rgb=np.full((len(xyz), 3), _GREY, np.uint8),
        point_ids=point_ids,
        image_ids=image_ids.astype(np.int32),
        feature_ids=feature_ids.astype(np.int32),
        xy_px=xy_px.astype(np.float32),
    )


def _lifted(frame: Frame, depth_m: Depth, count: int, rng: np.random.Generator) -> Floats:
    """Lift random pixels with depth to world points (P, 3), P <= count."""
    rows, columns = np.nonzero(depth_m > 0)
    drawn = rng.permutation(len(rows))[:count]
    rows, columns = rows[drawn], columns[drawn]
    z = depth_m[rows, columns].astype(np.float64)
    in_camera = sample_grid(frame.camera, 1).rays()[rows, columns] * z[:, None]
    return frame.cam_from_world.inverse().apply(in_camera)


def _observations(
    frames: Sequence[Frame], depths_m: Depths, points: Floats
) -> tuple[Bools, Floats]:
    """Return visibility, bool (P, S), of points (P, 3) in frames, and pixels, float64 (P, S, 2)."""
    seen = np.zeros((len(points), len(frames)), bool)
    pixels = np.zeros((len(points), len(frames), 2))
    for column, frame in enumerate(frames):
        in_camera = frame.cam_from_world.apply(points)
        ahead = _in_field(frame.camera, in_camera)
        px = project(frame.camera, np.where(ahead[:, None], in_camera, [0.0, 0.0, 1.0]))
        size = np.array([frame.camera.width, frame.camera.height])
        inside = ahead & ((px >= _BORDER_PX) & (px <= size - _BORDER_PX)).all(1)
        where = np.where(inside[:, None], px, 0.0).astype(np.int64)
        z = in_camera[:, 2]
        error = np.abs(depths_m[frame.name][where[:, 1], where[:, 0]] - z)
        seen[:, column] = inside & (error < _DEPTH_TOLERANCE * z + _DEPTH_TOLERANCE_M)
        pixels[:, column] = px
    return seen, pixels


def _in_field(camera: Camera, in_camera: Floats) -> Bools:
    """Select points in front of the camera, no farther from its axis than the image's corners.

    Beyond the corners the distortion may be non-monotonic and project a point into the image.
    """
    z = in_camera[:, 2]
    inside = (in_camera[:, :2] ** 2).sum(1) <= _squared_reach(camera) * z**2
    return np.asarray((z > 0) & inside, np.bool_)


@cache
def _squared_reach(camera: Camera) -> float:
    """Return the largest squared distance of a pixel's ray from the axis at depth 1."""
    grid = sample_grid(camera, 1)
    return float((grid.x**2 + grid.y**2).max())


def sift_points(frames: Sequence[Frame], features: Features, depths_m: Depths) -> SparsePoints:
    """Triangulate points from matches of features of the same surface point.

    Parameters
    ----------
    features, depths_m : of each frame by image name; depth float32 (H, W) along the optical axis, 0
        without a surface.

    Returns
    -------
    Grey points with ``xyz`` in the world of the poses, each observed by at least three images.
    ``image_ids`` index ``frames``, ``feature_ids`` are rows of the features.
    """
    images = [
        MapImage(frame.name, frame.camera, frame.cam_from_world, features[frame.name].keypoints_px)
        for frame in frames
    ]
    world = [_world_points(frame, features[frame.name], depths_m[frame.name]) for frame in frames]
    matches = {}
    for i, j in combinations(range(len(frames)), 2):
        # walls hide other places
        if frames[i].place == frames[j].place:
            mine, others = features[frames[i].name], features[frames[j].name]
            found = _matches(frames[j], mine, others, world[i])
            agree = _near(frames[i], mine, world[j], found[:, ::-1])
            matches[i, j] = found[agree]
    points = triangulate(images, matches)
    rows = zip(points.image_ids.tolist(), points.keypoint_ids.tolist(), strict=True)
    xy_px = np.array([images[image].keypoints_px[row] for image, row in rows]).reshape(-1, 2)
    return _grey_points(points.xyz, points.point_ids, points.image_ids, points.keypoint_ids, xy_px)


def write_sift_database(path: Path, frames: Mapping[str, Frame], features: Features) -> None:
    """Write a COLMAP database of the frames' features; frames with equal cameras share one."""
    pycolmap = load_pycolmap()
    path.parent.mkdir(parents=True, exist_ok=True)
    camera_ids: dict[Camera, int] = {}
    database = pycolmap.Database.open(str(path))
    with pycolmap.DatabaseTransaction(database):
        for name, frame in sorted(frames.items()):
            if frame.camera not in camera_ids:
                camera_ids[frame.camera] = database.write_camera(colmap_camera(frame.camera))
            image = pycolmap.Image(name=name, camera_id=camera_ids[frame.camera])
            image_id = database.write_image(image)
            found = features[frame.name]
            database.write_keypoints(image_id, np.ascontiguousarray(found.keypoints_px))
            kind = pycolmap.FeatureExtractorType.SIFT
            rows = pycolmap.FeatureDescriptors(kind, np.ascontiguousarray(found.descriptors))
            database.write_descriptors(image_id, rows)
    database.close()


def nvm_model(names: Sequence[str], frames: Sequence[Frame], points: SparsePoints) -> NvmModel:
    """Return the frames as images of an NVM file, under the given names."""
    lenses = np.array([intrinsics(frame.camera) for frame in frames])
    return NvmModel(
        names=tuple(names),
        focal_px=lenses[:, 0],
        quat_wxyz=np.array([frame.cam_from_world.quat_wxyz for frame in frames]),
        centers=np.array([frame.cam_from_world.center() for frame in frames]),
        k_colmap=lenses[:, 4],
        points=points,
    )


def _world_points(frame: Frame, features: LocalFeatures, depth_m: Depth) -> Floats:
    """Return the world point of each feature, float64 (N, 3); NaN without depth."""
    xy = features.keypoints_px
    last = np.array(depth_m.shape[::-1]) - 1
    column, row = np.clip(xy.astype(np.int64), 0, last).T
    z = depth_m[row, column].astype(np.float64)
    z[z <= 0] = np.nan
    return frame.cam_from_world.inverse().apply(bearing_rays(frame.camera, xy) * z[:, None])


def _matches(
    frame: Frame, features: LocalFeatures, others: LocalFeatures, world: Floats
) -> NDArray[np.int64]:
    """Match ``features`` with world points ``world`` to those of another frame: (K, 2)."""
    px = px_from_cam(frame.camera, frame.cam_from_world.apply(world))
    inside = ((px > 0) & (px < (frame.camera.width, frame.camera.height))).all(axis=1)
    if inside.sum() < _MIN_SHARED:
        return np.zeros((0, 2), np.int64)
    matches, _ = match_nearest(features.descriptors, others.descriptors, _MATCHING)
    return matches[_near(frame, others, world, matches)]


def _near(
    frame: Frame, features: LocalFeatures, world: Floats, matches: NDArray[np.int64]
) -> Bools:
    """Select matches whose first feature's point projects to the second feature."""
    px = px_from_cam(frame.camera, frame.cam_from_world.apply(world[matches[:, 0]]))
    error = np.linalg.norm(px - features.keypoints_px[matches[:, 1]], axis=1)
    return np.asarray(error <= _MAX_ERROR_PX)  # False for NaN


@dataclass(frozen=True, eq=False)
class MapFrames:
    """Depth and features of the rendered map images, by image name.

    ``depths_m`` are float32 (H, W) along the optical axis, 0 without a surface. ``features`` are
    COLMAP's SIFT, empty if the models have exact points.
    """

    depths_m: Depths
    features: Features
    points_per_image: int

    def points(self, frames: Sequence[Frame], rng: np.random.Generator) -> SparsePoints:
        """Return :func:`sift_points` if there are features, else :func:`exact_tracks`."""
        if self.features:
            return sift_points(frames, self.features, self.depths_m)
        count = self.points_per_image
        return exact_tracks(frames, self.depths_m, points_per_frame=count, rng=rng)


def render_map_and_queries(
    options: ModelTwinOptions,
    mapping: Sequence[Frame],
    others: Sequence[Frame],
    images: Path,
    work: Work,
) -> MapFrames:
    """Render all frames and write them, by name, below ``images``."""
    names = frozenset(frame.name for frame in mapping)
    finish = partial(_write, images, names if options.model_features else frozenset())
    frames = [*mapping, *others]
    drawn = render_frames(options.world(), frames, finish, with_depth=names, work=work)
    return MapFrames(
        {name: depth for name, (depth, _) in drawn.items() if depth is not None},
        {name: features for name, (_, features) in drawn.items() if features is not None},
        options.points_per_image,
    )


def _write(
    images: Path, with_features: frozenset[str], frame: Frame, view: RenderedFrame
) -> tuple[Depth | None, LocalFeatures | None]:
    path = images / frame.name
    write_image(path, view.image, jpeg_quality=JPEG_QUALITY)
    # features are extracted from the written image, with its JPEG artefacts
    wanted = frame.name in with_features
    return view.depth_m, ColmapSift().extract(read_image_rgb(path)) if wanted else None
