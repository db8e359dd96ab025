"""Triangulation and connected models by pycolmap: true points, no output."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_models import CAMERAS, PINHOLE
from numpy.typing import NDArray
from poses import rigid

from megloc_kapture.errors import OutputError
from megloc_kapture.io.colmap import (
    MapImage,
    TriangulationOptions,
    load_pycolmap,
    px_from_cam,
    quiet_stderr,
    triangulate,
    write_model,
)
from megloc_kapture.io.colmap_mapping import connected_models
from megloc_kapture.values import Camera, RigidTransform

Array = NDArray[np.float64]
Triangulated = tuple[Array, Array, NDArray[np.int64]]
Matches = dict[tuple[int, int], NDArray[np.int64]]
MIXED = [CAMERAS[model] for model in ("PINHOLE", "SIMPLE_RADIAL", "OPENCV_FISHEYE")]


def scene(
    *cameras: Camera, num_images: int = 5, num_points: int = 40, offset: Array | float = 0.0
) -> tuple[Array, list[MapImage], Matches]:
    """World points, images around them with keypoints in mixed order, and all true matches."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -1.5, -1), (2, 1.5, 1), (num_points, 3))
    away = RigidTransform.from_matrix(np.eye(3), np.zeros(3) - offset)
    images, row_of_point = [], []
    for k in range(num_images):
        camera = cameras[k % len(cameras)]
        rotation = [0.05 * k, 0.12 * (k - num_images / 2), 0.1]
        near = rigid(rotation, [0.6 * (k - 2), 0.1 * k, 8.0])
        pixels = px_from_cam(camera, near.apply(points))
        assert (pixels > 0).all() and (pixels < (camera.width, camera.height)).all()
        order = rng.permutation(num_points)
        row_of_point.append(np.argsort(order))
        images.append(MapImage(f"{k}.jpg", camera, near @ away, pixels[order].astype(np.float32)))
    matches = {
        (i, j): np.stack([row_of_point[i], row_of_point[j]], axis=1)
        for i, j in combinations(range(num_images), 2)
    }
    return points + offset, images, matches


def assert_recovered(xyz: Array, points: Array) -> None:
    distance = np.linalg.norm(xyz[:, None] - points, axis=2)
    assert sorted(distance.argmin(axis=1).tolist()) == list(range(len(points)))
    assert distance.min(axis=1).max() < 1e-3


@pytest.fixture(scope="module")
def triangulated() -> Triangulated:
    _, images, matches = scene(*MIXED)
    return triangulate(images, matches)


def test_points_are_recovered_by_cameras_of_all_models(triangulated: Triangulated) -> None:
    points, _, _ = scene(*MIXED)
    xyz, errors_px, seen = triangulated
    assert_recovered(xyz, points)
    assert len(seen) == 5 * 40  # every point is seen in every image
    assert errors_px.shape == (40,) and errors_px.max() < 1e-3


def test_earth_centred_coordinates_lose_nothing(triangulated: Triangulated) -> None:
    offset, (near_xyz, _, near) = np.array([4.2e6, 1.7e5, 4.78e6]), triangulated
    points, images, matches = scene(*MIXED, offset=offset)
    xyz, _, seen = triangulate(images, matches)
    assert_recovered(xyz, points)
    np.testing.assert_allclose(xyz - offset, near_xyz, atol=1e-5)
    np.testing.assert_array_equal(seen[:, 2], near[:, 2])


def test_observations_are_matched_keypoints_by_point_and_image(triangulated: Triangulated) -> None:
    points, images, _ = scene(*MIXED)
    xyz, _, seen = triangulated
    nearest = np.linalg.norm(xyz[:, None] - points, axis=2).argmin(axis=1)
    for point, image, keypoint in seen:
        entry = images[image]
        in_cam = entry.cam_from_world.apply(points[nearest[point]][None])
        pixel = px_from_cam(entry.camera, in_cam)[0]
        np.testing.assert_allclose(entry.keypoints_px[keypoint], pixel, atol=1e-3)
    np.testing.assert_array_equal(seen, seen[np.lexsort(seen.T[::-1])])  # sorted
    # points are in the order of their observations, not in COLMAP's
    tracks = [seen[seen[:, 0] == k, 1:].tolist() for k in range(len(xyz))]
    assert tracks == sorted(tracks)


def test_without_images_or_matches_there_are_no_points() -> None:
    _, images, _ = scene(PINHOLE)
    for xyz, errors_px, seen in (triangulate([], {}), triangulate(images, {})):
        assert xyz.shape == (0, 3) and errors_px.shape == (0,)
        assert seen.shape == (0, 3)


def test_tracks_of_two_images_are_optional() -> None:
    points, images, matches = scene(PINHOLE)
    two = {(1, 3): matches[1, 3]}
    assert len(triangulate(images, two)[0]) == 0
    xyz, _, seen = triangulate(images, two, TriangulationOptions(two_view_tracks=True))
    assert_recovered(xyz, points)
    assert set(seen[:, 1].tolist()) == {1, 3}


def test_observations_with_a_large_reprojection_error_are_dropped() -> None:
    points, images, matches = scene(PINHOLE)
    keypoints = images[0].keypoints_px.copy()
    wrong = np.arange(len(keypoints)) % 2 == 0
    keypoints[wrong] += (0.0, 12.0)  # across the epipolar lines
    images[0] = replace(images[0], keypoints_px=keypoints)
    _, _, seen = triangulate(images, matches)
    rows = seen[seen[:, 1] == 0, 2]
    assert not wrong[rows].any() and len(rows) == 20


def test_nearly_parallel_rays_give_no_point() -> None:
    points, images, _ = scene(PINHOLE, num_images=3)
    first = images[0]
    close = [
        replace(first, name=f"{k}.jpg", cam_from_world=shift @ first.cam_from_world)
        for k, shift in enumerate(RigidTransform((1, 0, 0, 0), (0.01 * k, 0, 0)) for k in range(3))
    ]
    for k, image in enumerate(close):
        pixels = px_from_cam(image.camera, image.cam_from_world.apply(points))
        close[k] = replace(image, keypoints_px=pixels.astype(np.float32))
    same = np.stack([np.arange(40)] * 2, axis=1)
    assert len(triangulate(close, {(0, 1): same, (0, 2): same, (1, 2): same})[0]) == 0


def test_keypoints_may_have_more_columns_and_an_image_no_keypoints() -> None:
    points, images, matches = scene(PINHOLE, num_images=4)
    wide = [
        replace(image, keypoints_px=np.pad(image.keypoints_px, ((0, 0), (0, 2))))
        for image in images
    ]
    wide.append(replace(images[0], name="empty.jpg", keypoints_px=np.zeros((0, 2), np.float32)))
    xyz, _, seen = triangulate(wide, {**matches, (0, 4): np.zeros((0, 2), np.int64)})
    assert_recovered(xyz, points)
    assert 4 not in seen[:, 1]


def test_colmap_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    _, images, matches = scene(PINHOLE)
    assert len(triangulate(images, matches)[0]) == 40
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------------ mappers

RADIAL = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.01))
FIRST, SECOND = ("a0", "a1", "a2"), ("b0", "b1", "b2")


def model_of_two_groups(folder: Path, num_shared: int) -> object:
    """Six images in two groups; each group sees 100 points, some of them shared."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (200 - num_shared, 3))
    seen = [np.arange(100)] * 3 + [np.arange(100 - num_shared, len(points))] * 3
    images, observed = [], []
    for number, (name, rows) in enumerate(zip(FIRST + SECOND, seen, strict=True)):
        pose = RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.2 * number, 0.0, 0.0))
        px = px_from_cam(RADIAL, points[rows] + pose.translation).astype(np.float32)
        images.append(MapImage(name, RADIAL, pose, px))
        observed.append((np.arange(100), rows))
    write_model(folder, images, observed, points, np.zeros((len(points), 3)))
    return load_pycolmap().Reconstruction(str(folder))


def test_several_threads_leave_standard_error_as_it_was() -> None:
    def silence(begin_s: float) -> None:
        time.sleep(begin_s)
        with quiet_stderr():
            time.sleep(0.2)

    saved, before = os.dup(2), os.fstat(2)
    try:
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(silence, (0.0, 0.1)))
        assert os.path.samestat(os.fstat(2), before)
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def test_a_keypoint_with_two_points_keeps_the_first(tmp_path: Path) -> None:
    points, images, matches = scene(CAMERAS["PINHOLE"], num_images=2, num_points=5)
    rows = [np.append(matches[0, 1][:, side], matches[0, 1][0, side]) for side in (0, 1)]
    seen = np.array([0, 1, 2, 3, 4, 4])
    write_model(tmp_path, images, [(row, seen) for row in rows], points, np.zeros((5, 3)))
    model = load_pycolmap().Reconstruction(str(tmp_path))
    assert [len(point.track.elements) for _, point in sorted(model.points3D.items())] == [2] * 5


@pytest.mark.parametrize(("num_shared", "parts"), [(30, 1), (29, 2)])
def test_few_common_points_make_two_models(tmp_path: Path, num_shared: int, parts: int) -> None:
    models = connected_models(model_of_two_groups(tmp_path, num_shared), ["camera"])
    assert len(models) == parts
    assert [tuple(model.poses) for model in models] == (
        [FIRST + SECOND] if parts == 1 else [FIRST, SECOND]
    )
    assert [model.num_points for model in models] == (
        [200 - num_shared] if parts == 1 else [100, 100]
    )
    for model in models:
        assert model.cameras == {"camera": RADIAL}
        assert model.error_px < 1e-3
        for name, pose in model.poses.items():
            moved = np.array(pose.translation)
            assert moved == pytest.approx((-0.2 * (FIRST + SECOND).index(name), 0, 0), abs=1e-9)


def test_a_full_disk_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, images, _ = scene(PINHOLE)
    full = shutil.disk_usage(tmp_path)._replace(free=1 << 19)
    monkeypatch.setattr("megloc_kapture.io.colmap.disk_usage", lambda path: full)
    with pytest.raises(OutputError, match="0 MB are free, but COLMAP's database needs 1 MB"):
        triangulate(images, {}, scratch=tmp_path / "map")
    assert list((tmp_path / "map").iterdir()) == []
