"""Places: squares and streets, about twenty metres across, laid out and furnished from a seed.

A place has a frame (metres, z up, ground at z = 0, origin near its centre) with a pose in the
world. Places of one world share materials, windows, doors and posters, which makes retrieval and
matching hard.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from megloc_kapture.values import RigidTransform
from megloc_twins.frames import Frame
from megloc_twins.moving_objects import FloorPlan, Obstacle, draw_floor_plan, moving_object_recipes
from megloc_twins.options import SyntheticWorldOptions, seed_of, stream
from megloc_twins.portable import Float64, settled_pose
from megloc_twins.surfaces import Opening, SurfaceBuilder, Surfaces, Wall
from megloc_twins.textures import GROUND_TEXELS_PER_M, TextureRecipe, index_of, texels

Point = tuple[float, float]
TexturePicker = Callable[[str], int]

# furniture: radius of the required circle, metres, and probability
_FURNITURE = {
    "crates": (0.9, 0.35),
    "pillar": (0.65, 0.25),
    "kiosk": (1.2, 0.15),
    "planter": (0.9, 0.25),
}
_MAX_FURNITURE = 8

_PLACE_DISTANCE_M = 90.0  # between centres of neighbouring places, before a random shift
_WALL_TEXELS_PER_M = 100
_MATERIALS = ("brick", "stone", "plaster")
_SHARED = 0.6  # probability that a texture is one of those shared by all places
_TEXTURES = {  # width, height in texels; number of textures shared by all places, and per place
    "window": (156, 192, 3, 3),
    "door": (132, 270, 2, 3),
    "shutter": (240, 300, 1, 2),
    "poster": (180, 252, 5, 9),
    "sign": (300, 80, 2, 6),
    "wood": (160, 160, 2, 3),
    "plain": (128, 128, 3, 2),
    "glow": (8, 8, 1, 1),
}

_GROUND_STOREY_M, _UPPER_STOREY_M, _CORNICE_M = 3.3, 2.9, 0.35
_EAVES_M = _GROUND_STOREY_M + _UPPER_STOREY_M
_WALL_HEIGHT_M = _EAVES_M + _CORNICE_M
# contents of a bay of the ground floor: probability; half the width, lower and upper edge, metres
_BAYS = {
    "window": (0.3, 0.65, 0.95, 2.45),
    "door": (0.2, 0.55, 0.0, 2.25),
    "shutter": (0.15, 1.0, 0.0, 2.5),
    "posters": (0.35, 0.0, 0.0, 0.0),
}


@dataclass(frozen=True, eq=False)
class Furniture:
    """Builder of furniture at a point (x, y in metres); ``pick`` returns a texture of a kind."""

    builder: SurfaceBuilder
    rng: Generator
    pick: TexturePicker

    def crates(self, at: Point) -> None:
        base = 0.0
        for _ in range(int(self.rng.integers(1, 4))):
            size = self.rng.uniform(0.6, 0.95)
            sides = self.pick("wood"), self.pick("wood"), self.pick("wood"), self.pick("wood")
            spot = (at[0] + self.rng.uniform(-0.1, 0.1), at[1] + self.rng.uniform(-0.1, 0.1))
            yaw = self.rng.uniform(0, np.pi)
            self.builder.add_box(spot, (size, size, size), yaw, sides, sides[0], base=base)
            base += size

    def pillar(self, at: Point) -> None:
        """Add an advertising pillar: two rows of posters on eight sides."""
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
        self.builder.add_box(at, (1.0, 1.0, 0.3), turn, plain, plain)
        self.builder.add_box(at, (1.2, 1.2, 0.2), turn, plain, plain, base=2.7, bottom=plain)

    def kiosk(self, at: Point) -> None:
        yaw = self.rng.uniform(0, np.pi)
        sides = (self.pick("window"), self.pick("poster"), self.pick("door"), self.pick("poster"))
        roof = self.pick("plain")
        self.builder.add_box(at, (1.5, 1.3, 2.1), yaw, sides, roof)
        self.builder.add_box(at, (1.8, 1.6, 0.14), yaw, roof, roof, base=2.1, bottom=roof)
        a, b = self.pick("sign"), self.pick("sign")
        self.builder.add_box(at, (1.3, 1.1, 0.4), yaw, (a, b, a, b), roof, base=2.24)

    def planter(self, at: Point) -> None:
        yaw = self.rng.uniform(0, np.pi)
        side, plain = self.pick("wood"), self.pick("plain")
        self.builder.add_box(at, (1.3, 0.6, 0.55), yaw, side, plain)
        board = self.pick("poster")
        sides = (board, plain, board, plain)
        self.builder.add_box(at, (0.75, 0.1, 1.05), yaw, sides, plain, base=0.55)


@dataclass(frozen=True, eq=False)
class Facade:
    """Facade of a house: a wall with windows, doors and attachments."""

    wall: Wall
    rng: Generator
    pick: TexturePicker

    def build(self) -> list[Float64]:
        """Furnish the wall; return the positions of its lamps, float64 (3,) each, metres."""
        wall, rng = self.wall, self.rng
        num_bays = max(1, int(round(wall.length / rng.uniform(2.3, 3.0))))
        edges = np.linspace(0, wall.length, num_bays + 1)
        ground: list[Opening] = []
        upper: list[Opening] = []
        window = self.pick("window")
        for left, right in zip(edges[:-1], edges[1:], strict=True):
            self._ground_bay(left, right, ground)
            if rng.random() < 0.85:
                self._upper_window(left, right, window, upper)
        wall.storey((0.0, _GROUND_STOREY_M), ground)
        wall.storey((_GROUND_STOREY_M, _EAVES_M), upper)
        wall.block((0.0, wall.length), (_EAVES_M, _WALL_HEIGHT_M), 0.25, wall.trim, wall.trim)
        for edge in edges[1:-1]:
            draw = rng.random()
            if draw < 0.35:  # pilaster
                span = (float(edge) - 0.18, float(edge) + 0.18)
                self.wall.block(span, (0.0, _EAVES_M), 0.16, wall.texture, wall.trim)
            elif draw < 0.5:  # drain pipe
                span = (float(edge) - 0.05, float(edge) + 0.05)
                pipe = self.pick("plain")
                self.wall.block(span, (0.0, _EAVES_M), 0.1, pipe, pipe)
        lamps = []
        for x in np.arange(rng.uniform(1.5, 3.5), wall.length - 1, rng.uniform(4.5, 7.0)).tolist():
            glow = self.pick("glow")
            span = (x - 0.13, x + 0.13)
            wall.block(span, (2.95, 3.25), 0.24, glow, glow, glow=4.0)
            lamps.append(wall.point(x, 3.1, 0.45))
        return lamps

    def _ground_bay(self, left: float, right: float, holes: list[Opening]) -> None:
        rng = self.rng
        kind = str(rng.choice(list(_BAYS), p=[share for share, *_ in _BAYS.values()]))
        if kind == "posters":
            self._posters(left + 0.25, right - 0.25)
            return
        middle, width = (left + right) / 2, right - left
        _, half, y0, y1 = _BAYS[kind]
        half = min(half, width / 2 - 0.2)
        shift = rng.uniform(-0.2, 0.2)
        x0, x1 = middle + shift - half, middle + shift + half
        recess, texture = rng.uniform(0.15, 0.35), self.pick(kind)
        holes.append(Opening(x0, x1, y0, y1, recess, texture, 0.25 * float(rng.random() < 0.2)))
        if kind == "window":
            self._ledge(holes[-1])
        if rng.random() < 0.5:  # a sign
            half = min(0.95, (right - left) / 2 - 0.1)
            depth = rng.uniform(0.06, 0.2)
            span = (middle - half, middle + half)
            self.wall.block(span, (2.62, 2.62 + 0.5), depth, self.pick("sign"), self.wall.trim)

    def _upper_window(self, left: float, right: float, common: int, holes: list[Opening]) -> None:
        rng, middle, half = self.rng, (left + right) / 2, min(0.6, (right - left) / 2 - 0.25)
        window = common if rng.random() < 0.6 else self.pick("window")
        y0, y1 = _GROUND_STOREY_M + 0.75, _GROUND_STOREY_M + 2.3
        glow = 0.6 * float(rng.random() < 0.25)
        hole = Opening(middle - half, middle + half, y0, y1, 0.22, window, glow)
        holes.append(hole)
        if rng.random() < 0.3:  # a balcony
            span = (max(0.0, hole.x0 - 0.25), min(self.wall.length, hole.x1 + 0.25))
            self.wall.block(span, (y0 - 0.55, y0 + 0.2), 0.6, self.pick("wood"), self.pick("plain"))
        else:
            self._ledge(hole)

    def _ledge(self, hole: Opening) -> None:
        trim = self.wall.trim
        self.wall.block((hole.x0 - 0.1, hole.x1 + 0.1), (hole.y0 - 0.1, hole.y0), 0.14, trim, trim)

    def _posters(self, x: float, end: float) -> None:
        rng = self.rng
        while x + 0.7 <= end:
            width = float(rng.choice([0.7, 0.9]))
            if x + width > end:
                width = 0.7
            base = rng.uniform(0.6, 1.2)
            height = (base, base + width * 1.4)
            depth = rng.uniform(0.02, 0.08)
            self.wall.block((x, x + width), height, depth, self.pick("poster"), self.wall.trim)
            x += width + rng.uniform(0.08, 0.3)


@dataclass(frozen=True, eq=False)
class Place:
    """A place; geometry is in the place's frame."""

    index: int  # in its world
    recipes: tuple[TextureRecipe, ...]  # its textures, those of moving objects first
    surfaces: Surfaces  # ``texture`` indexes ``recipes``
    lamps: Float64  # (L, 3), sources of light at night
    plan: FloorPlan  # free ground
    place_from_world: RigidTransform

    @property
    def name(self) -> str:
        return f"place{self.index}"

    def cam_from_place(self, frame: Frame) -> RigidTransform:
        return frame.cam_from_world @ self.place_from_world.inverse()


@dataclass
class _TextureStore:
    """Textures of a place by recipe, some of them shared by all places."""

    seed: int
    place: int
    rng: Generator
    recipes: list[TextureRecipe]

    def pick(self, kind: str) -> int:
        width, height, num_shared, num_own = _TEXTURES[kind]
        shared = self.rng.random() < _SHARED
        owner = "shared" if shared else f"place{self.place}"
        number = int(self.rng.integers(num_shared if shared else num_own))
        seed = seed_of(self.seed, owner, kind, number)
        return index_of(TextureRecipe(kind, width, height, seed), self.recipes)

    def material(self, painter: str, kind: str, size_m: tuple[float, float], label: str) -> int:
        density = GROUND_TEXELS_PER_M
        params: dict[str, str | float] = {"material": kind}
        params["material_seed"] = seed_of(self.seed, "material")
        if painter == "wall":
            density, params["graffiti"] = _WALL_TEXELS_PER_M, float(self.rng.integers(0, 3))
        seed = seed_of(self.seed, self.place, label)
        recipe = TextureRecipe(painter, *texels(size_m, density), seed, tuple(params.items()))
        return index_of(recipe, self.recipes)


def build_place(options: SyntheticWorldOptions, index: int) -> Place:
    rng = stream(options.seed, "layout", index)
    plan = draw_floor_plan(rng, index)
    seed, recipes = options.seed, moving_object_recipes(options.seed)
    store = _TextureStore(seed, index, stream(seed, "textures", index), recipes)
    builder = SurfaceBuilder()
    lamps: list[Float64] = []
    ends = np.roll(plan.outline, -1, axis=0)
    # seen from inside, a counter-clockwise outline runs to the left
    for number, (end, start) in enumerate(zip(plan.outline, ends, strict=True)):
        size_m = (float(np.hypot(*(end - start))), _WALL_HEIGHT_M)
        material = _MATERIALS[int(rng.integers(len(_MATERIALS)))]
        texture = store.material("wall", material, size_m, f"wall{number}")
        trim = store.pick("plain")
        wall = Wall(builder, (start, end), texture, trim, _WALL_HEIGHT_M)
        lamps += Facade(wall, rng, store.pick).build()
    low, high = plan.outline.min(0) - 0.5, plan.outline.max(0) + 0.5
    width, depth = (high - low).tolist()
    kind = str(rng.choice(["paving", "asphalt"], p=[0.65, 0.35]))
    texture = store.material("ground", kind, (width, depth), "ground")
    corner = np.array([low[0], high[1], 0.0])
    builder.add(corner, np.array([width, 0.0, 0.0]), np.array([0.0, -depth, 0.0]), texture)
    plan = _furnished(plan, Furniture(builder, rng, store.pick))
    # on a loose grid, with a random rotation
    columns = int(np.ceil(np.sqrt(options.num_places)))
    middle = np.array([index % columns, index // columns, 0.0]) * _PLACE_DISTANCE_M
    middle += np.array([*rng.uniform(-8, 8, 2), rng.uniform(-1, 1)])
    world_from_place = settled_pose(about_z(rng.uniform(-np.pi, np.pi)), middle)
    return Place(
        index=index,
        plan=plan,
        recipes=tuple(store.recipes),
        surfaces=builder.build(),
        lamps=np.array(lamps).reshape(-1, 3),
        place_from_world=world_from_place.inverse(),
    )


def about_z(angle: float) -> Float64:
    """Return the rotation matrix (3, 3) about z by an angle in radians."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _furnished(plan: FloorPlan, furniture: Furniture) -> FloorPlan:
    """Add furniture that does not touch walls, the rig's path or other furniture to the plan."""
    rng = furniture.rng
    placed: list[Obstacle] = []
    low, high = plan.outline.min(0), plan.outline.max(0)
    shares = [share for _, share in _FURNITURE.values()]
    for _ in range(400):
        if len(placed) >= _MAX_FURNITURE:
            break
        kind = str(rng.choice(list(_FURNITURE), p=shares))
        radius, _ = _FURNITURE[kind]
        x, y = (float(v) for v in rng.uniform(low, high))
        apart = all(np.hypot(x - o.x, y - o.y) > radius + o.radius + 0.5 for o in placed)
        off_path = plan.distance_to_path(x, y) > radius + 0.9
        if apart and off_path and plan.is_free(x, y, radius + 0.1):
            placed.append(Obstacle(x, y, radius))
            getattr(furniture, kind)((x, y))
    return replace(plan, obstacles=tuple(placed))
