"""4Seasons' keyframe poses and the transformations between its frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.grammars.fourseasons_poses import (
    read_gnss_poses,
    read_keyframe_accuracy,
    read_poses,
)
from megloc_kapture.datasets.grammars.fourseasons_transformations import read_transformations
from megloc_kapture.errors import DataError

TIME = 1602074877390449152
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


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "file.txt"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    ("text", "scale", "quality"),
    [
        (HEADER + ROW + "\n", 0.9624, 2.0),
        (HEADER + ROW, 0.9624, 2.0),
        ((HEADER + ROW + "\n").replace("\n", "\r\n"), 0.9624, 2.0),
        (HEADER + ROW + ",0.5\n", 0.9624, 2.0),
        (HEADER + ROW.removesuffix(",2") + "\n", 0.9624, None),
        (HEADER + ROW.removesuffix(",0.9624,2") + "\n\n", None, None),
        (ROW.replace(",", ", "), 0.9624, 2.0),
        (ROW.replace(",", " "), 0.9624, 2.0),
    ],
)
def test_gnss_poses(tmp_path: Path, text: str, scale: float | None, quality: float | None) -> None:
    rows = read_gnss_poses(write(tmp_path, text))
    assert list(rows) == [TIME]  # to the last digit
    row = rows[TIME]
    assert (row.scale, row.fusion_quality) == (scale, quality)
    assert row.slam_from_cam.translation == (-0.06, 0.05, -0.15)
    rotation = Rotation.from_quat([-0.015376, 0.724499, -0.689104, -0.000977])
    np.testing.assert_allclose(
        row.slam_from_cam.rotation_matrix(), rotation.as_matrix(), atol=1e-14
    )


@pytest.mark.parametrize(
    ("row", "match"),
    [
        (",".join(ROW.split(",")[:7]), "expected 8 to 11 fields, .* got 7"),
        (ROW + ",1,2", "got 12"),
        (ROW.replace(str(TIME), "1602074877.39"), "'1602074877.39' is not a timestamp"),
        (ROW.replace(str(TIME), "1602074877390449152000"), "is not a timestamp"),
        (ROW.replace(str(TIME), "-5"), "'-5' is not a timestamp"),
        (ROW.replace(str(TIME), "1_6"), "'1_6' is not a timestamp"),
        (ROW.replace("0.05", "nan"), "translation 'nan' is not finite"),
        (ROW.replace("0.05", "5e9"), "leads nowhere on earth"),
        (ROW.replace("0.05", ""), "translation '' is not a number"),
        (ROW.replace("0.724499", "0.7"), "not a unit quaternion"),
        (ROW.replace("0.724499", "1e300"), "not a unit quaternion"),
        (ROW.replace("0.9624", "0"), "scale 0 is no factor"),
        (ROW.replace("0.9624", "-1"), "scale -1 is no factor"),
        (ROW.replace(",2", ",good"), "fusion_quality 'good' is not a number"),
        (f"{ROW}\n{ROW}", f"timestamp {TIME} is given twice"),
    ],
)
def test_broken_gnss_poses(tmp_path: Path, row: str, match: str) -> None:
    path = write(tmp_path, HEADER + row)
    with pytest.raises(DataError, match=match) as caught:
        read_gnss_poses(path)
    line = 3 if "twice" in match else 2
    assert str(caught.value).startswith(f"{path}:{line}: ")


@pytest.mark.parametrize(
    "text",
    [PLAIN, f"# ts tx ty tz qx qy qz qw\n{PLAIN}\n", PLAIN.replace(" ", ","), PLAIN + "\r\n\r\n"],
)
def test_poses(tmp_path: Path, text: str) -> None:
    poses = read_poses(write(tmp_path, text))
    assert list(poses) == [TIME]
    assert poses[TIME].translation == (-0.06, 0.05, -0.15)
    assert poses[TIME].quat_wxyz[0] == pytest.approx(-0.000977, abs=1e-7)


def test_broken_poses(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"file\.txt:1: expected 7 numbers, .* got 8"):
        read_poses(write(tmp_path, PLAIN + " 0"))
    with pytest.raises(DataError, match=r"file\.txt:2: timestamp \d+ is given twice"):
        read_poses(write(tmp_path, f"{PLAIN}\n{PLAIN}"))
    for reader in (read_poses, read_gnss_poses):
        for content in ("", "\n\n", HEADER):
            with pytest.raises(DataError, match=r"file\.txt: no pose in the file"):
                reader(write(tmp_path, content))


def test_keyframe_accuracy(tmp_path: Path) -> None:
    path = write(tmp_path, f"# better than 0.05 m\n{TIME}\n{TIME + 1} 0.03\n")
    assert read_keyframe_accuracy(path) == {TIME, TIME + 1}
    with pytest.raises(DataError, match=r"file\.txt:1: 'x' is not a timestamp"):
        read_keyframe_accuracy(write(tmp_path, "x\n"))


@pytest.mark.parametrize("between", ["\n", "", "\n\n"])
@pytest.mark.parametrize("order", [1, -1])
def test_transformations(tmp_path: Path, between: str, order: int) -> None:
    found = read_transformations(write(tmp_path, between.join(BLOCKS[::order])))
    assert found.s_from_as.translation == (1.0, 2.0, 3.0)
    assert found.w_from_gpsw.translation == (4.0, 5.0, 6.0)
    assert found.w_from_gpsw.quat_wxyz == (0.8, 0.0, 0.0, 0.6)
    assert found.e_from_gpsw.translation == (4e6, 8e5, 4.7e6)
    assert found.e_from_gpsw.quat_wxyz == (0.8, 0.6, 0.0, 0.0)
    assert found.gnss_scale == 0.9624


@pytest.mark.parametrize(
    ("text", "line", "match"),
    [
        ("".join(BLOCKS[:4]), 9, "there is no transform_e_gpsw"),
        ("", 1, "no transform_S_AS, transform_w_gpsw, transform_e_gpsw"),
        ("1,2,3,0,0,0,1\n" + "".join(BLOCKS), 1, "numbers without a line"),
        ("".join(BLOCKS).replace("1,2,3,0,0,0,1\n", ""), 12, "there is no transform_S_AS"),
        ("".join(BLOCKS).replace("4,5,6,", "4,5,"), 6, "expected 7 numbers, .* got 6"),
        ("".join(BLOCKS + BLOCKS[:1]), 14, "'transform_S_AS' is given twice"),
        ("".join(BLOCKS).replace("0.9624", "0.9,0.8"), 12, "expected one scale, got 2"),
        ("".join(BLOCKS).replace("0.9624", "x"), 12, "scale 'x' is not a number"),
    ],
)
def test_broken_transformations(tmp_path: Path, text: str, line: int, match: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(DataError, match=match) as caught:
        read_transformations(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


def test_transformations_without_scale(tmp_path: Path) -> None:
    assert read_transformations(write(tmp_path, "".join(BLOCKS[:5]))).gnss_scale is None


def test_the_published_files_as_kapture_reads_them(shared_data: Path) -> None:
    from tools.kapture_import_4seasons import load_transformations_file

    folder = next((shared_data / "kapture_samples/4seasons/TUM").glob("recording_*"))
    theirs, scale = load_transformations_file(str(folder / "Transformations.txt"))
    ours = read_transformations(folder / "Transformations.txt")
    assert ours.gnss_scale == scale == 0.962356
    for name, transform in (
        ("transform_S_AS", ours.s_from_as),
        ("transform_w_gpsw", ours.w_from_gpsw),
        ("transform_e_gpsw", ours.e_from_gpsw),
    ):
        np.testing.assert_allclose(transform.quat_wxyz, theirs[name].r_raw, atol=1e-6)
        np.testing.assert_array_equal(transform.translation, theirs[name].t_raw)
    rows = read_gnss_poses(folder / "GNSSPoses.txt")
    assert len(rows) == 2874
    assert {row.scale for row in rows.values()} == {0.962356}
    assert next(iter(rows)) == TIME
