"""Worlds with a map and true query poses, and everybody's way to write poses down wrongly.

Poses are turned and written with scipy's rotations and plain matrices, not with what is tested.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.check.reading import MapCameras, Reference, read_reference
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.io.dataset_tables import ImageGroup
from megloc_kapture.io.kapture import KaptureFolder

OPENGL = np.diag([1.0, -1.0, -1.0])
# x, y, z of the file are x, z, -y of the map: y up instead of z up
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Scene:
    """A map and the true poses of queries in it, as ``cam_from_world``."""

    map_rotations: np.ndarray
    map_centers: np.ndarray
    rotations: np.ndarray
    centers: np.ndarray
    size: float
    map_frames: tuple[str, ...] = ()
    query_frames: tuple[str, ...] = ()
    names: tuple[str, ...] = field(default=())

    def query_names(self) -> tuple[str, ...]:
        return self.names or tuple(f"q/{i:05d}.jpg" for i in range(len(self.centers)))

    def reference(self) -> Reference:
        """The map as it is read from an import."""
        images = tuple(f"m/{i:05d}.jpg" for i in range(len(self.map_centers)))
        queries = self.query_names()
        of_images = zip(images, self.map_frames, strict=False)
        of_queries = zip(queries, self.query_frames, strict=False)
        groups = {image: ImageGroup(frame=frame) for image, frame in of_images}
        groups |= {query: ImageGroup(condition=frame) for query, frame in of_queries}
        return Reference(
            folder="import",
            groups=groups,
            expected={name: name for name in queries},
            queries=frozenset(queries),
            cameras=MapCameras(images, quats_of(self.map_rotations), self.map_centers),
        )

    def disturbed(self, *, wrong: float, noise: float, angle_deg: float, seed: int = 0) -> Scene:
        """A share of poses truly wrong, a fifth of them gone, the others noisy."""
        rng = np.random.default_rng(seed)
        number = len(self.centers)
        turn = Rotation.from_rotvec(np.deg2rad(rng.normal(0, angle_deg / 1.7, (number, 3))))
        rotations = turn.as_matrix() @ self.rotations
        centers = self.centers + rng.normal(0, noise / 1.7, (number, 3))
        bad = rng.permutation(number)[: int(wrong * number)]
        rotations[bad] = Rotation.random(len(bad), random_state=seed).as_matrix()
        centers[bad] = rng.uniform(-1.5 * self.size, 1.5 * self.size, (len(bad), 3))
        centers[bad] += self.map_centers.mean(axis=0)
        kept = np.sort(rng.permutation(number)[: int(0.8 * number)])
        return replace(
            self,
            rotations=rotations[kept],
            centers=centers[kept],
            query_frames=tuple(np.array(self.query_frames)[kept]) if self.query_frames else (),
            names=tuple(np.array(self.query_names())[kept]),
        )


def quats_of(rotations: np.ndarray) -> np.ndarray:
    """w x y z."""
    return np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=1)


def level_cameras(yaw: np.ndarray, pitch: float | np.ndarray = 0.0) -> np.ndarray:
    """Rotations of cameras that stand upright where z is up; rows are right, down, forward."""
    pitch = pitch + 0 * yaw
    forward = np.stack(
        [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=1
    )
    right = np.stack([np.sin(yaw), -np.cos(yaw), 0 * yaw], axis=1)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def street(rng: np.random.Generator) -> Scene:
    """A rig of three cameras driven along a bend, all at one height; queries to the rear."""
    along = np.arange(0, 600, 2.0)
    path = np.stack([200 * np.sin(along / 150), along, np.full_like(along, 1.5)], axis=1)
    path += [620_000.0, 5_735_000.0, 100.0]
    head = np.arctan2(np.gradient(path[:, 1]), np.gradient(path[:, 0]))
    views = [
        level_cameras(head + turn, pitch) for turn, pitch in ((1.6, 0), (3.1, -0.2), (-1.6, 0))
    ]
    at = rng.choice(len(path), 80)
    side = rng.normal(0, 2, (80, 1)) * np.stack([-np.sin(head[at]), np.cos(head[at]), 0 * at], 1)
    return Scene(
        np.concatenate(views),
        np.concatenate([path, path + [0, 0, 0.3], path]),
        level_cameras(head[at] + 3.1 + rng.normal(0, 0.05, 80), -0.2),
        path[at] + side,
        300.0,
    )


def table(rng: np.random.Generator) -> Scene:
    """A hand-held camera around an object of a metre; two metres in all."""

    def cameras(number: int) -> tuple[np.ndarray, np.ndarray]:
        around, above = rng.uniform(0, 3.5, number), rng.uniform(0.2, 1.2, number)
        far = rng.uniform(0.8, 1.2, number)
        level = np.stack([np.cos(around), np.sin(around)], axis=1) * np.cos(above)[:, None]
        centers = np.column_stack([level, np.sin(above)]) * far[:, None]
        wobble = rng.normal(0, 0.1, (2, number))
        return level_cameras(around + np.pi + wobble[0], wobble[1] - above), centers

    return Scene(*cameras(60), *cameras(25), 1.0)


def city(rng: np.random.Generator) -> Scene:
    """Phones anywhere in a town, in a world whose axes stand askew; hundreds of metres off."""
    askew = Rotation.from_rotvec([0.4, 1.1, -0.7]).as_matrix()

    def cameras(number: int) -> tuple[np.ndarray, np.ndarray]:
        centers = rng.uniform([600, -100, 1], [900, 100, 4], (number, 3))
        level = level_cameras(rng.uniform(0, 2 * np.pi, number), rng.normal(0.1, 0.1, number))
        return level @ askew.T, centers @ askew.T

    return Scene(*cameras(1500), *cameras(80), 150.0)


def floors(rng: np.random.Generator) -> Scene:
    """Panoramic scans of two floors that are frames of their own, unlike in their plans."""
    rotations, centers, frames = [], [], []
    queries = []
    for frame, (length, width, origin) in (("F1", (60, 8, 0.0)), ("F2", (12, 50, 100.0))):
        places = np.array(
            [[x, y, 1.5] for x in np.arange(0, length, 5.0) for y in np.arange(0, width, 5.0)]
        )
        for yaw in np.arange(0, 2 * np.pi, np.pi / 6):
            for pitch in (-0.5, 0.0, 0.5):
                rotations.append(level_cameras(np.full(len(places), yaw), pitch))
                centers.append(places + [origin, 0, 0])
                frames += [frame] * len(places)
        inside = rng.uniform([0, 0, 1.4], [length - 5, width - 3, 1.7], (30, 3)) + [origin, 0, 0]
        queries.append((level_cameras(rng.uniform(0, 6.28, 30), rng.normal(0, 0.1, 30)), inside))
    return Scene(
        np.concatenate(rotations),
        np.concatenate(centers),
        np.concatenate([own for own, _ in queries]),
        np.concatenate([own for _, own in queries]),
        30.0,
        map_frames=tuple(frames),
        query_frames=("F1",) * 30 + ("F2",) * 30,
    )


_MAKERS = {"street": street, "table": table, "city": city, "floors": floors}


@pytest.fixture(scope="session")
def make_scene() -> Callable[[str], Scene]:
    """Function: a rendered world's poses by name: street, table, city, floors."""
    return lambda name: _MAKERS[name](np.random.default_rng(4))


@pytest.fixture(scope="session")
def real_scene(shared_data: Path) -> Callable[[str], Scene]:
    """Function: a real scene by name."""

    def read(name: str) -> Scene:
        folder = shared_data / "scenes" / name
        cameras = read_reference(folder).cameras
        assert cameras is not None
        poses = KaptureFolder(folder / "query_gt").read().poses()
        quats, translations = stack_poses(poses.values())
        return Scene(
            Rotation.from_quat(np.roll(cameras.quats, -1, axis=1)).as_matrix(),
            cameras.centers,
            Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix(),
            camera_centers(quats, translations),
            float(np.ptp(cameras.centers)),
            names=tuple(poses),
        )

    return read


def lines_of(scene: Scene, mistakes: Sequence[str] = ()) -> list[str]:
    """The rows of a pose file with these mistakes in all of its poses."""
    rotations, centers = scene.rotations, scene.centers
    if "world-axes" in mistakes:
        rotations, centers = rotations @ Y_UP.T, centers @ Y_UP.T
    if "axes" in mistakes:
        rotations = OPENGL @ rotations
    translations = -np.einsum("nij,nj->ni", rotations, centers)
    if "inverted" in mistakes:
        rotations = rotations.transpose(0, 2, 1)
    if "inverted" in mistakes or "centre" in mistakes:
        translations = centers
    quats = quats_of(rotations)
    if "xyzw" in mistakes:
        quats = np.roll(quats, -1, axis=1)
    return [
        " ".join([name, *(repr(float(v)) for v in (*quat, *translation))]) + "\n"
        for name, quat, translation in zip(scene.query_names(), quats, translations, strict=True)
    ]


@pytest.fixture(scope="session")
def pose_lines() -> Callable[..., list[str]]:
    """See :func:`lines_of`."""
    return lines_of
