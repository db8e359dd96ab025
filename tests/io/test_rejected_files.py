"""Mistakes in files: each is refused with the name of the file and, in tables, the line."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table
from megloc_kapture.io.dataset_tables import read_side_tables
from megloc_kapture.io.images import image_size, read_depth_map, read_image_rgb
from megloc_kapture.io.kapture.features import (
    SUFFIX,
    ArrayKind,
    FeatureConfig,
    FeatureReader,
    FeatureWriter,
    feature_folder,
    list_types,
    open_folders,
    read_config,
)
from megloc_kapture.io.kapture.matches import (
    read_pairs,
)
from megloc_kapture.io.kapture.points import read_observations, read_points3d
from megloc_kapture.io.kapture.sensors import read_kapture_data

VERSION = "# kapture format: 1.1\n"
SENSORS = VERSION + (
    "cam, , camera, PINHOLE, 640, 480, 500, 500, 320, 240\n"
    "deep, , depth, SIMPLE_PINHOLE, 320, 240, 250, 160, 120\n"
)
IDENTITY = "1, 0, 0, 0, 0, 0, 0"

# the correct rows before the mistake, and the reader
TABLES: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "sensors/sensors.txt": (SENSORS, read_kapture_data),
    "sensors/records_camera.txt": (VERSION + "0, cam, ok.jpg\n# note\n", read_kapture_data),
    "sensors/trajectories.txt": (VERSION + f"0, cam, {IDENTITY}\n", read_kapture_data),
    "sensors/rigs.txt": (VERSION + f"rig, cam, {IDENTITY}\n", read_kapture_data),
    "keypoints.txt": (VERSION, lambda root: read_config(root / "keypoints.txt", "keypoints")),
    "descriptors.txt": (VERSION, lambda root: read_config(root / "descriptors.txt", "descriptors")),
    "pairs.txt": (VERSION + "a, b, 1\n", lambda root: read_pairs(root / "pairs.txt")),
    "table.csv": (
        "image,reason\nok,\n",
        lambda root: list(read_csv_table(root / "table.csv", ("image", "reason"))),
    ),
    "groups.csv": ("image,condition,frame,location,scored\n", read_side_tables),
    "names.csv": ("image,name\n", read_side_tables),
    "relocalization.csv": ("file,reference,query\n", read_side_tables),
}


@pytest.mark.parametrize(
    ("name", "row", "message"),
    [
        ("sensors/records_camera.txt", "1, cam", "expected 3 columns, got 2"),
        ("sensors/records_camera.txt", "9.5, cam, a.jpg", "timestamp '9.5' is not an integer"),
        ("sensors/records_camera.txt", "9, cam, d\\a.jpg", "backslash .*; separate folders by /"),
        ("sensors/records_camera.txt", "9, nocam, a.jpg", "unknown sensor or rig 'nocam': define"),
        ("sensors/records_camera.txt", "9, deep, a.jpg", "of type 'depth', not 'camera'"),
        ("sensors/records_camera.txt", "0, cam, b.jpg", "timestamp 0 of 'cam' is listed twice"),
        ("sensors/records_camera.txt", "9, cam, ok.jpg", "'ok.jpg' is listed twice"),
        ("sensors/records_camera.txt", "9, cam, a/../../b.jpg", "leads out"),
        ("sensors/trajectories.txt", "1, cam, 1, 0, 0, 0, 0, 0", "expected 9 columns, got 8"),
        ("sensors/trajectories.txt", "1, cam, nan, 0, 0, 0, 0, 0, 0", "finite numbers qw"),
        ("sensors/trajectories.txt", "1, cam, 0.998, 0, 0, 0, 0, 0, 0", "not a unit quaternion"),
        ("sensors/trajectories.txt", "1, cam, 1, 0, 0, , 0, 0, 0", "some but not all"),
        ("sensors/sensors.txt", "x, ", "at least 3 columns"),
        ("sensors/sensors.txt", "cam, n, gnss", "'cam' is empty or listed twice"),
        ("sensors/sensors.txt", "x, n, camera", "expected a camera model, width, height"),
        ("sensors/sensors.txt", "x, n, camera, PINHOLLOW, 6, 4, 1, 1, 1, 1", "unknown camera mod"),
        ("sensors/sensors.txt", "x, n, camera, PINHOLE, 6, 4, 5, 3, 2", "takes 4 parameters"),
        ("sensors/sensors.txt", "x, n, camera, PINHOLE, 6, 4, nan, 5, 3, 2", "must be finite"),
        ("sensors/sensors.txt", "x, n, camera, UNKNOWN_CAMERA, 640", "width and a height"),
        ("sensors/rigs.txt", f"deep, cam, {IDENTITY}", "also a sensor id"),
        ("sensors/rigs.txt", f"rig, cam, {IDENTITY}", "twice"),
        ("sensors/rigs.txt", f"a, rig, {IDENTITY}\nrig, a, {IDENTITY}", "'rig' contains itself"),
        ("keypoints.txt", "n, float32", "expected 3 columns, got 2"),
        ("keypoints.txt", "n, float16, 2", "dtype 'float16' is not one of"),
        ("keypoints.txt", "n, float32, 0", "dsize '0'"),
        ("descriptors.txt", "n, float32, 2, ../k, L2", "leads out"),
        ("pairs.txt", "a b c d", "expected 3 columns, got 4"),
        ("pairs.txt", "a, b, c", "expected finite numbers score, got 'c'"),
        ("pairs.txt", "a, ../b, 1", "leads out"),
        ("pairs.txt", ", b, 1", "empty"),
        ("table.csv", "c", "1 fields"),
        ("table.csv", "a,b,c", "3 fields"),
        ("groups.csv", "a.jpg,day,,,x", "scored: it should be a valid boolean"),
        ("groups.csv", "../a.jpg,day,,,1", "leads out"),
        ("names.csv", "a.jpg,x y", "name: "),
        ("relocalization.csv", "../../x.txt,a,b", ""),
    ],
)
def test_a_wrong_row_has_file_and_line(tmp_path: Path, name: str, row: str, message: str) -> None:
    before, read = TABLES[name]
    (tmp_path / "sensors").mkdir()
    (tmp_path / "sensors/sensors.txt").write_text(SENSORS)
    content = f"{before}{row}\n"
    (tmp_path / name).write_text(content)
    line = len(content.splitlines())
    with pytest.raises(DataError, match=f"{re.escape(name)}:{line}: .*{message}"):
        read(tmp_path)


def csv_table(path: Path) -> Any:
    return list(read_csv_table(path, ("image", "reason")))


def kapture_of(path: Path) -> Any:
    return read_kapture_data(path.parents[1])


def depth_map(path: Path) -> Any:
    return read_depth_map(path, width=3, height=1)


def points_with(row: str) -> str:
    return VERSION + "1,2,3,4,5,6\n" * 20 + row + "\n1,2,3,4,5,6\n"


def observations_with(row: str) -> str:
    return VERSION + "0, t, a, 1, b, 2\n" * 20 + row + "\n3, t, a, 1\n"


def sensors_of(version: str) -> str:
    return SENSORS.replace(VERSION, "" if version == "none" else VERSION.replace("1.1", version))


MILLIMETRES = np.array([[0, 1523, 8000.0]], "<f4").tobytes()


@pytest.mark.parametrize(
    ("name", "content", "read", "message"),
    [
        ("sensors.txt", sensors_of("1.2"), kapture_of, r":1: .*1.2 is not supported"),
        ("sensors.txt", sensors_of("11.1"), kapture_of, r":1: .*11.1 is not supported"),
        ("sensors.txt", sensors_of("none"), kapture_of, ":1: .*first line must be"),
        ("table.csv", "", csv_table, ":1: .*header"),
        ("table.csv", "image\na\n", csv_table, ":1: .*header"),
        ("table.csv", "image,reason,extra\na,b,c\n", csv_table, ":1: .*header"),
        ("table.csv", b"image,reason\na,\xff\n", csv_table, ":2: .*UTF-8"),
        (
            "points3d.txt",
            points_with("1,2,3,4,5"),
            read_points3d,
            "not a table with 3 or 6 columns",
        ),
        ("points3d.txt", points_with("1,2,3,4,5,"), read_points3d, "could not convert string ''"),
        ("points3d.txt", points_with("1,2,3,4,5,nan"), read_points3d, "point 20 is not finite"),
        ("o.txt", observations_with("5, t, a, 1, b"), read_observations, "expected point3d_id"),
        ("o.txt", observations_with("x, t, a, 1"), read_observations, "expected point3d_id"),
        ("o.txt", observations_with("5, a, 1, b, 2"), read_observations, "1.0 have no type"),
        ("o.txt", observations_with("5, t, a, -1"), read_observations, "with ids of 0 or more"),
        ("o.txt", observations_with(f"5, t, a, {2**31}"), read_observations, "ids of 0 or more"),
        ("o.txt", observations_with("5, t/u, a, 1"), read_observations, "cannot be a type name"),
        ("o.txt", observations_with("5, t, ../a, 1"), read_observations, "leads out"),
        ("a.depth", bytes(8), depth_map, "8 bytes"),
        ("a.depth", bytes(16), depth_map, "16 bytes"),
        ("a.depth", MILLIMETRES, depth_map, "all values are whole .* millimetres; give met"),
    ],
)
def test_a_wrong_file_is_named(
    tmp_path: Path, name: str, content: str | bytes, read: Callable[[Path], Any], message: str
) -> None:
    path = tmp_path / "sensors" / name
    path.parent.mkdir()
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(DataError, match=f"{re.escape(name)}.*{message}"):
        read(path)


def test_the_layout_of_kapture_1_0_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "reconstruction/keypoints").mkdir(parents=True)
    (tmp_path / "reconstruction/keypoints/keypoints.txt").write_text(VERSION)
    with pytest.raises(DataError, match="kapture_upgrade_1_0_to_1_1"):
        list_types(tmp_path, "keypoints", orphan=False)


def test_the_folder_of_a_type_names_the_folder_to_give(tmp_path: Path) -> None:
    (tmp_path / "global_features").mkdir()
    (tmp_path / "global_features/global_features.txt").write_text(VERSION)
    with pytest.raises(DataError, match="that contains global_features/TYPE/global_features"):
        list_types(tmp_path, "global_features", orphan=True)


@pytest.mark.parametrize(
    ("kind", "config", "size", "message"),
    [
        ("keypoints", FeatureConfig("k", np.dtype("float32"), 3), 23, "whole rows"),
        ("global_features", FeatureConfig("g", np.dtype("float32"), 16), 0, "exactly one row"),
        ("global_features", FeatureConfig("g", np.dtype("float32"), 16), 128, "exactly one row"),
    ],
)
def test_truncated_arrays_are_named(
    tmp_path: Path, kind: ArrayKind, config: FeatureConfig, size: int, message: str
) -> None:
    FeatureWriter(tmp_path, kind, "T", config)
    folder = feature_folder(tmp_path, kind, "T", orphan=False)
    (folder / f"a.jpg{SUFFIX[kind]}").write_bytes(bytes(size))
    features = FeatureReader(kind, "T", [folder])
    for read in (features.read, features.length):
        with pytest.raises(DataError, match=rf"a\.jpg\.\w+: {size} bytes are not {message}"):
            read("a.jpg")


def test_a_compressed_tar_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "keypoints.tar"
    path.write_bytes(b"\x1f\x8b\x08packed")
    with pytest.raises(DataError, match=r"keypoints\.tar: not an uncompressed tar"):
        open_folders([tmp_path], "keypoints")


def test_one_fraction_makes_depth_metres_and_a_missing_map_is_named(tmp_path: Path) -> None:
    np.array([[0, 1.5, 8000.0]], "<f4").tofile(tmp_path / "d.depth")
    assert depth_map(tmp_path / "d.depth").max() == 8000
    with pytest.raises(DataError, match=r"b\.depth: cannot read: the file is missing"):
        depth_map(tmp_path / "b.depth")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_truncated_images_are_named(tmp_path: Path, suffix: str, capfd: Any) -> None:
    path = tmp_path / ("a" + suffix)
    pixels = np.random.default_rng(0).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    content = path.read_bytes()
    for share in (0.5, 0.99):
        path.write_bytes(content[: int(len(content) * share)])
        with pytest.raises(DataError, match=path.name):
            read_image_rgb(path)
    assert capfd.readouterr().err == ""


def test_files_other_than_images_are_named(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("not an image")
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "folder.jpg").mkdir()
    (tmp_path / "dangling.jpg").symlink_to("/nowhere")
    for name in ("text.jpg", "empty.jpg", "folder.jpg", "dangling.jpg", "missing.jpg"):
        for read in (read_image_rgb, image_size):
            with pytest.raises(DataError, match=name):
                read(tmp_path / name)
