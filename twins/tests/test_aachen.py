"""Aachen Day-Night's twin: its layout, truth and import, looked at with kapture and COLMAP."""

from __future__ import annotations

from pathlib import Path

import kapture
import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir

from megloc_kapture.datasets.aachen.adapter import Aachen, AachenOptions
from megloc_kapture.datasets.official import write_official
from megloc_kapture.io.kapture import KaptureFolder

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

LAYOUT = "aachen"

NUM_DATABASE, NUM_SEQUENCE = 30, 6


@pytest.fixture(scope="module", params=["1.0", "1.1"])
def imported(
    request: pytest.FixtureRequest, root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Import the twin by the adapter."""
    out = tmp_path_factory.mktemp("imported") / request.param
    write_official(Aachen(AachenOptions(version=request.param)).read(root), out)
    return out


def cameras_by_image(folder: Path) -> dict[str, list[str]]:
    data = kapture_from_dir(str(folder))
    return {
        image: data.sensors[sensor].sensor_params
        for _, sensor, image in kapture.flatten(data.records_camera)
    }


def listed(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().split("\n")]


def test_versions(imported: Path) -> None:
    mapping, query = cameras_by_image(imported / "mapping"), cameras_by_image(imported / "query")
    sensors = kapture_from_dir(str(imported / "mapping")).sensors
    num_added = sum(name.startswith("query/night/nexus5x_additional_night/") for name in query)
    in_sequences = sum(name.startswith("sequences/") for name in mapping)
    in_database = sum(name.startswith("db/") for name in mapping)
    result = (in_database, in_sequences, len(mapping), len(sensors), len(query), num_added)
    # each sequence has one camera
    newer = (NUM_DATABASE, NUM_SEQUENCE, NUM_DATABASE + NUM_SEQUENCE, NUM_DATABASE + 2, 8, 2)
    older = (NUM_DATABASE, 0, NUM_DATABASE, NUM_DATABASE, 6, 0)
    assert result == (older if imported.name == "1.0" else newer)


def test_colmap_reads_the_added_model(root: Path) -> None:
    # the official frame is far from the origin
    poses = KaptureFolder(root / "ground_truth/mapping").read().poses().values()
    assert min(np.linalg.norm(pose.center()) for pose in poses) > 500
    cameras = cameras_by_image(root / "ground_truth/mapping").values()
    assert any(int(params[1]) < int(params[2]) for params in cameras)  # portraits
    model = pycolmap.Reconstruction(str(root / "3D-models/aachen_v_1_1"))
    assert model.num_reg_images() == NUM_DATABASE + NUM_SEQUENCE
    assert len(model.cameras) == NUM_DATABASE + 2
    model.update_point_3d_errors()
    assert 0 < model.compute_mean_reprojection_error() < 1e-3
    ids = {image.name: image_id for image_id, image in model.images.items()}
    assert sorted(ids, key=lambda name: ids[name]) != sorted(ids)


def test_quirks_of_the_layout(root: Path) -> None:
    models, queries = root / "3D-models", root / "queries"
    rows = listed(models / "aachen_cvpr2018_db.nvm")
    rows = [row for row in rows if row and row[0].startswith("db/")]
    names = [row[0] for row in rows]
    # numbered without order, the model's order is its own, and so is that of the intrinsics
    numbers = [int(name[3:-4]) for name in names]
    assert numbers != sorted(numbers) and max(numbers) > len(numbers)
    assert (models / "aachen_cvpr2018_db.list.txt").read_text().split() == names
    # the NVM's distortion has the other sign
    k = {row[0]: float(row[-1]) for row in listed(models / "database_intrinsics.txt") if row}
    assert set(k) == set(names) and list(k) != names
    assert [float(row[-2]) for row in rows] == [-k[name] for name in names]
    assert any(value != 0 for value in k.values())
    day, night = (
        listed(queries / f"{when}_time_queries_with_intrinsics.txt") for when in ("day", "night")
    )
    assert (len(day), len(night)) == (4, 4)  # no line end, so no empty line, at the end
    assert {len(row) for row in day + night} == {8}
    # the digits the published lists have
    numbers = [float(text) for row in day + night for text in row[4:]]
    assert numbers == [float(f"{number:.6g}") for number in numbers]
    assert {row[1] for row in day} == {"SIMPLE_RADIAL"}
    assert len({tuple(row[2:]) for row in day + night}) == 8  # a camera each
    # the list without intrinsics has line ends
    text = (queries / "day_time_queries_without_intrinsics.txt").read_text()
    assert text == "".join(f"{row[0]}\n" for row in day)
    images = root / "images_upright"
    on_disk = {str(path.relative_to(images)) for path in (images / "query").rglob("*.jpg")}
    in_lists = {row[0] for row in day + night}
    assert in_lists < on_disk and len(on_disk - in_lists) == 2
    assert len({name.split("/")[-1] for name in on_disk}) == len(on_disk)
    assert sum("additional" in row[0] for row in night) == 2
