"""RobotCar Seasons in a small official layout, and in kapture folders made of it by kapture."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from kapture_forms import assert_linked, assert_same_dataset, robotcar_with_kapture, without_images
from poses import error_vector, rigid
from robotcar_files import CAMERAS, QUERIES, TEST, TRAIN, ts, write_layout

from megloc_kapture.datasets.official import OfficialDataset
from megloc_kapture.datasets.robotcar import ImageKey
from megloc_kapture.datasets.robotcar.adapter import RobotCar, RobotCarOptions
from megloc_kapture.datasets.robotcar.images import rig_of_model
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import read_side_tables
from megloc_kapture.io.kapture import write_sensors
from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.values import RigidTransform


@pytest.fixture(scope="module")
def downloaded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("robotcar") / "RobotCar-Seasons"
    write_layout(root)
    return root


def read(root: Path, **options: object) -> OfficialDataset:
    return RobotCar(RobotCarOptions(**options)).read(root)  # type: ignore[arg-type]


def query_name(number: int, camera: str = "rear") -> str:
    return f"{QUERIES[number][0]}/{camera}/{ts(number)}.jpg"


def scored(dataset: OfficialDataset) -> set[str]:
    return {name for name, group in dataset.groups.items() if group.scored}


def test_version_2_has_training_and_test_images(downloaded: Path) -> None:
    dataset = read(downloaded)
    assert len(dataset.query.records_camera) == 12
    assert not dataset.query.trajectories
    assert dict(dataset.names) == {query_name(12): f"rear/{ts(12)}.png"}
    assert dataset.query_gt is not None
    poses = dataset.query_gt.poses()
    assert sorted(poses) == sorted(query_name(n) for n in TRAIN)
    assert scored(dataset) == {query_name(n) for n in (*TRAIN, *TEST)}
    published = {count.what: count.published for count in dataset.summary}
    assert published["training images with a pose"] == 1906
    assert published["test images"] == 1872 and published["  night, rear"] == 438


def test_version_1_asks_for_all_rear_images(downloaded: Path) -> None:
    dataset = read(downloaded, version=1)
    # in the order of the lists, location by location
    order = (11, 13, 12, 14)
    assert list(dataset.names.items()) == [(query_name(n), f"rear/{ts(n)}.jpg") for n in order]
    assert scored(dataset) == set(dataset.names)
    truth = dataset.query_gt
    assert truth is not None and len(truth.poses()) == 2  # half of them are public
    for options in ({"train_as_map": True}, {"queries": "test"}):
        with pytest.raises(OptionError, match="version 2"):
            read(downloaded, version=1, **options)


def test_the_test_list_decides_the_version(root: Path) -> None:
    (root / "lists").mkdir()
    (root / "robotcar_v2_test.txt").rename(root / "lists/robotcar_v2_test.txt")
    with pytest.raises(
        DataError, match=r"lists/robotcar_v2_test\.txt: this list of version 2 belongs"
    ):
        read(root)
    assert list(read(root, version=1).names.values())[0].endswith(".jpg")
    (root / "lists/robotcar_v2_test.txt").unlink()
    assert list(read(root).names.values())[0].endswith(".jpg")
    (root / "robotcar_v2_train.txt").unlink()
    dataset = read(root)
    assert dataset.missing is not None and not dataset.missing.files
    assert dataset.query_gt is not None and not dataset.query_gt.trajectories


def test_conditions_locations_and_priors_come_from_folders_and_lists(downloaded: Path) -> None:
    dataset = read(downloaded)
    reference = dataset.groups[f"overcast-reference/left/{ts(3)}.jpg"]
    assert (reference.condition, reference.location) == ("overcast-reference", "002/left")
    query = dataset.groups[query_name(13, "right")]
    assert (query.condition, query.location, query.scored) == ("night", "001/right", False)
    assert dataset.priors[query_name(13, "right")] == ("001/right",)
    assert dataset.priors.keys() == set(dataset.query.image_names())
    assert dataset.protocol.pools == protocol_of("robotcar").pools


def test_without_some_individual_models_the_prior_is_the_camera(root: Path) -> None:
    models = root / "3D-models/individual/colmap_reconstructions"
    shutil.rmtree(models / "002_aligned")
    dataset = read(root)
    assert dataset.priors[query_name(11)] == ("001/rear", "rear")
    assert dataset.priors[query_name(12)] == ("rear",)
    # the individual models give the poses: the location is missing
    alone = read(root, model="individual")
    assert len(alone.mapping.records_camera) == 6
    assert alone.priors[query_name(12)] == ("002/rear",)
    assert alone.missing is not None
    with pytest.raises(DataError, match="002_aligned; --allow-missing"):
        alone.missing.refuse()
    # without any of them only the camera is known
    shutil.rmtree(models)
    dataset = read(root)
    assert dataset.missing is not None and not dataset.missing.files
    assert dataset.groups[f"overcast-reference/left/{ts(3)}.jpg"].location == "left"
    assert dataset.priors[query_name(13, "right")] == ("right",)
    assert any("location of 9 map images is not known" in remark for remark in dataset.remarks)


def test_queries_may_be_restricted_to_training_or_test_images(downloaded: Path) -> None:
    for queries, numbers, published in (("train", TRAIN, 2), ("test", TEST, 0)):
        dataset = read(downloaded, queries=queries)
        expected = {query_name(n, camera) for n in numbers for camera in CAMERAS}
        assert set(dataset.query.image_names()) == expected == set(dataset.priors)
        assert dataset.query_gt is not None and len(dataset.query_gt.poses()) == published
        assert len(dataset.names) == (queries == "test")


def test_training_images_are_added_to_the_map_on_request(downloaded: Path) -> None:
    dataset = read(downloaded, train_as_map=True)
    assert len(dataset.mapping.records_camera) == 9 + 2
    pose = dataset.mapping.cam_from_world(query_name(13))
    assert pose is not None
    np.testing.assert_allclose(pose.center(), [13.0, 5.0, -2.0], atol=1e-12)
    assert dataset.groups[query_name(13)].location == "001/rear"
    assert not dataset.groups[query_name(13)].scored
    # images of these moments are no queries
    expected = {query_name(n, camera) for n in (12, 14) for camera in CAMERAS}
    assert set(dataset.query.image_names()) == expected == set(dataset.priors)
    assert dataset.query_gt is not None and not dataset.query_gt.poses()


def test_additional_truth_is_joined_with_the_public_one(root: Path) -> None:
    data = read(root).query
    for number in (11, 12):
        for camera in CAMERAS:
            data.trajectories[ts(number), camera] = RigidTransform.identity()
    write_sensors(root / "ground_truth/query", data)
    truth = read(root).query_gt
    assert truth is not None and len(truth.poses()) == 6 + 1
    assert truth.poses()[query_name(12)] == RigidTransform.identity()
    # published poses take precedence
    center = truth.poses()[query_name(11)].center()
    np.testing.assert_allclose(center, [11.0, 5.0, -2.0], atol=1e-12)


RIG = {
    "rear": RigidTransform.identity(),
    "left": rigid([0.1, 1.6, -0.05], [0.4, -0.1, 0.9]),
    "right": rigid([-0.1, -1.5, 0.1], [-0.5, 0.0, 1.0]),
}


def poses(moments: int, *, noise: float, wrong: int = 0) -> dict[ImageKey, RigidTransform]:
    rng = np.random.default_rng(0)
    result = {}
    for moment in range(moments):
        rear_from_world = rigid(rng.normal(size=3), rng.normal(size=3) * 100)
        for camera, sensor_from_rear in RIG.items():
            off = rigid(noise * rng.normal(size=3), noise * rng.normal(size=3))
            if moment < wrong and camera == "left":
                off = rigid(rng.normal(size=3), 5 * rng.normal(size=3))
            key = ImageKey("overcast-reference", camera, str(moment))
            result[key] = off @ sensor_from_rear @ rear_from_world
    return result


@pytest.mark.parametrize(
    ("moments", "noise", "wrong", "error"), [(12, 0.0, 0, 1e-9), (100, 0.01, 15, 0.006)]
)
def test_the_rig_is_the_mean_without_outliers(
    moments: int, noise: float, wrong: int, error: float
) -> None:
    rig = rig_of_model(poses(moments, noise=noise, wrong=wrong))
    assert set(rig) == set(RIG)
    for camera, expected in RIG.items():
        assert np.linalg.norm(error_vector(rig[camera], expected)) < error
    # too few moments
    assert rig_of_model(poses(9, noise=0.0)) == rig_of_model({}) == {}


TEST_LIST = "robotcar_v2_test.txt"


@pytest.fixture(scope="module")
def official(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("robotcar") / "RobotCar-Seasons"
    write_layout(root)
    for camera in CAMERAS:  # kapture's importer reads the lines by their order
        (root / f"intrinsics/{camera}_intrinsics.txt").write_text("fx 9.5\nfy 10\ncx 4\ncy 3.5\n")
    return root


@pytest.fixture(scope="module")
def kapture_form(official: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("kapture") / "RobotCar_Seasons-v2"
    return robotcar_with_kapture(official, place)


@pytest.fixture
def form_copy(kapture_form: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(kapture_form, tmp_path / "form", symlinks=True))


@pytest.mark.parametrize(
    "options", [{}, {"train_as_map": True}, {"queries": "train"}, {"location_prior": False}]
)
def test_both_forms_give_the_same_dataset(
    official: Path, form_copy: Path, tmp_path: Path, options: dict[str, object]
) -> None:
    shutil.copyfile(official / TEST_LIST, form_copy / TEST_LIST)
    actual, expected = read(form_copy, **options), read(official, model="individual", **options)
    assert len(expected.names) == len(TEST) * (options.get("queries") != "train")
    assert_same_dataset(actual, expected, atol=1e-12)
    for data, other in ((actual.mapping, expected.mapping), (actual.query, expected.query)):
        (ours,), (theirs,) = data.rigs.values(), other.rigs.values()
        assert ours.keys() == theirs.keys()
        for camera, pose in theirs.items():
            np.testing.assert_allclose(ours[camera].matrix(), pose.matrix(), rtol=0, atol=1e-12)
    assert_linked(actual, tmp_path / "out", official / "images")
    name, priors = f"dawn/rear/{ts(12)}.jpg", read_side_tables(tmp_path / "out/megloc").priors
    assert priors.get(name, ("002/rear",)) == ("002/rear",)
    assert bool(priors) == options.get("location_prior", True)


def test_without_the_test_list_all_unpublished_rear_images_are_submitted(
    kapture_form: Path,
) -> None:
    dataset = read(kapture_form)
    hidden = sorted(
        (place, ts(number)) for number, (_, place) in QUERIES.items() if number not in TRAIN
    )
    assert list(dataset.names.values()) == [f"rear/{time}.png" for _, time in hidden]
    assert any(f"Without {TEST_LIST}" in remark for remark in dataset.remarks)
    assert dataset.query_gt is not None and len(dataset.query_gt.poses()) == len(TRAIN)


def test_version_1_is_read_without_training_images(official: Path, form_copy: Path) -> None:
    expected = read(official, version=1, model="individual")
    assert_same_dataset(read(form_copy, version=1), expected, atol=1e-12)
    for part in form_copy.glob("*/mapping"):
        for condition in {condition for condition, _ in QUERIES.values()}:
            without_images(part, f"{condition}/")
    assert "version 1" in read(form_copy).remarks[-1]
    with pytest.raises(OptionError, match="train_as_map"):
        read(form_copy, train_as_map=True)


def test_the_folder_of_kapture_s_archive_is_recognised(
    kapture_form: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_DATA", str(kapture_form.parent))
    choice = choose_dataset("robotcar", None)
    choice.check()
    assert choice.root == kapture_form
    with pytest.raises(OptionError, match="kapture folders"):
        RobotCar(RobotCarOptions(reference_model=True)).check(kapture_form)
