"""Lists of images with their cameras: values, variants, errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.camera_list import read_camera_rows
from megloc_kapture.values import Camera

LINE = "query/day/nexus4/IMG_20140520_182846.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 -0.0353019"
OTHER = "query/day/milestone/b.jpg SIMPLE_RADIAL 768 1024 971.838 384 512 -0.00177789"
CAMERA = Camera("SIMPLE_RADIAL", 1600, 1200, (1469.2, 800.0, 600.0, -0.0353019))
OTHER_CAMERA = Camera("SIMPLE_RADIAL", 768, 1024, (971.838, 384.0, 512.0, -0.00177789))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "list.txt"


def test_images_in_their_order(path: Path) -> None:
    # the published lists end without a line end
    path.write_text(f"\n  \n{LINE.replace(' ', '  ')}\n\n{OTHER.replace(' ', chr(9))}")
    cameras = read_camera_rows(path)
    assert list(cameras.items()) == [(LINE.split()[0], CAMERA), (OTHER.split()[0], OTHER_CAMERA)]


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("a.jpg 1600 1200 1469.2 800 600 0", "expected a row NAME MODEL WIDTH HEIGHT"),
        ("a.jpg FISH 1600 1200 1469.2 800 600 0", "MODEL one of SIMPLE_PINHOLE, "),
        ("a.jpg SIMPLE_RADIAL 1600", "must be numbers, got ['1600']"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600", "takes 4 parameters, got 3"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 0 0", "takes 4 parameters, got 5"),
        ("a.jpg SIMPLE_RADIAL 1600.5 1200 1469.2 800 600 0", "size 1600.5x1200 is not in whole"),
        ("a.jpg SIMPLE_RADIAL 0 1200 1469.2 800 600 0", "not positive"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 nan 800 600 0", "finite"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 -5 800 600 0", "focal length -5.0 is not positive"),
        ("a.jpg SIMPLE_RADIAL 1600 1200 fifty 800 600 0", "must be numbers, got"),
        ("../a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 0", "leads out of its folder"),
        (LINE, "is listed twice"),
    ],
)
def test_bad_lines_name_file_and_line(path: Path, line: str, match: str) -> None:
    path.write_text(f"{LINE}\n\n{line}\n{OTHER}\n")
    with pytest.raises(DataError) as caught:
        read_camera_rows(path)
    assert str(caught.value).startswith(f"{path}:3: ") and match in str(caught.value)
    assert "\n" not in str(caught.value)
