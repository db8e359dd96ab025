"""The kapture folders written of the records and tables of any dataset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.official import (
    Missing,
    OfficialDataset,
    read_ground_truth,
    write_official,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io import dataset_tables as tables
from megloc_kapture.io.kapture import KaptureData, write_sensors
from megloc_kapture.values import RigidTransform
from tests.worlds import one_camera

POSE = RigidTransform((0.5, 0.5, -0.5, 0.5), (1.0, 2.0, 3.0))


@pytest.fixture
def dataset(tmp_path: Path) -> OfficialDataset:
    """Two map images and a query below one folder."""
    images = tmp_path / "official" / "images"
    for name in ("db/1.jpg", "db/2.jpg", "query/3.jpg"):
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        (images / name).write_bytes(name.encode())
    return OfficialDataset(
        mapping=one_camera(["db/1.jpg", "db/2.jpg"], POSE),
        query=one_camera(["query/3.jpg"]),
        links={"": images},
        protocol=tables.Protocol(dataset="toy"),
    )


def test_missing_files_are_summarised_by_folder(dataset: OfficialDataset, tmp_path: Path) -> None:
    root = tmp_path / "official"
    missing = Missing(root)
    assert missing.require(root / "images/db/1.jpg")
    for name in ("night/1.jpg", "night/2.jpg", "night/3.jpg", "lists/night.txt"):
        assert not missing.require(root / "images" / name)
    message = (
        r"official: 4 files are missing: images/lists/night\.txt, images/night/1\.jpg and 2 more "
        r"in its folder; --allow-missing imports the rest$"
    )
    with pytest.raises(DataError, match=message):
        write_official(replace(dataset, missing=missing), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    write_official(replace(dataset, missing=missing), tmp_path / "out", allow_missing=True)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"mapping": one_camera(["db/1.jpg"])}, "no mapping image with a pose is left"),
        ({"query": KaptureData()}, "no query image is left"),
        ({"query": one_camera(["db/2.jpg"])}, "image 'db/2.jpg' is in the map and a query"),
    ],
)
def test_a_dataset_without_map_or_queries_or_with_shared_images_is_refused(
    dataset: OfficialDataset, tmp_path: Path, part: dict[str, KaptureData], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        write_official(replace(dataset, **part), tmp_path / "out")  # type: ignore[arg-type]


def test_additional_truth_is_converted_to_the_local_frame(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    moved = tables.SimilarityTransform(quat_wxyz=(0.5, 0.5, 0.5, 0.5), translation=(4e6, 1e6, -2e6))
    world = tables.World(official_from_local=moved)
    assert read_ground_truth(tmp_path, one_camera(["q/1.jpg"]), world) == (None, {})
    truth = tmp_path / "ground_truth"
    write_sensors(truth / "query", one_camera(["q/1.jpg", "q/2.jpg"], POSE))
    tables.write_groups(truth / "megloc", {"q/1.jpg": tables.ImageGroup(condition="DUC1")})
    poses, groups = read_ground_truth(tmp_path, one_camera(["q/0.jpg", "q/1.jpg"]), world)
    assert poses is not None and list(poses.poses()) == ["q/1.jpg"]
    assert groups == {"q/1.jpg": tables.ImageGroup(condition="DUC1")}
    back = world.pose_in_official(poses.poses()["q/1.jpg"])
    np.testing.assert_allclose(back.center(), POSE.center(), atol=1e-6)
    np.testing.assert_allclose(back.quat_wxyz, POSE.quat_wxyz, atol=1e-12)
    assert "true poses of 1 images that are not queries are left out" in caplog.text
