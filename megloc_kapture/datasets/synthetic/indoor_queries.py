"""Where telephones are held on floors that are alike: where one can still tell them apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.cameras import looking_at, reduced
from megloc_kapture.datasets.synthetic.covisibility import CoarseView, coarse_view, visible
from megloc_kapture.datasets.synthetic.indoor_floors import Floor, Zone
from megloc_kapture.datasets.synthetic.indoor_rooms import MODULE_M
from megloc_kapture.datasets.synthetic.indoor_shots import cam_from_scan, phone_camera
from megloc_kapture.datasets.synthetic.movers import NUM_PEOPLE, Mover
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.render import (
    NO_SURFACE,
    depth_map,
    sample_grid,
    visible_surfaces,
)
from megloc_kapture.values import Camera, RigidTransform

_REDUCTION = 20  # of a glance, px per px
_ATTEMPTS = 400
_WALL_DISTANCE_M = 0.7
_NEAREST_M, _MEDIAN_M = 0.7, 1.6  # of what a query sees: 10th percentile, median
# share of a query's view that the scans of its floor have seen from about there; how much more
# that must be than what scans of other rooms of the kind have seen of theirs, which is alike
_MIN_SEEN, _MIN_MARGIN = 0.6, 0.2
# 90 degrees wide, 106 high
_QUARTER = Camera("SIMPLE_PINHOLE", 240, 320, (120.0, 120.0, 160.0))
_MAX_ANGLE_DEG, _MAX_DISTANCE_RATIO = 35.0, 2.0

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class QueryView:
    """Where a telephone is held, and who stands in front of it; in the place's frame."""

    floor: int
    zone: str
    camera: Camera
    cam_from_place: RigidTransform
    people: tuple[Mover, ...]


def query_views(
    floors: Sequence[Floor], seed: int, count: int, size: tuple[int, int]
) -> list[QueryView]:
    """Views of floors, the first floor's first, zone by zone; about every third held upright.

    Of some hundred random poses in the zone the first of which the scans of the floor have seen
    enough, and more than those of other rooms have seen of what looks the same; failing that, the
    one nearest to it.
    """
    scans = [[_ScanViews(floor, zone) for zone in floor.zones] for floor in floors]
    views = []
    for index, floor in enumerate(floors):
        for number in range(count * index // len(floors), count * (index + 1) // len(floors)):
            position = number - count * index // len(floors)
            zone = floor.zones[position % len(floor.zones)]
            rng = stream(seed, "indoor", "query", index, position)
            upright = (position + position // len(floor.zones)) % 3 == 2
            camera = phone_camera(*(size[::-1] if upright else size))
            pose, yaw = _query_pose(floors, (index, zone), camera, scans, rng)
            views.append(QueryView(index, zone.name, camera, pose, _people(zone, pose, yaw, rng)))
    return views


def _query_pose(
    floors: Sequence[Floor],
    where: tuple[int, Zone],
    camera: Camera,
    scans: Sequence[Sequence[_ScanViews]],
    rng: np.random.Generator,
) -> tuple[RigidTransform, float]:
    index, zone = where
    low, high = zone.plan.outline.min(axis=0), zone.plan.outline.max(axis=0)
    copies = list(_copies(floors, index, zone))
    best: tuple[float, RigidTransform, float] | None = None
    for _ in range(_ATTEMPTS):
        x, y = (float(v) for v in rng.uniform(low, high))
        yaw = float(rng.uniform(-np.pi, np.pi))
        pitch, roll = float(rng.normal(-0.05, 0.1)), float(rng.normal(0, 0.05))
        position = np.array([x, y, rng.uniform(1.4, 1.75)])
        if not zone.plan.is_free(x, y, _WALL_DISTANCE_M):
            continue
        pose = looking_at(position, yaw, pitch, roll)
        glance = _glance(floors[index], camera, pose)
        if np.percentile(glance.depth, 10) < _NEAREST_M or np.median(glance.depth) < _MEDIAN_M:
            continue
        seen = float((_have_seen(scans[index], glance.points, position) & ~glance.glass).mean())
        miss = max(0.0, _MIN_SEEN - seen)
        if best is not None and miss >= best[0]:
            continue
        for other, moved in copies:
            again = _have_seen(scans[other], moved.apply(glance.points), moved.apply(position))
            alike = float((again & ~glance.own & ~glance.glass).mean())
            miss = max(miss, _MIN_MARGIN - (seen - alike))
        if best is None or miss < best[0]:
            best = (miss, pose, yaw)
        if miss == 0.0:
            break
    if best is None:  # every zone has room for a query
        raise RuntimeError(f"no free view in {zone.name}")
    return best[1:]


def _copies(
    floors: Sequence[Floor], index: int, zone: Zone
) -> Iterator[tuple[int, RigidTransform]]:
    """Floors and transforms that take the zone to others of its kind; a corridor's also turned."""
    half_turn = RigidTransform((0.0, 0.0, 0.0, 1.0), (MODULE_M, 0.0, 0.0))
    for other_index, floor in enumerate(floors):
        for other in floor.zones:
            if other.kind != zone.kind:
                continue
            if (other_index, other.name) != (index, zone.name):
                yield other_index, other.place_from_zone @ zone.place_from_zone.inverse()
            if zone.kind == "corridor":
                turned = other.place_from_zone @ half_turn @ zone.place_from_zone.inverse()
                yield other_index, turned


@dataclass(frozen=True, eq=False)
class _Glance:
    """A view at a fraction of its resolution: of each point its depth (P,), where it is (P, 3),
    whether it belongs to its room alone, and whether it is glass (P,)."""

    depth: Floats
    points: Floats
    own: Bools
    glass: Bools


def _glance(floor: Floor, camera: Camera, cam_from_place: RigidTransform) -> _Glance:
    grid = sample_grid(reduced(camera, _REDUCTION), 1)
    seen = visible_surfaces(floor.place.surfaces, cam_from_place, grid)
    hit = seen.surface != NO_SURFACE
    z = depth_map(seen).astype(np.float64)
    rays = np.stack(np.broadcast_arrays(grid.x, grid.y, 1.0), axis=-1)
    points = cam_from_place.inverse().apply((rays * z[..., None])[hit])
    surface = seen.surface[hit]
    return _Glance(z[hit], points, floor.own[surface], floor.glass[surface])


class _ScanViews:
    """What a scan sees, coarsely: all around, as high and low as its cutouts reach."""

    def __init__(self, floor: Floor, zone: Zone) -> None:
        self.center = zone.scan_from_place.center()
        self.views: list[CoarseView] = [
            coarse_view(
                floor.place.surfaces, _QUARTER, cam_from_scan(yaw, 0) @ zone.scan_from_place
            )
            for yaw in (0, 90, 180, 270)
        ]

    def sees(self, points: Floats) -> Bools:
        """Which points (P, 3) it sees."""
        seen = np.zeros(len(points), bool)
        for view in self.views:
            seen |= visible(points, view)
        return seen


def _have_seen(scans: Sequence[_ScanViews], points: Floats, position: Floats) -> Bools:
    """Which points (P, 3) a scan has seen about as one sees them from ``position`` (3,)."""
    found = np.zeros(len(points), bool)
    here = points - position
    distance = np.linalg.norm(here, axis=1)
    for scan in scans:
        there = points - scan.center
        other = np.linalg.norm(there, axis=1)
        cosine = (here * there).sum(axis=1) / (distance * other)
        alike = cosine > np.cos(np.radians(_MAX_ANGLE_DEG))
        alike &= np.abs(np.log(distance / other)) < np.log(_MAX_DISTANCE_RATIO)
        alike &= ~found
        if alike.any():
            found[alike] = scan.sees(points[alike])
    return found


def _people(
    zone: Zone, pose: RigidTransform, yaw: float, rng: np.random.Generator
) -> tuple[Mover, ...]:
    """Up to two people in front of every second telephone."""
    people: list[Mover] = []
    wanted = int(rng.integers(0, 4)) - 1
    x0, y0, _ = pose.center()
    for _ in range(20):
        if len(people) >= wanted:
            break
        distance, angle = rng.uniform(1.8, 3.5), yaw + rng.uniform(-0.5, 0.5)
        x, y = float(x0 + distance * np.cos(angle)), float(y0 + distance * np.sin(angle))
        if zone.plan.is_free(x, y, 0.3):
            turn = float(rng.uniform(-np.pi, np.pi))
            people.append(Mover("person", int(rng.integers(NUM_PEOPLE)), (x, y), turn))
    return tuple(people)
