"""The text files of 4Seasons: values and published variants."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.fourseasons import (
    parse_relocalization_name,
    read_calibration,
    read_gnss_poses,
    read_pinhole,
    read_poses,
    read_relocalization,
    read_transformations,
)
from megloc_kapture.errors import DataError
from megloc_kapture.values import Camera, RigidTransform

TIME, LATER = 1602074877390449152, 1610028237003433729
PINHOLE = "Pinhole 501.5 502.5 421.8 167.7 0.0 0.0 0.0 0.0\n800 400\ncrop\n800 400\n"
HEADER = "# timestamp_ns, tran_x, tran_y, tran_z, quat_x, quat_y, quat_z, quat_w, scale, q, v3\n"
ROW = f"{TIME},-0.06,0.05,-0.15,-0.015376,0.724499,-0.689104,-0.000977,0.9624,2"
PLAIN = f"{TIME} -0.06 0.05 -0.15 -0.015376 0.724499 -0.689104 -0.000977"
BLOCKS = (
    "# transform_S_AS: translation vector, rotation quaternion\n1,2,3,0,0,0,1\n",
    "# TS_cam_imu: translation vector, rotation quaternion\n9,9,9,0,0,0,1\n",
    "# transform_w_gpsw: translation vector, rotation quaternion\n4,5,6,0,0,0.6,0.8\n",
    "# transform_gps_imu: translation vector, rotation quaternion\n0,0,0,0,0,0,1\n",
    "# transform_e_gpsw: translation vector, rotation quaternion\n4e6,8e5,4.7e6,0.6,0,0,0.8\n",
    "# GNSS scale\n0.9624\n",
)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "file.txt"
        path.write_bytes(text.encode())
        return path

    return write


@pytest.mark.parametrize(
    ("old", "new"),
    [("", ""), (" 0.0 0.0 0.0 0.0", ""), ("crop\n800 400\n", "")],
)
def test_a_pinhole_file_is_read_with_its_variants(
    write: Callable[[str], Path], old: str, new: str
) -> None:
    camera = read_pinhole(write(PINHOLE.replace(old, new) if old else PINHOLE))
    assert camera == Camera("PINHOLE", 800, 400, (501.5, 502.5, 421.8, 167.7))


@pytest.mark.parametrize(
    ("text", "scale", "quality"),
    [
        (HEADER + ROW, 0.9624, 2.0),
        (HEADER + ROW + ",0.5\n", 0.9624, 2.0),
        (HEADER + ROW.removesuffix(",2"), 0.9624, None),
        (HEADER + ROW.removesuffix(",0.9624,2"), None, None),
        (ROW.replace(",", ", "), 0.9624, 2.0),
        (ROW.replace(",", " "), 0.9624, 2.0),
    ],
)
def test_gnss_poses_are_read_with_optional_columns(
    write: Callable[[str], Path], text: str, scale: float | None, quality: float | None
) -> None:
    rows = read_gnss_poses(write(text))
    assert list(rows) == [TIME]  # to the last digit
    row = rows[TIME]
    assert (row.scale, row.fusion_quality) == (scale, quality)
    assert row.slam_from_cam.translation == (-0.06, 0.05, -0.15)
    rotation = Rotation.from_quat([-0.015376, 0.724499, -0.689104, -0.000977]).as_matrix()
    np.testing.assert_allclose(row.slam_from_cam.rotation_matrix(), rotation, atol=1e-14)
    assert read_poses(write(f"# ts\n{PLAIN}\n")) == {TIME: row.slam_from_cam}


@pytest.mark.parametrize("order", [1, -1])
def test_transformations_are_read_in_any_order(write: Callable[[str], Path], order: int) -> None:
    actual = read_transformations(write("".join(BLOCKS[::order])))
    assert actual.s_from_as.translation == (1.0, 2.0, 3.0)
    assert actual.w_from_gpsw == RigidTransform((0.8, 0.0, 0.0, 0.6), (4.0, 5.0, 6.0))
    assert actual.e_from_gpsw == RigidTransform((0.8, 0.6, 0.0, 0.0), (4e6, 8e5, 4.7e6))
    assert actual.gnss_scale == 0.9624
    assert read_transformations(write("".join(BLOCKS[:5]))).gnss_scale is None


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("relocalizationFile_rec_2020-03-24_easy.txt", (None, "rec_2020-03-24")),
        ("relocalizationFile_rec_2020-03-24.txt", (None, "rec_2020-03-24")),
        ("relocalizationFile_rec_2020_to_rec_2021.txt", ("rec_2020", "rec_2021")),
        ("reloc_loop_2_train_to_loop_2_test.txt", ("loop_2_train", "loop_2_test")),
        ("reloc_city_loop.txt", None),
        ("relocalizationFile_.txt", None),
        ("relocalizationFile_a.csv", None),
        ("times.txt", None),
    ],
)
def test_names_of_relocalization_files_are_parsed(
    name: str, expected: tuple[str | None, str] | None
) -> None:
    assert parse_relocalization_name(name) == expected


def test_relocalization_pairs_may_have_a_relative_pose(write: Callable[[str], Path]) -> None:
    rows = read_relocalization(write(f"# pairs\n{TIME},{LATER}\n\n{LATER} {TIME}\n"))
    assert [(row.reference, row.query) for row in rows] == [(TIME, LATER), (LATER, TIME)]
    assert all(row.query_from_reference is None for row in rows)
    row = read_relocalization(write(f"{TIME} {LATER} 1 2 3 0 0 0.6 0.8\n"))[0]
    assert row.query_from_reference is not None
    point = row.query_from_reference.apply(np.array([[1.0, 0.0, 0.0]]))[0]
    np.testing.assert_allclose(point, [1.28, 2.96, 3.0])  # rotated by 73.74 deg about z


def test_both_cameras_of_a_calibration_are_required(tmp_path: Path) -> None:
    (tmp_path / "undistorted_calib_0.txt").write_text(PINHOLE)
    with pytest.raises(DataError, match=r"undistorted_calib_1\.txt: .*the file is missing"):
        read_calibration(tmp_path)
