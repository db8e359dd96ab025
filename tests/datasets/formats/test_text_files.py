"""Optional parts of text files of 4Seasons and InLoc, and names of RobotCar's images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets import fourseasons, robotcar
from megloc_kapture.values import Camera, RigidTransform

PINHOLE = "Pinhole 501.5 502.5 421.8 167.7 0.0 0.0 0.0 0.0\n800 400\ncrop\n800 400\n"
TRANSFORMATIONS = (
    "# transform_S_AS: translation vector, rotation quaternion\n1,2,3,0,0,0,1\n",
    "# TS_cam_imu: translation vector, rotation quaternion\n9,9,9,0,0,0,1\n",
    "# transform_w_gpsw: translation vector, rotation quaternion\n4,5,6,0,0,0.6,0.8\n",
    "# transform_e_gpsw: translation vector, rotation quaternion\n4e6,8e5,4.7e6,0.6,0,0,0.8\n",
    "# GNSS scale\n0.9624\n",
)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        (tmp_path / "file.txt").write_text(text)
        return tmp_path / "file.txt"

    return write


@pytest.mark.parametrize("optional", ["", " 0.0 0.0 0.0 0.0", "crop\n800 400\n"])
def test_a_pinhole_file_has_optional_parts(write: Callable[[str], Path], optional: str) -> None:
    camera = fourseasons.read_pinhole(write(PINHOLE.replace(optional, "") if optional else PINHOLE))
    assert camera == Camera("PINHOLE", 800, 400, (501.5, 502.5, 421.8, 167.7))


@pytest.mark.parametrize("order", [1, -1])
def test_transformations_are_read_in_any_order(write: Callable[[str], Path], order: int) -> None:
    scene_from_slam, earth_from_scene, scale = fourseasons.read_transformations(
        write("".join(TRANSFORMATIONS[::order]))
    )
    world_from_scene = RigidTransform((0.8, 0.0, 0.0, 0.6), (4.0, 5.0, 6.0))
    world_from_slam = world_from_scene @ scene_from_slam
    np.testing.assert_allclose(world_from_slam.translation, (1.0, 2.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(world_from_slam.rotation_matrix(), np.eye(3), atol=1e-12)
    assert earth_from_scene == RigidTransform((0.8, 0.6, 0.0, 0.0), (4e6, 8e5, 4.7e6))
    assert scale == 0.9624
    _, _, no_scale = fourseasons.read_transformations(write("".join(TRANSFORMATIONS[:4])))
    assert no_scale is None


def test_names_of_images_have_condition_camera_and_time() -> None:
    key = robotcar.ImageKey("night-rain", "rear", "1418840689734892")
    for name in ("night-rain/rear/1418840689734892.png", "./night-rain/rear/1418840689734892.jpg"):
        assert robotcar.parse_image(name) == key
    assert (key.timestamp, key.path) == (1418840689734892, "night-rain/rear/1418840689734892")
    assert robotcar.parse_image("rear/5.png") == robotcar.ImageKey("", "rear", "5")
    for name in ("5.png", "a/b/rear/5.png", "../rear/5.png", "dawn/rear/5.jpeg", "dawn/rear/x.jpg"):
        assert robotcar.parse_image(name) is None, name
