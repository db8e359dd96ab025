"""Sparse models: NVM compared with kapture's importer, and which files of COLMAP are read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import kapture
import kapture.io.csv
import numpy as np
import pytest
from kapture.io.records import TransferAction
from megloc_twins.sparse_models import write_colmap_model, write_nvm
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets import nvm as nvm_reader
from megloc_kapture.datasets.nvm import NvmModel, read_nvm
from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap_model import (
    ColmapImage,
    ColmapModel,
    SparsePoints,
    colmap_model_files,
    read_colmap_model,
)
from megloc_kapture.io.images import write_image
from megloc_kapture.values import Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


SAMPLE = "kapture_samples/Aachen-Day-Night"

CAMERA = "db/7.jpg 1000.0 1 0 0 0 2.0 0.0 -5.0 0.08 0"
TURNED = "db/8.jpg 900.5 0.5 -0.5 0.5 0.5 1 2 3 -0.25 0"
POINTS = [
    "1.5 -2 3e1 255 0 7 3 0 12 10.5 20.25 1 3 30.125 40 0 9 11 21",
    "4 5 6 1 2 3 1 1 2147483647 1e2 .5",
    "-7 8 9 0 0 0 0",
]
MODEL = ["2", CAMERA, TURNED, "", "3", *POINTS]
ARRAYS = ("xyz", "rgb", "point_ids", "image_ids", "feature_ids", "xy_px")


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read two rows at a time."""
    monkeypatch.setattr(nvm_reader, "_ROWS", 2)


def file(path: Path, lines: list[str], end: str = "\n") -> Path:
    path.write_bytes(end.join(["NVM_V3", "", *lines]).encode())
    return path


def check_model(model: NvmModel) -> None:
    assert model.names == ("db/7.jpg", "db/8.jpg")
    assert model.focal_px.tolist() == [1000.0, 900.5]
    assert model.k_colmap.tolist() == [-0.08, 0.25]
    assert model.centers.tolist() == [[2, 0, -5], [1, 2, 3]]
    assert model.cam_from_world(0).translation == (-2.0, 0.0, 5.0)
    rotation = Rotation.from_quat([-0.5, 0.5, 0.5, 0.5])
    expected = -rotation.as_matrix() @ [1, 2, 3]
    assert model.cam_from_world(1).quat_wxyz == (0.5, -0.5, 0.5, 0.5)
    assert np.allclose(model.cam_from_world(1).translation, expected, atol=1e-14)
    points = model.points
    assert points.xyz.tolist() == [[1.5, -2, 30], [4, 5, 6], [-7, 8, 9]]
    assert points.rgb.tolist() == [[255, 0, 7], [1, 2, 3], [0, 0, 0]]
    assert points.point_ids.tolist() == [0, 0, 0, 1]
    assert points.image_ids.tolist() == [0, 1, 0, 1]
    assert points.feature_ids.tolist() == [12, 3, 9, 2147483647]
    assert points.xy_px.tolist() == [[10.5, 20.25], [30.125, 40], [11, 21], [100, 0.5]]
    dtypes = [getattr(points, name).dtype for name in ARRAYS]
    assert dtypes == [np.float64, np.uint8, np.int64, np.int32, np.int32, np.float32]


def test_a_model_is_read_with_any_line_ends_and_trailer(tmp_path: Path) -> None:
    for tail, end in (([], "\n"), ([""], "\r\n"), (["0"], "\n"), (["", "0", "", "PLY"], "\r\n")):
        model = read_nvm(file(tmp_path / "m.nvm", MODEL + tail, end))
        check_model(model)
    model = read_nvm(file(tmp_path / "m.nvm", ["1", CAMERA, "0", "0"]))
    assert model.names == ("db/7.jpg",) and len(model.points) == 0
    model = read_nvm(file(tmp_path / "m.nvm", ["1", CAMERA.replace("/7", "/night 7"), "0"]))
    assert model.names == ("db/night 7.jpg",)


def test_known_variants_of_the_layout_are_read(tmp_path: Path) -> None:
    lines = ["\ufeffNVM_V3 FixedK 1000 512 1000.5 384 ", " ", "\t", " 2  "]
    lines += ["./db/7.jpg\t1000.0 1 0 0 0  2.0 0.0 -5.0 0.08 0 ", "", TURNED.replace(" ", "\t")]
    lines += ["", "", "3 ", *(f"  {point} \n" for point in POINTS)]
    unregistered = [f"unregistered/{k}.jpg 0 1 0 0 0 0 0 0 0 0" for k in (1, 2)]
    lines += ["2", *unregistered, "0", "0", "# what follows is not looked at: 1 2 three"]
    path = tmp_path / "m.nvm"
    path.write_bytes("\n".join(lines).encode() + b"\n\xff\x00\xfe")
    check_model(read_nvm(path))
    poses = read_nvm(path, with_points=False)
    assert len(poses.points) == 0 and np.array_equal(poses.centers, read_nvm(path).centers)


def test_quaternions_are_normalised(tmp_path: Path) -> None:
    camera = "a.jpg 1 0.5003 -0.5 0.5 0.5 0 0 0 0 0"
    model = read_nvm(file(tmp_path / "m.nvm", ["1", camera, "0"]))
    w, x, y, z = model.quat_wxyz[0]
    assert np.linalg.norm(model.quat_wxyz[0]) == pytest.approx(1, abs=1e-15)
    assert w / x == pytest.approx(-0.5003 / 0.5, rel=1e-12) and (y, z) == (-x, -x)


def import_with_kapture(nvm: Path, images: Path, output: Path) -> kapture.Kapture:
    from tools.kapture_import_nvm import import_nvm

    import_nvm(str(nvm), str(images), str(output), None, False, True, True, TransferAction.skip)
    return kapture.io.csv.kapture_from_dir(str(output))


def observed(data: kapture.Kapture, folder: Path) -> list[tuple[int, str, float, float]]:
    """(point, image, x, y) of every observation."""
    rows = []
    for point in data.observations:
        for image, keypoint in data.observations[point, "sift"]:
            path = kapture.io.features.get_keypoints_fullpath("sift", str(folder), image)
            keypoints = kapture.io.features.image_keypoints_from_file(path, np.float32, 2)
            rows.append((point, image, *keypoints[keypoint].tolist()))
    return sorted(rows)


def check_against_kapture(model: NvmModel, data: kapture.Kapture, folder: Path) -> None:
    points = model.points
    merged = np.hstack([points.xyz, points.rgb])
    assert np.allclose(merged, data.points3d.as_array(), atol=1e-9)
    sensors = {name: (time, sensor) for time, sensor, name in kapture.flatten(data.records_camera)}
    for index, name in enumerate(model.names):
        camera = data.sensors[sensors[name][1]]
        assert camera.camera_params[2] == model.focal_px[index]
        assert camera.camera_params[5] == model.k_colmap[index]
        theirs, ours = data.trajectories[sensors[name]], model.cam_from_world(index)
        # kapture keeps the length of the quaternion, which has six digits here
        assert np.allclose(ours.quat_wxyz, theirs.r_raw, atol=1e-6)
        assert np.allclose(ours.translation, theirs.t_raw, atol=1e-9)
    columns = points.point_ids, points.image_ids, points.xy_px.tolist()
    rows: set[tuple[Any, ...]] = {
        (int(point), model.names[image], x, y)
        for point, image, (x, y) in zip(*columns, strict=True)
    }
    assert sorted(rows) == observed(data, folder)


@pytest.mark.slow
def test_the_published_sample_reads_as_kapture_reads_it(shared_data: Path, tmp_path: Path) -> None:
    nvm = shared_data / SAMPLE / "3D-models" / "aachen_cvpr2018_db.nvm"
    data = import_with_kapture(nvm, shared_data / SAMPLE / "images_upright", tmp_path)
    check_against_kapture(read_nvm(nvm), data, tmp_path)


def random_model(num_images: int = 7, num_points: int = 60) -> NvmModel:
    rng = np.random.default_rng(2)
    point_ids, image_ids = np.nonzero(rng.random((num_points, num_images)) < 0.4)
    # an image sees a point twice, and features are not dense
    point_ids, image_ids = np.r_[point_ids[:1], point_ids], np.r_[image_ids[:1], image_ids]
    points = SparsePoints(
        rng.normal(0, 1e3, (num_points, 3)),
        rng.integers(0, 256, (num_points, 3)).astype(np.uint8),
        point_ids.astype(np.int64),
        image_ids.astype(np.int32),
        rng.permutation(500)[: len(point_ids)].astype(np.int32),
        rng.uniform(0, 1e3, (len(point_ids), 2)).astype(np.float32),
    )
    return NvmModel(
        tuple(f"db/{i}.jpg" for i in rng.permutation(num_images)),
        rng.uniform(500, 1000, num_images),
        Rotation.random(num_images, random_state=2).as_quat(scalar_first=True),
        rng.normal(0, 1e3, (num_images, 3)),
        rng.normal(0, 0.1, num_images),
        points,
    )


def test_a_written_model_reads_back_equal_and_kapture_reads_it(tmp_path: Path) -> None:
    model, path = random_model(), tmp_path / "m.nvm"
    write_nvm(path, model)
    read = read_nvm(path)
    assert read.names == model.names
    for name in ("focal_px", "centers", "k_colmap"):
        assert np.array_equal(getattr(read, name), getattr(model, name))
    assert np.allclose(read.quat_wxyz, model.quat_wxyz, rtol=0, atol=1e-15)
    for name in ARRAYS:
        ours, theirs = getattr(read.points, name), getattr(model.points, name)
        assert ours.dtype == theirs.dtype and np.array_equal(ours, theirs)
    # COLMAP's exporter leaves blanks in blank lines, which kapture does not accept
    text = path.read_text()
    assert text.startswith("NVM_V3 \n \n7  \n")
    path.write_text(text.replace("\n \n", "\n\n"))
    for name in model.names:
        write_image(tmp_path / "images" / name, np.zeros((48, 64, 3), np.uint8))
    data = import_with_kapture(path, tmp_path / "images", tmp_path / "kapture")
    check_against_kapture(model, data, tmp_path / "kapture")


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
    write_colmap_model(tmp_path, EMPTY, text=True)
    names = ("cameras.txt", "images.txt", "points3D.txt")
    assert colmap_model_files(tmp_path) == tuple(tmp_path / name for name in names)
    assert read_colmap_model(tmp_path).images == ()
    write_colmap_model(tmp_path, SMALL, text=False)
    (tmp_path / "points3D.bin").unlink()
    poses = read_colmap_model(tmp_path, with_points=False)
    assert (poses.cameras, poses.images, len(poses.points)) == (SMALL.cameras, SMALL.images, 0)
    for read in (read_colmap_model, colmap_model_files):
        with pytest.raises(DataError, match=r"points3D\.bin: file is missing"):
            read(tmp_path)
    names = ("cameras.bin", "images.bin")
    assert colmap_model_files(tmp_path, with_points=False) == tuple(tmp_path / n for n in names)


CAMERAS = "1 SIMPLE_RADIAL 1600 1067 1084.6 800 533.5 -0.0811\n"
IMAGES = "7 1 0 0 0 0.5 0 2 1 db/7.jpg\n\n8 1 0 0 0 0 0 0 1 db/8.jpg\n\n"


def write_text(
    root: Path, *, cameras: str = CAMERAS, images: str = IMAGES, points3D: str = ""
) -> None:
    for name, text in (("cameras", cameras), ("images", images), ("points3D", points3D)):
        (root / f"{name}.txt").write_text(text, encoding="utf-8", newline="")


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("cameras", "SIMPLE_RADIAL", "NEW", "cameras.txt:1: expected a row NAME MODEL"),
        ("cameras", " -0.0811", "", "cameras.txt:1: camera model SIMPLE_RADIAL takes 4 parameters"),
        ("images", "0 0 1 db/8", "0 0 3 db/8", "images.txt:3: camera 3 is not in cameras.txt"),
        ("images", "8 1", "7 1", "images.txt:3: image id 7 is listed twice"),
        ("images", "8 1", f"{10**18} 1", r"images.txt:3: image id 1000.* is not from 0 to 42949"),
        ("images", "7 1 0", "7 nan 0", "images.txt:1: expected finite numbers IMAGE_ID QW"),
        ("images", "2 1 db/7.jpg", "2 1", "images.txt:1: 9 columns instead of 10"),
        ("cameras", "1600", "0", "cameras.txt: camera 1: image size 0x1067"),
        ("images", "7 1 0 0 0", "7 0 0 0 0", "images.txt: image 'db/7.jpg': .*quaternion"),
        ("images", "db/7", "../7", "images.txt: image '../7.jpg': .*leads out"),
        ("images", "db/8", "db/7", "'db/7.jpg': is listed twice"),
        ("images", "7 1", "version https://git-lfs", "images.txt: a Git LFS pointer; fetch"),
        ("points3D", "", "1 2 3 4 5 6 7", "not a model that COLMAP can read .*points3D.txt"),
        ("points3D", "", "1 2 3 4 .5 .6 0 1", "not a model that COLMAP can read .*points3D.txt"),
    ],
)
def test_a_wrong_text_model_is_named(
    tmp_path: Path, name: str, old: str, new: str, message: str
) -> None:
    before = {"cameras": CAMERAS, "images": IMAGES, "points3D": ""}[name]
    write_text(tmp_path, **{name: before.replace(old, new)})
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
    write_text(tmp_path, images=change(IMAGES))
    names = [image.name for image in read_colmap_model(tmp_path).images]
    assert [name[-5:].removesuffix(".jpg")[-1] for name in names] == ["7", "8"]
    assert len({name.rpartition("/")[0] for name in names} & {"db", "my photos/day 1"}) == 1


def test_image_sizes_and_ids_written_as_floats_are_read(tmp_path: Path) -> None:
    cameras, images = CAMERAS.replace("1600 1067", "1600.0 1067."), IMAGES.replace("7 1", "7.0 1")
    write_text(tmp_path, cameras=cameras, images=images)
    model = read_colmap_model(tmp_path)
    assert [image.image_id for image in model.images] == [7, 8]
    (camera,) = model.cameras.values()
    assert (camera.width, camera.height, camera.params[0]) == (1600, 1067, 1084.6)


@pytest.mark.parametrize("track", ["7 0", "9 0"], ids=["feature", "image"])
def test_points_of_missing_features_are_ignored(
    tmp_path: Path, track: str, caplog: pytest.LogCaptureFixture
) -> None:
    write_text(tmp_path, points3D=f"1 0 0 5 1 2 3 0 {track}\n")
    model = read_colmap_model(tmp_path)
    assert len(model.images) == 2 and not len(model.points)
    assert "points3D.txt: ignored, as its tracks name images or features" in caplog.text


def test_backslashes_in_binary_files_separate_folders(tmp_path: Path) -> None:
    write_text(tmp_path, images=IMAGES.replace("db/", "db\\"))
    pycolmap.Reconstruction(tmp_path).write_binary(tmp_path)
    for text_file in tmp_path.glob("*.txt"):
        text_file.unlink()
    model = read_colmap_model(tmp_path)
    assert [image.name for image in model.images] == ["db/7.jpg", "db/8.jpg"]


def test_camera_models_that_kapture_lacks_are_refused_by_name(tmp_path: Path) -> None:
    model, params = "SIMPLE_DIVISION", (500.0, 320.0, 240.0, 0.01)
    camera = pycolmap.Camera(camera_id=1, model=model, width=640, height=480, params=params)
    written = pycolmap.Reconstruction()
    written.add_camera_with_trivial_rig(camera)
    written.write_binary(tmp_path)
    with pytest.raises(DataError, match=f"cameras.*camera model {model}; .*undistorter"):
        read_colmap_model(tmp_path)
