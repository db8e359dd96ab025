"""RobotCar Seasons' small text files: the published forms, their quirks, and broken ones."""

from __future__ import annotations

from pathlib import Path

from megloc_kapture.datasets.robotcar import (
    ImageKey,
    parse_image,
    read_intrinsics,
)

INTRINSICS = "fx 400.000000\nfy 400.000000\ncx 508.222931\ncy 498.187378\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "file.txt"
    path.write_text(text)
    return path


def test_image_names() -> None:
    key = ImageKey("night-rain", "rear", "1418840689734892")
    for name in ("night-rain/rear/1418840689734892.png", "./night-rain/rear/1418840689734892.jpg"):
        assert parse_image(name) == key
    assert (key.timestamp, key.path) == (1418840689734892, "night-rain/rear/1418840689734892")
    assert parse_image("rear/5.png") == ImageKey("", "rear", "5")
    names = ["5.png", "a/b/rear/5.png", "../rear/5.png", "/rear/5.png", "dawn//5.png"]
    names += [".dawn/rear/5.jpg", "dawn/re,ar/5.jpg", f"dawn/rear/{'1' * 20}.jpg"]
    names += [f"dawn/rear/{n}" for n in ("5.PNG", "5.jpeg", "x.jpg", "-5.jpg", "٣.jpg", "5.jpg\n")]
    for name in names:
        assert parse_image(name) is None, name


def test_intrinsics_in_any_order(tmp_path: Path) -> None:
    expected = (400.0, 400.0, 508.222931, 498.187378)
    lines = INTRINSICS.splitlines()
    for order in (lines, lines[::-1], lines[2:] + lines[:2]):
        assert read_intrinsics(written(tmp_path, "\n".join(order))) == expected
