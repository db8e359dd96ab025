"""Places: squares and streets a few metres across, laid out and furnished from a seed.

A place is made in its own frame (metres, z up, ground at z = 0, origin near its middle) and knows
where that frame lies in the world. Places of one world have materials, windows, doors and posters
in common, which is what makes retrieval and matching err.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.values import RigidTransform
from megloc_twins.facades import WALL_HEIGHT_M, Facade, TexturePicker, Wall
from megloc_twins.moving_objects import FloorPlan, Obstacle, draw_floor_plan, moving_object_recipes
from megloc_twins.options import SyntheticWorldOptions, stream
from megloc_twins.portable import settled_pose
from megloc_twins.surfaces import SurfaceBuilder, Surfaces
from megloc_twins.textures import TextureRecipe

Point = tuple[float, float]

# radius of the circle each kind needs, metres, and how often it is chosen
RADIUS_M = {"crates": 0.9, "pillar": 0.65, "kiosk": 1.2, "planter": 0.9}
SHARE = {"crates": 0.35, "pillar": 0.25, "kiosk": 0.15, "planter": 0.25}

PLACE_DISTANCE_M = 90.0  # between the middles of neighbours, before each is moved a little
WALL_TEXELS_PER_M = 100
GROUND_TEXELS_PER_M = 80
MAX_FURNITURE = 8
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
# how many of a kind all places share, and how many a place has of its own
_SHARED = {"window": 3, "door": 2, "shutter": 1, "poster": 5, "sign": 2, "wood": 2, "plain": 3}
_OWN = {"window": 3, "door": 3, "shutter": 2, "poster": 9, "sign": 6, "wood": 3, "plain": 2}


@dataclass(frozen=True, eq=False)
class Furniture:
    """Furniture of a kind at a point (x, y metres); ``pick`` gives a texture of a kind."""

    builder: SurfaceBuilder
    rng: np.random.Generator
    pick: TexturePicker

    def crates(self, at: Point) -> None:
        base = 0.0
        for _ in range(int(self.rng.integers(1, 4))):
            size = self.rng.uniform(0.6, 0.95)
            sides = tuple(self.pick("wood") for _ in range(4))
            spot = (at[0] + self.rng.uniform(-0.1, 0.1), at[1] + self.rng.uniform(-0.1, 0.1))
            self.builder.add_box(
                spot,
                (size, size, size),
                self.rng.uniform(0, np.pi),
                (sides[0], sides[1], sides[2], sides[3]),
                sides[0],
                base=base,
            )
            base += size

    def pillar(self, at: Point) -> None:
        """An advertising pillar: two storeys of posters on eight sides."""
        sides, radius = 8, 0.55
        turn = self.rng.uniform(0, np.pi)
        for level in range(2):
            for side in range(sides):
                a, b = (turn + 2 * np.pi * (side + k) / sides for k in (0, 1))
                left = np.array([at[0] + radius * np.cos(a), at[1] + radius * np.sin(a), 0.0])
                right = np.array([at[0] + radius * np.cos(b), at[1] + radius * np.sin(b), 0.0])
                top = np.array([0.0, 0.0, 0.3 + 1.2 * (level + 1)])
                texture = self.pick("poster")
                self.builder.add(left + top, right - left, np.array([0.0, 0.0, -1.2]), texture)
        plain = self.pick("plain")
        self.builder.add_box(at, (1.0, 1.0, 0.3), turn, (plain,) * 4, plain)
        self.builder.add_box(at, (1.2, 1.2, 0.2), turn, (plain,) * 4, plain, base=2.7, bottom=plain)

    def kiosk(self, at: Point) -> None:
        yaw = self.rng.uniform(0, np.pi)
        sides = (self.pick("window"), self.pick("poster"), self.pick("door"), self.pick("poster"))
        roof = self.pick("plain")
        self.builder.add_box(at, (1.5, 1.3, 2.1), yaw, sides, roof)
        self.builder.add_box(at, (1.8, 1.6, 0.14), yaw, (roof,) * 4, roof, base=2.1, bottom=roof)
        signs = (self.pick("sign"), self.pick("sign"))
        self.builder.add_box(
            at, (1.3, 1.1, 0.4), yaw, (signs[0], signs[1], signs[0], signs[1]), roof, base=2.24
        )

    def planter(self, at: Point) -> None:
        yaw = self.rng.uniform(0, np.pi)
        side, plain = self.pick("wood"), self.pick("plain")
        self.builder.add_box(at, (1.3, 0.6, 0.55), yaw, (side,) * 4, plain)
        board = self.pick("poster")
        self.builder.add_box(
            at, (0.75, 0.1, 1.05), yaw, (board, plain, board, plain), plain, base=0.55
        )


@dataclass(frozen=True, eq=False)
class Place:
    """One place, in its own frame.

    Parameters
    ----------
    index : number of the place in its world.
    recipes : its textures, the moving objects' first.
    surfaces : its geometry; ``texture`` counts in ``recipes``.
    lamps : float64 (L, 3), sources of light at night.
    plan : where one can stand.
    place_from_world : from the world's frame to the place's.
    """

    index: int
    recipes: tuple[TextureRecipe, ...]
    surfaces: Surfaces
    lamps: NDArray[np.float64]
    plan: FloorPlan
    place_from_world: RigidTransform

    @property
    def name(self) -> str:
        """Name of the place in image paths and tables."""
        return f"place{self.index}"

    def surfaces_in_world(self) -> Surfaces:
        """Its geometry in the world's frame."""
        world_from_place = self.place_from_world.inverse()
        return self.surfaces.moved(
            world_from_place.rotation_matrix(), np.array(world_from_place.translation)
        )


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
    plan = draw_floor_plan(rng, index)
    store = _TextureStore(options, index, stream(options.seed, "textures", index))
    store.recipes += moving_object_recipes(options.seed)
    builder = SurfaceBuilder()
    lamps: list[NDArray[np.float64]] = []
    ends = np.roll(plan.outline, -1, axis=0)
    for number, (start, end) in enumerate(zip(plan.outline, ends, strict=True)):
        # seen from inside, a counter-clockwise outline runs to the left
        wall = _wall(store, rng, end, start, number)
        lamps += Facade(builder, wall, rng, store.pick).build()
    _ground(builder, store, rng, plan)
    plan = _furnish(builder, store, rng, plan)
    return Place(
        index=index,
        recipes=tuple(store.recipes),
        surfaces=builder.build(),
        lamps=np.array(lamps).reshape(-1, 3),
        plan=plan,
        place_from_world=_place_from_world(rng, index, options.num_places),
    )


def _place_from_world(rng: np.random.Generator, index: int, num_places: int) -> RigidTransform:
    """Places lie on a loose grid, each turned at random."""
    columns = int(np.ceil(np.sqrt(num_places)))
    middle = np.array([index % columns, index // columns, 0.0]) * PLACE_DISTANCE_M
    middle += np.array([*rng.uniform(-8, 8, 2), rng.uniform(-1, 1)])
    yaw = rng.uniform(-np.pi, np.pi)
    cos, sin = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return settled_pose(rotation, middle).inverse()


def _wall(
    store: _TextureStore,
    rng: np.random.Generator,
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    number: int,
) -> Wall:
    length = float(np.hypot(*(end - start)))
    material = _MATERIALS[int(rng.integers(len(_MATERIALS)))]
    texture = store.material("wall", material, (length, WALL_HEIGHT_M), f"wall{number}")
    return Wall.between(start, end, texture, store.pick("plain"))


def _ground(
    builder: SurfaceBuilder, store: _TextureStore, rng: np.random.Generator, plan: FloorPlan
) -> None:
    low, high = plan.outline.min(0) - 0.5, plan.outline.max(0) + 0.5
    width, depth = (float(side) for side in high - low)
    kind = str(rng.choice(["paving", "asphalt"], p=[0.65, 0.35]))
    texture = store.material("ground", kind, (width, depth), "ground")
    corner = np.array([low[0], high[1], 0.0])
    builder.add(corner, np.array([width, 0.0, 0.0]), np.array([0.0, -depth, 0.0]), texture)


def _furnish(
    builder: SurfaceBuilder, store: _TextureStore, rng: np.random.Generator, plan: FloorPlan
) -> FloorPlan:
    """Put furniture clear of the walls, the rig's path and each other; the plan with it."""
    placed: list[Obstacle] = []
    furniture = Furniture(builder, rng, store.pick)
    low, high = plan.outline.min(0), plan.outline.max(0)
    for _ in range(400):
        if len(placed) >= MAX_FURNITURE:
            break
        kind = str(rng.choice(list(SHARE), p=list(SHARE.values())))
        radius = RADIUS_M[kind]
        x, y = (float(v) for v in rng.uniform(low, high))
        apart = all(np.hypot(x - o.x, y - o.y) > radius + o.radius + 0.5 for o in placed)
        off_path = plan.distance_to_path(x, y) > radius + 0.9
        if apart and off_path and plan.is_free(x, y, radius + 0.1):
            placed.append(Obstacle(x, y, radius))
            getattr(furniture, kind)((x, y))
    return replace(plan, obstacles=tuple(placed))
