"""Exports of cameras, compared with OpenCV and COLMAP."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from poses import random_pose

from megloc_kapture.cli.info import describe_sizes
from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.images import image_size, write_image
from megloc_kapture.pipeline.export import (
    ExportedImage,
    export,
    export_colmap,
    export_nerfstudio,
    export_tum,
    export_undistorted,
    frustum,
)
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.values import Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

NO_ROWS = np.zeros(0, np.int64)
NO_POINTS = np.zeros((0, 6))


def image(
    camera: Camera, pose: RigidTransform, *, timestamp: int = 0, path: Path = Path("missing.jpg")
) -> ExportedImage:
    return ExportedImage(
        name="a.jpg",
        camera=camera,
        cam_from_world=pose,
        keypoints_px=np.zeros((0, 2), np.float32),
        path=path,
        timestamp=timestamp,
        sensor="cam",
        is_query=False,
        rows=NO_ROWS,
        points=NO_ROWS,
    )


@pytest.mark.parametrize(
    "camera",
    [
        Camera("SIMPLE_RADIAL", 640, 480, (500, 320, 240, 0.1)),
        Camera("OPENCV", 640, 480, (500, 510, 320, 240, 0.1, 0.01, 0.001, 0.002)),
        Camera("OPENCV_FISHEYE", 640, 480, (500, 510, 320, 240, 0.1, 0.01, 0.001, 0.002)),
        Camera("SIMPLE_RADIAL_FISHEYE", 640, 480, (500, 320, 240, 0.1)),
        Camera("RADIAL_FISHEYE", 640, 480, (500, 320, 240, 0.1, 0.01)),
    ],
    ids=lambda camera: camera.model,
)
def test_cameras_of_nerfstudio_project_like_opencv(camera: Camera, tmp_path: Path) -> None:
    import cv2

    (tmp_path / "a.jpg").touch()
    posed = image(camera, RigidTransform.identity(), path=tmp_path / "a.jpg")
    export_nerfstudio([posed], NO_POINTS, tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    (frame,) = content["frames"]
    matrix = np.array(
        [[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1.0]]
    )
    points = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 5), (20, 3))
    fisheye = content["camera_model"] == "OPENCV_FISHEYE"  # where nerfstudio reads it
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    distortion = np.array([frame.get(name, 0.0) for name in names])
    zero, projection = np.zeros(3), cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    pixels, _ = projection(points[:, None], zero, zero, matrix, distortion)
    expected = project(camera, RigidTransform.identity(), points)
    np.testing.assert_allclose(pixels.reshape(-1, 2), expected, atol=1e-8)


def test_nerfstudio_takes_no_fisheye_with_other_cameras(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").touch()
    cameras = Camera.pinhole(6, 4, 5), Camera("OPENCV_FISHEYE", 6, 4, (5, 5, 3, 2, 0, 0, 0, 0))
    images = [image(c, RigidTransform.identity(), path=tmp_path / "a.jpg") for c in cameras]
    with pytest.raises(DataError, match="OPENCV and OPENCV_FISHEYE: choose one with --sensor"):
        export_nerfstudio(images, NO_POINTS, tmp_path)


def test_tum_timestamps_are_seconds_or_frame_numbers(tmp_path: Path) -> None:
    camera, pose = Camera.pinhole(6, 4, 5), RigidTransform.identity()
    for timestamp, column in ((1602074877390449152, "1602074877.390449152"), (17, "17")):
        export_tum([image(camera, pose, timestamp=timestamp)], tmp_path / "a.tum")
        assert (tmp_path / "a.tum").read_text().split()[0] == column


def test_undistorted_model_for_gaussian_splatting(tmp_path: Path) -> None:
    camera = Camera("OPENCV_FISHEYE", 640, 480, (400, 410, 320, 240, 0.1, 0.01, 0.0, 0.0))
    rng, pose = np.random.default_rng(0), RigidTransform.identity()
    points = np.concatenate([rng.uniform((-1, -1, 3), (1, 1, 5), (20, 3)), np.ones((20, 3))], 1)
    rows = np.arange(20)
    images = []
    for name in ("left/a.png", "right/a.png"):
        (tmp_path / name).parent.mkdir()
        write_image(tmp_path / name, rng.integers(0, 255, (480, 640, 3), np.uint8))
        pixels = project(camera, pose, points[:, :3])
        posed = image(camera, pose, path=tmp_path / name)
        images.append(replace(posed, name=name, keypoints_px=pixels, rows=rows, points=rows))
    (out := tmp_path / "out").mkdir()
    export_undistorted(images, points, out)

    model = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    model.update_point_3d_errors()
    assert {found.model.name for found in model.cameras.values()} == {"PINHOLE"}
    assert model.num_points3D() == 20 and model.compute_num_observations() == 40
    assert model.compute_mean_reprojection_error() < 1e-4
    for found in model.images.values():
        assert found.name in ("left_a.png", "right_a.png")
        assert image_size(out / "images" / found.name) == (found.camera.width, found.camera.height)
    assert sorted(path.name for path in out.iterdir()) == ["images", "sparse"]


def test_images_that_a_format_cannot_store_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").touch()
    odd = Camera("THIN_PRISM_FISHEYE", 640, 480, (500, 500, 320, 240, *[0.0] * 8))
    pose = RigidTransform.identity()
    with pytest.raises(DataError, match="no camera model THIN_PRISM_FISHEYE; undistort"):
        export_nerfstudio([image(odd, pose, path=tmp_path / "a.jpg")], NO_POINTS, tmp_path)
    (tmp_path / "records_data").symlink_to(tmp_path)
    missing = image(Camera.pinhole(6, 4, 5), pose, path=tmp_path / "records_data" / "b.jpg")
    with pytest.raises(DataError, match=f"{tmp_path}/b.jpg: nerfstudio needs the file"):
        export_nerfstudio([missing], NO_POINTS, tmp_path)
    two = image(Camera.pinhole(6, 4, 5), pose), image(Camera.pinhole(6, 4, 5), pose)
    with pytest.raises(DataError, match="share a timestamp"):
        export_tum(two, tmp_path / "a.tum")
    with pytest.raises(DataError, match="two images are named 'a.jpg': .* differ only in / and _"):
        export_colmap(two, NO_POINTS, tmp_path / "model")


def test_corners_of_a_frustum_project_to_those_of_the_image() -> None:
    camera = Camera("OPENCV", 640, 480, (500, 510, 320, 240, -0.1, 0.01, 0.001, 0.002))
    pose = random_pose(np.random.default_rng(0))
    corners = frustum(camera, pose, 2.0)
    np.testing.assert_allclose(corners[0], pose.center(), atol=1e-12)
    np.testing.assert_allclose(pose.apply(corners[1:])[:, 2], 2.0)
    expected = [(0, 0), (640, 0), (640, 480), (0, 480)]
    np.testing.assert_allclose(project(camera, pose, corners[1:]), expected, atol=1e-6)


def test_cameras_and_keypoints_are_scaled_to_smaller_images(map_copy: Path, tmp_path: Path) -> None:
    opened = KaptureMap.open(map_copy)
    name = opened.images[0]
    camera, keypoints = opened.camera(name), opened.keypoints["rootsift"].keypoints_px(name)
    records = map_copy / "sensors" / "records_data"
    records.unlink()
    for image in opened.folder.read().image_names():
        write_image(records / image, np.zeros((camera.height // 2, camera.width // 2, 3), np.uint8))
    scaled = KaptureMap.open(map_copy)
    assert export("nerfstudio", tmp_path / "nerf", map=scaled) == len(opened.images)
    frame = json.loads((tmp_path / "nerf" / "transforms.json").read_text())["frames"][0]
    assert (frame["w"], frame["h"]) == (camera.width // 2, camera.height // 2)
    assert frame["fl_x"] == pytest.approx(camera.params[0] / 2)
    export("colmap", tmp_path / "colmap", map=scaled)
    model = pycolmap.Reconstruction(str(tmp_path / "colmap"))
    found = next(one for one in model.images.values() if one.name == name)
    assert model.cameras[found.camera_id].width == camera.width // 2
    xy = np.array([point.xy for point in found.points2D])
    np.testing.assert_allclose(xy, keypoints[:, :2] / 2, atol=1e-3)
    described = describe_sizes(scaled.folder)
    assert any("200x150, scaled from the 400x300" in text for text in described)
    with pytest.raises(OutputError, match="is or contains an input"):
        export("colmap", map_copy, map=scaled, force=True)
    write_image(records / name, np.zeros((50, 50, 3), np.uint8))
    with pytest.raises(DataError, match=f"{name}: the image is 50x50, its camera says"):
        export("colmap", tmp_path / "refused", map=KaptureMap.open(map_copy))
