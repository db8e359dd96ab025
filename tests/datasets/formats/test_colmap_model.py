"""COLMAP's text and binary models as they are read through pycolmap, and damaged ones."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from megloc_twins.model_files import write_colmap_binary, write_colmap_text

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import px_from_cam
from megloc_kapture.io.colmap_model import (
    ColmapImage,
    ColmapModel,
    SparsePoints,
    colmap_model_files,
    read_colmap_model,
)
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

WRITERS = pytest.mark.parametrize("write", [write_colmap_text, write_colmap_binary])
EMPTY = ColmapModel({}, (), SparsePoints.none())


def small_model() -> ColmapModel:
    """Camera models of all kinds, an image without points, gaps in ids and features."""
    cameras = {
        3 * k + 1: Camera(name, 640, 480, tuple(0.25 * i + 0.1 for i in range(number)))
        for k, (name, number) in enumerate(CAMERA_MODEL_NUM_PARAMS.items())
    }
    half = 0.5**0.5
    images = (
        ColmapImage(2, "db/7.jpg", 1, RigidTransform((1.0, 0.0, 0.0, 0.0), (0.5, 0.0, 2.0))),
        ColmapImage(5, "a/b/c.jpg", 4, RigidTransform((half, 0.0, -half, 0.0), (0.1, -2e-17, 3e9))),
        ColmapImage(9, "c.jpg", 4, RigidTransform((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0))),
        ColmapImage(2**31 - 2, "d.jpg", 4, RigidTransform((0.5, 0.5, -0.5, 0.5), (1.0, 2.0, 3.0))),
    )
    points = SparsePoints(
        np.array([[1.0, 2.0, 3.0], [-0.1, 1e-9, 1e9], [4.0, 5.0, 6.0]]),
        np.array([[0, 128, 255], [1, 2, 3], [4, 5, 6]], dtype=np.uint8),
        np.array([0, 0, 0, 1, 1]),
        np.array([1, 0, 0, 3, 0], dtype=np.int32),
        np.array([4, 2, 0, 0, 7], dtype=np.int32),
        np.array([[1.1, 2.2], [3, 4], [5, 6], [639.9, 0.01], [9, 10]], dtype=np.float32),
    )
    return ColmapModel(cameras, images, points)


def same(first: ColmapModel, second: ColmapModel) -> bool:
    arrays = ("xyz", "rgb", "point_ids", "image_ids", "feature_ids", "xy_px")
    return (
        first.cameras == second.cameras
        and first.images == second.images
        and all(
            np.array_equal(getattr(first.points, name), getattr(second.points, name))
            for name in arrays
        )
    )


@WRITERS
def test_a_model_comes_back_exactly(tmp_path: Path, write: Callable[..., None]) -> None:
    model = small_model()
    write(tmp_path, model)
    assert same(read_colmap_model(tmp_path), model)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    assert set(theirs.cameras) == set(model.cameras)
    for camera_id, camera in theirs.cameras.items():
        ours = model.cameras[camera_id]
        assert (camera.model.name, tuple(camera.params)) == (ours.model, ours.params)
    colours = {tuple(point.xyz): point.color.tolist() for point in theirs.points3D.values()}
    points = model.points
    assert colours == dict(zip(map(tuple, points.xyz), points.rgb.tolist(), strict=True))
    content = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    write(tmp_path, model)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == content
    # poses alone need no points
    next(tmp_path.glob("points3D.*")).unlink()
    poses = read_colmap_model(tmp_path, with_points=False)
    assert poses.images == model.images and len(poses.points) == 0
    with pytest.raises(DataError, match=r"points3D\.\w+: file is missing"):
        read_colmap_model(tmp_path)
    write(tmp_path, EMPTY)
    assert same(read_colmap_model(tmp_path), EMPTY)


def test_the_binary_files_count_where_there_are_both(tmp_path: Path) -> None:
    for read in (read_colmap_model, colmap_model_files):
        with pytest.raises(DataError, match="neither images.bin nor images.txt is here") as caught:
            read(tmp_path)
        assert str(caught.value).startswith(f"{tmp_path}: ")
    write_colmap_text(tmp_path, EMPTY)
    names = ("cameras.txt", "images.txt", "points3D.txt")
    assert colmap_model_files(tmp_path) == tuple(tmp_path / name for name in names)
    write_colmap_binary(tmp_path, small_model())
    assert same(read_colmap_model(tmp_path), small_model())
    names = ("cameras.bin", "images.bin")
    assert colmap_model_files(tmp_path, with_points=False) == tuple(tmp_path / n for n in names)


CAMERAS = "# comment\n\n 1 SIMPLE_RADIAL 1600 1067 1084.6 800 533.5 -0.0811 \n"
IMAGES = "7 1 0 0 0 0.5 0 2 1 db/7.jpg\n1 2 4 3.5 4 -1 5 6 9\n8 1 0 0 0 0 0 0 1 db/8.jpg\n"
POINTS = "# c\n4 1 2 3 255 0 9 0.5 7 0\n9 4 5 6 1 2 3 -1 7 2 8 0 7 1\n1 0 0 0 0 0 0 1\n"


def write_files(folder: Path, **texts: str) -> Path:
    contents = {"cameras": CAMERAS, "images": IMAGES + "0 1 9\n", "points3D": POINTS, **texts}
    for name, text in contents.items():
        (folder / f"{name}.txt").write_bytes(text.encode("utf-8", errors="surrogateescape"))
    return folder


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_text_by_hand(tmp_path: Path, end: str) -> None:
    texts = {"cameras": CAMERAS, "images": IMAGES + "0 1 9", "points3D": POINTS}
    model = read_colmap_model(
        write_files(tmp_path, **{k: v.replace("\n", end) for k, v in texts.items()})
    )
    assert model.cameras[1] == Camera("SIMPLE_RADIAL", 1600, 1067, (1084.6, 800, 533.5, -0.0811))
    assert [image.name for image in model.images] == ["db/7.jpg", "db/8.jpg"]
    assert model.images[0].cam_from_world.translation == (0.5, 0, 2)
    points = model.points
    # by their ids
    assert points.xyz.tolist() == [[0, 0, 0], [1, 2, 3], [4, 5, 6]]
    assert points.rgb.tolist() == [[0, 0, 0], [255, 0, 9], [1, 2, 3]]
    assert points.point_ids.tolist() == [1, 2, 2, 2]
    assert points.image_ids.tolist() == [0, 0, 1, 0]
    assert points.feature_ids.tolist() == [0, 2, 0, 1]
    assert points.xy_px.tolist() == [[1, 2], [5, 6], [0, 1], [3.5, 4]]
    dtypes = [points.xyz, points.rgb, points.point_ids, points.image_ids, points.feature_ids]
    assert [a.dtype for a in dtypes] == [np.float64, np.uint8, np.int64, np.int32, np.int32]


def test_an_empty_line_of_features_is_consumed(tmp_path: Path) -> None:
    images = (
        "# Image list\n\n"
        "3 1 0 0 0 0 0 0 1 a.jpg\n\n"
        "1 1 0 0 0 0 0 0 1 b.jpg\n1 1 -1\n"
        "# between images\n\n"
        "2 1 0 0 0 0 0 0 1 ./c.jpg\n \n"
        "9 1 0 0 0 0 0 0 1 last.jpg"  # its line of features is missing
    )
    model = read_colmap_model(
        write_files(tmp_path, images=images, points3D="5 1 1 1 1 1 1 0 1 0\n")
    )
    assert [(i.image_id, i.name) for i in model.images] == [
        (1, "b.jpg"),
        (2, "c.jpg"),
        (3, "a.jpg"),
        (9, "last.jpg"),
    ]
    assert model.points.image_ids.tolist() == [0]


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("cameras", "1 PINHOLE 5 5\n", "cameras.txt, images.txt"),
        ("cameras", "\n1 NEW 5 5 1\n", "Camera model does not exist"),
        ("cameras", "1 PINHOLE 0 5 1 1 1 1\n", "cameras.txt: camera 1: image size 0x5"),
        ("images", "7 0 0 0 0 0 0 0 1 a\n\n", "images.txt: image 'a': .*quaternion"),
        ("images", "7 1 0 0 0 0 nan 0 1 a\n\n", "a model that COLMAP can read"),
        ("images", "7 1 0 0 0 0 0 0 1 ../a\n\n", "images.txt: image '../a': .*leads out"),
        ("images", IMAGES.replace("8.jpg", "7.jpg") + "0 1 9\n", "'db/7.jpg': is listed twice"),
        ("points3D", "1 1 1 1 1 1 1 1 8 7\n", "a model that COLMAP can read"),
    ],
)
def test_bad_text_is_named(tmp_path: Path, name: str, text: str, match: str) -> None:
    with pytest.raises(DataError, match=match) as caught:
        few = {} if text.startswith(IMAGES[:20]) else {"points3D": ""}
        read_colmap_model(write_files(tmp_path, **{**few, name: text}))
    assert str(caught.value).startswith(str(tmp_path))


def test_rigs_have_the_cameras_whose_pose_is_known(tmp_path: Path) -> None:
    rig = pycolmap.Rig(rig_id=7)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), None)
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.IMU, 3), pycolmap.Rigid3d())
    written = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        camera = {"model": "PINHOLE", "width": 4, "height": 4, "params": [4] * 4}
        written.add_camera(pycolmap.Camera(camera_id=camera_id, **camera))
    written.add_rig(rig)
    written.write_binary(tmp_path)
    assert list(read_colmap_model(tmp_path).cams_from_rig[7]) == [1]
    assert len(colmap_model_files(tmp_path)) == 5
    (tmp_path / "frames.bin").write_bytes(struct.pack("<Q", 2**40))
    with pytest.raises(DataError, match=r"frames\.bin: .*cut short"):
        read_colmap_model(tmp_path)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_later_camera_models(tmp_path: Path, form: str) -> None:
    """Those that are others without distortion become these, the rest is refused by name."""
    rays = np.random.default_rng(0).uniform((-2, -2, 0.1), (2, 2, 1), (100, 3))
    for model, params in {
        "SIMPLE_FISHEYE": (500.0, 320.0, 240.0),
        "FISHEYE": (500.0, 510.0, 320.0, 240.0),
        "DIVISION": (500.0, 510.0, 320.0, 240.0, 0.01),
        "SIMPLE_DIVISION": (500.0, 320.0, 240.0, 0.01),
        "RAD_TAN_THIN_PRISM_FISHEYE": (500.0, 500.0, 320.0, 240.0, *[0.001] * 12),
    }.items():
        theirs = pycolmap.Camera(camera_id=1, model=model, width=640, height=480, params=params)
        written = pycolmap.Reconstruction()
        written.add_camera_with_trivial_rig(theirs)
        getattr(written, f"write_{form}")(tmp_path)
        if model in ("SIMPLE_FISHEYE", "FISHEYE"):
            ours = read_colmap_model(tmp_path).cameras[1]
            np.testing.assert_allclose(
                px_from_cam(ours, rays), theirs.img_from_cam(rays), rtol=0, atol=1e-9
            )
        else:
            with pytest.raises(DataError, match=f"cameras.*camera model {model}; .*undistorter"):
                read_colmap_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_binary_files_are_named(tmp_path: Path, name: str) -> None:
    write_colmap_binary(tmp_path, small_model())
    content = (tmp_path / name).read_bytes()
    for cut in (content[:4], content[:-1], content[: len(content) // 2], content + b"\0"):
        (tmp_path / name).write_bytes(cut)
        with pytest.raises(DataError, match=rf"{name}: .*cut short|COLMAP can read"):
            read_colmap_model(tmp_path)
    # pycolmap would fill the memory
    (tmp_path / name).write_bytes(struct.pack("<Q", 2**40) + content[8:])
    with pytest.raises(DataError, match=rf"{name}: .*cut short|COLMAP can read"):
        read_colmap_model(tmp_path)
