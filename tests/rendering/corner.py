"""Exact images and depth of a corner of a room: two textured walls."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.io.images import write_depth_map, write_image
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 400, 300, (300.0, 302.0, 200.0, 150.0))
TEXTURE_PX_PER_M = 50
# origin, unit vector of the texture's columns, width and height in metres; rows go down (+y)
WALLS = (
    (np.array([-6.0, -4.0, 6.0]), np.array([1.0, 0.0, 0.0]), 8, 8),
    (np.array([2.0, -4.0, 6.0]), np.array([0.6, 0.0, -0.8]), 4, 8),
)
IDENTITY = RigidTransform.identity()


@cache
def wall_texture(width: int, height: int, seed: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3))
    for sigma in (1.5, 4.0, 12.0):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width, 3)), (0, 0), sigma)
        image += layer / layer.std()
    return np.clip(128 + 30 * image, 0, 255).astype(np.uint8)


def render(cam_from_world: RigidTransform, camera: Camera = CAMERA) -> NDArray[np.uint8]:
    """Render an image (H, W, 3), exact except for bilinear sampling."""
    fx, fy, cx, cy = camera.params
    # OpenCV's warp has pixel centres at integers, in the texture and in the image
    calibration = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    size = (camera.width, camera.height)
    image = np.full((camera.height, camera.width, 3), 128, dtype=np.uint8)
    for seed, (origin, along, width, height) in enumerate(WALLS):
        texture = wall_texture(width * TEXTURE_PX_PER_M, height * TEXTURE_PX_PER_M, seed)
        world_from_texture = np.column_stack(
            [along / TEXTURE_PX_PER_M, [0, 1 / TEXTURE_PX_PER_M, 0], origin]
        )
        in_cam = cam_from_world.rotation_matrix() @ world_from_texture
        in_cam[:, 2] += cam_from_world.translation
        homography = calibration @ in_cam @ centre
        seen = cv2.warpPerspective(texture, homography, size, flags=cv2.INTER_LINEAR)
        inside = cv2.warpPerspective(np.full_like(texture, 255), homography, size) == 255
        image = np.where(inside.all(axis=2, keepdims=True), seen, image)
    return image


def depth_m(cam_from_world: RigidTransform, camera: Camera = CAMERA) -> NDArray[np.float32]:
    """Render the depth (H, W) along the optical axis in metres; 0 outside the walls."""
    fx, fy, cx, cy = camera.params
    x = (np.arange(camera.width) + 0.5 - cx) / fx
    y = (np.arange(camera.height) + 0.5 - cy) / fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)
    nearest = np.full(rays.shape[:2], np.inf)
    down = np.array([0.0, 1.0, 0.0])
    for origin, along, width, height in WALLS:
        rotation = cam_from_world.rotation_matrix()
        corner = rotation @ origin + np.array(cam_from_world.translation)
        normal = rotation @ np.cross(along, down)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (normal @ corner) / (rays @ normal)
        hit = rays * depth[..., None] - corner
        column, row = hit @ (rotation @ along), hit @ (rotation @ down)
        on_wall = (column >= 0) & (column <= width) & (row >= 0) & (row <= height) & (depth > 0)
        nearest = np.where(on_wall & (depth < nearest), depth, nearest)
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)


def distance_to_walls(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances in metres (N,) of points (N, 3) to the plane of the nearer wall."""
    normals = [np.cross(along, [0.0, 1.0, 0.0]) for _, along, _, _ in WALLS]
    distances = [np.abs((points - WALLS[k][0]) @ normal) for k, normal in enumerate(normals)]
    return np.min(distances, axis=0)


def pose_at(center: ArrayLike, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> RigidTransform:
    rotation = Rotation.from_euler("xy", [pitch_deg, yaw_deg], degrees=True).as_matrix()
    return RigidTransform.from_matrix(rotation, -rotation @ np.array(center))


def write_kapture(
    root: Path,
    poses: dict[str, RigidTransform],
    *,
    with_poses: bool,
    with_images: bool = True,
    with_depth: bool = False,
    first_timestamp: int = 0,
    world_from_room: RigidTransform = IDENTITY,
) -> None:
    """Write rendered images as a kapture, with the depth of each where it is asked for."""
    data = KaptureData(sensors={"cam": Sensor.from_camera(CAMERA)})
    if with_depth:
        data.sensors["depth"] = Sensor.from_camera(CAMERA, sensor_type="depth")
        data.rigs["both"] = {"cam": IDENTITY, "depth": IDENTITY}
    for timestamp, (image, pose) in enumerate(poses.items(), start=first_timestamp):
        data.records_camera[timestamp, "cam"] = image
        if with_poses:
            data.trajectories[timestamp, "cam"] = pose
        if with_images:
            path = root / "sensors" / "records_data" / image
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, render(pose @ world_from_room))
            if with_depth:
                data.records_depth[timestamp, "depth"] = f"{image}.depth"
                write_depth_map(f"{path}.depth", depth_m(pose @ world_from_room))
    write_sensors(root, data)


def write_scene(root: Path, *, with_depth: bool = False) -> None:
    """Write ``mapping/`` of seven images, ``query/`` of four and their poses, ``query_gt/``.

    The camera walks along the wall; the images are numbered in its order, 0000.jpg to 0010.jpg.
    The world's axes are not the room's, and its origin is elsewhere.
    """
    world_from_room = pose_at((20.0, 3.0, -30.0), 70, -35)
    room_from_world = world_from_room.inverse()
    walk = {
        f"{step:04}.jpg": pose_at(
            (-1.6 + 0.32 * step, 0.2 * (-1) ** step, 0.1 * (step % 4)), step - 5.0, step % 3 - 1.0
        )
        @ room_from_world
        for step in range(11)
    }
    queries = {name: walk.pop(name) for name in ("0001.jpg", "0004.jpg", "0007.jpg", "0010.jpg")}
    write = partial(write_kapture, world_from_room=world_from_room)
    write(root / "mapping", walk, with_poses=True, with_depth=with_depth)
    write(root / "query", queries, with_poses=False, with_depth=with_depth, first_timestamp=7)
    write(root / "query_gt", queries, with_poses=True, with_images=False, first_timestamp=7)
