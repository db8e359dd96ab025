"""Uncertainty of points compared with Ceres, and points with too much of it."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from camera_models import CAMERAS
from corner import pose_at
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import median_abs_deviation

from megloc_kapture.mapping.uncertainty import (
    left_with_too_few,
    mean_depths,
    point_covariances,
    point_deviations,
    too_uncertain,
)
from megloc_kapture.values import Camera, RigidTransform

Floats = NDArray[np.float64]


def synthetic(model: str, *, narrow: bool = False) -> pycolmap.Reconstruction:
    """Make COLMAP's synthetic scene with one pixel of noise.

    Its cameras surround the points; ``narrow`` moves them close together, which leaves depths
    uncertain. They are rotated about their optical axes, otherwise two entries of each rotation
    are equal.
    """
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, 8, 300
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    options.camera_params = list(CAMERAS[model].params)
    options.camera_width, options.camera_height = 640, 480
    scene = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = 1.0, 0.01
    pycolmap.synthesize_noise(noise, scene)
    for number, frame_id in enumerate(sorted(scene.frames)):
        frame = scene.frames[frame_id]
        turn = Rotation.from_rotvec((0.0, 0.0, 0.3 + number)).as_matrix()
        rolled = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3))
        if narrow:
            tilt = pycolmap.Rotation3d(Rotation.from_rotvec((0.1, -0.05, 0.2)).as_matrix())
            away = np.array([0.02 * number, 0.01 * (number % 3), 8.0])
            frame.rig_from_world = rolled * pycolmap.Rigid3d(tilt, away)
        else:
            frame.rig_from_world = rolled * frame.rig_from_world
    return scene


def ceres(scene: pycolmap.Reconstruction, ids: list[int]) -> Floats:
    """Ceres' covariances (N, 3, 3) of points with poses and cameras fixed."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in scene.images:
        config.add_image(image_id)
    for frame_id in scene.frames:
        config.set_constant_rig_from_world_pose(frame_id)
    for camera_id in scene.cameras:
        config.set_constant_cam_intrinsics(camera_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(
        pycolmap.BundleAdjustmentOptions(), config, scene
    )
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.POINTS
    options.damping = 0.0
    result = pycolmap.estimate_ba_covariance(options, scene, adjuster)
    return np.array([result.get_point_cov(point_id) for point_id in ids])


@pytest.mark.parametrize(("model", "narrow"), [("OPENCV", True), ("OPENCV_FISHEYE", False)])
def test_covariances_equal_ceres(model: str, narrow: bool) -> None:
    scene = synthetic(model, narrow=narrow)
    images = sorted(scene.images)
    cameras, poses = [], []
    for image_id in images:
        image = scene.images[image_id]
        camera = scene.cameras[image.camera_id]
        cameras.append(Camera(camera.model.name, camera.width, camera.height, tuple(camera.params)))
        pose = image.cam_from_world()
        poses.append(RigidTransform.from_matrix(pose.rotation.matrix(), np.array(pose.translation)))
    ids = sorted(scene.points3D)
    rows = [
        (number, images.index(element.image_id))
        for number, point_id in enumerate(ids)
        for element in scene.points3D[point_id].track.elements
    ]
    point_ids, image_ids = np.array(rows).T
    xyz = np.array([scene.points3D[point_id].xyz for point_id in ids])
    assert cameras[0].model == model and len(ids) == 300
    covariances = point_covariances(xyz, point_ids, image_ids, cameras, poses)
    ours = covariances[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    theirs = ceres(scene, ids)
    conditions = np.linalg.cond(theirs)
    assert conditions.min() > 1e3 if narrow else conditions.max() < 10
    scale = np.linalg.norm(theirs, axis=(1, 2), keepdims=True)
    assert np.abs((ours - theirs) / scale).max() < 1e-9
    deviations = point_deviations(covariances)
    np.testing.assert_allclose(deviations**2, np.linalg.eigvalsh(theirs), rtol=1e-7)


# around the origin, which all of them see
CENTERS = ((-1.0, 0.1, -6.0), (0.3, -0.4, -5.0), (1.2, 0.2, -6.5), (0.1, 0.9, -5.5))
POSES = [pose_at(center, 4.0 - 3 * k, 2.0 * k) for k, center in enumerate(CENTERS)]
FISHEYE = CAMERAS["OPENCV_FISHEYE"]


def test_undetermined_points_have_no_covariance() -> None:
    poses = POSES
    points = np.zeros((5, 3))
    # one view; the same view twice; no view; two views; two views, one of them from behind
    point_ids = np.array([0, 1, 1, 3, 3, 4, 4])
    image_ids = np.array([0, 1, 1, 0, 1, 0, 4])
    away = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, -9.0))
    cameras = [CAMERAS["PINHOLE"]] * 5
    result = point_covariances(points, point_ids, image_ids, cameras, [*poses, away])
    known = np.isfinite(result).all(axis=1)
    assert known.tolist() == [False, False, False, True, False]
    assert np.isnan(result[~known]).all()
    assert np.isnan(point_deviations(result)[~known]).all()
    none = np.zeros(0, np.int64)
    assert point_covariances(np.zeros((0, 3)), none, none, [], []).shape == (0, 6)
    assert np.isnan(point_covariances(np.zeros((2, 3)), none, none, [], [])).all()
    assert point_deviations(np.zeros((0, 6))).shape == (0, 3)


def test_the_order_of_observations_and_a_far_origin_do_not_matter() -> None:
    poses, cameras = POSES, [FISHEYE] * 4
    points = np.array([[0.1, 0.0, 0.2], [-0.3, 0.1, 0.0]])
    point_ids, image_ids = np.array([0, 0, 0, 1, 1, 1]), np.array([0, 1, 2, 1, 2, 3])
    straight = point_covariances(points, point_ids, image_ids, cameras, poses)
    for order in ([5, 4, 3, 2, 1, 0], [3, 0, 5, 2, 4, 1]):
        shuffled = point_covariances(points, point_ids[order], image_ids[order], cameras, poses)
        np.testing.assert_allclose(shuffled, straight, rtol=1e-12)
    offset = np.array([4.1e6, 8.5e5, 4.8e6])
    away = RigidTransform((1.0, 0.0, 0.0, 0.0), tuple((-offset).tolist()))
    moved = [pose @ away for pose in poses]
    far = point_covariances(points + offset, point_ids, image_ids, cameras, moved)
    np.testing.assert_allclose(far, straight, rtol=1e-6)


def test_images_of_the_same_centre_determine_no_points() -> None:
    """Rounding must not look like parallax."""
    rng = np.random.default_rng(2)
    turns = Rotation.from_rotvec(0.2 * rng.normal(size=(100, 3))).as_matrix()
    point_ids, image_ids = np.repeat(np.arange(50), 100), np.tile(np.arange(100), 50)
    for center in (np.zeros(3), np.array([4.1e6, 8.5e5, 4.8e6])):
        exact = [RigidTransform.from_matrix(turn, np.zeros(3)) for turn in turns]
        poses = [
            RigidTransform(pose.quat_wxyz, tuple((-pose.rotation_matrix() @ center).tolist()))
            for pose in exact
        ]
        points = center + rng.uniform((-1, -1, 2), (1, 1, 9), (50, 3))
        result = point_covariances(points, point_ids, image_ids, [FISHEYE] * 100, poses)
        assert np.isnan(result).all()


def test_mean_depths_are_those_of_the_observing_images() -> None:
    poses = [RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, z)) for z in (0.0, 1.0, 1.0)]
    xyz = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 5.0], [0.0, 0.0, 1.0]])
    depths = mean_depths(xyz, np.array([0, 0, 1]), np.arange(3, dtype=np.int32), poses)
    np.testing.assert_allclose(depths, [3.5, 6.0, np.nan])


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3), st.floats(0.5, 4.0))
def test_the_relative_limit_follows_the_scale(seed: int, scale: float, num_sigmas: float) -> None:
    rng = np.random.default_rng(seed)
    depths = rng.uniform(1.0, 50.0, 200)
    relative = np.exp(rng.normal(-6.0, 0.7, 200))
    relative[::10] = np.nan
    result = too_uncertain(relative * depths, depths, num_sigmas)
    logarithms = np.log(relative[~np.isnan(relative)])
    spread = median_abs_deviation(logarithms, scale="normal")
    expected = np.log(relative) > np.median(logarithms) + num_sigmas * spread
    near = np.abs(np.log(relative) - np.median(logarithms) - num_sigmas * spread) < 1e-5
    np.testing.assert_array_equal(result[~near], expected[~near])
    # the noise of images and the unit of the world change nothing
    for deviations, other in ((relative * depths * scale, depths), (relative * depths, depths)):
        again = too_uncertain(deviations * scale, other * scale, num_sigmas)
        np.testing.assert_array_equal(again[~near], result[~near])


def test_the_relative_limit_allows_unknown_deviations() -> None:
    unknown = np.array([np.nan, np.nan])
    assert not too_uncertain(unknown, np.ones(2), 2.0).any()
    assert not too_uncertain(np.full(5, 0.1), np.ones(5), 2.0).any()  # all alike
    infinite = np.array([0.1, 0.11, 0.12, np.inf])
    assert too_uncertain(infinite, np.ones(4), 2.0).tolist() == [False, False, False, True]


def test_points_that_lose_no_observation_stay() -> None:
    point_ids = np.array([0, 1, 1, 2, 2, 2, 3])
    dropped = np.array([0, 0, 1, 1, 0, 0, 1], bool)
    # 0: lifted by depth; 1: one of two left; 2: two of three left; 3: none left; 4: not observed
    gone = left_with_too_few(point_ids, dropped, 5, 2)
    assert gone.tolist() == [False, True, False, True, False]
