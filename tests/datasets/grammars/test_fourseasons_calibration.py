"""4Seasons' calibration files: values, variants, errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from megloc_kapture.datasets.grammars.fourseasons_calibration import (
    read_calibration,
    read_pinhole,
    read_stereo,
)
from megloc_kapture.errors import DataError

PINHOLE = "Pinhole 501.5 502.5 421.8 167.7 0.0 0.0 0.0 0.0\n800 400\ncrop\n800 400\n"
STEREO = "1.0 0.0 0.0 -0.3\n0.0 1.0 0.0 0.0\n0.0 0.0 1.0 0.0\n0.0 0.0 0.0 1.0\n"


@pytest.mark.parametrize(
    "text",
    [
        PINHOLE,
        PINHOLE.rstrip(),
        PINHOLE.replace("\n", "\r\n"),
        "\ufeff" + PINHOLE,
        PINHOLE.replace(" 0.0 0.0 0.0 0.0", ""),
        PINHOLE.replace("crop\n800 400\n", ""),
        PINHOLE.replace(" ", "  "),
    ],
)
def test_pinhole(tmp_path: Path, text: str) -> None:
    path = tmp_path / "undistorted_calib_0.txt"
    path.write_bytes(text.encode())
    camera = read_pinhole(path)
    assert (camera.model, camera.width, camera.height) == ("PINHOLE", 800, 400)
    assert camera.params == (501.5, 502.5, 421.8, 167.7)


@pytest.mark.parametrize(
    ("old", "new", "line", "match"),
    [
        ("Pinhole", "Equidistant", 1, "expected 'Pinhole fx fy cx cy"),
        ("167.7 0.0", "167.7", 1, "expected 'Pinhole"),
        ("0.0 0.0\n", "0.0 0.1\n", 1, "cannot have distortion"),
        ("501.5", "nan", 1, "'nan' is not finite"),
        ("501.5", "5_01.5", 1, "is not a number"),
        ("501.5", "-501.5", 1, "focal length -501.5 is not positive"),
        ("crop\n800 400", "crop\n640 400", 4, r"is \(800, 400\) first and \(640, 400\) then"),
        ("800 400\ncrop", "800x400\ncrop", 2, "expected 'width height'"),
        ("800 400\ncrop", "0 400\ncrop", 4, "first and"),
        ("800 400\ncrop", "99999 400\ncrop", 2, "no camera takes images of 99999x400"),
        ("crop\n800 400\n", "crop\n", 3, "expected the lines .*, got 3"),
        (PINHOLE, "", 1, "expected the lines .*, got 0"),
    ],
)
def test_broken_pinhole(tmp_path: Path, old: str, new: str, line: int, match: str) -> None:
    path = tmp_path / "undistorted_calib_0.txt"
    path.write_text(PINHOLE.replace(old, new))
    with pytest.raises(DataError, match=match) as caught:
        read_pinhole(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


@pytest.mark.parametrize(
    ("old", "new", "line", "match"),
    [
        ("1.0\n", "1.0 0\n", 4, "expected four lines of four numbers, got line 4 with 5"),
        ("0.0 0.0 0.0 1.0\n", "", 4, "expected four lines of four numbers, got 3"),
        ("0.0 0.0 0.0 1.0", "0.0 0.0 0.0 1.0\n0 0 0 1", 5, "got line 5"),
        ("0.0 0.0 0.0 1.0", "0.0 0.0 0.1 1.0", 4, "no rigid motion"),
        ("0.0 0.0 1.0 0.0", "0.0 0.0 -1.0 0.0", 4, "no rigid motion"),
        ("0.0 0.0 1.0 0.0", "0.0 0.0 1e300 0.0", 4, "no rigid motion"),
        ("-0.3", "-3e99", 4, "no rigid motion"),
        ("-0.3", "inf", 1, "'inf' is not finite"),
    ],
)
def test_broken_stereo(tmp_path: Path, old: str, new: str, line: int, match: str) -> None:
    path = tmp_path / "undistorted_calib_stereo.txt"
    path.write_text(STEREO.replace(old, new))
    with pytest.raises(DataError, match=match) as caught:
        read_stereo(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


def test_missing_file(tmp_path: Path) -> None:
    (tmp_path / "undistorted_calib_0.txt").write_text(PINHOLE)
    with pytest.raises(DataError, match=r"undistorted_calib_1\.txt: cannot read"):
        read_calibration(tmp_path)


def test_the_published_calibration(shared_data: Path) -> None:
    """A point 0.3 m to the right and 5 m ahead lies straight ahead of the right camera."""
    folder = shared_data / "kapture_samples/4seasons/TUM/calibration"
    calibration = read_calibration(folder)
    matrix = np.loadtxt(folder / "undistorted_calib_stereo.txt")
    np.testing.assert_array_equal(calibration.cam1_from_cam0.rotation_matrix(), matrix[:3, :3])
    np.testing.assert_array_equal(calibration.cam1_from_cam0.translation, matrix[:3, 3])
    point = calibration.cam1_from_cam0.apply(np.array([[0.3, 0.0, 5.0]]))[0]
    np.testing.assert_allclose(point, [0.0, 0.0, 5.0], atol=1e-3)
    camera = calibration.cam1
    theirs = pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )
    assert theirs.img_from_cam(point[None])[0, 0] == pytest.approx(421.7953735163109, abs=0.06)
