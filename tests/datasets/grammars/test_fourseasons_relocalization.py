"""Relocalization files of the challenges, and lists of frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.grammars.fourseasons_relocalization import (
    parse_relocalization_name,
    read_relocalization,
)
from megloc_kapture.datasets.grammars.fourseasons_times import read_times
from megloc_kapture.errors import DataError

A, B = 1602074877390449152, 1610028237003433729


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "file.txt"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "relocalizationFile_recording_2020-03-24_17-45-31_easy.txt",
            (None, "recording_2020-03-24_17-45-31"),
        ),
        (
            "relocalizationFile_recording_2020-03-24_17-36-22.txt",
            (None, "recording_2020-03-24_17-36-22"),
        ),
        (
            "relocalizationFile_recording_2020-10-08_09-57-28_to_recording_2021-01-07_14-03-57.txt",
            ("recording_2020-10-08_09-57-28", "recording_2021-01-07_14-03-57"),
        ),
        (
            "reloc_city_loop_2_train_to_city_loop_2_test.txt",
            ("city_loop_2_train", "city_loop_2_test"),
        ),
        ("reloc_city_loop.txt", None),
        ("relocalizationFile_.txt", None),
        ("relocalizationFile_a.csv", None),
        ("times.txt", None),
    ],
)
def test_names(name: str, expected: tuple[str | None, str] | None) -> None:
    assert parse_relocalization_name(name) == expected


@pytest.mark.parametrize("text", [f"{A} {B}\n{B} {A}", f"# pairs\r\n{A},{B}\r\n\r\n{B} {A}\r\n"])
def test_pairs(tmp_path: Path, text: str) -> None:
    rows = read_relocalization(write(tmp_path, text))
    assert [(row.reference, row.query) for row in rows] == [(A, B), (B, A)]
    assert all(row.query_from_reference is None for row in rows)


def test_pairs_with_poses(tmp_path: Path) -> None:
    row = read_relocalization(write(tmp_path, f"{A} {B} 1 2 3 0 0 0.6 0.8\n"))[0]
    assert row.query_from_reference is not None
    point = row.query_from_reference.apply(np.array([[1.0, 0.0, 0.0]]))[0]
    np.testing.assert_allclose(point, [1.28, 2.96, 3.0])  # turned by 73.74 deg about z


@pytest.mark.parametrize(
    ("text", "line", "match"),
    [
        (f"{A}\n", 1, "expected 'reference query' .* got 1 fields"),
        (f"{A} {B}\n{A} {B} 1 2 3\n", 2, "got 5 fields"),
        (f"{A} {B} 1 2 3 0 0 0.6 0.7\n", 1, "not a unit quaternion"),
        (f"{A} b\n", 1, "'b' is not a timestamp"),
        (f"{A} {B}.0\n", 1, "is not a timestamp"),
    ],
)
def test_broken_pairs(tmp_path: Path, text: str, line: int, match: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(DataError, match=match) as caught:
        read_relocalization(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


def test_no_pairs(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no pair in the file"):
        read_relocalization(write(tmp_path, "# nothing\n"))


def test_times_keep_every_digit(tmp_path: Path) -> None:
    text = f"{A} 1602074877.3904490471 0.25\n{B} 1610028237.0034337044\n"
    assert read_times(write(tmp_path, text)) == [A, B]
    assert read_times(write(tmp_path, text.replace("\n", "\r\n").rstrip())) == [A, B]


@pytest.mark.parametrize(
    ("text", "line", "match"),
    [
        (f"{A}\n", 1, "expected 'timestamp seconds exposure', got 1 fields"),
        (f"{A} 1.5 0.25\n{A} 1.5 0.25\n", 2, "is given twice"),
        (f"{A} soon 0.25\n", 1, "'soon' is not a number"),
        ("1.5e18 1.5 0.25\n", 1, "is not a timestamp"),
    ],
)
def test_broken_times(tmp_path: Path, text: str, line: int, match: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(DataError, match=match) as caught:
        read_times(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


def test_the_published_times(shared_data: Path) -> None:
    folder = next((shared_data / "kapture_samples/4seasons/TUM").glob("recording_*"))
    times = read_times(folder / "times.txt")
    assert len(times) == 10030
    images = {int(p.stem) for p in (folder / "undistorted_images/cam0").iterdir()}
    assert len(images) == 4
    assert images <= set(times)
