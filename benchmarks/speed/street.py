"""Synthetic maps of any size: a street of points seen by a car's left-facing camera.

Images and the points they see advance in equal steps, so the length of the street is proportional
to the number of images, and the number of images per point is constant.
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
# x to the right along the street, y down, z away from it
LOOKING_LEFT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Street:
    """Points and images of a street.

    Attributes
    ----------
    xyz : float64 (N, 3), ordered along the street.
    poses : ``cam_from_world`` of each image.
    first : int64 (I,); image i sees the points first[i] to first[i] + num_seen - 1.
    num_seen : number of points per image.
    num_keypoints : number of keypoints per image; ``num_seen`` of them observe a point.
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
        """Return the points (num_seen,) that an image sees."""
        return self.first[image] + np.arange(self.num_seen)

    def keypoints_of_seen(self, image: int) -> NDArray[np.int64]:
        """Return the keypoint (num_seen,) of each point that an image sees."""
        rng = np.random.default_rng([1, image])
        return rng.permutation(self.num_keypoints)[: self.num_seen]

    def observations(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return images, keypoints and points (O,), sorted by point."""
        count = len(self.poses)
        images = np.repeat(np.arange(count), self.num_seen)
        keypoints = np.concatenate([self.keypoints_of_seen(i) for i in range(count)])
        points = np.concatenate([self.seen(i) for i in range(count)])
        order = np.argsort(points, kind="stable")
        return images[order], keypoints[order], points[order]

    def keypoints_px(self, image: int) -> NDArray[np.float32]:
        """Return keypoints (num_keypoints, 2): projections of seen points, and random ones."""
        rng = np.random.default_rng([2, image])
        px = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (self.num_keypoints, 2))
        xyz = self.xyz[self.seen(image)]
        px[self.keypoints_of_seen(image)] = project(CAMERA, self.poses[image], xyz)
        return px.astype(np.float32)

    def index(self) -> MapIndex:
        """Build the index of the map, equal to the index read from files."""
        images, keypoints, points = self.observations()
        return MapIndex.build(self.xyz, self.names, images, keypoints, points)


def make_street(num_images: int, num_points: int, num_seen: int, num_keypoints: int) -> Street:
    """Build a street; deterministic."""
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
    along_m = (np.arange(num_images) + 0.5) * STEP_M
    poses = tuple(looking_left(x, 0.0, 0.0, 0.0) for x in along_m.tolist())
    nearest = np.round(along_m * num_points / length - num_seen / 2)
    first = np.clip(nearest, 0, num_points - num_seen).astype(np.int64)
    return Street(xyz, poses, first, num_seen, num_keypoints)


def looking_left(x: float, y: float, z: float, angle_rad: float) -> RigidTransform:
    """Return ``cam_from_world`` at a position, rotated about the vertical."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    yaw = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    rotation = yaw @ LOOKING_LEFT
    return RigidTransform.from_matrix(rotation, -rotation @ np.array([x, y, z]))


def random_pose(street: Street, rng: np.random.Generator, margin: int) -> RigidTransform:
    """Draw a query pose at least ``margin`` images from the ends of the street."""
    x = rng.uniform(margin, len(street.poses) - margin) * STEP_M
    return looking_left(x, rng.uniform(-1, 1), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3))


def nearest_images(street: Street, x: float, count: int) -> NDArray[np.int64]:
    """Return the ``count`` images nearest to ``x`` metres along the street, nearest first."""
    along_m = (np.arange(len(street.poses)) + 0.5) * STEP_M
    return np.argsort(np.abs(along_m - x), kind="stable")[:count]


def in_view(pose: RigidTransform, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Test which points (N, 3) project into the image."""
    px = project(CAMERA, pose, xyz)
    inside = (px > 0) & (px < (CAMERA.width, CAMERA.height))
    return np.asarray(inside.all(axis=1))
