"""Floor plans, with people and cars that differ from image to image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from megloc_twins.options import seed_of
from megloc_twins.portable import Float64
from megloc_twins.surfaces import SurfaceBuilder, Surfaces
from megloc_twins.textures import TextureRecipe

Kind = Literal["person", "car"]

# outline (counter-clockwise) and closed path of the mapping rig, metres
_SHAPES: tuple[tuple[tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]], ...] = (
    (  # a courtyard
        ((-8.5, -6.5), (8.5, -6.5), (8.5, 6.5), (-8.5, 6.5)),
        ((-4.0, -2.3), (4.0, -2.3), (4.0, 2.3), (-4.0, 2.3)),
    ),
    (  # a street corner
        ((-9.0, -8.0), (9.0, -8.0), (9.0, 0.5), (1.0, 0.5), (1.0, 8.0), (-9.0, 8.0)),
        ((-5.5, -4.5), (4.5, -4.8), (4.5, -2.6), (-2.8, -2.4), (-2.8, 4.5), (-5.2, 4.5)),
    ),
    (  # a square with six sides
        ((-7.5, -5.0), (0.0, -8.5), (8.0, -5.0), (7.5, 4.5), (0.5, 8.0), (-8.5, 5.0)),
        ((-3.6, -2.2), (0.0, -3.8), (3.6, -2.2), (3.4, 2.2), (0.3, 3.7), (-3.9, 2.3)),
    ),
    (  # a street that bends
        ((-12.0, -5.5), (0.0, -4.0), (12.0, -6.5), (12.0, 2.5), (0.0, 4.5), (-12.0, 3.0)),
        ((-7.5, -2.2), (0.0, -1.2), (7.5, -3.4), (7.5, 0.0), (0.0, 1.6), (-7.5, 0.4)),
    ),
)

NUM_PEOPLE = 6
NUM_CARS = 3
_HEAD = 0.13  # height of the head in a person's texture, as a fraction


@dataclass(frozen=True)
class Obstacle:
    """An obstacle in a place: a circle on the ground, metres."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Plan of a place in its frame, metres."""

    outline: Float64  # (N, 2), counter-clockwise base line of the walls
    path: Float64  # (M, 2), closed path of the mapping rig
    obstacles: tuple[Obstacle, ...] = ()

    def is_free(self, x: float, y: float, margin: float) -> bool:
        """Return True if a circle of radius ``margin`` around (x, y) meets no wall or obstacle."""
        return _distance_inside(x, y, self.outline) >= margin and all(
            np.hypot(x - o.x, y - o.y) >= o.radius + margin for o in self.obstacles
        )

    def distance_to_path(self, x: float, y: float) -> float:
        return abs(_distance_inside(x, y, self.path))

    @property
    def path_length_m(self) -> float:
        return float(np.hypot(*(np.roll(self.path, -1, axis=0) - self.path).T).sum())

    def on_path(self, distance_m: ArrayLike) -> tuple[Float64, Float64]:
        """Return positions (..., 2) and headings (radians) at distances (...) along the path."""
        along = np.roll(self.path, -1, axis=0) - self.path
        lengths = np.hypot(*along.T)
        ends = np.cumsum(lengths)
        distance = np.asarray(distance_m) % ends[-1]
        leg = np.searchsorted(ends, distance)
        part = (distance - ends[leg] + lengths[leg]) / lengths[leg]
        heading = np.arctan2(along[leg, 1], along[leg, 0])
        return self.path[leg] + part[..., None] * along[leg], heading

    def stops(self, count: int) -> list[tuple[Float64, float]]:
        """Return equidistant positions (2,) along the path, with the headings (radians)."""
        spots, headings = self.on_path((np.arange(count) + 0.5) / count * self.path_length_m)
        return list(zip(spots, headings.tolist(), strict=True))


def draw_floor_plan(rng: Generator, index: int) -> FloorPlan:
    """Return the empty floor plan of place ``index``: one of four shapes, slightly stretched."""
    outline, path = (np.array(shape) for shape in _SHAPES[index % len(_SHAPES)])
    stretch = rng.uniform(0.94, 1.06, 2)
    return FloorPlan(outline * stretch, path * stretch)


def _distance_inside(x: float, y: float, ring: Float64) -> float:
    """Return the distance of (x, y) from a polygon, negative outside it."""
    return cv2.pointPolygonTest(ring.astype(np.float32), (x, y), True)


@dataclass(frozen=True)
class MovingObject:
    """A person or car at one moment: x, y (metres) and yaw (radians) in the place's frame."""

    kind: Kind
    variant: int  # number of the kind's texture, from 0
    position: tuple[float, float]
    yaw: float

    @property
    def radius_m(self) -> float:
        return 0.4 if self.kind == "person" else 2.2


def moving_object_recipes(seed: int) -> list[TextureRecipe]:
    """Return the textures of all moving objects, which come first in every place's list."""
    number = seed_of(seed, "movers")
    recipes = [TextureRecipe("cloth", 120, 360, number + i) for i in range(NUM_PEOPLE)]
    for i in range(NUM_CARS):
        recipes.append(TextureRecipe("car", 420, 90, number + 100 + i, (("side", 1.0),)))
        recipes.append(TextureRecipe("car", 180, 90, number + 100 + i, (("side", 0.0),)))
    return [*recipes, TextureRecipe("window", 220, 60, number + 200)]


def place_moving_objects(
    plan: FloorPlan, rng: Generator, count: int, position: Float64, yaw: float | None = None
) -> tuple[MovingObject, ...]:
    """Place up to ``count`` people and cars near a position (x, y first; metres, place's frame).

    With ``yaw`` (radians) they are in front of the position, else all around it.
    """
    moving_objects: list[MovingObject] = []
    for _ in range(60):
        if len(moving_objects) >= count:
            break
        kind: Kind = "car" if rng.random() < 0.3 else "person"
        distance = rng.uniform(4.5, 8.0) if kind == "car" else rng.uniform(2.5, 7.0)
        angle = rng.uniform(-np.pi, np.pi) if yaw is None else yaw + rng.uniform(-0.5, 0.5)
        x = float(position[0] + distance * np.cos(angle))
        y = float(position[1] + distance * np.sin(angle))
        variant = int(rng.integers(NUM_CARS if kind == "car" else NUM_PEOPLE))
        item = MovingObject(kind, variant, (x, y), float(rng.uniform(-np.pi, np.pi)))
        apart = all(
            np.hypot(x - m.position[0], y - m.position[1]) > item.radius_m + m.radius_m
            for m in moving_objects
        )
        if apart and plan.is_free(x, y, 0.6 * item.radius_m):
            moving_objects.append(item)
    return tuple(moving_objects)


def moving_object_surfaces(moving_objects: tuple[MovingObject, ...]) -> Surfaces:
    """Return the surfaces in the place's frame; textures index :func:`moving_object_recipes`."""
    builder = SurfaceBuilder()
    for item in moving_objects:
        at, yaw = item.position, item.yaw
        if item.kind == "person":
            cloth = item.variant % NUM_PEOPLE
            body, head = (0.0, _HEAD, 1.0, 1.0), (0.3, 0.0, 0.7, _HEAD)
            builder.add_box(at, (0.5, 0.32, 1.5), yaw, cloth, cloth, uv=body)
            builder.add_box(at, (0.2, 0.24, 0.26), yaw, cloth, cloth, base=1.5, uv=head)
        else:
            side = NUM_PEOPLE + 2 * (item.variant % NUM_CARS)
            glass, end = NUM_PEOPLE + 2 * NUM_CARS, side + 1
            builder.add_box(at, (4.2, 1.75, 0.8), yaw, (side, end, side, end), end, base=0.1)
            builder.add_box(at, (2.3, 1.5, 0.55), yaw, glass, end, base=0.9)
    return builder.build()
