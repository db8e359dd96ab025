"""A scene in memory, as plugins of poses see it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, RigidTransform


@dataclass
class Scene:
    """A map and its queries by image name."""

    poses: dict[str, RigidTransform]
    cameras: dict[str, Camera]
    depths: dict[str, DepthView] = field(default_factory=dict)
    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    masks: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    asked: list[str] = field(default_factory=list)

    def query_image(self, name: str) -> NDArray[np.uint8]:
        return self.map_image(name)

    def map_image(self, name: str) -> NDArray[np.uint8]:
        self.asked.append(name)
        if name not in self.images:
            raise DataError(f"no pixels of {name}")
        return self.images[name]

    def map_mask(self, name: str) -> NDArray[np.bool_] | None:
        return self.masks.get(name)

    def map_depth(self, name: str) -> DepthView | None:
        return self.depths.get(name)

    def map_points(self, name: str) -> NDArray[np.float64]:
        return self.points

    def map_camera(self, name: str) -> Camera:
        return self.cameras[name]

    def map_pose(self, name: str) -> RigidTransform:
        return self.poses[name]

    query_mask, query_depth = map_mask, map_depth
