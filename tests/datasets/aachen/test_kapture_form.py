"""Aachen Day-Night in kapture folders, made by kapture's importers of the official layout."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from aachen_files import write_v1_0, write_v1_1
from kapture.io.csv import kapture_from_dir
from kapture_forms import (
    aachen_with_kapture,
    assert_linked,
    assert_same_dataset,
    without_images,
)
from kloc import kapture_tool

from megloc_kapture.datasets.aachen.adapter import Aachen, AachenOptions
from megloc_kapture.datasets.official import OfficialDataset
from megloc_kapture.pipeline.datasets import choose_dataset

PARTS = ("query_day", "query_night")


@pytest.fixture(scope="module")
def official(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_v1_1(write_v1_0(tmp_path_factory.mktemp("official") / "Aachen"))


@pytest.fixture(scope="module")
def downloaded(official: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The layout of kapture's downloader: mapping/, query_day/ and query_night/."""
    return aachen_with_kapture(official, tmp_path_factory.mktemp("kapture") / "Aachen-Day-Night")


def read(root: Path, **options: object) -> OfficialDataset:
    return Aachen(AachenOptions(**options)).read(root)  # type: ignore[arg-type]


def test_both_forms_give_the_same_dataset(official: Path, downloaded: Path, tmp_path: Path) -> None:
    expected, actual = read(official), read(downloaded)
    assert len(expected.names) == 5 and expected.protocol.pose_file_stem == "Aachen_v1_1"
    assert_same_dataset(actual, expected)
    assert_linked(actual, tmp_path / "out", official / "images_upright")
    assert kapture_from_dir(str(tmp_path / "out" / "query")).trajectories is None


def test_queries_merged_by_kapture_are_read(official: Path, downloaded: Path, root: Path) -> None:
    parts = [downloaded / part for part in PARTS]
    images = ["--image_transfer", "link_absolute"]
    kapture_tool("kapture_merge", "-i", *parts, "-o", root / "query", *images)
    assert_same_dataset(read(root), read(official))  # the layout of kapture's scripts
    for part in PARTS:
        shutil.rmtree(root / part)
    assert_same_dataset(read(root), read(official))


def test_kapture_folders_may_be_in_a_subfolder(
    official: Path, downloaded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "Aachen-Day-Night-v1.1"  # the name in kapture's archive
    place.mkdir()
    (place / "kapture").symlink_to(downloaded)
    assert_same_dataset(read(place), read(official))
    monkeypatch.setenv("MEGLOC_DATA", str(tmp_path))
    choice = choose_dataset("aachen", None)
    choice.check()
    assert choice.root == place
    # official files take precedence
    shutil.copytree(official, place, dirs_exist_ok=True)
    assert read(place).links == {"": place / "images_upright"}


def test_the_name_of_the_pose_file_follows_the_version(downloaded: Path, root: Path) -> None:
    for part, gone in (("mapping", "sequences/"), ("query_night", "_additional_night/")):
        without_images(root / part, gone)
    assert read(root).protocol.pose_file_stem == "Aachen"
    # the additional queries alone, or the name of the folder, show version 1.1
    shutil.rmtree(root / "query_night")
    shutil.copytree(downloaded / "query_night", root / "query_night", symlinks=True)
    assert read(root).protocol.pose_file_stem == "Aachen_v1_1"
    shutil.rmtree(root / "query_night")
    assert read(root, version="1.1").protocol.pose_file_stem == "Aachen_v1_1"
    named = root.rename(root.with_name("Aachen-Day-Night-v1.1"))
    assert read(named).protocol.pose_file_stem == "Aachen_v1_1"
