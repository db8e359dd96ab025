"""People and cars: there in one image, elsewhere or gone in the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.floor_plans import FloorPlan
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.surfaces import SurfaceBuilder, Surfaces
from megloc_kapture.datasets.synthetic.textures import TextureRecipe

NUM_PEOPLE = 6
NUM_CARS = 3
_HEAD = 0.13  # part of a person's texture that is the head


@dataclass(frozen=True)
class Mover:
    """A person or car at one moment.

    Parameters
    ----------
    kind : what it is.
    variant : which of the kind, from 0.
    position : x, y in the place's frame, metres.
    yaw : radians in the place's frame.
    """

    kind: Literal["person", "car"]
    variant: int
    position: tuple[float, float]
    yaw: float

    @property
    def radius_m(self) -> float:
        """Radius of the circle on the ground that holds it."""
        return 0.4 if self.kind == "person" else 2.2


def mover_recipes(seed: int) -> list[TextureRecipe]:
    """Textures of all movers; a place puts them first, so that their indices are the same."""
    number = int(stream(seed, "movers").integers(2**31))
    recipes = [TextureRecipe("cloth", 120, 360, number + i) for i in range(NUM_PEOPLE)]
    for i in range(NUM_CARS):
        recipes.append(TextureRecipe("car", 420, 90, number + 100 + i, (("side", 1.0),)))
        recipes.append(TextureRecipe("car", 180, 90, number + 100 + i, (("side", 0.0),)))
    recipes.append(TextureRecipe("window", 220, 60, number + 200))
    return recipes


def place_movers(
    plan: FloorPlan,
    rng: np.random.Generator,
    count: int,
    position: NDArray[np.float64],
    *,
    yaw: float | None,
) -> tuple[Mover, ...]:
    """At most ``count`` people and cars near a position (x, y first; metres, place's frame).

    They stand in front of it where ``yaw`` (radians) is given, else all around.
    """
    movers: list[Mover] = []
    for _ in range(60):
        if len(movers) >= count:
            break
        kind: Literal["person", "car"] = "car" if rng.random() < 0.3 else "person"
        distance = rng.uniform(4.5, 8.0) if kind == "car" else rng.uniform(2.5, 7.0)
        angle = rng.uniform(-np.pi, np.pi) if yaw is None else yaw + rng.uniform(-0.5, 0.5)
        x = float(position[0] + distance * np.cos(angle))
        y = float(position[1] + distance * np.sin(angle))
        variant = int(rng.integers(NUM_CARS if kind == "car" else NUM_PEOPLE))
        mover = Mover(kind, variant, (x, y), float(rng.uniform(-np.pi, np.pi)))
        apart = all(
            np.hypot(x - m.position[0], y - m.position[1]) > mover.radius_m + m.radius_m
            for m in movers
        )
        if apart and plan.is_free(x, y, 0.6 * mover.radius_m):
            movers.append(mover)
    return tuple(movers)


def mover_surfaces(movers: tuple[Mover, ...]) -> Surfaces:
    """The movers' surfaces in the place's frame; textures as in :func:`mover_recipes`."""
    builder = SurfaceBuilder()
    for mover in movers:
        if mover.kind == "person":
            cloth = mover.variant % NUM_PEOPLE
            sides = (cloth,) * 4
            body, head = (0.0, _HEAD, 1.0, 1.0), (0.3, 0.0, 0.7, _HEAD)
            builder.add_box(mover.position, (0.5, 0.32, 1.5), mover.yaw, sides, cloth, uv=body)
            builder.add_box(
                mover.position, (0.2, 0.24, 0.26), mover.yaw, sides, cloth, base=1.5, uv=head
            )
        else:
            side = NUM_PEOPLE + 2 * (mover.variant % NUM_CARS)
            glass = NUM_PEOPLE + 2 * NUM_CARS
            body_sides = (side, side + 1, side, side + 1)
            builder.add_box(
                mover.position, (4.2, 1.75, 0.8), mover.yaw, body_sides, side + 1, base=0.1
            )
            builder.add_box(
                mover.position, (2.3, 1.5, 0.55), mover.yaw, (glass,) * 4, side + 1, base=0.9
            )
    return builder.build()
