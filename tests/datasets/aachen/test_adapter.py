"""Aachen Day-Night in small official layouts, and in kapture folders made of them by kapture."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aachen_files import (
    ADDED,
    DATABASE,
    DAY,
    DAY_LIST,
    LIST,
    MODEL,
    NIGHT,
    NVM,
    SEQUENCE,
    write_v1_0,
    write_v1_1,
)
from kapture import flatten
from kapture.io.csv import kapture_from_dir
from kapture_forms import aachen_with_kapture, assert_linked, assert_same_dataset, without_images
from kloc import kapture_tool
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.aachen.adapter import Aachen, AachenOptions
from megloc_kapture.datasets.official import OfficialDataset, write_official
from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import read_side_tables
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.values import Camera

QUERY_CAMERA = Camera("SIMPLE_RADIAL", 8, 6, (7.5, 4.0, 3.0, -0.0353019))


def edit(path: str, old: str, new: str) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        text = (root / path).read_text()
        assert old in text
        (root / path).write_text(text.replace(old, new, 1))

    return change


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_v1_0(tmp_path / "Aachen-Day-Night")


@pytest.fixture
def root11(root: Path) -> Path:
    return write_v1_1(root)


def read(root: Path, **options: object) -> OfficialDataset:
    return Aachen(AachenOptions(**options)).read(root)  # type: ignore[arg-type]


def written(root: Path, output: Path, *, allow_missing: bool = False, **options: object) -> Path:
    write_official(read(root, **options), output, allow_missing=allow_missing)
    return output


def test_version_1_0_is_read(root: Path, tmp_path: Path) -> None:
    out = written(root, tmp_path / "out")
    mapping, query = (KaptureFolder(out / part).read() for part in ("mapping", "query"))
    assert mapping.poses().keys() == set(DATABASE)
    # the list has the cameras by name
    assert mapping.camera_of("db/3.jpg") == Camera("SIMPLE_RADIAL", 8, 6, (12, 4.25, 3, -0.25))
    assert [mapping.record_of(name) for name in DATABASE] == [
        (position, f"camera_{position:05d}") for position in range(3)
    ]
    # queries are those of the lists, without poses
    assert query.image_names() == sorted(DAY + NIGHT)
    assert query.trajectories == {}
    assert all(query.camera_of(name) == QUERY_CAMERA for name in DAY + NIGHT)
    records = [(100_000 + k, f"day_{k:05d}") for k in range(3)] + [(200_000, "night_00000")]
    assert [query.record_of(name) for name in (*DAY, *NIGHT)] == records
    assert not (out / "query_gt").exists()


def test_without_the_list_of_cameras_those_of_the_model_are_centred(
    root: Path, root11: Path
) -> None:
    (root / LIST).unlink()
    dataset = read(root, version="1.0")
    cameras = [dataset.mapping.camera_of(name) for name in ("db/3.jpg", "db/1228.jpg")]
    assert cameras == [
        Camera("SIMPLE_RADIAL", 8, 6, (12, 4, 3, -0.25)),
        Camera("SIMPLE_RADIAL", 6, 8, (11, 3, 4, 0.5)),
    ]
    assumed = [
        any("assumed to be the image centres" in remark for remark in read_dataset.remarks)
        for read_dataset in (dataset, read(root11))
    ]
    assert assumed == [True, False]


def test_tables_have_the_names_conditions_and_protocol_of_the_challenge(
    root11: Path, tmp_path: Path
) -> None:
    tables = written(root11, tmp_path / "out") / "megloc"
    # in the order of the lists, day first
    names = list(read_side_tables(tables).names.items())
    assert names == [(n, n.split("/")[-1]) for n in (*DAY, *ADDED, *NIGHT)]
    groups = read_side_tables(tables).groups
    conditions = {name: group.condition for name, group in groups.items()}
    assert conditions == dict.fromkeys(DAY, "day") | dict.fromkeys(NIGHT + ADDED, "night")
    assert all(group.scored for group in groups.values())
    protocol = read_side_tables(tables).protocol
    assert (protocol.dataset, protocol.conditions) == ("aachen", ("day", "night"))
    assert (protocol.pose_file, protocol.pose_file_names) == ("ltvl", "basename")
    # the pose file is named after the version that is read
    assert protocol.pose_file_stem == "Aachen_v1_1"
    assert read(root11, version="1.0").protocol.pose_file_stem == "Aachen"
    assert not (tables / "priors.csv").exists()


@pytest.mark.parametrize(
    ("folder", "images"),
    [("aachen_v1_1", "images_upright"), ("aachen_v_1_1", "images/images_upright")],
)
def test_other_names_of_folders_are_accepted(root11: Path, folder: str, images: str) -> None:
    models = root11 / "3D-models"
    (models / "aachen_v_1_1").rename(models / folder)
    (root11 / images).parent.mkdir(exist_ok=True)
    (root11 / "images_upright").rename(root11 / images)
    dataset = read(root11)
    assert len(dataset.mapping.records_camera) == 5
    assert dataset.links == {"": root11 / images}
    assert dataset.missing is not None and dataset.missing.files == []


def test_images_keep_their_ids_where_others_are_missing(root11: Path, tmp_path: Path) -> None:
    gone = {DATABASE[0], SEQUENCE[1], DAY[1], ADDED[0]}
    for name in gone:
        (root11 / "images_upright" / name).unlink()
    out = written(root11, tmp_path / "out", allow_missing=True)
    mapping, query = (KaptureFolder(out / part).read() for part in ("mapping", "query"))
    assert mapping.image_names() == sorted({*DATABASE, *SEQUENCE} - gone)
    assert list(read_side_tables(out / "megloc").names) == [DAY[0], DAY[2], NIGHT[0]]
    assert mapping.record_of("db/3.jpg")[1] == "camera_00009"
    assert query.record_of(DAY[2]) == (100_002, "day_00002")
    assert query.record_of(NIGHT[0]) == (200_001, "night_00001")


@pytest.mark.parametrize(
    ("change", "where", "match"),
    [
        (edit(LIST, "db/7.jpg", "db/8.jpg"), LIST, "no line for 'db/7.jpg'"),
        (edit(DAY_LIST, DAY[2], DAY[0]), f"{DAY_LIST}:3", "is listed twice"),
        (edit(MODEL, NVM, NVM + NVM[9:]), MODEL, "several models, expected one"),
    ],
)
def test_contradictory_lists_are_named(
    root: Path, change: Callable[[Path], None], where: str, match: str
) -> None:
    change(root)
    with pytest.raises(DataError, match=match) as caught:
        read(root)
    assert str(caught.value).startswith(f"{root / where}: ")


def test_the_model_of_the_chosen_version_is_required(root: Path) -> None:
    with pytest.raises(DataError, match=r"v1\.1 is missing: 3D-models/aachen_v_1_1"):
        Aachen(AachenOptions(version="1.1")).check(root)
    (root / "aachen_v1_1" / "3D-models").mkdir(parents=True)  # its archive, extracted elsewhere
    with pytest.raises(DataError, match=r"v1\.1's .*/aachen_v1_1 is not in place"):
        Aachen().check(root)
    Aachen(AachenOptions(version="1.0")).check(root)
    (root / "aachen_v1_1" / "3D-models").rmdir()
    (root / "aachen_v1_1").rmdir()
    (root / MODEL).unlink()
    with pytest.raises(DataError, match=r"v1\.0 is missing: 3D-models/aachen_cvpr2018_db\.nvm"):
        Aachen().check(root)
    (root / "3D-models/aachen_v_1_1").mkdir()
    with pytest.raises(DataError, match="aachen_v_1_1: no COLMAP model"):
        Aachen().check(root)


def test_the_reference_model_is_imported_on_request(root: Path, tmp_path: Path) -> None:
    assert not (written(root, tmp_path / "plain") / "reference").exists()
    output = written(root, tmp_path / "out", reference_model=True) / "reference"
    assert not KaptureFolder(output).types("descriptors")
    for database in (None, root / "aachen.db"):
        if database is not None:
            database.touch()
        dataset = read(root, reference_model=True)
        assert dataset.reference is not None and dataset.reference_database == database
        told = any("without descriptors" in remark for remark in dataset.remarks)
        assert told == (database is None)


PARTS = ("query_day", "query_night")


@pytest.fixture(scope="module")
def official(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_v1_1(write_v1_0(tmp_path_factory.mktemp("official") / "Aachen"))


@pytest.fixture(scope="module")
def kapture_form(official: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The layout of kapture's downloader: mapping/, query_day/ and query_night/."""
    return aachen_with_kapture(official, tmp_path_factory.mktemp("kapture") / "Aachen-Day-Night")


@pytest.fixture
def form_copy(kapture_form: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(kapture_form, tmp_path / "form", symlinks=True))


def test_both_forms_give_the_same_dataset(
    official: Path, kapture_form: Path, tmp_path: Path
) -> None:
    expected, actual = read(official), read(kapture_form)
    assert len(expected.names) == 5 and expected.protocol.pose_file_stem == "Aachen_v1_1"
    assert_same_dataset(actual, expected)
    assert_linked(actual, tmp_path / "out", official / "images_upright")
    assert kapture_from_dir(str(tmp_path / "out" / "query")).trajectories is None


def test_queries_merged_by_kapture_are_read(
    official: Path, kapture_form: Path, form_copy: Path
) -> None:
    parts = [kapture_form / part for part in PARTS]
    images = ["--image_transfer", "link_absolute"]
    kapture_tool("kapture_merge", "-i", *parts, "-o", form_copy / "query", *images)
    assert_same_dataset(read(form_copy), read(official))  # the layout of kapture's scripts
    for part in PARTS:
        shutil.rmtree(form_copy / part)
    assert_same_dataset(read(form_copy), read(official))


def test_kapture_folders_may_be_in_a_subfolder(
    official: Path, kapture_form: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "Aachen-Day-Night-v1.1"  # the name in kapture's archive
    place.mkdir()
    (place / "kapture").symlink_to(kapture_form)
    assert_same_dataset(read(place), read(official))
    with pytest.raises(DataError, match=f"there is one in {place}/: give it as the root"):
        read(tmp_path)
    monkeypatch.setenv("MEGLOC_DATA", str(tmp_path))
    choice = choose_dataset("aachen", None)
    choice.check()
    assert choice.root == place
    # official files take precedence
    shutil.copytree(official, place, dirs_exist_ok=True)
    assert read(place).links == {"": place / "images_upright"}


def test_the_name_of_the_pose_file_follows_the_version(kapture_form: Path, form_copy: Path) -> None:
    for part, gone in (("mapping", "sequences/"), ("query_night", "_additional_night/")):
        without_images(form_copy / part, gone)
    assert read(form_copy).protocol.pose_file_stem == "Aachen"
    # the additional queries alone, or the name of the folder, show version 1.1
    shutil.rmtree(form_copy / "query_night")
    shutil.copytree(kapture_form / "query_night", form_copy / "query_night", symlinks=True)
    assert read(form_copy).protocol.pose_file_stem == "Aachen_v1_1"
    shutil.rmtree(form_copy / "query_night")
    assert read(form_copy, version="1.1").protocol.pose_file_stem == "Aachen_v1_1"
    named = form_copy.rename(form_copy.with_name("Aachen-Day-Night-v1.1"))
    assert read(named).protocol.pose_file_stem == "Aachen_v1_1"


def test_missing_parts_of_the_kapture_form_are_named(form_copy: Path) -> None:
    (form_copy / "mapping" / "sensors" / "trajectories.txt").unlink()
    for part in ("query_day", "query_night"):
        shutil.rmtree(form_copy / part)
    missing = read(form_copy).missing
    assert missing is not None
    assert missing.by_folder() == ["query", "mapping/sensors/trajectories.txt"]


def images_of(folder: Path) -> dict[str, tuple[list[float], Any]]:
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
