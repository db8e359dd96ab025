"""Models of COLMAP's mappers: parts that too few points hold together come apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.geometry.cameras import px_from_cam
from megloc_kapture.io.colmap import MapImage, write_model
from megloc_kapture.io.colmap_cameras import load_pycolmap
from megloc_kapture.io.colmap_mapping import connected_models
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.01))
FIRST, SECOND = ("a0", "a1", "a2"), ("b0", "b1", "b2")


def model_of_two_groups(folder: Path, num_shared: int) -> object:
    """Six images: three see the points 0 to 99, three those that follow, but for shared ones."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (200 - num_shared, 3))
    seen = [np.arange(100)] * 3 + [np.arange(100 - num_shared, len(points))] * 3
    images, observed = [], []
    for number, (name, rows) in enumerate(zip(FIRST + SECOND, seen, strict=True)):
        pose = RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.2 * number, 0.0, 0.0))
        px = px_from_cam(CAMERA, points[rows] + pose.translation).astype(np.float32)
        images.append(MapImage(name, CAMERA, pose, px))
        observed.append((np.arange(100), rows))
    write_model(folder, images, observed, points, np.zeros((len(points), 3)))
    return load_pycolmap().Reconstruction(str(folder))


@pytest.mark.parametrize(("num_shared", "parts"), [(30, 1), (29, 2), (0, 2)])
def test_parts_with_fewer_than_30_common_points_come_apart(
    tmp_path: Path, num_shared: int, parts: int
) -> None:
    models = connected_models(model_of_two_groups(tmp_path, num_shared), ["camera"])
    assert len(models) == parts
    assert [tuple(model.poses) for model in models] == (
        [FIRST + SECOND] if parts == 1 else [FIRST, SECOND]
    )
    assert [model.num_points for model in models] == (
        [200 - num_shared] if parts == 1 else [100, 100]
    )
    for model in models:
        assert model.cameras == {"camera": CAMERA}
        assert model.error_px < 1e-3
        for name, pose in model.poses.items():
            moved = np.array(pose.translation)
            assert moved == pytest.approx((-0.2 * (FIRST + SECOND).index(name), 0, 0), abs=1e-9)
