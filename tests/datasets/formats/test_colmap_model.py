"""COLMAP's text and binary models, against pycolmap in both directions."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from megloc_twins.model_files import write_colmap_binary, write_colmap_text

from megloc_kapture.datasets.formats.colmap_model import ColmapImage, ColmapModel
from megloc_kapture.datasets.formats.colmap_reading import colmap_model_files, read_colmap_model
from megloc_kapture.datasets.formats.sparse_models import SparsePoints
from megloc_kapture.datasets.formats.text_lines import TextFile
from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import px_from_cam
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

WRITERS = pytest.mark.parametrize("write", [write_colmap_text, write_colmap_binary])
EMPTY = ColmapModel({}, (), SparsePoints.none())


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let borders of blocks be everywhere."""
    monkeypatch.setitem(TextFile.__init__.__kwdefaults__, "block_bytes", 200)


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
@pytest.mark.usefixtures("small_blocks")
def test_text_by_hand(tmp_path: Path, end: str) -> None:
    texts = {"cameras": CAMERAS, "images": IMAGES + "0 1 9", "points3D": POINTS}
    model = read_colmap_model(
        write_files(tmp_path, **{k: v.replace("\n", end) for k, v in texts.items()})
    )
    assert model.cameras[1] == Camera("SIMPLE_RADIAL", 1600, 1067, (1084.6, 800, 533.5, -0.0811))
    assert [image.name for image in model.images] == ["db/7.jpg", "db/8.jpg"]
    assert model.images[0].cam_from_world.translation == (0.5, 0, 2)
    points = model.points
    assert points.xyz.tolist() == [[1, 2, 3], [4, 5, 6], [0, 0, 0]]
    assert points.rgb.tolist() == [[255, 0, 9], [1, 2, 3], [0, 0, 0]]
    assert points.point_ids.tolist() == [0, 1, 1, 1]
    assert points.image_ids.tolist() == [0, 0, 1, 0]
    assert points.feature_ids.tolist() == [0, 2, 0, 1]
    assert points.xy_px.tolist() == [[1, 2], [5, 6], [0, 1], [3.5, 4]]
    dtypes = [points.xyz, points.rgb, points.point_ids, points.image_ids, points.feature_ids]
    assert [a.dtype for a in dtypes] == [np.float64, np.uint8, np.int64, np.int32, np.int32]


@pytest.mark.usefixtures("small_blocks")
def test_an_empty_line_of_features_is_consumed(tmp_path: Path) -> None:
    images = (
        "# Image list\n\n"
        "3 1 0 0 0 0 0 0 1 a.jpg\n\n"
        "1 1 0 0 0 0 0 0 1 b.jpg\n1 1 -1\n"
        "# between images\n\n"
        "2 1 0 0 0 0 0 0 1 ./c.jpg\n \n"
        "9 1 0 0 0 0 0 0 1 last one.jpg"  # its line of features is missing
    )
    model = read_colmap_model(
        write_files(tmp_path, images=images, points3D="5 1 1 1 1 1 1 0 1 0\n")
    )
    assert [(i.image_id, i.name) for i in model.images] == [
        (1, "b.jpg"),
        (2, "c.jpg"),
        (3, "a.jpg"),
        (9, "last one.jpg"),
    ]
    assert model.points.image_ids.tolist() == [0]


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("cameras", "1 PINHOLE 5 5\n", "cameras.txt:1: expected a camera .* got 4"),
        ("cameras", "\n1 NEW 5 5 1\n", "cameras.txt:2: unknown camera model 'NEW'"),
        ("cameras", CAMERAS + CAMERAS, "cameras.txt:6: camera 1 is listed twice"),
        ("cameras", "1 PINHOLE 5 5 1 1 1 nan\n", "cameras.txt:1: camera parameter 'nan'"),
        ("cameras", "1 PINHOLE 0 5 1 1 1 1\n", "cameras.txt:1: image size 0x5"),
        ("cameras", "", "images.txt:1: image .* unknown camera 1"),
        ("images", "7 1 0 0 0 0 0 0 1\n\n", "images.txt:1: expected an image .* got 9"),
        ("images", "7 2 0 0 0 0 0 0 1 a\n\n", "images.txt:1: .* unit quaternion"),
        ("images", "7 1 0 0 0 0 inf 0 1 a\n\n", "images.txt:1: pose 'inf'"),
        ("images", "2147483647 1 0 0 0 0 0 0 1 a\n\n", "images.txt:1: image id .* out of range"),
        ("images", "7 1 0 0 0 0 0 0 1 ../a\n\n", "images.txt:1: .* leads out"),
        ("images", IMAGES + "0 1 9\n" + IMAGES, "images.txt:5: image id 7 is listed twice"),
        ("images", IMAGES.replace("8.jpg", "7.jpg"), "images.txt:3: image 'db/7.jpg' is listed"),
        ("images", IMAGES + "0 1\n", "images.txt:4: expected features .* got 2 fields"),
        ("images", IMAGES + "0 1 1.5\n", "images.txt:4: point id '1.5'"),
        ("images", IMAGES + "0 nan 1\n", "images.txt:4: image coordinate 'nan'"),
        ("images", IMAGES + "0 1e300 1\n", "images.txt:4: image coordinate '1e300'"),
        ("images", IMAGES + "\n", "images.txt:4: .* names feature 0 of image 8, which has 0"),
        ("images", IMAGES, "images.txt:3: .* names feature 0 of image 8"),
        ("images", IMAGES[:49], "points3D.txt: a track names image 8, which is not there"),
        ("points3D", "1 1 1 1 1 1 1\n", "points3D.txt:1: expected a point .* got 7"),
        ("points3D", POINTS + "1 1 1 1 1 1 1 1 7\n", "points3D.txt:5: .* got 9"),
        ("points3D", POINTS + "1 1 nan 1 1 1 1 1\n", "points3D.txt:5: coordinate 'nan'"),
        ("points3D", POINTS + "1 1 1 1 1 1 256 1\n", "points3D.txt:5: a colour"),
        ("points3D", POINTS + "1 1 1 1 1 1 1 x\n", "points3D.txt:5: reprojection error 'x'"),
        ("points3D", POINTS + "1 1 1 1 1 1 1 1 7 x\n", "points3D.txt:5: feature index 'x'"),
        ("points3D", POINTS + "1 1 1 1 1 1 1 1 -7 1\n", "points3D.txt:5: image id '-7'"),
        ("points3D", POINTS + "1 1 1 1 1 1 1 1 7 2147483648\n", "points3D.txt:5: feature index"),
    ],
)
@pytest.mark.usefixtures("small_blocks")
def test_bad_text_is_named(tmp_path: Path, name: str, text: str, match: str) -> None:
    with pytest.raises(DataError, match=match):
        read_colmap_model(write_files(tmp_path, **{name: text}))


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_files_that_are_none_are_named(tmp_path: Path, name: str, form: str) -> None:
    (write_colmap_text if form == "txt" else write_colmap_binary)(tmp_path, small_model())
    path = tmp_path / f"{name}.{form}"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DataError, match=rf"{name}\.{form}: not a plain file"):
        read_colmap_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_every_truncation_is_named(tmp_path: Path, name: str) -> None:
    write_colmap_binary(tmp_path, small_model())
    content = (tmp_path / name).read_bytes()
    for size in [*range(0, 100, 3), *range(100, len(content), 11), len(content) - 1]:
        (tmp_path / name).write_bytes(content[:size])
        with pytest.raises(DataError, match=rf"{name}: .* \(byte \d+ of {size}\)"):
            read_colmap_model(tmp_path)
    (tmp_path / name).write_bytes(content + b"\0")
    with pytest.raises(DataError, match=rf"{name}: 1 bytes follow after the last of"):
        read_colmap_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_counts_are_checked_before_memory_is_taken(tmp_path: Path, name: str) -> None:
    write_colmap_binary(tmp_path, small_model())
    content = (tmp_path / name).read_bytes()
    for count in (2**64 - 1, 2**63, 2**40, 10**6):
        (tmp_path / name).write_bytes(struct.pack("<Q", count) + content[8:])
        with pytest.raises(DataError, match=rf"{name}: {count} \w+ do not fit into the file"):
            read_colmap_model(tmp_path)


# offsets of the first record's fields, from the published layouts
@pytest.mark.parametrize(
    ("name", "offset", "value", "match"),
    [
        ("cameras.bin", 12, struct.pack("<i", 18), "unknown camera model 18"),
        ("cameras.bin", 12, struct.pack("<i", 16), "the model EUCM .*image_undistorter"),
        ("cameras.bin", 12, struct.pack("<i", 17), "the model EQUIRECTANGULAR .*panorama_sfm"),
        ("cameras.bin", 16, struct.pack("<Q", 0), "image size 0x480"),
        ("cameras.bin", 16, struct.pack("<Q", 2**63), "is out of range"),
        ("cameras.bin", 32, struct.pack("<d", np.nan), "must be finite"),
        ("images.bin", 12, struct.pack("<d", np.nan), "unit quaternion"),
        ("images.bin", 12, struct.pack("<d", 2), "unit quaternion"),
        ("images.bin", 44, struct.pack("<d", np.inf), "pose of image 'db/7.jpg' is not finite"),
        ("images.bin", 68, struct.pack("<I", 77), "unknown camera 77"),
        ("images.bin", 8, struct.pack("<I", 2**32 - 1), "image id 4294967295 is out of range"),
        ("images.bin", 8, struct.pack("<I", 5), "image id 5 is listed twice"),
        ("images.bin", 72, b"/", "absolute path"),
        ("images.bin", 72, b"x" * 10_000, r"name does not end \(byte 72"),
        ("images.bin", 81, struct.pack("<Q", 2**61), "features do not fit into the file"),
        ("images.bin", 89, struct.pack("<d", np.nan), "a feature of image 2 is not finite"),
        ("images.bin", 89, struct.pack("<d", 1e300), "a feature of image 2 is not finite"),
        ("points3D.bin", 16, struct.pack("<d", np.nan), "point 1 of 3 is not finite"),
        ("points3D.bin", 51, struct.pack("<Q", 2**60), "the file ends within a point"),
        ("points3D.bin", 59, struct.pack("<i", -1), "out of range"),
        ("points3D.bin", 59, struct.pack("<i", 3), "a track names image 3, which is not there"),
        ("points3D.bin", 63, struct.pack("<i", 99), "names feature 99 of image 5, which has 5"),
    ],
)
def test_bad_binary_values_are_named(
    tmp_path: Path, name: str, offset: int, value: bytes, match: str
) -> None:
    write_colmap_binary(tmp_path, small_model())
    path = tmp_path / name
    content = path.read_bytes()
    path.write_bytes(content[:offset] + value + content[offset + len(value) :])
    with pytest.raises(DataError, match=match):
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
            with pytest.raises(DataError, match=f"cameras.* the model {model} .*undistorter"):
                read_colmap_model(tmp_path)
