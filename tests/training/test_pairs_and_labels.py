"""Pairs of a rendered kapture and of photographs, and the labels of their keypoints."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from corner import CAMERA, depth_m, pose_at, render, write_kapture
from images import texture
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureFolder, read_pairs, write_pairs
from megloc_kapture.plugins import DepthView
from megloc_kapture.training import pairs as training_pairs
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
from megloc_kapture.training.pairs import Photographs, PosedPairs, random_view
from megloc_kapture.values import Camera, RigidTransform
from tests.training.conftest import POSES

SMALL = 200  # longer side, px


def test_pairs_are_drawn_from_overlap_bins(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = PosedPairs(KaptureFolder(walk), SMALL)
    assert source.counts()["images"] == 5 and source.counts()["pairs"] > 4
    baselines = {}
    for low, high in ((0.3, 0.5), (0.5, 0.7)):
        monkeypatch.setattr(training_pairs, "_OVERLAP_BINS", (low, high))
        narrow = PosedPairs(KaptureFolder(walk), SMALL)
        moved = []
        for seed in range(8):
            a, b = narrow.draw(np.random.default_rng(seed)).views or ()
            b_from_a = b.cam_from_world @ a.cam_from_world.inverse()
            moved.append(np.linalg.norm(b_from_a.center()))
        baselines[low] = np.mean(moved)
    assert baselines[0.3] > baselines[0.5] + 0.4


def test_measured_overlaps_are_read_again(walk: Path, other_walk: Path, tmp_path: Path) -> None:
    path = tmp_path / "overlaps" / "0.txt"
    source = PosedPairs(KaptureFolder(walk), SMALL, measured=path)
    pairs = read_pairs(path)
    assert len(pairs) == 10 and 0.5 < max(pair.score for pair in pairs) < 1
    # the file's overlaps are used: all but one pair overlap too much
    write_pairs(path, [replace(p, score=0.99) for p in pairs[1:]] + [replace(pairs[0], score=0.2)])
    again = PosedPairs(KaptureFolder(walk), SMALL, measured=path)
    assert again.counts()["pairs"] == 1 < source.counts()["pairs"]
    with pytest.raises(DataError, match=r"0\.txt: image '0\.png' lacks a pose or depth in .*; -f"):
        PosedPairs(KaptureFolder(other_walk), SMALL, measured=path)


def test_pairs_have_reduced_images_and_geometry(walk: Path) -> None:
    source = PosedPairs(KaptureFolder(walk), SMALL)
    pair, again = (source.draw(np.random.default_rng(3)) for _ in range(2))
    assert pair.keys == again.keys and pair.keys is not None and pair.views is not None
    names = [Path(key).name for key in pair.keys]
    assert names[0] != names[1]
    for name, image, view in zip(names, pair.images, pair.views, strict=True):
        assert image.shape == (150, 200, 3)
        assert (view.camera.width, view.camera.height) == (200, 150)
        assert view.camera.params[0] == pytest.approx(150.0)
        whole = render(POSES[name]).astype(np.float64)
        halved = whole.reshape(150, 2, 200, 2, 3).mean(axis=(1, 3))
        assert np.abs(image - halved).max() <= 1
        np.testing.assert_array_equal(view.depth.depth_m, depth_m(POSES[name]))
    # a point of the wall is where both cameras see it
    a, b = (POSES[name] for name in names)
    point = np.array([[-1.5, 0.3, 6.0]])
    px = []
    for pose in (a, b):
        x, y, z = pose.apply(point)[0]
        px.append(np.array([[150 * x / z + 100, 151 * y / z + 75]]))
    assert pair.label(px[0], px[1]).partner_a.tolist() == [0]
    assert pair.label(px[0], px[1] + 10).partner_a.tolist() == [-1]
    assert {tuple(source.draw(np.random.default_rng(k)).keys or ()) for k in range(30)} >= {
        pair.keys,
        (pair.keys[1], pair.keys[0]),
    }


def test_invalid_training_data_is_refused(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_kapture(tmp_path / "flat", POSES, with_poses=True)
    with pytest.raises(DataError, match=r"flat: no two images with a pose .* and a depth map"):
        PosedPairs(KaptureFolder(tmp_path / "flat"), SMALL)
    monkeypatch.setattr(training_pairs, "_OVERLAP_BINS", (0.98, 0.99))
    with pytest.raises(
        DataError, match=r"no pair of images overlaps by 0\.98 to 0\.99; the 10 candidate pairs"
    ):
        PosedPairs(KaptureFolder(walk), SMALL)
    shutil.copytree(walk, tmp_path / "holes")
    (tmp_path / "holes" / "sensors" / "records_data" / "2.png").unlink()
    with pytest.raises(DataError, match=r"2\.png: no such image"):
        PosedPairs(KaptureFolder(tmp_path / "holes"), SMALL)
    with pytest.raises(DataError, match="no such folder"):
        Photographs(tmp_path / "nowhere", SMALL)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no image"):
        Photographs(tmp_path / "empty", SMALL)


def test_views_of_one_photograph(tmp_path: Path) -> None:
    write_image(tmp_path / "sub" / "photo.jpg", render(POSES["2.png"]))
    (tmp_path / "notes.txt").write_text("no image")
    source = Photographs(tmp_path, SMALL)
    assert source.counts() == {"images": 1}
    pair, again = (source.draw(np.random.default_rng(0)) for _ in range(2))
    assert pair.images[0].shape == (150, 200, 3) and pair.keys is None and pair.views is None
    assert pair.images[0].tobytes() == again.images[0].tobytes() != pair.images[1].tobytes()
    grid = np.stack(np.meshgrid(np.arange(0.5, 200, 4), np.arange(0.5, 150, 4)), -1).reshape(-1, 2)
    matches = pair.label(grid, grid).matches()
    assert len(matches) > 50
    # partners of a grid under a homography are near one, fitted to them
    a, b = (grid[rows] for rows in matches.T)
    px_in_b = cv2.perspectiveTransform(a[None], cv2.findHomography(a, b)[0])[0]
    assert np.linalg.norm(px_in_b - b, axis=1).mean() < 3


def bilinear(image: NDArray[np.uint8], px: NDArray[np.float64]) -> NDArray[np.float64]:
    at = (px - 0.5).T[::-1]
    channels = np.moveaxis(image.astype(np.float64), 2, 0)
    return np.stack([map_coordinates(channel, at, order=1) for channel in channels], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_a_view_follows_its_homography(seed: int) -> None:
    image = texture(240, 320, sigma_px=6.0)
    rng = np.random.default_rng(seed)
    view, view_from_image = random_view(image, (160, 120), rng)
    assert view.shape == (120, 160, 3)
    px = rng.uniform((2, 2), (158, 118), (200, 2))
    px_in_image = cv2.perspectiveTransform(px[None], np.linalg.inv(view_from_image))[0]
    # all of it lies in the photograph
    assert (px_in_image > -1e-3).all() and (px_in_image < (320.001, 240.001)).all()
    inside = ((px_in_image > 1) & (px_in_image < (318, 238))).all(axis=1)
    error = bilinear(view, px[inside]) - bilinear(image, px_in_image[inside])
    assert np.abs(error).mean() < 1.0


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
