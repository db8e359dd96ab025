"""RobotCar Seasons in kapture folders that kapture's own importer made of its official layout."""

from __future__ import annotations

import shutil
from pathlib import Path

import kapture
import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir, kapture_to_dir
from kapture_forms import robotcar_with_kapture
from robotcar_files import CAMERAS, QUERIES, TEST, TRAIN, ts, write_layout

from megloc_kapture.datasets.official import OfficialDataset, write_official
from megloc_kapture.datasets.robotcar.adapter import RobotCar, RobotCarOptions
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.dataset_tables import read_priors
from megloc_kapture.io.kapture import KaptureData, KaptureFolder
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


@pytest.fixture
def root(downloaded: Path, tmp_path: Path) -> Path:
    """A copy to be changed."""
    return Path(shutil.copytree(downloaded, tmp_path / "root", symlinks=True))


def read(root: Path, **options: object) -> OfficialDataset:
    return RobotCar(RobotCarOptions(**options)).read(root)  # type: ignore[arg-type]


def assert_same_data(found: KaptureData | None, expected: KaptureData | None) -> None:
    assert found is not None and expected is not None
    assert found.records_camera == expected.records_camera
    for name in expected.image_names():
        assert found.camera_of(name) == expected.camera_of(name)
    assert_same_poses(found.trajectories, expected.trajectories)
    (ours,), (theirs,) = found.rigs.values(), expected.rigs.values()
    assert_same_poses(ours, theirs)


def assert_same_poses(found: dict, expected: dict) -> None:
    assert found.keys() == expected.keys()
    for key, pose in expected.items():
        np.testing.assert_allclose(
            found[key].rotation_matrix(), pose.rotation_matrix(), rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(found[key].translation, pose.translation, rtol=0, atol=1e-12)


def assert_same(found: OfficialDataset, expected: OfficialDataset) -> None:
    assert_same_data(found.mapping, expected.mapping)
    assert_same_data(found.query, expected.query)
    assert_same_data(found.query_gt, expected.query_gt)
    assert found.groups == expected.groups
    assert found.priors == expected.priors
    assert found.protocol == expected.protocol
    assert found.names == expected.names and list(found.names) == list(expected.names)
    assert [str(count) for count in found.summary] == [str(count) for count in expected.summary]


@pytest.mark.parametrize(
    "options", [{}, {"train_as_map": True}, {"queries": "train"}, {"location_prior": False}]
)
def test_the_same_dataset_in_both_forms(
    official: Path, root: Path, options: dict[str, object]
) -> None:
    shutil.copyfile(official / TEST_LIST, root / TEST_LIST)
    expected = read(official, model="individual", **options)
    assert len(expected.names) == len(TEST) * (options.get("queries") != "train")
    assert_same(read(root, **options), expected)


def test_without_the_list_all_that_may_be_asked_for_is_handed_in(downloaded: Path) -> None:
    dataset = read(downloaded)
    hidden = sorted(
        (place, ts(number)) for number, (_, place) in QUERIES.items() if number not in TRAIN
    )
    assert list(dataset.names.values()) == [f"rear/{time}.png" for _, time in hidden]
    assert any(f"Without {TEST_LIST}" in remark for remark in dataset.remarks)
    assert dataset.query_gt is not None and len(dataset.query_gt.poses()) == len(TRAIN)


def test_version_1(official: Path, root: Path, tmp_path: Path) -> None:
    # every rear image is asked for; which poses are public does not depend on it
    assert_same(read(root, version=1), read(official, version=1, model="individual"))
    for part in root.glob("*/mapping"):
        data = kapture_from_dir(str(part))
        for time, sensor, name in list(kapture.flatten(data.records_camera)):
            if not name.startswith("overcast-reference/"):
                del data.records_camera[time][sensor]
        kapture_to_dir(str(part), data)
    assert "version 1" in read(root).remarks[-1]
    with pytest.raises(OptionError, match="train_as_map"):
        read(root, train_as_map=True)


def test_priors_are_locations_and_can_be_turned_off(
    official: Path, downloaded: Path, tmp_path: Path
) -> None:
    for number, root in enumerate((official, downloaded)):
        for prior in (True, False):
            out = tmp_path / f"{number}-{prior}"
            write_official(read(root, location_prior=prior), out)
            priors = read_priors(out / "megloc")
            assert len(priors) == prior * len(QUERIES) * len(CAMERAS)
            name = f"dawn/rear/{ts(12)}.jpg"
            assert priors.get(name) == (("002/rear",) if prior else None)


def test_images_are_linked_one_by_one(downloaded: Path, official: Path, tmp_path: Path) -> None:
    write_official(read(downloaded), tmp_path / "out")
    for part in ("mapping", "query"):
        folder = KaptureFolder(tmp_path / "out" / part)
        names = folder.read().image_names()
        records = folder.root / "sensors/records_data"
        files = [path for path in records.rglob("*") if not path.is_dir()]
        assert sorted(str(path.relative_to(records)) for path in files) == names
        assert all((records / n).samefile(official / "images" / n) for n in names)


def test_a_location_without_queries(official: Path, root: Path) -> None:
    shutil.rmtree(root / "02" / "query")
    assert set(read(root).names.values()) <= {f"rear/{ts(number)}.png" for number in (11, 12, 13)}


def test_it_is_found_by_the_folder_kapture_unpacks_to(
    downloaded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_DATA", str(downloaded.parent))
    choice = choose_dataset("robotcar", None)
    choice.check()
    assert choice.root == downloaded
    files = {path.relative_to(downloaded).parts[0] for path in choice.input_files(downloaded)}
    assert files == {"01", "02"}


def test_its_own_model_is_not_there(downloaded: Path) -> None:
    with pytest.raises(OptionError, match="kapture folders"):
        RobotCar(RobotCarOptions(reference_model=True)).check(downloaded)


@pytest.mark.parametrize(
    ("table", "old", "new", "message"),
    [
        ("02/mapping/sensors/sensors.txt", " 9.5,", " 9.25,", "not that of other images"),
        ("01/mapping/sensors/records_camera.txt", "overcast-reference/", "", "expected condition/"),
        ("02/query/sensors/records_camera.txt", "/left/", "/front/", "of camera 'front'"),
    ],
)
def test_what_is_wrong_is_named(root: Path, table: str, old: str, new: str, message: str) -> None:
    if "records" in table:  # the images are renamed with their records
        data = root / table.replace("records_camera.txt", "records_data")
        for path in sorted(data.rglob("*.jpg")):
            name = str(path.relative_to(data))
            (data / name.replace(old, new)).parent.mkdir(parents=True, exist_ok=True)
            path.rename(data / name.replace(old, new))
    path = root / table
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DataError, match=message) as caught:
        read(root)
    assert str(Path(table).parents[1]) in str(caught.value)
