"""What rankers and refiners see of a map, against the folder itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from megloc_kapture.stages.ranking_scene import KaptureScene


def test_points_are_those_that_an_image_observes(world: Any) -> None:
    folder = world.map()
    scene = KaptureScene(folder)
    xyz = folder.points3d()[:, :3]
    for image in sorted(world.map_poses):
        seen: set[int] = set()
        for observed in folder.observations().values():
            names = np.array(observed.image_names)[observed.image_ids]
            seen |= set(observed.point_ids[names == image].tolist())
        assert seen
        np.testing.assert_array_equal(scene.map_points(image), xyz[sorted(seen)])
    assert scene.map_points("elsewhere.png").shape == (0, 3)
