"""Rejection against COLMAP's own filters, on the same cameras, points and keypoints."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import median_abs_deviation

from megloc_kapture.geometry.cameras import project
from megloc_kapture.mapping.rejection import (
    ObservedPoints,
    UncertaintyOptions,
    left_with_too_few,
    mean_depths,
    reprojection_errors_px,
    seen_at_angle,
    too_uncertain,
)
from megloc_kapture.values import Camera, RigidTransform

CAMERAS = (
    Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.05)),
    Camera("OPENCV_FISHEYE", 640, 480, (300.0, 310.0, 320.0, 240.0, 0.01, 0.002, 0.0, 0.0)),
)


def scene(seed: int) -> tuple[ObservedPoints, np.ndarray]:
    """Points seen by two or more of twelve images, many at small angles, some keypoints far off."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(12):
        rotation = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()
        center = rng.normal(0, [0.3, 0.2, 0.1])
        poses.append(RigidTransform.from_matrix(rotation, -rotation @ center))
    depths = rng.uniform(2, 30, 400)
    xyz = np.column_stack([rng.uniform(-0.3, 0.3, (400, 2)), np.ones(400)]) * depths[:, None]
    seen = rng.random((400, 12)) < rng.uniform(0.15, 0.6, (400, 1))
    seen[np.arange(400), rng.integers(0, 6, 400)] = True
    seen[np.arange(400), rng.integers(6, 12, 400)] = True
    point_ids, image_ids = np.nonzero(seen)
    observed = ObservedPoints(
        xyz, point_ids, image_ids.astype(np.int32), [CAMERAS[i % 2] for i in range(12)], poses
    )
    keypoints = np.empty((len(point_ids), 2))
    for row, (point, image) in enumerate(zip(point_ids, image_ids, strict=True)):
        keypoints[row] = project(CAMERAS[image % 2], poses[image], xyz[point][None])[0]
    keypoints += rng.normal(0, 1.0, keypoints.shape)
    off = rng.random(len(keypoints)) < 0.25
    keypoints[off] += rng.normal(0, 4.0, (int(off.sum()), 2))
    return observed, keypoints


def colmap_filter(
    observed: ObservedPoints, keypoints: np.ndarray, max_error: float, min_angle: float
) -> dict[int, set[int]]:
    """Images that observe each point after COLMAP's filter; points that are gone are missing."""
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction()
    for camera_id, own in enumerate(CAMERAS, 1):
        camera = pycolmap.Camera(
            model=own.model, width=own.width, height=own.height, params=list(own.params)
        )
        camera.camera_id = camera_id
        reconstruction.add_camera_with_trivial_rig(camera)
    rows_of: dict[int, list[int]] = {}
    for image, pose in enumerate(observed.cams_from_world):
        rows = np.flatnonzero(observed.image_ids == image)
        rows_of[image] = rows.tolist()
        w, x, y, z = pose.quat_wxyz
        reconstruction.add_image_with_trivial_frame(
            pycolmap.Image(
                image_id=image + 1,
                name=f"{image}.png",
                camera_id=image % 2 + 1,
                keypoints=keypoints[rows],
            ),
            pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), pose.translation),
        )
    ids = {}
    for point, xyz in enumerate(observed.xyz):
        elements = [
            pycolmap.TrackElement(int(observed.image_ids[row]) + 1, place)
            for row in np.flatnonzero(observed.point_ids == point)
            for place in [rows_of[int(observed.image_ids[row])].index(int(row))]
        ]
        ids[reconstruction.add_point3D(xyz, pycolmap.Track(elements))] = point
    manager = pycolmap.ObservationManager(reconstruction)
    manager.filter_all_points3D(max_error, min_angle)
    return {
        ids[number]: {element.image_id - 1 for element in point.track.elements}
        for number, point in reconstruction.points3D.items()
    }


@pytest.mark.parametrize(("max_error", "min_angle"), [(4.0, 1.5), (1.5, 0.5), (50.0, 4.0)])
def test_what_is_left_is_what_colmap_leaves(max_error: float, min_angle: float) -> None:
    observed, keypoints = scene(3)
    dropped = reprojection_errors_px(observed, keypoints) > max_error
    gone = left_with_too_few(observed.point_ids, dropped, 400, 2)
    kept = ~dropped & ~gone[observed.point_ids]
    left = ObservedPoints(
        observed.xyz,
        observed.point_ids[kept],
        observed.image_ids[kept],
        observed.cameras,
        observed.cams_from_world,
    )
    wide = seen_at_angle(left, min_angle)
    expected = colmap_filter(observed, keypoints, max_error, min_angle)
    assert set(np.flatnonzero(wide).tolist()) == set(expected)
    assert 0 < len(expected) < 400
    for point, images in expected.items():
        assert set(left.image_ids[left.point_ids == point].tolist()) == images


def test_angles_of_long_tracks_compare_all_pairs() -> None:
    # seven images on a line: only the outermost two see the point at more than 11 degrees
    centers = np.array([[0.1 * i, 0.0, 0.0] for i in range(7)])
    poses = [RigidTransform((1.0, 0.0, 0.0, 0.0), tuple(-c)) for c in centers]
    observed = ObservedPoints(
        np.array([[0.3, 0.0, 3.0]]),
        np.zeros(7, np.int64),
        np.arange(7, dtype=np.int32),
        [CAMERAS[0]] * 7,
        poses,
    )
    widest = 2 * np.degrees(np.arctan(0.1))
    assert seen_at_angle(observed, widest - 0.01).all()
    assert not seen_at_angle(observed, widest + 0.01).any()


def test_points_behind_a_camera_are_infinitely_wrong() -> None:
    observed = ObservedPoints(
        np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]),
        np.array([0, 1]),
        np.zeros(2, np.int32),
        [CAMERAS[0]],
        [RigidTransform.identity()],
    )
    errors = reprojection_errors_px(observed, np.array([[320.0, 240.0], [323.0, 244.0]]))
    np.testing.assert_allclose(errors, [np.inf, 5.0])


def test_mean_depths() -> None:
    poses = [RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, float(t))) for t in (0, 1)]
    observed = ObservedPoints(
        np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 5.0], [0.0, 0.0, 1.0]]),
        np.array([0, 0, 1]),
        np.array([0, 1, 1], np.int32),
        [CAMERAS[0]] * 2,
        poses,
    )
    np.testing.assert_allclose(mean_depths(observed), [3.5, 6.0, np.nan])


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({}, [0, 0, 0, 0, 0, 0]),
        ({"max_deviation": 0.02}, [0, 0, 1, 1, 0, 0]),
        ({"max_relative_deviation": 0.01}, [0, 1, 0, 0, 0, 0]),
        ({"keep_quantile": 0.8}, [0, 0, 0, 1, 0, 0]),
        ({"keep_quantile": 0.2}, [0, 1, 1, 1, 0, 1]),
        ({"max_deviation": 0.02, "max_relative_deviation": 0.01}, [0, 1, 1, 1, 0, 0]),
    ],
)
def test_uncertain_points(limits: dict[str, Any], expected: list[int]) -> None:
    deviations = np.array([0.005, 0.015, 0.03, 0.05, np.nan, 0.02])
    depths = np.array([1.0, 1.0, 5.0, 10.0, 1.0, 5.0])
    options = UncertaintyOptions.model_validate(limits)
    assert options.needs_deviations() == bool(limits)
    assert too_uncertain(deviations, depths, options).tolist() == [bool(e) for e in expected]


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        # each limit by itself: above it goes, at it stays, below it stays
        ({"max_deviation": 2.0}, [0, 0, 1]),
        ({"max_relative_deviation": 0.2}, [0, 0, 1]),
        ({"keep_quantile": 2 / 3}, [0, 0, 1]),
        ({"max_robust_sigmas": 0.5}, [0, 0, 1]),
    ],
)
def test_the_uncertain_go_and_the_sure_stay(limits: dict[str, Any], expected: list[int]) -> None:
    deviations = np.array([1.0, 2.0, 3.0])
    found = too_uncertain(deviations, np.full(3, 10.0), UncertaintyOptions.model_validate(limits))
    assert found.tolist() == [bool(e) for e in expected]


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3), st.floats(0.5, 4.0))
def test_a_limit_of_the_scenes_own_follows_its_scale(
    seed: int, scale: float, num_sigmas: float
) -> None:
    rng = np.random.default_rng(seed)
    depths = rng.uniform(1.0, 50.0, 200)
    relative = np.exp(rng.normal(-6.0, 0.7, 200))
    relative[::10] = np.nan
    options = UncertaintyOptions(max_robust_sigmas=num_sigmas)
    found = too_uncertain(relative * depths, depths, options)
    logarithms = np.log(relative[~np.isnan(relative)])
    spread = median_abs_deviation(logarithms, scale="normal")
    expected = np.log(relative) > np.median(logarithms) + num_sigmas * spread
    near = np.abs(np.log(relative) - np.median(logarithms) - num_sigmas * spread) < 1e-5
    np.testing.assert_array_equal(found[~near], expected[~near])
    # images ten times as noisy, or a world in another unit, change nothing
    for deviations, other in ((relative * depths * scale, depths), (relative * depths, depths)):
        again = too_uncertain(deviations * scale, other * scale, options)
        np.testing.assert_array_equal(again[~near], found[~near])


def test_a_limit_of_the_scenes_own_bears_what_is_unknown() -> None:
    options = UncertaintyOptions(max_robust_sigmas=2.0)
    unknown = np.array([np.nan, np.nan])
    assert not too_uncertain(unknown, np.ones(2), options).any()
    assert not too_uncertain(np.full(5, 0.1), np.ones(5), options).any()  # all alike
    infinite = np.array([0.1, 0.11, 0.12, np.inf])
    assert too_uncertain(infinite, np.ones(4), options).tolist() == [False, False, False, True]


def test_who_loses_nothing_stays() -> None:
    point_ids = np.array([0, 1, 1, 2, 2, 2, 3])
    dropped = np.array([0, 0, 1, 1, 0, 0, 1], bool)
    # 0: a lifted point; 1: one of two left; 2: two of three left; 3: nothing left; 4: never seen
    gone = left_with_too_few(point_ids, dropped, 5, 2)
    assert gone.tolist() == [False, True, False, True, False]
