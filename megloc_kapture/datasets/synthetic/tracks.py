"""Points of a rendered world and where its images see them, exactly: models for the twins.

The twins' official layouts come with a sparse model. Its points are lifted from the depth of the
rendered images, and its features are their projections, so that the model is as exact as float32
pixels allow; no detector and no triangulation is involved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.sparse_points import SparsePoints
from megloc_kapture.datasets.synthetic.render import project, sample_grid
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.values import Camera

_BORDER_PX = 2.0  # no feature nearer to the border
# between a point's depth and that of the pixel it falls into; surfaces seen at a slant need it
_DEPTH_TOLERANCE = 0.01
_DEPTH_TOLERANCE_M = 0.02
_GREY = 128  # the depth knows no colour

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def exact_tracks(
    shots: Sequence[Shot],
    depths_m: Mapping[str, NDArray[np.float32]],
    *,
    points_per_shot: int,
    rng: np.random.Generator,
) -> SparsePoints:
    """Sparse points that at least two of the shots see, with exact observations.

    Pixels with depth are drawn at random in every shot, lifted to the frame of the shots' poses
    and projected into all shots of the same place whose depth agrees.

    Parameters
    ----------
    shots : PINHOLE, SIMPLE_PINHOLE or SIMPLE_RADIAL cameras.
    depths_m : float32 (H, W) along the optical axis by image name, one for each shot, 0 where
        nothing is seen.
    points_per_shot : pixels drawn in each shot; those that no other shot sees give no point.
    rng : draws the pixels.

    Returns
    -------
    ``xyz`` in the frame of the shots' poses, all grey; observations sorted by point, then image;
    ``image_ids`` count in ``shots``, ``feature_ids`` from 0 in each image; ``xy_px`` are the
    projections rounded to float32.
    """
    xyz: list[Floats] = [np.zeros((0, 3))]
    point_ids: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
    image_ids: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
    xy_px: list[Floats] = [np.zeros((0, 2))]
    num_points = 0
    for shot in shots:
        # those of other places stand behind walls
        here = [index for index, other in enumerate(shots) if other.place == shot.place]
        points = _lifted(shot, depths_m[shot.name], points_per_shot, rng)
        seen, px = _observations([shots[index] for index in here], depths_m, points)
        seen, px, points = _kept(seen, px, points)
        of_point, of_image = np.nonzero(seen)
        xyz.append(points)
        point_ids.append(of_point + num_points)
        image_ids.append(np.array(here, np.int64)[of_image])
        xy_px.append(px[of_point, of_image])
        num_points += len(points)
    images = np.concatenate(image_ids)
    return SparsePoints(
        xyz=np.concatenate(xyz),
        rgb=np.full((num_points, 3), _GREY, np.uint8),
        point_ids=np.concatenate(point_ids),
        image_ids=images.astype(np.int32),
        feature_ids=_ranks(images),
        xy_px=np.concatenate(xy_px).astype(np.float32),
    )


def _lifted(
    shot: Shot, depth_m: NDArray[np.float32], count: int, rng: np.random.Generator
) -> Floats:
    """World points (P, 3), P <= count, of random pixels that have depth."""
    rows, columns = np.nonzero(depth_m > 0)
    drawn = rng.permutation(len(rows))[:count]
    rows, columns = rows[drawn], columns[drawn]
    x, y = _rays(shot.camera)
    z = depth_m[rows, columns].astype(np.float64)
    in_camera = np.stack([x[rows, columns] * z, y[rows, columns] * z, z], axis=1)
    return shot.cam_from_world.inverse().apply(in_camera)


def _observations(
    shots: Sequence[Shot], depths_m: Mapping[str, NDArray[np.float32]], points: Floats
) -> tuple[Bools, Floats]:
    """Which points (P, 3) which shots see, bool (P, S), and at which pixels, float64 (P, S, 2)."""
    seen = np.zeros((len(points), len(shots)), bool)
    pixels = np.zeros((len(points), len(shots), 2))
    for column, shot in enumerate(shots):
        in_camera = shot.cam_from_world.apply(points)
        ahead = _in_field(shot.camera, in_camera)
        px = project(shot.camera, np.where(ahead[:, None], in_camera, [0.0, 0.0, 1.0]))
        size = np.array([shot.camera.width, shot.camera.height])
        inside = ahead & ((px >= _BORDER_PX) & (px <= size - _BORDER_PX)).all(1)
        where = np.where(inside[:, None], px, 0.0).astype(np.int64)
        z = in_camera[:, 2]
        error = np.abs(depths_m[shot.name][where[:, 1], where[:, 0]] - z)
        seen[:, column] = inside & (error < _DEPTH_TOLERANCE * z + _DEPTH_TOLERANCE_M)
        pixels[:, column] = px
    return seen, pixels


def _in_field(camera: Camera, in_camera: Floats) -> Bools:
    """Which points lie ahead and no farther from the axis than the image's corners.

    Farther out the distortion need not be monotonous and may fold a point back into the image.
    """
    x, y = _rays(camera)
    limit = float((x**2 + y**2).max())
    z = in_camera[:, 2]
    return np.asarray((z > 0) & ((in_camera[:, :2] ** 2).sum(1) <= limit * z**2), np.bool_)


def _rays(camera: Camera) -> tuple[Floats, Floats]:
    """Normalised coordinates of the pixels' centres, two of float64 (H, W)."""
    grid = sample_grid(camera, 1)
    return np.broadcast_to(grid.x, grid.shape), np.broadcast_to(grid.y, grid.shape)


def _kept(seen: Bools, pixels: Floats, points: Floats) -> tuple[Bools, Floats, Floats]:
    """What at least two images see."""
    enough = seen.sum(1) >= 2
    return seen[enough], pixels[enough], points[enough]


def _ranks(images: NDArray[np.int64]) -> NDArray[np.int32]:
    """For each observation how many of its image precede it."""
    order = np.argsort(images, kind="stable")
    ordered = images[order]
    first = np.searchsorted(ordered, ordered)
    ranks = np.empty(len(images), np.int32)
    ranks[order] = np.arange(len(images)) - first
    return ranks
