"""4Seasons' keyframe files: pose and point cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.grammars.fourseasons_keyframes import read_keyframe
from megloc_kapture.errors import DataError

TEXT = """# timestamp
1602074877390449152

# fx, fy, cx, cy, width, height, npoints
501.5,502.5,421.8,167.7,800,400,2

# camToWorld: translation vector, rotation quaternion
1,2,3,0,0,0.6,0.8

# Exposure time (ms)
0.245718

# Point Cloud Data :\x20
# u,v,idepth_scaled,idepth_hessian,maxRelBaseline,numGoodRes,status\x20
# color information\x20
394.000000,5.000000,0.047381,903300736.000000,0.071440,0,1
35,29,40,24,32,32,32,36,
529.500000,6.000000,0.055165,901976256.000000,0.083134,0,1
31,28,17,27,19,14,18,20,
"""
CLOUD = TEXT.index("394")


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "KeyFrame_1602074877390449152.txt"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        TEXT,
        TEXT.rstrip(),
        TEXT + "\n\n",
        TEXT.replace("\n", "\r\n"),
        TEXT.replace("\n\n", "\n"),
        TEXT.replace("36,\n", "36\n"),
        TEXT + "\n# something new\n1,2,3\n",
    ],
)
def test_a_keyframe(tmp_path: Path, text: str) -> None:
    keyframe = read_keyframe(write(tmp_path, text))
    assert keyframe.timestamp == 1602074877390449152
    assert (keyframe.camera.width, keyframe.camera.height) == (800, 400)
    assert keyframe.camera.params == (501.5, 502.5, 421.8, 167.7)
    assert keyframe.world_from_cam.quat_wxyz == (0.8, 0.0, 0.0, 0.6)
    assert keyframe.world_from_cam.translation == (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(keyframe.points, [[394, 5, 0.047381], [529.5, 6, 0.055165]])


@pytest.mark.parametrize("end", ["", "\n", "\n\n"])
def test_a_keyframe_without_points(tmp_path: Path, end: str) -> None:
    text = TEXT[:CLOUD].rstrip("\n").replace(",2\n", ",0\n") + end
    assert read_keyframe(write(tmp_path, text)).points.shape == (0, 3)


@pytest.mark.parametrize(
    ("old", "new", "line", "match"),
    [
        (",800,400,2", ",800,400,3", 20, "2 points, 3 are announced"),
        (",800,400,2", ",800,400,999999999999999999", 20, "2 points, 9{18} are announced"),
        (",800,400,2", ",800,400", 5, "expected fx, .* got 6 fields"),
        (",800,400,2", ",800,400.5,2", 5, "'400.5' is not an integer"),
        (",800,400,2", ",-800,400,2", 5, "image size -800x400 is not positive"),
        ("1602074877390449152\n", "1602074877.39\n", 2, "is not a timestamp"),
        ("# timestamp\n", "", 19, "no line '# timestamp'"),
        ("# camToWorld", "# worldToCam", 20, "no line '# camToWorld'"),
        ("1,2,3,0,0,0.6,0.8", "1,2,3,0,0,0.6", 8, "expected 7 numbers"),
        ("529.500000,", "", 18, "expected u,v,idepth_scaled.* got 6 fields"),
        ("529.500000", "nan", 18, "'nan' is not finite"),
        ("31,28,17,27,19,14,18,20,", "31,28,17,", 19, "expected 8 colours"),
        ("31,28,17,27,19,14,18,20,\n", "", 19, "expected 8 colours"),
        (TEXT[TEXT.index("# Point") :], "", 13, "no line '# Point Cloud'"),
        (TEXT, "", 1, "no line '# timestamp'"),
    ],
)
def test_broken_keyframes(tmp_path: Path, old: str, new: str, line: int, match: str) -> None:
    path = write(tmp_path, TEXT.replace(old, new))
    with pytest.raises(DataError, match=match) as caught:
        read_keyframe(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


def test_the_published_clouds_as_kapture_reads_them(shared_data: Path) -> None:
    from tools.kapture_import_4seasons import (
        load_4season_depth_from_keyframe_data,
        load_4season_pose_from_keyframe_data,
    )

    folder = next((shared_data / "kapture_samples/4seasons/TUM").glob("recording_*"))
    files = sorted((folder / "KeyFrameData").iterdir())
    assert len(files) == 4
    for file in files:
        ours = read_keyframe(file)
        depth = load_4season_depth_from_keyframe_data(str(file))
        np.testing.assert_array_equal(ours.points.astype(np.float32), depth.coords)
        assert ours.camera.params == (*depth.f, *depth.c)
        assert (ours.camera.height, ours.camera.width) == depth.image_size
        pose = load_4season_pose_from_keyframe_data(str(file))
        cam_from_world = ours.world_from_cam.inverse()
        np.testing.assert_allclose(cam_from_world.translation, pose.t_raw, atol=1e-6)
        np.testing.assert_allclose(np.abs(cam_from_world.quat_wxyz), np.abs(pose.r_raw), atol=1e-6)
