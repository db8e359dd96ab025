"""Lifting keypoints through depth, against planes and steps whose depth is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.mapping.lifting import LiftingOptions, lift_keypoints
from megloc_kapture.values import Camera, RigidTransform

IMAGE = Camera("SIMPLE_RADIAL", 640, 480, (520.0, 321.0, 238.0, -0.05))
DEPTH = Camera("PINHOLE", 320, 240, (290.0, 292.0, 160.0, 120.0))
IDENTITY = RigidTransform.identity()
BESIDE = RigidTransform.from_matrix(
    np.array([[0.9998, -0.02, 0.0], [0.02, 0.9998, 0.0], [0.0, 0.0, 1.0]]),
    np.array([0.04, 0.01, 0]),
)


def plane_depth(camera: Camera) -> NDArray[np.float32]:
    """Depth of the plane z = 2 + 0.3 x in the camera's frame."""
    fx, _, cx, _ = camera.params
    x = (np.arange(camera.width) + 0.5 - cx) / fx
    return np.tile((2 / (1 - 0.3 * x)).astype(np.float32), (camera.height, 1))


@pytest.mark.parametrize("image_from_depth", [IDENTITY, BESIDE], ids=["registered", "beside"])
def test_points_lie_on_the_plane_and_on_their_rays(image_from_depth: RigidTransform) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    keypoints = np.random.default_rng(0).uniform([180, 120], [460, 360], (500, 2))
    points, valid = lift_keypoints(
        keypoints.astype(np.float32), plane_depth(DEPTH), IMAGE, DEPTH, image_from_depth
    )
    assert valid.all()
    in_depth = image_from_depth.inverse().apply(points)
    np.testing.assert_allclose(in_depth[:, 2], 2 + 0.3 * in_depth[:, 0], atol=2e-3)
    camera = pycolmap.Camera(
        model=IMAGE.model, width=IMAGE.width, height=IMAGE.height, params=IMAGE.params
    )
    np.testing.assert_allclose(camera.img_from_cam(points), keypoints, atol=1e-3)


def test_the_centre_of_the_first_pixel_is_half() -> None:
    depth = np.full((2, 3), 5.0, np.float32)
    depth[0, 0] = 4.9
    camera = Camera("PINHOLE", 3, 2, (10.0, 10.0, 1.5, 1.0))
    keypoints = np.array([[0.5, 0.5], [1.0, 0.5], [2.5, 1.5]])
    points, valid = lift_keypoints(keypoints, depth, camera, camera, IDENTITY)
    assert valid.all()
    np.testing.assert_allclose(points[:, 2], [4.9, 4.95, 5.0], rtol=1e-6)


def test_an_edge_has_no_depth() -> None:
    depth = np.full((100, 100), 2.0, np.float32)
    depth[:, 50:] = 4.0
    camera = Camera("PINHOLE", 100, 100, (100.0, 100.0, 50.0, 50.0))
    keypoints = np.array([[48.0, 20.0], [50.0, 20.0], [52.0, 20.0]])
    points, valid = lift_keypoints(keypoints, depth, camera, camera, IDENTITY)
    assert valid.tolist() == [True, False, True]
    assert np.isnan(points[1]).all()
    loose = LiftingOptions(max_jump=1.5)
    assert lift_keypoints(keypoints, depth, camera, camera, IDENTITY, loose)[1].all()


def test_missing_depth_falls_back_to_the_nearest_that_is_there() -> None:
    depth = np.full((4, 4), 3.0, np.float32)
    depth[1, 2], depth[2, 1], depth[2, 2] = 0.0, np.nan, -1.0
    depth[1, 1] = 2.9
    camera = Camera("PINHOLE", 4, 4, (10.0, 10.0, 2.0, 2.0))
    points, valid = lift_keypoints(np.array([[1.6, 1.6]]), depth, camera, camera, IDENTITY)
    assert valid.all()
    np.testing.assert_allclose(points[0, 2], 2.9, rtol=1e-6)
    nothing = np.zeros((4, 4), np.float32)
    assert not lift_keypoints(np.array([[1.6, 1.6]]), nothing, camera, camera, IDENTITY)[1].any()


def test_what_the_depth_camera_does_not_see_has_none() -> None:
    wide = Camera("PINHOLE", 640, 480, (300.0, 300.0, 320.0, 240.0))
    keypoints = np.array([[5.0, 240.0], [320.0, 240.0]])
    _, valid = lift_keypoints(keypoints, plane_depth(DEPTH), wide, DEPTH, IDENTITY)
    assert valid.tolist() == [False, True]
    empty, none = lift_keypoints(np.zeros((0, 2)), plane_depth(DEPTH), wide, DEPTH, IDENTITY)
    assert empty.shape == (0, 3) and none.shape == (0,)
