"""Labels of keypoints against explicit definitions, on walls of exact depth."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from corner import CAMERA, depth_m, pose_at
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.plugins import DepthView
from megloc_kapture.training.labels import (
    IGNORED,
    NEGATIVE_PX,
    POSITIVE_PX,
    UNMATCHED,
    PosedView,
    labels_of_homography,
    labels_of_views,
    overlap,
    reproject,
)
from megloc_kapture.values import Camera, RigidTransform

IDENTITY = RigidTransform.identity()
WITHOUT_DEPTH = -3
DISTORTED = Camera("OPENCV", 400, 300, (300.0, 302.0, 198.0, 151.0, -0.12, 0.03, 1e-3, -2e-3))


def corner_view(pose: RigidTransform) -> PosedView:
    return PosedView(CAMERA, pose, DepthView(CAMERA, depth_m(pose), IDENTITY))


def brute_force(
    px_a: NDArray[np.float64], px_b: NDArray[np.float64], a: PosedView, b: PosedView
) -> list[int]:
    """Labels of a's keypoints with depth, one by one; WITHOUT_DEPTH of the others."""
    a_in_b, known_a, visible_a = reproject(px_a, a, b)
    b_in_a, _, visible_b = reproject(px_b, b, a)
    distance = np.full((len(px_a), len(px_b)), np.inf)
    for i, j in itertools.product(np.flatnonzero(visible_a), np.flatnonzero(visible_b)):
        distance[i, j] = max(np.hypot(*(a_in_b[i] - px_b[j])), np.hypot(*(b_in_a[j] - px_a[i])))
    result = []
    for i, known in enumerate(known_a):
        j = int(distance[i].argmin())
        mutual = int(distance[:, j].argmin()) == i
        away = np.nan_to_num(np.hypot(*(a_in_b[i] - px_b).T), nan=np.inf).min()
        if not known:
            result.append(WITHOUT_DEPTH)
        elif mutual and distance[i, j] < POSITIVE_PX:
            result.append(j)
        else:
            result.append(UNMATCHED if away > NEGATIVE_PX else IGNORED)
    return result


def keypoints(a: PosedView, b: PosedView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Random ones, and in b some that are those of a, more or less."""
    rng = np.random.default_rng(0)
    px_a = rng.uniform(0, (a.camera.width, a.camera.height), (150, 2))
    moved, _, visible = reproject(px_a, a, b)
    near = moved[visible] + rng.normal(0, 2.0, (visible.sum(), 2))
    far = rng.uniform(0, (b.camera.width, b.camera.height), (75, 2))
    inside = ((near > 1) & (near < (b.camera.width - 1, b.camera.height - 1))).all(axis=1)
    return px_a, np.concatenate([near[inside], far])


def test_labels_equal_brute_force() -> None:
    a, pose = corner_view(pose_at((-1.0, 0, 0), -4, 0)), pose_at((0.4, 0.1, 0.3), 4, 1)
    b = PosedView(DISTORTED, pose, DepthView(CAMERA, depth_m(pose), IDENTITY))
    px_a, px_b = keypoints(a, b)
    result = labels_of_views(px_a, px_b, a, b)
    for px, other_px, view, other, partner in (
        (px_a, px_b, a, b, result.partner_a),
        (px_b, px_a, b, a, result.partner_b),
    ):
        expected = np.array(brute_force(px, other_px, view, other))
        has_label = expected != WITHOUT_DEPTH
        assert has_label.sum() > 75
        np.testing.assert_array_equal(partner[has_label], expected[has_label])
        assert (expected >= 0).sum() > 20
        assert min((expected == UNMATCHED).sum(), (expected == IGNORED).sum()) > 2
    matches = result.matches()
    np.testing.assert_array_equal(result.partner_b[matches[:, 1]], matches[:, 0])


def test_hidden_keypoints_have_no_partner() -> None:
    a, b = corner_view(pose_at((-1.5, 0, 0), -4, 0)), corner_view(pose_at((1.0, 0, 0), 3, 0))
    px_a = np.random.default_rng(1).uniform((50, 50), (350, 250), (200, 2))
    px_in_b, known, visible = reproject(px_a, a, b)
    assert known.all() and visible.sum() > 80
    exact = labels_of_views(px_a, px_in_b[visible], a, b)
    assert (exact.partner_a[visible] == np.arange(visible.sum())).all()
    # an object in front of the second camera
    blocked = np.where(np.arange(400) < 200, 1.0, b.depth.depth_m).astype(np.float32)
    hidden = PosedView(b.camera, b.cam_from_world, DepthView(CAMERA, blocked, IDENTITY))
    behind = px_in_b[visible, 0] < 198
    labels = labels_of_views(px_a, px_in_b[visible], a, hidden)
    assert behind.sum() > 20
    assert (labels.partner_a[visible][behind] == IGNORED).all()
    clear = px_in_b[visible, 0] > 202
    assert (labels.partner_a[visible][clear] >= 0).all()


def test_keypoints_without_depth_by_epipolar_lines() -> None:
    a, b = corner_view(pose_at((-0.5, 0, 0), 0, 0)), corner_view(pose_at((0.5, 0, 0), 0, 0))
    nothing = DepthView(CAMERA, np.zeros((300, 400), np.float32), IDENTITY)
    blind = [PosedView(CAMERA, view.cam_from_world, nothing) for view in (a, b)]
    # the cameras stand side by side: epipolar lines are rows
    px_a = np.array([[100.0, 80.0], [100.0, 200.0]])
    px_b = np.array([[300.0, 80.0 + 3.0], [20.0, 150.0]])
    labels = labels_of_views(px_a, px_b, *blind)
    assert labels.partner_a.tolist() == [IGNORED, UNMATCHED]
    assert labels.partner_b.tolist() == [IGNORED, UNMATCHED]
    # of one centre there are no such lines
    same = [PosedView(CAMERA, a.cam_from_world, nothing)] * 2
    assert (labels_of_views(px_a, px_b, *same).partner_a == IGNORED).all()


def test_a_separate_depth_camera_and_distortion() -> None:
    pose_a, pose_b = pose_at((-0.6, 0, 0), -2, 0), pose_at((0.3, 0.1, 0.2), 1, 1)
    image_from_depth = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.05, -0.02, 0.01))
    views = []
    for pose in (pose_a, pose_b):
        depth = depth_m(image_from_depth.inverse() @ pose)
        views.append(PosedView(DISTORTED, pose, DepthView(CAMERA, depth, image_from_depth)))
    a, b = views
    px_a = np.random.default_rng(2).uniform((60, 60), (340, 240), (150, 2))
    rays = bearing_rays(DISTORTED, px_a)
    # the wall before both cameras is the plane z = 6 of the room
    origin, along = pose_a.center(), rays @ pose_a.rotation_matrix()
    points = origin + along * ((6.0 - origin[2]) / along[:, 2])[:, None]
    on_wall = points[:, 0] < 1.5
    expected = project(DISTORTED, pose_b, points)
    px_in_b, _, visible = reproject(px_a, a, b)
    assert (on_wall & visible).sum() > 60
    np.testing.assert_allclose(px_in_b[on_wall & visible], expected[on_wall & visible], atol=0.05)


def test_labels_of_a_homography_equal_those_of_a_plane() -> None:
    """The wall of the corner, once by its depth and once by the homography between its images."""
    a, b = corner_view(pose_at((-2.5, 0, 0), -8, 2)), corner_view(pose_at((-2.0, 0.2, 0.3), -6, 0))
    grid = np.stack(np.meshgrid(np.arange(20.5, 380, 20), np.arange(20.5, 280, 20)), -1).reshape(
        -1, 2
    )
    px_in_b, _, visible = reproject(grid, a, b)
    grid, px_in_b = grid[visible], px_in_b[visible]
    b_from_a = cv2.findHomography(grid, px_in_b)[0]
    rng = np.random.default_rng(3)
    px_b = np.concatenate(
        [px_in_b + rng.normal(0, 2.5, px_in_b.shape), rng.uniform(0, 300, (40, 2))]
    )
    by_depth = labels_of_views(grid, px_b, a, b)
    by_plane = labels_of_homography(grid, px_b, b_from_a, (400, 300), (400, 300))
    np.testing.assert_array_equal(by_depth.partner_a, by_plane.partner_a)
    assert len(by_plane.matches()) > 50 and (by_plane.partner_a == IGNORED).any()


def test_overlap_is_the_smaller_share() -> None:
    near, far = corner_view(pose_at((-2, 0, 2.5), 0, 0)), corner_view(pose_at((-2, 0, 0), 0, 0))
    assert overlap(near, near) == 1.0
    assert overlap(near, far) == overlap(far, near)
    # the far view contains all of the near one, which shows (3.5 / 6)^2 of it
    assert overlap(near, far) == pytest.approx((3.5 / 6) ** 2, abs=0.04)
    away = corner_view(pose_at((-2, 0, 0), 120, 0))
    assert overlap(far, away) == 0.0


def test_empty_images_have_no_labels() -> None:
    view = corner_view(pose_at((0, 0, 0), 0, 0))
    none, some = np.zeros((0, 2)), np.array([[10.0, 10.0]])
    for px_a, px_b in ((none, some), (some, none), (none, none)):
        labels = labels_of_views(px_a, px_b, view, view)
        assert labels.partner_a.tolist() == [IGNORED] * len(px_a)
        assert len(labels.matches()) == 0
