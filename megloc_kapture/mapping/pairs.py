"""Pairs of map images: by poses, co-visibility or sequence, and the overlap of their views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from megloc_kapture.geometry.cameras import bearing_rays, px_from_cam
from megloc_kapture.values import Camera, Options, RigidTransform

# largest number of neighbours that are searched for similar viewing directions
_MAX_SEARCHED = 1024
_IMAGES_AT_ONCE = 256
# tested points: number of pixels across and down, and depths as multiples of the baseline
_GRID = (9, 7)
_DEPTHS = 2.0 ** np.arange(-2, 8, 0.5)


def exhaustive_pairs(count: int) -> NDArray[np.int64]:
    """Return all pairs i < j of ``count`` images, int64 (P, 2), sorted."""
    return np.stack(np.triu_indices(count, 1), axis=1).astype(np.int64)


def unique_pairs(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return distinct pairs (P, 2) with i < j, sorted."""
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    # sorting is faster if a pair is one number
    base = int(high.max(initial=0)) + 1
    keys = np.unique((low * base + high)[low != high])
    return np.stack(np.divmod(keys, base), axis=1)


class PairsByPosesOptions(Options):
    """Options for pairs by poses; they count neighbours, so the scale need not be metric."""

    num_neighbours: int = Field(
        default=20, gt=0, description="number of nearest camera centres per image"
    )
    max_angle_deg: float = Field(
        default=60.0, gt=0, le=180, description="largest angle between optical axes"
    )


def pairs_by_poses(
    cams_from_world: list[RigidTransform], options: PairsByPosesOptions
) -> NDArray[np.int64]:
    """Return pairs (P, 2) of nearby images with similar viewing directions, i < j, sorted.

    The search extends to more and more neighbours in a k-d tree, at most the 1024 nearest centres
    (or ``num_neighbours``, if larger).
    """
    count, wanted = len(cams_from_world), options.num_neighbours
    if count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    centers = np.array([pose.center() for pose in cams_from_world])
    axes = np.array([pose.rotation_matrix()[2] for pose in cams_from_world])
    min_cosine = np.cos(np.radians(options.max_angle_deg)) - 1e-12
    tree = cKDTree(centers)
    # plus one, as an image is its own nearest neighbour
    largest = min(count, max(_MAX_SEARCHED, wanted) + 1)
    sizes = [min(largest, 4 * wanted + 1)]
    while sizes[-1] < largest:
        sizes.append(min(largest, 2 * sizes[-1]))
    parts = []
    for image in range(count):
        for size in sizes:  # if neighbours look in different directions, search more of them
            near = tree.query(centers[image], k=size)[1]
            similar = axes[near] @ axes[image] >= min_cosine
            chosen = near[similar & (near != image)][:wanted]
            if len(chosen) == wanted:
                break
        parts.append(np.stack([np.full(len(chosen), image), chosen], axis=1))
    return unique_pairs(np.concatenate(parts))


# smallest number of shared points, equal to the smallest number of matches of a verified pair
_MIN_SHARED_POINTS = 15


class PairsByCovisibilityOptions(Options):
    top_k: int = Field(default=20, gt=0, description="number of most co-visible images per image")


def pairs_by_covisibility(
    num_images: int,
    point_ids: NDArray[np.integer[Any]],
    image_ids: NDArray[np.integer[Any]],
    options: PairsByCovisibilityOptions,
) -> NDArray[np.int64]:
    """Pair each image with those that share the most points; int64 (P, 2), i < j, sorted.

    Observations (O,) are in any order.
    """
    parts = [np.zeros((0, 2), dtype=np.int64)]
    ones, num_points = np.ones(len(point_ids), np.int32), int(point_ids.max(initial=-1)) + 1
    images_by_points = csr_array((ones, (image_ids, point_ids)), (num_images, num_points))
    images_by_points.data[:] = 1  # repeated observations count once
    points_by_images = images_by_points.T.tocsr()
    for start in range(0, num_images, _IMAGES_AT_ONCE):
        shared = (images_by_points[start : start + _IMAGES_AT_ONCE] @ points_by_images).tocoo()
        images, others = shared.coords[0].astype(np.int64) + start, shared.coords[1]
        enough = (shared.data >= _MIN_SHARED_POINTS) & (images != others)
        images, others, counts = images[enough], others[enough], shared.data[enough]
        order = np.lexsort((others, -counts, images))
        images, others = images[order], others[order]
        best = np.arange(len(images)) - np.searchsorted(images, images) < options.top_k
        parts.append(np.stack([images[best], others[best]], axis=1))
    return unique_pairs(np.concatenate(parts))


class PairsBySequenceOptions(Options):
    window: int = Field(
        default=5, gt=0, description="number of following images that each image is paired with"
    )
    loop: bool = Field(default=False, description="the first image follows the last one")


def pairs_by_sequence(
    cameras: Sequence[str], timestamps: Sequence[int], options: PairsBySequenceOptions
) -> NDArray[np.int64]:
    """Pair each image with the next images of its camera; int64 (P, 2), i < j, sorted."""
    sequences: dict[str, list[int]] = {}
    for image in sorted(range(len(cameras)), key=lambda image: timestamps[image]):
        sequences.setdefault(cameras[image], []).append(image)
    parts = [np.zeros((0, 2), dtype=np.int64)]
    for sequence in sequences.values():
        images = np.array(sequence, dtype=np.int64)
        for step in range(1, min(options.window, len(images) - 1) + 1):
            parts.append(np.stack([images[:-step], images[step:]], axis=1))
            if options.loop:
                parts.append(np.stack([images[-step:], images[:step]], axis=1))
    return unique_pairs(np.concatenate(parts))


def views_can_overlap(
    first: Camera,
    first_from_world: RigidTransform,
    second: Camera,
    second_from_world: RigidTransform,
) -> bool:
    """Return True if a point in one camera's view may be in the other's.

    The test points are on rays of a pixel grid, at depths from a quarter of the baseline to
    infinity.
    """
    between = second_from_world @ first_from_world.inverse()
    return _reaches(first, second, between) or _reaches(second, first, between.inverse())


def _reaches(first: Camera, second: Camera, second_from_first: RigidTransform) -> bool:
    x, y = np.meshgrid(
        np.linspace(0, first.width, _GRID[0]), np.linspace(0, first.height, _GRID[1])
    )
    rays = bearing_rays(first, np.stack([x.ravel(), y.ravel()], axis=1))
    turned = rays @ second_from_first.rotation_matrix().T
    offset = np.asarray(second_from_first.translation)
    depths = _DEPTHS * np.linalg.norm(offset)
    # the rays themselves are points at infinity, where only the rotation matters
    points = [turned, *(turned * depth + offset for depth in depths[depths > 0])]
    with np.errstate(invalid="ignore"):
        seen = px_from_cam(second, np.concatenate(points))
        inside = ((seen >= 0) & (seen <= (second.width, second.height))).all(axis=1)
    return bool(inside.any())
