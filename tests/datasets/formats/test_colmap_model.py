"""COLMAP's text and binary models: round trips, variants of the text form, damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from megloc_twins.sparse_models import write_colmap_model

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap_model import (
    ColmapImage,
    ColmapModel,
    SparsePoints,
    colmap_model_files,
    read_colmap_model,
)
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

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


@pytest.mark.parametrize("text", [True, False])
def test_a_model_reads_back_equal(tmp_path: Path, text: bool) -> None:
    model = small_model()
    write_colmap_model(tmp_path, model, text=text)
    assert same(read_colmap_model(tmp_path), model)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    assert set(theirs.cameras) == set(model.cameras)
    for camera_id, camera in theirs.cameras.items():
        ours = model.cameras[camera_id]
        assert (camera.model.name, tuple(camera.params)) == (ours.model, ours.params)
    colours = {tuple(point.xyz): point.color.tolist() for point in theirs.points3D.values()}
    points = model.points
    assert colours == dict(zip(map(tuple, points.xyz), points.rgb.tolist(), strict=True))
    # poses alone need no points
    next(tmp_path.glob("points3D.*")).unlink()
    poses = read_colmap_model(tmp_path, with_points=False)
    assert poses.images == model.images and len(poses.points) == 0
    with pytest.raises(DataError, match=r"points3D\.\w+: file is missing"):
        read_colmap_model(tmp_path)
    write_colmap_model(tmp_path, EMPTY, text=text)
    assert same(read_colmap_model(tmp_path), EMPTY)


def test_binary_files_take_precedence_over_text(tmp_path: Path) -> None:
    for read in (read_colmap_model, colmap_model_files):
        with pytest.raises(DataError, match="neither images.bin nor images.txt is here") as caught:
            read(tmp_path)
        assert str(caught.value).startswith(f"{tmp_path}: ")
    write_colmap_model(tmp_path, EMPTY, text=True)
    names = ("cameras.txt", "images.txt", "points3D.txt")
    assert colmap_model_files(tmp_path) == tuple(tmp_path / name for name in names)
    write_colmap_model(tmp_path, small_model(), text=False)
    assert same(read_colmap_model(tmp_path), small_model())
    names = ("cameras.bin", "images.bin")
    assert colmap_model_files(tmp_path, with_points=False) == tuple(tmp_path / n for n in names)


CAMERAS = "1 SIMPLE_RADIAL 1600 1067 1084.6 800 533.5 -0.0811\n"
IMAGES = "7 1 0 0 0 0.5 0 2 1 db/7.jpg\n\n8 1 0 0 0 0 0 0 1 db/8.jpg\n\n"


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("cameras", "SIMPLE_RADIAL", "NEW", "cameras.txt:1: expected a row NAME MODEL"),
        ("cameras", " -0.0811", "", "cameras.txt:1: camera model SIMPLE_RADIAL takes 4 parameters"),
        ("images", "0 0 1 db/8", "0 0 3 db/8", "images.txt:3: camera 3 is not in cameras.txt"),
        ("images", "8 1", "7 1", "images.txt:3: image id 7 is listed twice"),
        ("images", "7 1 0", "7 nan 0", "images.txt:1: expected finite numbers IMAGE_ID QW"),
        ("images", "2 1 db/7.jpg", "2 1", "images.txt:1: 9 columns instead of 10"),
        ("cameras", "1600", "0", "cameras.txt: camera 1: image size 0x1067"),
        ("images", "7 1 0 0 0", "7 0 0 0 0", "images.txt: image 'db/7.jpg': .*quaternion"),
        ("images", "db/7", "../7", "images.txt: image '../7.jpg': .*leads out"),
        ("images", "db/8", "db/7", "'db/7.jpg': is listed twice"),
    ],
)
def test_a_wrong_text_model_is_named(
    tmp_path: Path, name: str, old: str, new: str, message: str
) -> None:
    texts = {"cameras": CAMERAS, "images": IMAGES, "points3D": ""}
    texts[name] = texts[name].replace(old, new)
    for file, text in texts.items():
        (tmp_path / f"{file}.txt").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read_colmap_model(tmp_path)
    assert str(caught.value).startswith(str(tmp_path))


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n\n", "\n"),
        lambda text: f"\ufeff# comment\n{text}".replace("\n", "\r\n"),
        lambda text: text.replace("db/", "my photos/day 1/").replace("8.jpg", "8"),
        lambda text: text.replace("db/", "db\\"),
        lambda text: text.replace("db/7.jpg\n", "db/7.jpg\n1.5 2.5 -1 3 4 -1 5 6 -1 7 8 -1"),
    ],
    ids=["no lines of features", "Windows", "blanks in names", "backslashes", "features"],
)
def test_images_of_other_tools_are_read(tmp_path: Path, change: Callable[[str], str]) -> None:
    for file, text in (("cameras", CAMERAS), ("images", change(IMAGES)), ("points3D", "")):
        (tmp_path / f"{file}.txt").write_text(text, encoding="utf-8", newline="")
    names = [image.name for image in read_colmap_model(tmp_path).images]
    assert [name[-5:].removesuffix(".jpg")[-1] for name in names] == ["7", "8"]
    assert len({name.rpartition("/")[0] for name in names} & {"db", "my photos/day 1"}) == 1


def test_camera_models_that_kapture_lacks_are_refused_by_name(tmp_path: Path) -> None:
    model, params = "SIMPLE_DIVISION", (500.0, 320.0, 240.0, 0.01)
    camera = pycolmap.Camera(camera_id=1, model=model, width=640, height=480, params=params)
    written = pycolmap.Reconstruction()
    written.add_camera_with_trivial_rig(camera)
    written.write_binary(tmp_path)
    with pytest.raises(DataError, match=f"cameras.*camera model {model}; .*undistorter"):
        read_colmap_model(tmp_path)
