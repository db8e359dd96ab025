from __future__ import annotations

import numpy as np

from megloc_kapture.datasets.synthetic.shadow import add_shadows, cast_shadows
from megloc_kapture.datasets.synthetic.surfaces import SurfaceBuilder, Surfaces

SUN = (1 / np.sqrt(2), 0.0, 1 / np.sqrt(2))  # 45 degrees above +x: a metre of height, a metre long


def ground_and_box() -> tuple[Surfaces, Surfaces]:
    ground, box = SurfaceBuilder(), SurfaceBuilder()
    corner = np.array([-6.0, 6.0, 0.0])
    ground.add(corner, np.array([12.0, 0, 0]), np.array([0, -12.0, 0]), 0)
    box.add_box((0.0, 0.0), (1.0, 2.0, 2.0), 0.0, (0, 0, 0, 0), 0)
    return ground.build(), box.build()


def test_a_box_throws_its_shadow_away_from_the_sun() -> None:
    ground, box = ground_and_box()
    shadows = cast_shadows(ground.joined(box), SUN)
    x = np.array([[-4.0, -2.6, -2.4, -1.0, 1.0, 3.0, -1.0, -1.0]], np.float32)
    y = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.9, 1.1]], np.float32)
    lit = shadows.lit(x, y, np.zeros_like(x))
    # the box ends at x = -0.5 and is 2 m high: its shadow ends at x = -2.5
    np.testing.assert_array_equal(lit[0], [1, 1, 0, 0, 1, 1, 0, 1])


def test_a_surface_does_not_shade_itself_and_others_can_be_added() -> None:
    ground, box = ground_and_box()
    alone = cast_shadows(ground, SUN)
    grid = np.meshgrid(np.linspace(-5, 5, 50), np.linspace(-5, 5, 50))
    x, y = (a.astype(np.float32) for a in grid)
    assert alone.lit(x, y, np.zeros_like(x)).all()
    both = add_shadows(alone, box)
    assert not both.lit(x, y, np.zeros_like(x)).all()
    assert alone.lit(x, y, np.zeros_like(x)).all()  # unchanged
    together = cast_shadows(ground.joined(box), SUN).lit(x, y, np.zeros_like(x))
    assert (both.lit(x, y, np.zeros_like(x)) == together).mean() > 0.99
