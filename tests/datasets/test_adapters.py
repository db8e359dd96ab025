"""Downloads of official datasets that lack folders or files, the same way for every dataset."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from aachen_files import write_v1_0, write_v1_1
from fourseasons_files import DAY, SNOW, B, image, write_two_recordings
from inloc_files import write_download
from robotcar_files import ts, write_layout

from megloc_kapture.datasets.official import Count, write_official
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, write_sensors
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import DATASETS

CUTOUTS, DUC2 = "database/cutouts", "database/alignments/DUC2"


@pytest.fixture(scope="module")
def layouts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small official layouts, in a folder per dataset; read only."""
    root = tmp_path_factory.mktemp("layouts")
    write_v1_1(write_v1_0(root / "aachen"))
    write_layout(root / "robotcar")
    write_two_recordings(root / "4seasons")
    write_download(root / "inloc")
    return root


def without(layouts: Path, dataset: str, tmp_path: Path, *gone: str) -> Path:
    root = tmp_path / dataset
    shutil.copytree(layouts / dataset, root)
    for path in (root / name for name in gone):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return root


@pytest.mark.parametrize(
    ("dataset", "gone", "message"),
    [
        ("aachen", ["images_upright", "queries", "3D-models"], "no folder images_upright or quer"),
        ("aachen", ["queries"], "no folder queries; the root must contain images_upright"),
        ("robotcar", ["images", "3D-models"], "not RobotCar Seasons, .* no folder images or 3D"),
        ("4seasons", [DAY, SNOW], "no recording here"),
        ("inloc", [f"{CUTOUTS}/DUC1", f"{CUTOUTS}/DUC2"], "none of DUC1, DUC2 exists"),
        ("inloc", ["query"], "query/iphone7/ is missing; the layout of InLoc is database"),
        ("inloc", ["database/alignments"], "database/alignments/ is missing; the layout of InLoc"),
    ],
)
def test_a_folder_without_the_layout_is_refused(
    layouts: Path, tmp_path: Path, dataset: str, gone: list[str], message: str
) -> None:
    adapter: Any = load_plugin(DATASETS, dataset, {})
    adapter.check(layouts / dataset)
    root = without(layouts, dataset, tmp_path, *gone)
    with pytest.raises(DataError, match=f"{root}.*{message}"):
        adapter.check(root)
    with pytest.raises(DataError, match="absent"):
        adapter.check(tmp_path / "absent")


@pytest.mark.parametrize(
    "given", ["aachen", "robotcar", "4seasons", "robotcar/images", f"4seasons/{DAY}"]
)
def test_a_layout_above_or_below_the_given_folder_is_named(
    layouts: Path, tmp_path: Path, given: str
) -> None:
    dataset, _, inside = given.partition("/")
    shutil.copytree(layouts / dataset, tmp_path / dataset)
    root = tmp_path / given if inside else tmp_path
    with pytest.raises(DataError, match=f"there is one in .*{dataset}/: give it as the root"):
        load_plugin(DATASETS, dataset, {}).check(root)


@pytest.mark.parametrize(
    ("dataset", "mapping", "hint"),
    [
        ("robotcar", "Seasons-v2/01/mapping", "there is one in .*Seasons-v2/: give it as the root"),
        ("robotcar", "1/mapping", "the root must contain"),
        ("4seasons", "mapping", "no recording here.*can be evaluated as dataset kapture"),
        ("inloc", "mapping", "cutouts/ is missing.*can be evaluated as dataset kapture"),
    ],
)
def test_kapture_folders_in_another_place_are_named(
    tmp_path: Path, dataset: str, mapping: str, hint: str
) -> None:
    write_sensors(tmp_path / mapping, KaptureData())
    with pytest.raises(DataError, match=hint):
        load_plugin(DATASETS, dataset, {}).read(tmp_path)


def test_an_archive_in_place_of_a_folder_is_named(layouts: Path, tmp_path: Path) -> None:
    root = without(layouts, "aachen", tmp_path, "images_upright")
    (root / "images").mkdir()
    (root / "images" / "database_and_query_images.zip").touch()
    for other in ("imported", "ground_truth"):
        write_sensors(root / other / "mapping", KaptureData())
    (root / "imported" / "megloc").mkdir()
    message = "; is images/database_and_query_images.zip extracted[?]"
    with pytest.raises(DataError, match=message):
        load_plugin(DATASETS, "aachen", {}).check(root)


@pytest.mark.parametrize(
    ("dataset", "folder", "moved_to", "hint"),
    [
        ("robotcar", "images/night", "images/night/night", f"; {ts(13)}.jpg is at images/night/ni"),
        ("robotcar", "images/night", "images/nights", ""),
        ("robotcar", "images/night", "images/night.zip", "; is images/night.zip extracted[?]"),
        ("aachen", "images_upright/db", "images_upright/DB", "; [0-9]+.jpg is at images_upright/"),
        ("inloc", f"{DUC2}/transformations", DUC2, f"; DUC_trans_024.txt is at {DUC2}/"),
        ("inloc", "query/iphone7", "query/iphone7/iphone7", ""),
        ("inloc", DUC2, "../gone", ""),  # DUC1's files have the same names
    ],
)
def test_the_place_of_missing_files_is_named(
    layouts: Path, tmp_path: Path, dataset: str, folder: str, moved_to: str, hint: str
) -> None:
    root = without(layouts, dataset, tmp_path)
    (root / folder).rename(tmp_path / "moved")
    if moved_to.endswith(".zip"):
        (root / moved_to).touch()
    else:
        shutil.copytree(tmp_path / "moved", root / moved_to, dirs_exist_ok=True)
    missing = load_plugin(DATASETS, dataset, {}).read(root, allow_missing=True).missing
    with pytest.raises(DataError, match=f"{folder}/[^;]*{hint}.*; --allow-missing") as error:
        missing.refuse()
    assert bool(hint) == ("is at" in str(error.value) or "extracted" in str(error.value))


@pytest.mark.parametrize(
    ("dataset", "gone", "message", "map_images", "queries"),
    [
        ("aachen", "images_upright/db/7.jpg", r"db/7\.jpg", 4, 5),
        ("robotcar", "robotcar_v2_train.txt", "robotcar_v2_train.txt", 9, 12),
        ("robotcar", "intrinsics/left_intrinsics.txt", "left_intrinsics.txt", 6, 8),
        ("robotcar", "images/night", f"images/night/left/{ts(13)}.jpg", 9, 9),
        ("robotcar", f"images/overcast-reference/rear/{ts(2)}.jpg", f"rear/{ts(2)}.jpg", 8, 12),
        ("4seasons", SNOW, "<another recording, for the queries>", 4, 0),
        ("4seasons", image(DAY, B), f"{DAY}/.*{B}.png", 3, 4),
        ("4seasons", f"{SNOW}/undistorted_images/cam1", f"{SNOW}/.*cam1", 4, 2),
        ("inloc", f"{CUTOUTS}/DUC1/024/DUC_cutout_024_30_0.jpg", "DUC_cutout_024_30_0.jpg", 71, 3),
        ("inloc", f"{CUTOUTS}/DUC1/024/DUC_cutout_024_0_0.jpg.mat", "0_0.jpg.mat", 72, 3),
        ("robotcar", "3D-models/individual", "/queries_location_001.txt", 9, 0),
        ("inloc", f"{CUTOUTS}/DUC2", f"{CUTOUTS}/DUC2", 36, 3),
        ("inloc", f"{CUTOUTS}/DUC2/024", f"{CUTOUTS}/DUC2/<scans>", 36, 3),
        ("inloc", f"{DUC2}/transformations/DUC_trans_024.txt", "trans", 36, 3),
    ],
)
def test_missing_files_are_refused_or_skipped_on_request(
    layouts: Path,
    tmp_path: Path,
    dataset: str,
    gone: str,
    message: str,
    map_images: int,
    queries: int,
) -> None:
    adapter: Any = load_plugin(DATASETS, dataset, {})
    root = without(layouts, dataset, tmp_path, gone)
    with pytest.raises(DataError, match=f"{root}.*{message}.*--allow-missing"):
        write_official(adapter.read(root), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    write_official(adapter.read(root, allow_missing=True), tmp_path / "out", allow_missing=True)
    mapping, query = (KaptureFolder(tmp_path / "out" / part) for part in ("mapping", "query"))
    mapping.validate(deep=True)
    assert len(mapping.read().records_camera) == map_images
    assert len(query.read().records_camera) == queries


def test_counts_are_compared_with_the_published_ones() -> None:
    lines = [str(Count("images", 3, published)) for published in (None, 3, 5)]
    ends = [line.split(maxsplit=2)[2:] for line in lines]
    assert ends == [[], ["as published"], ["published: 5, -2"]]
