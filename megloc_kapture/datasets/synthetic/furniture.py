"""What stands about in a place: crates, advertising pillars, kiosks, planters with boards."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from megloc_kapture.datasets.synthetic.surfaces import SurfaceBuilder

TexturePicker = Callable[[str], int]
Point = tuple[float, float]

# radius of the circle each kind needs, metres, and how often it is chosen
RADIUS_M = {"crates": 0.9, "pillar": 0.65, "kiosk": 1.2, "planter": 0.9}
SHARE = {"crates": 0.35, "pillar": 0.25, "kiosk": 0.15, "planter": 0.25}


def build_furniture(
    builder: SurfaceBuilder, kind: str, rng: np.random.Generator, pick: TexturePicker, at: Point
) -> None:
    """Add a piece of furniture at ``at`` (x, y metres); ``pick`` gives a texture of a kind."""
    _BUILDERS[kind](builder, rng, pick, at)


def _crates(
    builder: SurfaceBuilder,
    rng: np.random.Generator,
    pick: TexturePicker,
    at: Point,
) -> None:
    base = 0.0
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.6, 0.95)
        sides = tuple(pick("wood") for _ in range(4))
        spot = (at[0] + rng.uniform(-0.1, 0.1), at[1] + rng.uniform(-0.1, 0.1))
        builder.add_box(
            spot,
            (size, size, size),
            rng.uniform(0, np.pi),
            (sides[0], sides[1], sides[2], sides[3]),
            sides[0],
            base=base,
        )
        base += size


def _pillar(
    builder: SurfaceBuilder,
    rng: np.random.Generator,
    pick: TexturePicker,
    at: Point,
) -> None:
    """An advertising pillar: two storeys of posters on eight sides."""
    sides, radius = 8, 0.55
    turn = rng.uniform(0, np.pi)
    for level in range(2):
        for side in range(sides):
            a, b = (turn + 2 * np.pi * (side + k) / sides for k in (0, 1))
            left = np.array([at[0] + radius * np.cos(a), at[1] + radius * np.sin(a), 0.0])
            right = np.array([at[0] + radius * np.cos(b), at[1] + radius * np.sin(b), 0.0])
            top = np.array([0.0, 0.0, 0.3 + 1.2 * (level + 1)])
            texture = pick("poster")
            builder.add(left + top, right - left, np.array([0.0, 0.0, -1.2]), texture)
    plain = pick("plain")
    builder.add_box(at, (1.0, 1.0, 0.3), turn, (plain,) * 4, plain)
    builder.add_box(at, (1.2, 1.2, 0.2), turn, (plain,) * 4, plain, base=2.7, bottom=plain)


def _kiosk(
    builder: SurfaceBuilder,
    rng: np.random.Generator,
    pick: TexturePicker,
    at: Point,
) -> None:
    yaw = rng.uniform(0, np.pi)
    sides = (pick("window"), pick("poster"), pick("door"), pick("poster"))
    roof = pick("plain")
    builder.add_box(at, (1.5, 1.3, 2.1), yaw, sides, roof)
    builder.add_box(at, (1.8, 1.6, 0.14), yaw, (roof,) * 4, roof, base=2.1, bottom=roof)
    signs = (pick("sign"), pick("sign"))
    builder.add_box(
        at, (1.3, 1.1, 0.4), yaw, (signs[0], signs[1], signs[0], signs[1]), roof, base=2.24
    )


def _planter(
    builder: SurfaceBuilder,
    rng: np.random.Generator,
    pick: TexturePicker,
    at: Point,
) -> None:
    yaw = rng.uniform(0, np.pi)
    side, plain = pick("wood"), pick("plain")
    builder.add_box(at, (1.3, 0.6, 0.55), yaw, (side,) * 4, plain)
    board = pick("poster")
    builder.add_box(at, (0.75, 0.1, 1.05), yaw, (board, plain, board, plain), plain, base=0.55)


_BUILDERS = {"crates": _crates, "pillar": _pillar, "kiosk": _kiosk, "planter": _planter}
