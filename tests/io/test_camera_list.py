"""Lists of images with their cameras: values, variants, errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.io.text_lines import read_camera_rows
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
