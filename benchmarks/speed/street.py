"""A street of points, and the images of a car that looks to its left: maps of any size.

Images follow each other at equal steps, and so do the points they see: the map is as long as it
has images, and each point is seen by equally many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import project
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 1600, 1200, (1000.0, 1000.0, 800.0, 600.0))
STEP_M = 1.0
GAP_M = 1000.0  # between parts
# x to the right along the street, y down, z away from it
LOOKING_LEFT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Street:
    """The points, and what the images see of them.

    Attributes
    ----------
    xyz : float64 (N, 3), from one end of the street to the other.
    poses : ``cam_from_world`` of each image.
    first : int64 (I,); image i sees the points from first[i] on.
    num_seen : how many points each image sees.
    num_keypoints : of an image; ``num_seen`` of them see a point.
    """

    xyz: NDArray[np.float64]
    poses: tuple[RigidTransform, ...]
    first: NDArray[np.int64]
    num_seen: int
    num_keypoints: int

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"map/{i:06d}.jpg" for i in range(len(self.poses)))

    def seen(self, image: int) -> NDArray[np.int64]:
        """The points (num_seen,) that an image sees."""
        return self.first[image] + np.arange(self.num_seen)

    def keypoints_of_seen(self, image: int) -> NDArray[np.int64]:
        """The keypoint (num_seen,) of an image for each point it sees, in their order."""
        rng = np.random.default_rng([1, image])
        return rng.permutation(self.num_keypoints)[: self.num_seen]

    def observations(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Images, keypoints and points (O,), sorted by point."""
        count = len(self.poses)
        images = np.repeat(np.arange(count), self.num_seen)
        keypoints = np.concatenate([self.keypoints_of_seen(i) for i in range(count)])
        points = np.concatenate([self.seen(i) for i in range(count)])
        order = np.argsort(points, kind="stable")
        return images[order], keypoints[order], points[order]

    def keypoints_px(self, image: int) -> NDArray[np.float32]:
        """Keypoints (num_keypoints, 2) of an image: of points where it sees some, else anywhere."""
        rng = np.random.default_rng([2, image])
        px = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (self.num_keypoints, 2))
        xyz = self.xyz[self.seen(image)]
        px[self.keypoints_of_seen(image)] = project(CAMERA, self.poses[image], xyz)
        return px.astype(np.float32)

    def index(self) -> MapIndex:
        """The map's index, as reading it from files would make it."""
        images, keypoints, points = self.observations()
        return MapIndex.build(self.xyz, self.names, images, keypoints, points)


def make_street(
    num_images: int, num_points: int, num_seen: int, num_keypoints: int, num_parts: int = 1
) -> Street:
    """A street of that size, in parts a kilometre from each other; the same every time."""
    rng = np.random.default_rng(0)
    length = num_images * STEP_M
    xyz = np.stack(
        [
            np.sort(rng.uniform(0.0, length, num_points)),
            rng.uniform(5.0, 15.0, num_points),
            rng.uniform(-3.0, 5.0, num_points),
        ],
        axis=1,
    )
    middles = (np.arange(num_images) + 0.5) * STEP_M
    part, part_of_point = ((x * num_parts / length).astype(np.int64) for x in (middles, xyz[:, 0]))
    bounds = np.searchsorted(part_of_point, np.arange(num_parts + 1))
    xyz[:, 0] += part_of_point * GAP_M
    places = middles + part * GAP_M
    poses = tuple(looking_left(x, 0.0, 0.0, 0.0) for x in places.tolist())
    nearest = np.round(middles * num_points / length - num_seen / 2)
    first = np.clip(nearest, bounds[part], bounds[part + 1] - num_seen).astype(np.int64)
    return Street(xyz, poses, first, num_seen, num_keypoints)


def looking_left(x: float, y: float, z: float, angle_rad: float) -> RigidTransform:
    """``cam_from_world`` at a place of the street, turned about the vertical."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    rotation = turn @ LOOKING_LEFT
    return RigidTransform.from_matrix(rotation, -rotation @ np.array([x, y, z]))


def random_pose(street: Street, rng: np.random.Generator, margin: int) -> RigidTransform:
    """A query's pose, at least ``margin`` images from the street's ends."""
    x = rng.uniform(margin, len(street.poses) - margin) * STEP_M
    return looking_left(x, rng.uniform(-1, 1), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3))


def pose_near(street: Street, rng: np.random.Generator, image: int) -> RigidTransform:
    """A query's pose within half a step of an image."""
    x = street.poses[image].center()[0] + rng.uniform(-0.5, 0.5) * STEP_M
    return looking_left(x, rng.uniform(-1, 1), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3))


def nearest_images(street: Street, place: float, count: int) -> NDArray[np.int64]:
    """The ``count`` images nearest to a place along the street, in metres; nearest first."""
    places = (np.arange(len(street.poses)) + 0.5) * STEP_M
    return np.argsort(np.abs(places - place), kind="stable")[:count]


def in_view(pose: RigidTransform, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N, 3) a query sees."""
    px = project(CAMERA, pose, xyz)
    inside = (px > 0) & (px < (CAMERA.width, CAMERA.height))
    return np.asarray(inside.all(axis=1))
