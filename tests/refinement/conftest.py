"""Points with the values that a query has there, and scenes in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest
from camera_models import CAMERAS
from numpy.typing import NDArray
from poses import random_pose

from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.photometric import LevelProblem
from megloc_kapture.refinement.pyramid import ChosenPoints, Level
from megloc_kapture.values import Camera, RigidTransform

Array = NDArray[np.float64]
WIDTH, HEIGHT = 160, 120


def texture(rng: np.random.Generator, channels: int, deviation_px: float = 1.5) -> Array:
    noise = rng.normal(size=(HEIGHT, WIDTH, channels))
    smooth = cv2.GaussianBlur(noise, (0, 0), deviation_px).reshape(noise.shape)
    return np.asarray(smooth / smooth.std())


def bilinear(values: Array, x: Array, y: Array) -> Array:
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - column)[:, None], (y - row)[:, None]
    top = (1 - a) * values[row, column] + a * values[row, column + 1]
    low = (1 - a) * values[row + 1, column] + a * values[row + 1, column + 1]
    return np.asarray((1 - b) * top + b * low)


def made_problem(
    model: str = "PINHOLE",
    *,
    channels: int = 1,
    count: int = 400,
    noise: float = 0.0,
    wrong: float = 0.0,
    seed: int = 0,
) -> tuple[LevelProblem, RigidTransform]:
    """Make points with the query's values at the true pose, up to gain and bias."""
    rng = np.random.default_rng(seed)
    camera, pose = CAMERAS[model], random_pose(rng)
    image = texture(rng, channels)
    px = rng.uniform((20, 20), (camera.width - 20, camera.height - 20), (count, 2))
    points = pose.inverse().apply(bearing_rays(camera, px) * rng.uniform(2.0, 9.0, (count, 1)))
    scale = WIDTH / camera.width
    # float32 like the level
    values = bilinear(image.astype(np.float32).astype(float), *(scale * px.T - 0.5))
    groups = rng.integers(0, 2, count)
    values = np.array([0.7, 1.3])[groups, None] * values + np.array([0.2, -0.4])[groups, None]
    outliers = rng.random(count) < wrong
    values[outliers] += rng.normal(size=(outliers.sum(), channels)) * 3
    # a level's noise is blurred like the level
    query = (image + noise * texture(rng, channels, 0.8)).astype(np.float32)
    level = Level(query, np.ones((HEIGHT, WIDTH), bool), scale, scale)
    chosen = ChosenPoints(points, values, groups)
    return LevelProblem(chosen, level, camera, pose), pose


@dataclass
class Scene:
    """A map and its queries by image name."""

    poses: dict[str, RigidTransform]
    cameras: dict[str, Camera]
    depths: dict[str, DepthView] = field(default_factory=dict)
    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    masks: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    asked: list[str] = field(default_factory=list)

    def query_image(self, name: str) -> NDArray[np.uint8]:
        return self.images[name]

    def map_image(self, name: str) -> NDArray[np.uint8]:
        self.asked.append(name)
        return self.images[name]

    def map_mask(self, name: str) -> NDArray[np.bool_] | None:
        return self.masks.get(name)

    def map_depth(self, name: str) -> DepthView | None:
        return self.depths.get(name)

    def map_points(self, name: str) -> Array:
        return self.points

    def map_camera(self, name: str) -> Camera:
        return self.cameras[name]

    def map_pose(self, name: str) -> RigidTransform:
        return self.poses[name]

    query_mask, query_depth = map_mask, map_depth


@pytest.fixture(scope="session")
def new_scene() -> Callable[..., Scene]:
    """Return a builder of scenes."""
    return Scene


@pytest.fixture(scope="session")
def problem() -> Callable[..., tuple[LevelProblem, RigidTransform]]:
    """Return a builder of problems with their true poses."""
    return made_problem
