"""InLoc in kapture folders, composed by kapture's own library, beside its official layout."""

from __future__ import annotations

import shutil
from pathlib import Path

import kapture
import pytest
from inloc_files import write_download
from kapture.io.csv import kapture_to_dir

from megloc_kapture.datasets.inloc.adapter import InLoc, InLocOptions
from megloc_kapture.datasets.official import OfficialDataset, write_official
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.datasets import choose_dataset


def read(root: Path, **options: object) -> OfficialDataset:
    return InLoc(InLocOptions.model_validate(options)).read(root)


@pytest.fixture(scope="module")
def official(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_download(tmp_path_factory.mktemp("data") / "official")


@pytest.fixture(scope="module")
def downloaded(official: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As kapture's guide shows it: tables from the download, images linked into them."""
    root = tmp_path_factory.mktemp("kapture") / "InLoc"
    known = read(official, depth=False).mapping
    sensors, records = kapture.Sensors(), kapture.RecordsCamera()
    trajectories = kapture.Trajectories()
    # f = 800 / tan 30 deg at 1600 px
    params = [40, 30, 34.64101615137755, 20, 15]
    sensors["cutouts"] = kapture.Camera(kapture.CameraType.SIMPLE_PINHOLE, params)
    for time, (name, pose) in enumerate(known.poses().items()):
        records[time, "cutouts"] = name.removeprefix("database/cutouts/")
        r, t = list(pose.quat_wxyz), list(pose.translation)
        trajectories[time, "cutouts"] = kapture.PoseTransform(r=r, t=t)
    mapping = kapture.Kapture(sensors=sensors, records_camera=records, trajectories=trajectories)
    kapture_to_dir(str(root / "mapping"), mapping)
    records = kapture.RecordsCamera()
    for time, name in enumerate(("IMG_0801.JPG", "IMG_0802.jpg", "IMG_0803.JPG")):
        records[time, "cutouts"] = f"iphone7/{name}"
    query = kapture.Kapture(sensors=sensors, records_camera=records)
    kapture_to_dir(str(root / "query"), query)
    for floor in ("DUC1", "DUC2"):
        images = root / "mapping/sensors/records_data" / floor
        images.parent.mkdir(exist_ok=True)
        images.symlink_to(official / "database/cutouts" / floor)
        (root / f"mapping/{floor}_alignment").mkdir()
    (root / "query/sensors/records_data").mkdir()
    (root / "query/sensors/records_data/iphone7").symlink_to(official / "query/iphone7")
    return root


@pytest.mark.parametrize("depth", [True, False])
def test_the_same_dataset_in_both_forms(official: Path, downloaded: Path, depth: bool) -> None:
    found, expected = read(downloaded, depth=depth), read(official, depth=depth)
    assert found.mapping == expected.mapping and found.query == expected.query
    assert found.groups == expected.groups and found.names == expected.names
    assert found.protocol == expected.protocol
    assert [str(count) for count in found.summary] == [str(count) for count in expected.summary]
    assert len(found.mapping.poses()) == 72


def test_what_is_written_has_images_and_depth(
    official: Path, downloaded: Path, tmp_path: Path
) -> None:
    for place, root in (("ours", official), ("theirs", downloaded)):
        write_official(read(root), tmp_path / place)
    folders = [KaptureFolder(tmp_path / place / "mapping") for place in ("ours", "theirs")]
    for name in folders[0].read().image_names():
        assert folders[0].image_path(name).samefile(folders[1].image_path(name))
    for name in folders[0].read().records_depth.values():
        ours, theirs = (folder.depth_path(name).read_bytes() for folder in folders)
        assert ours == theirs


@pytest.mark.parametrize("place", ["mapping", "."])
def test_wrong_scans_are_left_out_here_too(root: Path, place: str) -> None:
    (root / "mapping/DUC2_alignment").rmdir()
    if place == ".":
        (root / "mapping/DUC1_alignment").rmdir()
        (root / "DUC1_alignment").mkdir()
    folder = root / place / "DUC2_alignment"
    folder.mkdir()
    (folder / "know_incorrect.txt").write_text("024\n")
    dataset = read(root)
    assert {group.location for group in dataset.groups.values()} == {"DUC1/024", ""}
    assert any("DUC2/024" in remark for remark in dataset.remarks)


def test_images_without_a_pose_are_no_map_images(root: Path) -> None:
    table = root / "mapping/sensors/trajectories.txt"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(lines[:-3]))
    assert len(read(root).mapping.records_camera) == 69


def test_a_download_into_which_no_images_were_put(root: Path) -> None:
    for part, message in (("mapping", "none of DUC1, DUC2 is there"), ("query", "iphone7")):
        shutil.rmtree(root / part / "sensors/records_data")
        with pytest.raises(DataError, match=message):
            InLoc().check(root)


def test_input_files_are_what_is_read(downloaded: Path, official: Path) -> None:
    choice = choose_dataset("inloc", downloaded)
    choice.check()
    files = {str(path.relative_to(downloaded)) for path in choice.input_files(downloaded)}
    assert {"mapping/sensors/trajectories.txt", "mapping/sensors/records_camera.txt"} <= files
    image = "mapping/sensors/records_data/DUC1/024/DUC_cutout_024_0_0.jpg"
    assert {image, f"{image}.mat", "query/sensors/records_data/iphone7/IMG_0801.JPG"} <= files
