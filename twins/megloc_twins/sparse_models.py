"""Sparse models of a rendered world, with exact tracks.

The official layouts include a model. Its points are lifted from rendered depth and projected, so
the model is as exact as float32 pixels allow.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.random import Generator

from megloc_kapture.datasets.nvm import NvmModel
from megloc_kapture.io.colmap import load_pycolmap, new_colmap_camera, new_colmap_pose
from megloc_kapture.io.colmap_model import ColmapModel, SparsePoints
from megloc_kapture.values import Camera
from megloc_twins.frames import Frame
from megloc_twins.options import write_lines
from megloc_twins.portable import Bools, Float32, Float64
from megloc_twins.rasterization import intrinsics, project, sample_grid

_BORDER_PX = 2.0  # smallest distance of a feature from the image border
# tolerated difference of a point's depth from its pixel's, relative plus absolute; slanted
# surfaces need it
_DEPTH_TOLERANCE = 0.01
_DEPTH_TOLERANCE_M = 0.02
_GREY = 128  # depth maps have no colours

Depths = Mapping[str, Float32]


def exact_tracks(
    frames: Sequence[Frame], depths_m: Depths, rng: Generator, *, points_per_frame: int = 100
) -> SparsePoints:
    """Create sparse points seen in at least two frames, with exact observations.

    Pixels with depth are drawn at random in every frame, lifted to world points and projected into
    all frames of the same place whose depth agrees. Depth, (H, W) by image name, is 0 without a
    surface. Observations are sorted by point, then image; ``feature_ids`` count from 0 per image.
    """
    parts = [SparsePoints.none()]
    for frame in frames:
        # walls hide other places
        here = [index for index, other in enumerate(frames) if other.place == frame.place]
        points = _lifted(frame, depths_m[frame.name], points_per_frame, rng)
        seen, px = _observations([frames[index] for index in here], depths_m, points)
        enough = seen.sum(1) >= 2
        of_point, of_image = np.nonzero(seen[enough])
        rgb = np.full((np.count_nonzero(enough), 3), _GREY, np.uint8)
        image_ids = np.array(here, np.int32)[of_image]
        feature_ids = np.zeros_like(image_ids)  # numbered below
        xy_px = px[enough][of_point, of_image].astype(np.float32)
        parts.append(SparsePoints(points[enough], rgb, of_point, image_ids, feature_ids, xy_px))
    joined = SparsePoints.joined(parts)
    for image in np.unique(joined.image_ids):
        of_image = joined.image_ids == image
        joined.feature_ids[of_image] = np.arange(np.count_nonzero(of_image))
    return joined


def _lifted(frame: Frame, depth_m: Float32, count: int, rng: Generator) -> Float64:
    """Lift random pixels with depth to world points (P, 3), P <= count."""
    rows, columns = np.nonzero(depth_m > 0)
    drawn = rng.permutation(len(rows))[:count]
    rows, columns = rows[drawn], columns[drawn]
    z = depth_m[rows, columns].astype(np.float64)
    in_camera = sample_grid(frame.camera, 1).rays()[rows, columns] * z[:, None]
    return frame.cam_from_world.inverse().apply(in_camera)


def _observations(frames: list[Frame], depths_m: Depths, points: Float64) -> tuple[Bools, Float64]:
    """Return visibility, bool (P, S), of points (P, 3) in frames, and pixels, float64 (P, S, 2)."""
    seen = np.zeros((len(points), len(frames)), bool)
    pixels = np.zeros((len(points), len(frames), 2))
    for column, frame in enumerate(frames):
        in_camera = frame.cam_from_world.apply(points)
        z, squared_radius = in_camera[:, 2], (in_camera[:, :2] ** 2).sum(1)
        # beyond the corners the distortion may be non-monotonic and project a point into the image
        ahead = (z > 0) & (squared_radius <= _squared_reach(frame.camera) * z**2)
        px = project(frame.camera, np.where(ahead[:, None], in_camera, [0.0, 0.0, 1.0]))
        size = np.array([frame.camera.width, frame.camera.height])
        inside = ahead & ((px >= _BORDER_PX) & (px <= size - _BORDER_PX)).all(1)
        where = np.where(inside[:, None], px, 0.0).astype(np.int64)
        error = np.abs(depths_m[frame.name][where[:, 1], where[:, 0]] - z)
        seen[:, column] = inside & (error < _DEPTH_TOLERANCE * z + _DEPTH_TOLERANCE_M)
        pixels[:, column] = px
    return seen, pixels


@cache
def _squared_reach(camera: Camera) -> float:
    """Return the largest squared distance of a pixel's ray from the axis at depth 1."""
    grid = sample_grid(camera, 1)
    return float((grid.x**2 + grid.y**2).max())


def as_nvm(names: Sequence[str], frames: Sequence[Frame], points: SparsePoints) -> NvmModel:
    """Return the frames as images of an NVM file, under the given names."""
    lenses = np.array([intrinsics(frame.camera) for frame in frames])
    focal_px, k_colmap = lenses[:, 0], lenses[:, 4]
    quat_wxyz = np.array([frame.cam_from_world.quat_wxyz for frame in frames])
    centers = np.array([frame.cam_from_world.center() for frame in frames])
    return NvmModel(tuple(names), focal_px, quat_wxyz, centers, k_colmap, points)


def write_nvm(path: Path, model: NvmModel) -> None:
    """Write one model as COLMAP's exporter does: k with NVM's sign, pixels unchanged."""
    points = model.points
    columns = model.focal_px, model.quat_wxyz, model.centers, 0.0 - model.k_colmap
    lines = ["NVM_V3 ", " ", f"{len(model.names)}  "]
    for name, row in zip(model.names, np.column_stack(columns).tolist(), strict=True):
        lines.append(f"{name} {' '.join(map(repr, row))} 0")
    lines += ["", str(len(points))]
    rows = points.image_ids.tolist(), points.feature_ids.tolist(), points.xy_px.astype(str)
    seen = [f" {image} {feature} {x} {y}" for image, feature, (x, y) in zip(*rows, strict=True)]
    for xyz, rgb, track in _tracks(points):
        numbers = " ".join(map(repr, (*xyz, *rgb, len(seen[track]))))
        lines.append(numbers + "".join(seen[track]))
    write_lines(path, lines)


def write_colmap_model(folder: Path, model: ColmapModel, *, text: bool) -> None:
    """Write a model without rigs, as published, in COLMAP's text or binary form.

    Points get the ids 1, 2, ... Features without a point are at (0, 0).
    """
    pycolmap = load_pycolmap()
    written, points = pycolmap.Reconstruction(), model.points
    for camera_id, camera in model.cameras.items():
        of_colmap = new_colmap_camera(camera)
        of_colmap.camera_id = camera_id
        written.add_camera_with_trivial_rig(of_colmap)
    for position, image in enumerate(model.images):
        rows = points.image_ids == position
        ids = points.feature_ids[rows]
        xy_px = np.zeros((int(ids.max(initial=-1)) + 1, 2))
        xy_px[ids] = points.xy_px[rows]
        written.add_image_with_trivial_frame(
            pycolmap.Image(image.name, xy_px, image.camera_id, image.image_id),
            new_colmap_pose(image.cam_from_world),
        )
    for xyz, rgb, track in _tracks(points):
        of_image = [model.images[position].image_id for position in points.image_ids[track]]
        elements = map(pycolmap.TrackElement, of_image, points.feature_ids[track].tolist())
        written.add_point3D(np.array(xyz), pycolmap.Track(list(elements)), np.array(rgb, np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    (written.write_text if text else written.write_binary)(folder)
    for name in ("rigs", "frames"):
        (folder / f"{name}.{'txt' if text else 'bin'}").unlink()


def _tracks(points: SparsePoints) -> Iterator[tuple[list[float], list[int], slice]]:
    """Yield position, colour and observation rows of each point."""
    ends = np.searchsorted(points.point_ids, np.arange(len(points) + 1)).tolist()
    tracks = map(slice, ends[:-1], ends[1:])
    return zip(points.xyz.tolist(), points.rgb.tolist(), tracks, strict=True)
