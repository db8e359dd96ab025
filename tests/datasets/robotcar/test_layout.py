"""RobotCar Seasons' small text files: the published forms, their quirks, and broken ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.datasets.robotcar import (
    ImageKey,
    parse_image,
    read_intrinsics,
    read_query_location,
    read_test_list,
    read_train_poses,
)
from megloc_kapture.errors import DataError

INTRINSICS = "fx 400.000000\nfy 400.000000\ncx 508.222931\ncy 498.187378\n"
LOCATION = "dawn/left/1418721355075498.jpg\ndawn/rear/1418721355075498.jpg\n"
TEST = "rear/1418721355075498.png\nrear/1418721354984638.png\n"
TRAIN = (
    "dawn/rear/1000000000000001.png 1 0 0 10.0 0 1 0 0.0 0 0 1 -2.0 0 0 0 1\n"
    "night-rain/rear/1000000000000002.png 0 -1 0 5 1 0 0 2 0 0 1 0.5 0 0 0 1\n"
)
READERS: dict[Callable[[Path], Any], str] = {
    read_intrinsics: INTRINSICS,
    read_query_location: LOCATION,
    read_test_list: TEST,
    read_train_poses: TRAIN,
}


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


@pytest.mark.parametrize(
    ("reader", "old", "new", "line", "message"),
    [
        (read_intrinsics, "cy 4", "cz 4", None, "cy missing"),
        (read_intrinsics, "fx 400.000000", "fx nan", 1, "fx 'nan' is not a finite number"),
        (read_intrinsics, INTRINSICS, "fx 1\nfy 1\ncx 1\n", None, "cy missing"),
        (read_query_location, "dawn/rear", "rear", 2, "expected condition/camera/time.jpg"),
        (read_query_location, "dawn/rear", "../a/rear", 2, "expected condition/camera/time.jpg"),
        (read_test_list, "rear/1418721354984638.png", "rear/1418721355075498.jpg", 2, "twice"),
        (read_test_list, "rear/1418721354984638", "rear 5", 2, "expected camera/time.png"),
        (read_train_poses, "-2.0 0 0 0 1", "-2.0 0 0 1", 1, "got 16"),
        (read_train_poses, "-2.0 0 0 0 1", "-2.0 1 0 0 1", 1, "not 0 0 0 1"),
        (read_train_poses, " 1 0 0 2", " 2 0 0 2", 2, "not a rotation matrix"),
        (read_train_poses, " 0.5 ", " inf ", 2, "'inf' is not a finite number"),
        (read_train_poses, TRAIN, TRAIN + TRAIN, 3, "is given twice"),
        (read_train_poses, "night-rain/", "", 2, "expected condition/camera/time.jpg"),
    ],
)
def test_what_is_wrong_is_named(
    tmp_path: Path,
    reader: Callable[[Path], Any],
    old: str,
    new: str,
    line: int | None,
    message: str,
) -> None:
    assert old in READERS[reader] and reader(written(tmp_path, READERS[reader]))
    path = written(tmp_path, READERS[reader].replace(old, new))
    with pytest.raises(DataError) as caught:
        reader(path)
    assert message in caught.value.message
    assert (caught.value.path, caught.value.line) == (path, line)
