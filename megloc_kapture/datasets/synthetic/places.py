"""Places: squares and streets a few metres across, laid out from a seed.

A place is made in its own frame (metres, z up, ground at z = 0, origin near its middle) and knows
where that frame lies in the world. Places of one world have materials, windows, doors and posters
in common, which is what makes retrieval and matching err.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.facades import WALL_HEIGHT_M, Wall, build_facade
from megloc_kapture.datasets.synthetic.movers import mover_recipes
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.surfaces import SurfaceBuilder, Surfaces
from megloc_kapture.datasets.synthetic.textures import TextureRecipe

PLACE_DISTANCE_M = 80.0
WALL_TEXELS_PER_M = 100
GROUND_TEXELS_PER_M = 80

# outlines (counter-clockwise) and the closed path of the mapping rig, metres
_OUTLINES: tuple[tuple[tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]], ...] = (
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

_MATERIALS = ("brick", "stone", "plaster")
_SIZES = {  # width, height in texels
    "window": (156, 192),
    "door": (132, 270),
    "shutter": (240, 300),
    "poster": (180, 252),
    "sign": (300, 80),
    "wood": (160, 160),
    "plain": (128, 128),
    "glow": (8, 8),
}
_SHARED = {"window": 3, "door": 2, "shutter": 1, "poster": 5, "sign": 2, "wood": 2, "plain": 3}
_OWN = {"window": 3, "door": 3, "shutter": 2, "poster": 9, "sign": 6, "wood": 3, "plain": 2}


@dataclass(frozen=True)
class Obstacle:
    """Something that stands in a place: a circle on the ground, metres."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, eq=False)
class Place:
    """One place, in its own frame.

    Parameters
    ----------
    index : number of the place in its world.
    recipes : its textures, the movers' first.
    surfaces : its geometry; ``texture`` counts in ``recipes``.
    lamps : float64 (L, 3), sources of light at night.
    outline : float64 (N, 2), its walls' feet, counter-clockwise.
    path : float64 (M, 2), the closed path of the mapping rig.
    obstacles : what stands inside.
    world_rotation : radians about z, from the place's frame to the world's.
    world_offset : float64 (3,), where the place's origin is in the world.
    """

    index: int
    recipes: tuple[TextureRecipe, ...]
    surfaces: Surfaces
    lamps: NDArray[np.float64]
    outline: NDArray[np.float64]
    path: NDArray[np.float64]
    obstacles: tuple[Obstacle, ...]
    world_rotation: float
    world_offset: NDArray[np.float64]

    @property
    def name(self) -> str:
        """Name of the place in image paths and tables."""
        return f"place{self.index}"

    def rotation(self) -> NDArray[np.float64]:
        """``world_from_place``'s rotation, float64 (3, 3)."""
        cos, sin = np.cos(self.world_rotation), np.sin(self.world_rotation)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def is_free(self, x: float, y: float, margin: float) -> bool:
        """Whether a circle of radius ``margin`` around (x, y) meets no wall and no obstacle."""
        start, end = self.outline, np.roll(self.outline, -1, axis=0)
        point = np.array([x, y])
        crosses = (start[:, 1] > y) != (end[:, 1] > y)
        rise = np.where(crosses, end[:, 1] - start[:, 1], 1.0)
        at = start[:, 0] + (y - start[:, 1]) / rise * (end[:, 0] - start[:, 0])
        if np.count_nonzero(crosses & (x < at)) % 2 == 0:
            return False
        along = end - start
        part = np.clip(((point - start) * along).sum(1) / (along**2).sum(1), 0, 1)
        if np.hypot(*(start + part[:, None] * along - point).T).min() < margin:
            return False
        return all(np.hypot(x - o.x, y - o.y) >= o.radius + margin for o in self.obstacles)


@dataclass
class _TextureStore:
    """Textures of a place by recipe, and the choice between those shared by all places and own."""

    options: SyntheticWorldOptions
    place: int
    rng: np.random.Generator
    recipes: list[TextureRecipe] = field(default_factory=list)

    def index(self, recipe: TextureRecipe) -> int:
        if recipe not in self.recipes:
            self.recipes.append(recipe)
        return self.recipes.index(recipe)

    def pick(self, kind: str) -> int:
        width, height = _SIZES[kind]
        shared = self.rng.random() < self.options.repetition
        count = (_SHARED if shared else _OWN).get(kind, 1)
        owner = "shared" if shared else f"place{self.place}"
        number = int(self.rng.integers(count))
        seed = stream(self.options.seed, owner, kind, number).integers(2**31)
        return self.index(TextureRecipe(kind, width, height, int(seed)))

    def material(self, painter: str, kind: str, size_m: tuple[float, float], label: str) -> int:
        density = WALL_TEXELS_PER_M if painter == "wall" else GROUND_TEXELS_PER_M
        width, height = (max(8, int(round(side * density))) for side in size_m)
        seed = int(stream(self.options.seed, self.place, label).integers(2**31))
        shared_seed = int(stream(self.options.seed, "material").integers(2**31))
        params: dict[str, str | float] = {
            "material": kind,
            "material_seed": shared_seed,
            "dirt": self.options.unique_texture,
        }
        if painter == "wall":
            params["graffiti"] = float(self.rng.integers(0, 3))
        return self.index(
            TextureRecipe(painter, width, height, seed, tuple(sorted(params.items())))
        )


def build_place(options: SyntheticWorldOptions, index: int) -> Place:
    """Lay out place ``index`` of a world."""
    rng = stream(options.seed, "layout", index)
    outline, path = (np.array(shape) for shape in _OUTLINES[index % len(_OUTLINES)])
    stretch = rng.uniform(0.94, 1.06, 2)
    outline, path = outline * stretch, path * stretch
    store = _TextureStore(options, index, stream(options.seed, "textures", index))
    for recipe in mover_recipes(options.seed):
        store.recipes.append(recipe)
    builder = SurfaceBuilder()
    lamps: list[NDArray[np.float64]] = []
    for number, (start, end) in enumerate(zip(outline, np.roll(outline, -1, 0), strict=True)):
        # seen from inside, a counter-clockwise outline runs to the left
        wall = _wall(store, rng, end, start, number)
        lamps += build_facade(builder, wall, rng, store.pick)
    _ground(builder, store, rng, outline)
    obstacles = _furniture(builder, store, rng, outline, path)
    columns = int(np.ceil(np.sqrt(options.num_places)))
    offset = np.array([index % columns, index // columns, 0.0]) * PLACE_DISTANCE_M
    offset += np.array([*rng.uniform(-8, 8, 2), rng.uniform(-1, 1)])
    return Place(
        index=index,
        recipes=tuple(store.recipes),
        surfaces=builder.build(),
        lamps=np.array(lamps).reshape(-1, 3),
        outline=outline,
        path=path,
        obstacles=tuple(obstacles),
        world_rotation=float(rng.uniform(-np.pi, np.pi)),
        world_offset=offset,
    )


def _wall(
    store: _TextureStore,
    rng: np.random.Generator,
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    number: int,
) -> Wall:
    length = float(np.hypot(*(end - start)))
    right = np.array([*(end - start) / length, 0.0])
    inward = np.array([right[1], -right[0], 0.0])
    material = _MATERIALS[int(rng.integers(len(_MATERIALS)))]
    texture = store.material("wall", material, (length, WALL_HEIGHT_M), f"wall{number}")
    return Wall(np.array([*start, 0.0]), right, inward, length, texture, store.pick("plain"))


def _ground(
    builder: SurfaceBuilder,
    store: _TextureStore,
    rng: np.random.Generator,
    outline: NDArray[np.float64],
) -> None:
    low, high = outline.min(0) - 0.5, outline.max(0) + 0.5
    width, depth = high - low
    kind = str(rng.choice(["paving", "asphalt"], p=[0.65, 0.35]))
    texture = store.material("ground", kind, (width, depth), "ground")
    corner = np.array([low[0], high[1], 0.0])
    builder.add(corner, np.array([width, 0.0, 0.0]), np.array([0.0, -depth, 0.0]), texture)


def _distance_to_path(point: NDArray[np.float64], path: NDArray[np.float64]) -> float:
    start, along = path, np.roll(path, -1, axis=0) - path
    part = np.clip(((point - start) * along).sum(1) / (along**2).sum(1), 0, 1)
    return float(np.hypot(*(start + part[:, None] * along - point).T).min())


def _furniture(
    builder: SurfaceBuilder,
    store: _TextureStore,
    rng: np.random.Generator,
    outline: NDArray[np.float64],
    path: NDArray[np.float64],
) -> list[Obstacle]:
    """Crates, advertising pillars, kiosks and planters, clear of walls, path and each other."""
    empty = Place(
        0, (), SurfaceBuilder().build(), np.empty((0, 3)), outline, path, (), 0.0, np.zeros(3)
    )
    placed: list[Obstacle] = []
    low, high = outline.min(0), outline.max(0)
    for _ in range(400):
        if len(placed) >= 8:
            break
        kind = str(rng.choice(["crates", "pillar", "kiosk", "planter"], p=[0.35, 0.25, 0.15, 0.25]))
        radius = {"crates": 0.9, "pillar": 0.65, "kiosk": 1.2, "planter": 0.9}[kind]
        x, y = rng.uniform(low, high)
        clear = _distance_to_path(np.array([x, y]), path) > radius + 0.9
        apart = all(np.hypot(x - o.x, y - o.y) > radius + o.radius + 0.5 for o in placed)
        if not (clear and apart and empty.is_free(x, y, radius + 0.1)):
            continue
        placed.append(Obstacle(float(x), float(y), radius))
        _FURNITURE[kind](builder, store, rng, (float(x), float(y)))
    return placed


def _crates(
    builder: SurfaceBuilder,
    store: _TextureStore,
    rng: np.random.Generator,
    at: tuple[float, float],
) -> None:
    base = 0.0
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.6, 0.95)
        sides = tuple(store.pick("wood") for _ in range(4))
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
    store: _TextureStore,
    rng: np.random.Generator,
    at: tuple[float, float],
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
            texture = store.pick("poster")
            builder.add(left + top, right - left, np.array([0.0, 0.0, -1.2]), texture)
    plain = store.pick("plain")
    builder.add_box(at, (1.0, 1.0, 0.3), turn, (plain,) * 4, plain)
    builder.add_box(at, (1.2, 1.2, 0.2), turn, (plain,) * 4, plain, base=2.7, bottom=plain)


def _kiosk(
    builder: SurfaceBuilder,
    store: _TextureStore,
    rng: np.random.Generator,
    at: tuple[float, float],
) -> None:
    yaw = rng.uniform(0, np.pi)
    sides = (store.pick("window"), store.pick("poster"), store.pick("door"), store.pick("poster"))
    roof = store.pick("plain")
    builder.add_box(at, (1.5, 1.3, 2.1), yaw, sides, roof)
    builder.add_box(at, (1.8, 1.6, 0.14), yaw, (roof,) * 4, roof, base=2.1, bottom=roof)
    signs = (store.pick("sign"), store.pick("sign"))
    builder.add_box(
        at, (1.3, 1.1, 0.4), yaw, (signs[0], signs[1], signs[0], signs[1]), roof, base=2.24
    )


def _planter(
    builder: SurfaceBuilder,
    store: _TextureStore,
    rng: np.random.Generator,
    at: tuple[float, float],
) -> None:
    yaw = rng.uniform(0, np.pi)
    side, plain = store.pick("wood"), store.pick("plain")
    builder.add_box(at, (1.3, 0.6, 0.55), yaw, (side,) * 4, plain)
    board = store.pick("poster")
    builder.add_box(at, (0.75, 0.1, 1.05), yaw, (board, plain, board, plain), plain, base=0.55)


_FURNITURE = {"crates": _crates, "pillar": _pillar, "kiosk": _kiosk, "planter": _planter}
