"""Text files of the datasets: variants and optional parts are read, mistakes are named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.datasets import fourseasons, robotcar
from megloc_kapture.datasets.inloc.adapter import read_transformation, read_wrong_scans
from megloc_kapture.datasets.nvm import read_nvm
from megloc_kapture.errors import DataError
from megloc_kapture.io.text_lines import read_camera_rows, read_transform
from megloc_kapture.values import Camera, RigidTransform

Reader = Callable[[Path], Any]
TIME = 1602074877390449152
POSE = "-0.06,0.05,-0.15,0,0.6,0,0.8"
MATRIX = "0 -1 0 5.0\n1 0 0 2.0\n0 0 1 -1e-1\n0 0 0 1\n"
TEXTS: dict[Reader, str] = {
    fourseasons.read_pinhole: "Pinhole 501.5 502.5 421.8 167.7 0.0 0.0 0.0 0.0\n800 400\n"
    "crop\n800 400\n",
    read_transform: MATRIX,
    fourseasons.read_gnss_poses: f"# header\n{TIME},{POSE},0.96,2\n{TIME + 1},{POSE},1,2,5\n",
    fourseasons.read_poses: f"{TIME},{POSE}\n{TIME + 1},{POSE}\n".replace(",", " "),
    fourseasons.read_relocalization: f"{TIME} 1\n{TIME} 2 {POSE.replace(',', ' ')}\n",
    fourseasons.read_transformations: f"# transform_S_AS: t, q\n{POSE}\n"
    f"# transform_w_gpsw: t\n{POSE}\n\n# transform_e_gpsw: t, q\n{POSE}\n# GNSS scale\n0.96\n",
    robotcar.read_intrinsics: "fx 400.0\nfy 400.0\ncx 508.2\ncy 498.187378\n",
    robotcar.read_query_location: "dawn/left/1418721355075498.jpg\ndawn/rear/14.jpg\n",
    robotcar.read_test_list: "rear/1418721355075498.png\nrear/1418721354984638.png\n",
    robotcar.read_train_poses: "dawn/rear/1.png 1 0 0 10.0 0 1 0 0.0 0 0 1 -2.0 0 0 0 1\n",
    read_camera_rows: "query/day/a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 -0.0353\n"
    "query/b.jpg PINHOLE 768 1024 971.838 971.838 384 512",
    read_transformation: f"Before general icp:\n{MATRIX}\nAfter general icp:\n{MATRIX}",
    read_wrong_scans: "known wrong:\n\n008\nDUC_scan_12.ptx 31\n2017\n",
    read_nvm: "NVM_V3\n\n2\ndb/7.jpg 1000 1 0 0 0 2 0 -5 0.08 0\ndb/8.jpg 900 1 0 0 0 1 2 3 0 0\n"
    "\n1\n1.5 -2 30 255 0 7 2 0 12 10.5 20.25 1 3 30.125 40\n",
}
MAY_BE_EMPTY = (
    *(read_wrong_scans, fourseasons.read_gnss_poses, fourseasons.read_poses),
    fourseasons.read_relocalization,
)
SMALL = [reader for reader in TEXTS if reader is not read_nvm]
READERS = pytest.mark.parametrize("reader", SMALL, ids=lambda reader: reader.__name__)


@READERS
def test_line_ends_and_blanks_do_not_matter(tmp_path: Path, reader: Reader) -> None:
    text, path = TEXTS[reader], tmp_path / "file.txt"
    path.write_bytes(text.encode())
    expected = repr(reader(path))
    for other in (
        text.replace("\n", "\r\n"),
        text.rstrip("\n"),
        "\ufeff" + text,
        "".join(f" {line}\t\n" for line in text.split("\n")),
    ):
        path.write_bytes(other.encode())
        assert repr(reader(path)) == expected, other


def test_numbers_of_wrong_scans_are_read(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text(TEXTS[read_wrong_scans])
    assert read_wrong_scans(path) == {"008", "012", "031"}


@READERS
def test_empty_and_binary_files_are_named(tmp_path: Path, reader: Reader) -> None:
    path = tmp_path / "file.txt"
    for content in (b"\n  \n", b"1\n2 \xff"):
        path.write_bytes(content)
        if reader in MAY_BE_EMPTY and content.isspace():
            assert not reader(path)
            continue
        with pytest.raises(DataError, match=r"file\.txt\b"):
            reader(path)


@pytest.mark.parametrize(
    ("reader", "old", "new", "line", "message"),
    [
        (read_transform, "0 0 1 -1e-1", "0 0 1", None, "expected the 16 elements"),
        (read_transform, "-1e-1", "nan", None, "not a rotation and a translation"),
        (read_transform, "1 0 0 2.0", "2 0 0 2.0", None, "not a rotation"),
        (fourseasons.read_poses, "0 0.6", "", 1, "expected finite numbers tx ty tz"),
        (fourseasons.read_poses, "0.6 0 0.8", "0 0 0", 1, "not a unit quaternion"),
        (fourseasons.read_poses, f"{TIME} ", f"{TIME}.0 ", 1, ".0' is not a timestamp"),
        (fourseasons.read_relocalization, " 1\n", "\n", 1, "1 columns instead of 2 or 9"),
        (robotcar.read_intrinsics, "cy 4", "cz 4", None, "cy missing"),
        (robotcar.read_query_location, "dawn/rear", "../a/rear", 2, "expected condition/camera"),
        (robotcar.read_train_poses, "10.0", "x", 1, "could not convert string to float: 'x'"),
        (read_camera_rows, "768", "wide", 2, "could not convert string to float: 'wide'"),
        (read_camera_rows, "PINHOLE", "PIN", 2, "expected a row NAME MODEL"),
        (read_transformation, "0 0 1 -1e-1\n", "", None, "expected two matrices of four rows"),
        (read_nvm, " 1 3 30.125", " 9 3 30.125", None, "unknown image"),
        (read_nvm, "\n1\n1.5", "\n9\n1.5", None, "the file ends before its last point"),
        (read_nvm, "db/8", "db/7", None, "found 1 different images, expected 2"),
        (read_nvm, "2\ndb/7", "0\ndb/7", None, "the model has no images"),
        (read_nvm, "1000 1", "nan 1", None, "camera values are not finite"),
        (read_nvm, "1000 1", "1000 1.005", None, "camera 'db/7.jpg': .*not a unit quaternion"),
        (read_nvm, "db/7", "../7", None, "camera '../7.jpg': .*leads out"),
        (read_nvm, "40\n", "40\n1\nc.jpg 1 1 0 0 0 0 0 0 0 0\n1\n7 8 9 0 0 0 0\n", None, "several"),
    ],
)
def test_a_wrong_row_is_named(
    tmp_path: Path, reader: Reader, old: str, new: str, line: int | None, message: str
) -> None:
    path = tmp_path / "file.txt"
    assert old in TEXTS[reader]
    path.write_text(TEXTS[reader].replace(old, new))
    with pytest.raises(DataError, match=message) as caught:
        reader(path)
    assert (caught.value.path, caught.value.line) == (path, line)


TRANSFORMATIONS = (
    "# transform_S_AS: translation vector, rotation quaternion\n1,2,3,0,0,0,1\n",
    "# TS_cam_imu: translation vector, rotation quaternion\n9,9,9,0,0,0,1\n",
    "# transform_w_gpsw: translation vector, rotation quaternion\n4,5,6,0,0,0.6,0.8\n",
    "# transform_e_gpsw: translation vector, rotation quaternion\n4e6,8e5,4.7e6,0.6,0,0,0.8\n",
    "# GNSS scale\n0.9624\n",
)


def written(place: Path, text: str) -> Path:
    (place / "file.txt").write_text(text)
    return place / "file.txt"


@pytest.mark.parametrize("optional", ["", " 0.0 0.0 0.0 0.0", "crop\n800 400\n"])
def test_a_pinhole_file_has_optional_parts(tmp_path: Path, optional: str) -> None:
    text = TEXTS[fourseasons.read_pinhole]
    camera = fourseasons.read_pinhole(
        written(tmp_path, text.replace(optional, "") if optional else text)
    )
    assert camera == Camera("PINHOLE", 800, 400, (501.5, 502.5, 421.8, 167.7))


@pytest.mark.parametrize("order", [1, -1])
def test_transformations_are_read_in_any_order(tmp_path: Path, order: int) -> None:
    scene_from_slam, earth_from_scene, scale = fourseasons.read_transformations(
        written(tmp_path, "".join(TRANSFORMATIONS[::order]))
    )
    world_from_scene = RigidTransform((0.8, 0.0, 0.0, 0.6), (4.0, 5.0, 6.0))
    world_from_slam = world_from_scene @ scene_from_slam
    np.testing.assert_allclose(world_from_slam.translation, (1.0, 2.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(world_from_slam.rotation_matrix(), np.eye(3), atol=1e-12)
    assert earth_from_scene == RigidTransform((0.8, 0.6, 0.0, 0.0), (4e6, 8e5, 4.7e6))
    assert scale == 0.9624
    _, _, no_scale = fourseasons.read_transformations(
        written(tmp_path, "".join(TRANSFORMATIONS[:4]))
    )
    assert no_scale is None


def test_names_of_images_have_condition_camera_and_time() -> None:
    key = robotcar.ImageKey("night-rain", "rear", "1418840689734892")
    for name in ("night-rain/rear/1418840689734892.png", "./night-rain/rear/1418840689734892.jpg"):
        assert robotcar.parse_image(name) == key
    assert (key.timestamp, key.path) == (1418840689734892, "night-rain/rear/1418840689734892")
    assert robotcar.parse_image("rear/5.png") == robotcar.ImageKey("", "rear", "5")
    for name in ("5.png", "a/b/rear/5.png", "../rear/5.png", "dawn/rear/5.jpeg", "dawn/rear/x.jpg"):
        assert robotcar.parse_image(name) is None, name
