"""Where one can stand in a place: its walls' feet, the mapping rig's path, what stands about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# outlines (counter-clockwise) and the closed path of the mapping rig, metres
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


@dataclass(frozen=True)
class Obstacle:
    """Something that stands in a place: a circle on the ground, metres."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A place seen from above, in its own frame, metres.

    Parameters
    ----------
    outline : float64 (N, 2), its walls' feet, counter-clockwise.
    path : float64 (M, 2), the closed path of the mapping rig.
    obstacles : what stands inside.
    """

    outline: Floats
    path: Floats
    obstacles: tuple[Obstacle, ...] = ()

    def is_free(self, x: float, y: float, margin: float) -> bool:
        """Whether a circle of radius ``margin`` around (x, y) meets no wall and no obstacle."""
        if not self._is_inside(x, y) or _distance_to_ring(x, y, self.outline) < margin:
            return False
        return all(np.hypot(x - o.x, y - o.y) >= o.radius + margin for o in self.obstacles)

    def distance_to_path(self, x: float, y: float) -> float:
        """Distance of (x, y) from the mapping rig's path."""
        return _distance_to_ring(x, y, self.path)

    def stops(self, count: int) -> list[tuple[Floats, float]]:
        """Positions (2,) at equal distances along the path, with the headings there (radians)."""
        along = np.roll(self.path, -1, axis=0) - self.path
        lengths = np.hypot(*along.T)
        ends = np.cumsum(lengths)
        result = []
        for distance in (np.arange(count) + 0.5) / count * ends[-1]:
            leg = int(np.searchsorted(ends, distance))
            part = (distance - ends[leg] + lengths[leg]) / lengths[leg]
            heading = float(np.arctan2(along[leg, 1], along[leg, 0]))
            result.append((self.path[leg] + part * along[leg], heading))
        return result

    def _is_inside(self, x: float, y: float) -> bool:
        start, end = self.outline, np.roll(self.outline, -1, axis=0)
        crosses = (start[:, 1] > y) != (end[:, 1] > y)
        rise = np.where(crosses, end[:, 1] - start[:, 1], 1.0)
        at = start[:, 0] + (y - start[:, 1]) / rise * (end[:, 0] - start[:, 0])
        return np.count_nonzero(crosses & (x < at)) % 2 == 1


def draw_floor_plan(rng: np.random.Generator, index: int) -> FloorPlan:
    """The empty floor plan of place ``index``: one of four shapes, a little stretched."""
    outline, path = (np.array(shape) for shape in _SHAPES[index % len(_SHAPES)])
    stretch = rng.uniform(0.94, 1.06, 2)
    return FloorPlan(outline * stretch, path * stretch)


def _distance_to_ring(x: float, y: float, ring: Floats) -> float:
    along = np.roll(ring, -1, axis=0) - ring
    part = np.clip((((x, y) - ring) * along).sum(1) / (along**2).sum(1), 0, 1)
    return float(np.hypot(*(ring + part[:, None] * along - (x, y)).T).min())
