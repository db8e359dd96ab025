"""Names and values in the text files of 4Seasons, InLoc and RobotCar."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets import fourseasons, inloc, robotcar
from megloc_kapture.errors import DataError
from megloc_kapture.values import Camera, RigidTransform

TIME, LATER = 1602074877390449152, 1610028237003433729
PINHOLE = "Pinhole 501.5 502.5 421.8 167.7 0.0 0.0 0.0 0.0\n800 400\ncrop\n800 400\n"
ROW = f"{TIME},-0.06,0.05,-0.15,-0.015376,0.724499,-0.689104,-0.000977,0.9624,2"
TRANSFORMATIONS = (
    "# transform_S_AS: translation vector, rotation quaternion\n1,2,3,0,0,0,1\n",
    "# TS_cam_imu: translation vector, rotation quaternion\n9,9,9,0,0,0,1\n",
    "# transform_w_gpsw: translation vector, rotation quaternion\n4,5,6,0,0,0.6,0.8\n",
    "# transform_e_gpsw: translation vector, rotation quaternion\n4e6,8e5,4.7e6,0.6,0,0,0.8\n",
    "# GNSS scale\n0.9624\n",
)
SCAN = """Before general icp:
1 0 0 0
0 1 0 0
0 0 1 0
0 0 0 1

After general icp:
  0 -1  0  5.0
  1  0  0  2.0
  0  0  1  -1e-1
  0  0  0  1
"""


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        (tmp_path / "file.txt").write_text(text)
        return tmp_path / "file.txt"

    return write


# ------------------------------------------------------------------ 4Seasons


@pytest.mark.parametrize("optional", ["", " 0.0 0.0 0.0 0.0", "crop\n800 400\n"])
def test_a_pinhole_file_has_optional_parts(write: Callable[[str], Path], optional: str) -> None:
    camera = fourseasons.read_pinhole(write(PINHOLE.replace(optional, "") if optional else PINHOLE))
    assert camera == Camera("PINHOLE", 800, 400, (501.5, 502.5, 421.8, 167.7))


@pytest.mark.parametrize(
    ("text", "scale", "quality"),
    [
        (f"# header\n{ROW},0.5\n", 0.9624, 2.0),
        (ROW.removesuffix(",2"), 0.9624, None),
        (ROW.removesuffix(",0.9624,2"), None, None),
        (ROW.replace(",", " "), 0.9624, 2.0),
    ],
)
def test_gnss_poses_have_optional_scale_and_quality(
    write: Callable[[str], Path], text: str, scale: float | None, quality: float | None
) -> None:
    (time, row), *others = fourseasons.read_gnss_poses(write(text)).items()
    assert (time, others) == (TIME, [])  # to the last digit
    assert (row.scale, row.fusion_quality) == (scale, quality)
    assert row.slam_from_cam.translation == (-0.06, 0.05, -0.15)
    rotation = Rotation.from_quat([-0.015376, 0.724499, -0.689104, -0.000977]).as_matrix()
    np.testing.assert_allclose(row.slam_from_cam.rotation_matrix(), rotation, atol=1e-14)
    plain = " ".join(ROW.split(",")[:8])
    assert fourseasons.read_poses(write(f"# ts\n{plain}\n")) == {TIME: row.slam_from_cam}


@pytest.mark.parametrize("order", [1, -1])
def test_transformations_are_read_in_any_order(write: Callable[[str], Path], order: int) -> None:
    actual = fourseasons.read_transformations(write("".join(TRANSFORMATIONS[::order])))
    assert actual.s_from_as.translation == (1.0, 2.0, 3.0)
    assert actual.w_from_gpsw == RigidTransform((0.8, 0.0, 0.0, 0.6), (4.0, 5.0, 6.0))
    assert actual.e_from_gpsw == RigidTransform((0.8, 0.6, 0.0, 0.0), (4e6, 8e5, 4.7e6))
    assert actual.gnss_scale == 0.9624
    without = fourseasons.read_transformations(write("".join(TRANSFORMATIONS[:4])))
    assert without.gnss_scale is None


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("relocalizationFile_rec_2020-03-24_easy.txt", (None, "rec_2020-03-24")),
        ("relocalizationFile_rec_2020_to_rec_2021.txt", ("rec_2020", "rec_2021")),
        ("reloc_loop_2_train_to_loop_2_test.txt", ("loop_2_train", "loop_2_test")),
        ("reloc_city_loop.txt", None),
        ("times.txt", None),
    ],
)
def test_names_of_relocalization_files_have_the_recordings(
    name: str, expected: tuple[str | None, str] | None
) -> None:
    assert fourseasons.parse_relocalization_name(name) == expected


def test_relocalization_pairs_may_have_a_relative_pose(write: Callable[[str], Path]) -> None:
    rows = fourseasons.read_relocalization(write(f"# pairs\n{TIME},{LATER}\n\n{LATER} {TIME}\n"))
    assert [(row.reference, row.query) for row in rows] == [(TIME, LATER), (LATER, TIME)]
    assert all(row.query_from_reference is None for row in rows)
    row = fourseasons.read_relocalization(write(f"{TIME} {LATER} 1 2 3 0 0 0.6 0.8\n"))[0]
    assert row.query_from_reference is not None
    point = row.query_from_reference.apply(np.array([[1.0, 0.0, 0.0]]))[0]
    np.testing.assert_allclose(point, [1.28, 2.96, 3.0])  # rotated by 73.74 deg about z


def test_both_cameras_of_a_calibration_are_required(tmp_path: Path) -> None:
    (tmp_path / "undistorted_calib_0.txt").write_text(PINHOLE)
    with pytest.raises(DataError, match=r"undistorted_calib_1\.txt: .*the file is missing"):
        fourseasons.read_calibration(tmp_path)


# ------------------------------------------------------------------ InLoc and RobotCar


def test_names_of_cutouts_have_scan_and_direction() -> None:
    cutout = inloc.parse_cutout_name("cse_cutout_000_330_-30.jpg")
    assert cutout == inloc.Cutout("cse", "000", 330, -30)
    assert cutout.image == "cse_cutout_000_330_-30.jpg"
    assert cutout.transformation == "cse_trans_000.txt"


def test_the_second_matrix_of_a_transformation_is_used(write: Callable[[str], Path]) -> None:
    pose = inloc.read_transformation(write(f"comment: {SCAN}\nfitness 0.1\n"))
    np.testing.assert_allclose(pose.apply(np.array([[1.0, 0, 0]])), [[5, 3, -0.1]], atol=1e-12)


def test_numbers_of_wrong_scans_are_read(write: Callable[[str], Path]) -> None:
    path = write("known wrong:\n\n008\nDUC_scan_12.ptx 31\n2017\n")
    assert inloc.read_wrong_scans(path) == {"008", "012", "031"}


def test_names_of_images_have_condition_camera_and_time() -> None:
    key = robotcar.ImageKey("night-rain", "rear", "1418840689734892")
    for name in ("night-rain/rear/1418840689734892.png", "./night-rain/rear/1418840689734892.jpg"):
        assert robotcar.parse_image(name) == key
    assert (key.timestamp, key.path) == (1418840689734892, "night-rain/rear/1418840689734892")
    assert robotcar.parse_image("rear/5.png") == robotcar.ImageKey("", "rear", "5")
    for name in ("5.png", "a/b/rear/5.png", "../rear/5.png", "dawn/rear/5.jpeg", "dawn/rear/x.jpg"):
        assert robotcar.parse_image(name) is None, name
