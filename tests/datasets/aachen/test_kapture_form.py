"""Aachen Day-Night in kapture folders, made by kapture's importers of the official layout."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aachen_files import MODEL, write_v1_0, write_v1_1
from kapture import flatten
from kapture.io.csv import kapture_from_dir
from kapture_forms import (
    aachen_with_kapture,
    assert_linked,
    assert_same_dataset,
    without_images,
)
from kloc import kapture_tool
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.aachen.adapter import Aachen, AachenOptions
from megloc_kapture.datasets.official import OfficialDataset, write_official
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


def images_of(folder: Path) -> dict[str, tuple[list[float], Any]]:
    """Return cameras and poses by image, as kapture reads them."""
    data = kapture_from_dir(str(folder))
    poses = data.trajectories or {}
    return {
        name: (data.sensors[sensor].camera_params, poses.get(time, {}).get(sensor))
        for time, sensor, name in flatten(data.records_camera)
    }


def assert_same_kapture(ours: Path, theirs: Path) -> None:
    actual, expected = images_of(ours), images_of(theirs)
    assert actual.keys() == expected.keys() and len(actual) > 2
    for name, (params, pose) in expected.items():
        our_params, our_pose = actual[name]
        assert our_params == params and (our_pose is None) == (pose is None)
        if pose is not None:
            np.testing.assert_allclose(our_pose.t_raw, pose.t_raw, rtol=0, atol=1e-9)
            turns = (Rotation.from_quat(p.r_raw, scalar_first=True) for p in (our_pose, pose))
            assert np.degrees((next(turns) * next(turns).inv()).magnitude()) < 1e-9


@pytest.fixture
def sample(shared_data: Path) -> Path:
    folder = shared_data / "kapture_samples" / "Aachen-Day-Night"
    if not folder.is_dir():
        pytest.skip(f"no sample at {folder}")
    return folder


@pytest.mark.slow
def test_kapture_imports_the_published_sample_equally(sample: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_official(read(sample), out, allow_missing=True)
    assert_same_kapture(out / "mapping", sample / "kapture/training")
    assert_same_kapture(out / "query", sample / "kapture/query")
    kapture_tool(
        "kapture_import_nvm",
        *("-i", sample / MODEL, "-im", sample / "images_upright"),
        *("-o", tmp_path / "theirs", "--image_transfer", "skip"),
    )
    assert_same_kapture(out / "mapping", tmp_path / "theirs")
