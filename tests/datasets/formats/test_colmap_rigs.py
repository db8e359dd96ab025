"""Rigs and frames of COLMAP's models, as pycolmap writes them, and broken ones."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.datasets.formats.colmap_reading import ColmapRigs, read_colmap_rigs, rig_files
from megloc_kapture.errors import DataError

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


@pytest.fixture(scope="module")
def truth() -> Any:
    """Two rigs of three cameras, of which one has no known pose."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 3, 2
    options.num_points3D = 40
    return pycolmap.synthesize_dataset(options)


def test_models_before_version_4_have_none(tmp_path: Path) -> None:
    for binary in (True, False):
        assert read_colmap_rigs(tmp_path, binary=binary) == ColmapRigs()
        assert rig_files(tmp_path, binary=binary) == ()


@pytest.mark.parametrize("form", ["text", "binary"])
def test_a_camera_without_a_known_pose_and_other_sensors_are_left_out(
    tmp_path: Path, form: str
) -> None:
    rig = pycolmap.Rig(rig_id=7)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), None)
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.IMU, 3), pycolmap.Rigid3d())
    written = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        camera = {"model": "PINHOLE", "width": 4, "height": 4, "params": [4] * 4}
        written.add_camera(pycolmap.Camera(camera_id=camera_id, **camera))
    written.add_rig(rig)
    getattr(written, f"write_{form}")(tmp_path)
    rigs = read_colmap_rigs(tmp_path, binary=form == "binary")
    assert list(rigs.cams_from_rig[7]) == [1]
    assert len(rig_files(tmp_path, binary=form == "binary")) == 2


@pytest.mark.parametrize("name", ["rigs.bin", "frames.bin"])
def test_every_truncation_is_named(tmp_path: Path, truth: Any, name: str) -> None:
    truth.write_binary(tmp_path)
    content = (tmp_path / name).read_bytes()
    for size in [*range(0, len(content), 7), len(content) - 1]:
        (tmp_path / name).write_bytes(content[:size])
        with pytest.raises(DataError, match=rf"{name}: .* \(byte \d+ of {size}\)"):
            read_colmap_rigs(tmp_path, binary=True)
    (tmp_path / name).write_bytes(content + b"\0")
    with pytest.raises(DataError, match=rf"{name}: 1 bytes follow after the last of"):
        read_colmap_rigs(tmp_path, binary=True)
    (tmp_path / name).unlink()
    with pytest.raises(DataError, match=rf"{name}: file is missing"):
        read_colmap_rigs(tmp_path, binary=True)


POSE = "1 0 0 0 0 0 0"
RIG = f"1 2 CAMERA 1 CAMERA 2 1 {POSE}\n"
FRAME = f"5 1 {POSE} 2 CAMERA 1 8 CAMERA 2 9\n"


@pytest.mark.parametrize(
    ("rigs", "frames", "match"),
    [
        ("1\n", "", "rigs.txt:1: the line ends within a rig"),
        ("# none\n\nx 1 CAMERA 1\n", "", "rigs.txt:3: rig id 'x'"),
        ("1 -1\n", "", "rigs.txt:1: number of sensors '-1'"),
        ("1 3" + RIG[3:], "", "rigs.txt:1: the line ends within a rig"),
        (RIG.replace("1 0 0 0 0", "2 0 0 0 0"), "", "rigs.txt:1: rotation is not a unit"),
        (RIG.replace("1 0 0 0 0", "nan 0 0 0 0"), "", "rigs.txt:1: pose 'nan'"),
        (RIG + RIG, "", "rigs.txt:2: rig 1 is listed twice"),
        (RIG[:-1] + " 1\n", "", "rigs.txt:1: 1 fields follow after a rig"),
        (RIG, FRAME + "5 1 1\n", "frames.txt:2: the line ends within a frame"),
        (RIG, FRAME.replace("5 1 ", "5 2 "), "frames.txt:1: frame 5 is of the unknown rig 2"),
        (RIG, FRAME + FRAME, "frames.txt:2: image 8 is in two frames"),
        (RIG, FRAME.replace(" 9", " 9.5"), "frames.txt:1: image id '9.5'"),
        (RIG, FRAME[:-1] + " 3\n", "frames.txt:1: 1 fields follow after a frame"),
    ],
)
def test_bad_text_is_named(tmp_path: Path, rigs: str, frames: str, match: str) -> None:
    (tmp_path / "rigs.txt").write_text(rigs)
    (tmp_path / "frames.txt").write_text(frames)
    with pytest.raises(DataError, match=match):
        read_colmap_rigs(tmp_path, binary=False)


@pytest.mark.parametrize(
    ("name", "offset", "value", "match"),
    [
        ("rigs.bin", 0, struct.pack("<Q", 2**40), "1099511627776 rigs do not fit into the file"),
        ("rigs.bin", 12, struct.pack("<I", 2**31), r"rigs.bin: .* \(byte 172 of"),
        ("rigs.bin", 33, struct.pack("<d", 3), "rotation is not a unit quaternion"),
        ("rigs.bin", 65, struct.pack("<d", np.inf), "the pose of a sensor is not finite"),
        ("frames.bin", 12, struct.pack("<I", 99), "is of the unknown rig 99"),
        ("frames.bin", 72, struct.pack("<I", 2**31), "the file ends within the data of a frame"),
    ],
)
def test_bad_binary_values_are_named(
    tmp_path: Path, truth: Any, name: str, offset: int, value: bytes, match: str
) -> None:
    truth.write_binary(tmp_path)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[:offset] + value + content[offset + len(value) :])
    with pytest.raises(DataError, match=match):
        read_colmap_rigs(tmp_path, binary=True)
