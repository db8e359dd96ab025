"""RobotCar Seasons in kapture folders, made by kapture's importer of the official layout."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from kapture_forms import (
    assert_linked,
    assert_same_dataset,
    robotcar_with_kapture,
    without_images,
)
from robotcar_files import CAMERAS, QUERIES, TEST, TRAIN, ts, write_layout

from megloc_kapture.datasets.official import OfficialDataset
from megloc_kapture.datasets.robotcar.adapter import RobotCar, RobotCarOptions
from megloc_kapture.errors import OptionError
from megloc_kapture.io.dataset_tables import read_priors
from megloc_kapture.pipeline.datasets import choose_dataset

TEST_LIST = "robotcar_v2_test.txt"


@pytest.fixture(scope="module")
def official(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("robotcar") / "RobotCar-Seasons"
    write_layout(root)
    for camera in CAMERAS:  # kapture's importer reads the lines by their order
        (root / f"intrinsics/{camera}_intrinsics.txt").write_text("fx 9.5\nfy 10\ncx 4\ncy 3.5\n")
    return root


@pytest.fixture(scope="module")
def downloaded(official: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("kapture") / "RobotCar_Seasons-v2"
    return robotcar_with_kapture(official, place, (8, 6))


def read(root: Path, **options: object) -> OfficialDataset:
    return RobotCar(RobotCarOptions(**options)).read(root)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options", [{}, {"train_as_map": True}, {"queries": "train"}, {"location_prior": False}]
)
def test_both_forms_give_the_same_dataset(
    official: Path, root: Path, tmp_path: Path, options: dict[str, object]
) -> None:
    shutil.copyfile(official / TEST_LIST, root / TEST_LIST)
    actual, expected = read(root, **options), read(official, model="individual", **options)
    assert len(expected.names) == len(TEST) * (options.get("queries") != "train")
    assert_same_dataset(actual, expected, atol=1e-12)
    for data, other in ((actual.mapping, expected.mapping), (actual.query, expected.query)):
        (ours,), (theirs,) = data.rigs.values(), other.rigs.values()
        assert ours.keys() == theirs.keys()
        for camera, pose in theirs.items():
            np.testing.assert_allclose(ours[camera].matrix(), pose.matrix(), rtol=0, atol=1e-12)
    assert_linked(actual, tmp_path / "out", official / "images")
    name, priors = f"dawn/rear/{ts(12)}.jpg", read_priors(tmp_path / "out/megloc")
    assert priors.get(name, ("002/rear",)) == ("002/rear",)
    assert bool(priors) == options.get("location_prior", True)


def test_without_the_test_list_all_unpublished_rear_images_are_submitted(downloaded: Path) -> None:
    dataset = read(downloaded)
    hidden = sorted(
        (place, ts(number)) for number, (_, place) in QUERIES.items() if number not in TRAIN
    )
    assert list(dataset.names.values()) == [f"rear/{time}.png" for _, time in hidden]
    assert any(f"Without {TEST_LIST}" in remark for remark in dataset.remarks)
    assert dataset.query_gt is not None and len(dataset.query_gt.poses()) == len(TRAIN)


def test_version_1_is_read_without_training_images(official: Path, root: Path) -> None:
    expected = read(official, version=1, model="individual")
    assert_same_dataset(read(root, version=1), expected, atol=1e-12)
    for part in root.glob("*/mapping"):
        for condition in {condition for condition, _ in QUERIES.values()}:
            without_images(part, f"{condition}/")
    assert "version 1" in read(root).remarks[-1]
    with pytest.raises(OptionError, match="train_as_map"):
        read(root, train_as_map=True)


def test_the_folder_of_kapture_s_archive_is_recognised(
    downloaded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_DATA", str(downloaded.parent))
    choice = choose_dataset("robotcar", None)
    choice.check()
    assert choice.root == downloaded
    with pytest.raises(OptionError, match="kapture folders"):
        RobotCar(RobotCarOptions(reference_model=True)).check(downloaded)
