"""COLMAP's text and binary models: which files are read, and wrong files."""

from __future__ import annotations

from pathlib import Path

import pytest
from megloc_twins.model_files import write_colmap_binary, write_colmap_text

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap_model import (
    ColmapImage,
    ColmapModel,
    SparsePoints,
    colmap_model_files,
    read_colmap_model,
)
from megloc_kapture.values import Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

EMPTY = ColmapModel({}, (), SparsePoints.none())
POSE = RigidTransform((0.5, 0.5, -0.5, 0.5), (0.1, -2e-17, 3e9))
SMALL = ColmapModel(
    {3: Camera("PINHOLE", 640, 480, (500.0, 501.0, 320.0, 240.0))},
    (ColmapImage(2**31 - 2, "a/b/c.jpg", 3, POSE),),
    SparsePoints.none(),
)


def test_binary_files_take_precedence_over_text_and_poses_need_no_points(tmp_path: Path) -> None:
    for read in (read_colmap_model, colmap_model_files):
        with pytest.raises(DataError, match="neither images.bin nor images.txt is here") as caught:
            read(tmp_path)
        assert str(caught.value).startswith(f"{tmp_path}: ")
    write_colmap_text(tmp_path, EMPTY)
    names = ("cameras.txt", "images.txt", "points3D.txt")
    assert colmap_model_files(tmp_path) == tuple(tmp_path / name for name in names)
    assert read_colmap_model(tmp_path).images == ()
    write_colmap_binary(tmp_path, SMALL)
    (tmp_path / "points3D.bin").unlink()
    poses = read_colmap_model(tmp_path, with_points=False)
    assert (poses.cameras, poses.images, len(poses.points)) == (SMALL.cameras, SMALL.images, 0)
    with pytest.raises(DataError, match=r"points3D\.bin: file is missing"):
        read_colmap_model(tmp_path)
    names = ("cameras.bin", "images.bin")
    assert colmap_model_files(tmp_path, with_points=False) == tuple(tmp_path / n for n in names)


CAMERAS = "1 SIMPLE_RADIAL 1600 1067 1084.6 800 533.5 -0.0811\n"
IMAGES = "7 1 0 0 0 0.5 0 2 1 db/7.jpg\n\n8 1 0 0 0 0 0 0 1 db/8.jpg\n\n"


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("cameras", "SIMPLE_RADIAL", "NEW", "Camera model does not exist"),
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


def test_camera_models_that_kapture_lacks_are_refused_by_name(tmp_path: Path) -> None:
    model, params = "SIMPLE_DIVISION", (500.0, 320.0, 240.0, 0.01)
    camera = pycolmap.Camera(camera_id=1, model=model, width=640, height=480, params=params)
    written = pycolmap.Reconstruction()
    written.add_camera_with_trivial_rig(camera)
    written.write_binary(tmp_path)
    with pytest.raises(DataError, match=f"cameras.*camera model {model}; .*undistorter"):
        read_colmap_model(tmp_path)
