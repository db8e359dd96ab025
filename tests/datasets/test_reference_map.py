"""A sparse model as a kapture map, with the features of a COLMAP database or without."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import kapture
import kapture.io.csv
import kapture.io.features
import numpy as np
import pytest
from kapture.converter.colmap.database import COLMAPDatabase

from megloc_kapture.datasets.reference_map import ColmapDatabase, write_reference_map
from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap_model import SparsePoints
from megloc_kapture.io.kapture import KaptureData, KaptureFolder
from megloc_kapture.values import Camera, RigidTransform
from tests.worlds import one_camera

# unsorted, with an image that is not imported
NAMES = ("db/b.jpg", "db/a.jpg", "gone/c.jpg", "db/d.jpg")
# point, image, feature, x, y
ROWS = [
    (0, 0, 900, 1, 2),
    (0, 1, 7, 3, 4),
    (0, 2, 3, 0, 0),
    (0, 0, 4, 5, 6),  # twice in one image
    (1, 0, 4, 5, 6),  # a feature that sees two points
    (1, 1, 7, 3, 4),
    (1, 1, 7, 3, 4),  # the same again
    (3, 1, 2, 7, 8),
]


def points() -> SparsePoints:
    table = np.array(ROWS)
    return SparsePoints(
        np.arange(12.0).reshape(4, 3) / 7,
        np.arange(12, dtype=np.uint8).reshape(4, 3),
        table[:, 0],
        table[:, 1].astype(np.int32),
        table[:, 2].astype(np.int32),
        table[:, 3:].astype(np.float32),
    )


def data() -> KaptureData:
    names = ("db/a.jpg", "db/b.jpg", "db/d.jpg")
    return one_camera(names, RigidTransform.identity(), camera=Camera.pinhole(64, 48, 50))


def keypoints_by_kapture(folder: Path, image: str) -> Any:
    path = kapture.io.features.get_keypoints_fullpath("sift", str(folder), image)
    return kapture.io.features.image_keypoints_from_file(path, np.float32, 2)


def test_kapture_reads_the_points_and_observations_of_the_model(tmp_path: Path) -> None:
    photographs, output = tmp_path / "images", tmp_path / "reference"
    photographs.mkdir()
    counts = write_reference_map(output, data(), {"": photographs}, NAMES, points())
    assert counts == {"images": 3, "keypoints": 4, "points": 4, "observations": 6}

    read = kapture.io.csv.kapture_from_dir(str(output))
    assert (output / "sensors/records_data").resolve() == photographs
    images = sorted(name for *_, name in kapture.flatten(read.records_camera))
    assert images == ["db/a.jpg", "db/b.jpg", "db/d.jpg"]
    assert len(read.trajectories) == 3
    table = read.points3d.as_array()
    assert np.array_equal(table[:, :3], np.arange(12.0).reshape(4, 3) / 7)
    assert np.array_equal(table[:, 3:], np.arange(12.0).reshape(4, 3))
    # keypoints are numbered without gaps, in the order of the model's ids
    assert keypoints_by_kapture(output, "db/b.jpg").tolist() == [[5, 6], [1, 2]]
    assert keypoints_by_kapture(output, "db/a.jpg").tolist() == [[7, 8], [3, 4]]
    assert read.keypoints["sift"] == {"db/a.jpg", "db/b.jpg"}
    seen = {point: read.observations[point, "sift"] for point in read.observations}
    assert seen == {
        0: [("db/b.jpg", 1), ("db/a.jpg", 1), ("db/b.jpg", 0)],
        1: [("db/b.jpg", 0), ("db/a.jpg", 1)],
        3: [("db/a.jpg", 0)],
    }


def write_database(
    path: Path, names: dict[str, int], *, shift: float = 0.0, descriptors: int | None = None
) -> dict[str, tuple[Any, Any]]:
    """Write features that agree with ROWS, of the schema before version 4; counts by name."""
    rng = np.random.default_rng(1)
    database = COLMAPDatabase.connect(str(path))
    database.create_tables()
    camera_id = database.add_camera(1, 64, 48, np.array([50.0, 50, 32, 24]))
    written = {}
    for name, count in names.items():
        keypoints = rng.uniform(0, 48, (count, 4)).astype(np.float32)
        for _, image, feature, x, y in ROWS:
            if NAMES[image].split(".")[0] == name.split(".")[0] and feature < count:
                keypoints[feature, :2] = (x + shift, y)
        values = rng.integers(0, 256, (descriptors or count, 128)).astype(np.uint8)
        image_id = database.add_image(name, camera_id)
        database.add_keypoints(image_id, keypoints)
        database.add_descriptors(image_id, values)
        written[name] = (keypoints, values)
    database.commit()
    database.close()
    return written


# another suffix than in the kapture, as RobotCar's database has it; one image more
FEATURES = {"db/a.png": 10, "db/b.png": 901, "db/d.png": 0, "other.png": 2}


def test_all_features_of_a_database_keep_their_numbers(tmp_path: Path) -> None:
    database = tmp_path / "all of it?#100%.db"
    written = write_database(database, FEATURES, shift=0.01)
    before, output = database.read_bytes(), tmp_path / "map"
    counts = write_reference_map(output, data(), {}, NAMES, points(), database=database)
    assert database.read_bytes() == before
    assert counts == {"images": 3, "keypoints": 911, "points": 4, "observations": 6}
    folder = KaptureFolder(output)
    folder.validate()
    for name in ("a", "b"):
        keypoints, descriptors = written[f"db/{name}.png"]
        read = folder.keypoints("sift").read(f"db/{name}.jpg")
        assert np.array_equal(read, keypoints[:, :2])
        assert np.array_equal(folder.descriptors("sift").read(f"db/{name}.jpg"), descriptors)
    config = folder.descriptors("sift").config
    assert (config.keypoints_type, config.metric_type) == ("sift", "L2")
    # images without keypoints have empty arrays
    assert folder.keypoints("sift").names == ["db/a.jpg", "db/b.jpg", "db/d.jpg"]
    assert folder.keypoints("sift").read("db/d.jpg").shape == (0, 2)
    assert folder.descriptors("sift").read("db/d.jpg").shape == (0, 128)
    theirs = kapture.io.csv.kapture_from_dir(str(output))
    assert theirs.observations[0, "sift"] == [("db/b.jpg", 900), ("db/a.jpg", 7), ("db/b.jpg", 4)]


@pytest.mark.parametrize(
    ("names", "options", "match"),
    [
        ({"db/a.png": 10}, {}, "has no image 'db/b.jpg'"),
        ({**FEATURES, "db/b.png": 900}, {}, "not of this model: its features of 'db/b.png'"),
        (FEATURES, {"shift": 1.5}, "not of this model: its features of 'db/a.png'"),
        (FEATURES, {"descriptors": 9}, r"descriptors of 'db/a.jpg' have the shape \(9, 128\)"),
    ],
)
def test_the_database_of_another_model_is_refused(
    tmp_path: Path, names: dict[str, int], options: dict[str, Any], match: str
) -> None:
    path = tmp_path / "d.db"
    write_database(path, names, **options)
    with pytest.raises(DataError, match=match) as caught:
        write_reference_map(tmp_path / "m", data(), {}, NAMES, points(), database=path)
    assert str(caught.value).startswith(f"{path}: ")


def test_the_exact_name_takes_precedence_over_another_suffix(tmp_path: Path) -> None:
    names = {"db/a.jpg": 10, "db/a.png": 10, "db/b.jpg": 901}
    written = write_database(tmp_path / "d.db", names)
    write_reference_map(tmp_path, data(), {}, NAMES, points(), database=tmp_path / "d.db")
    # an image that is not in the database
    assert KaptureFolder(tmp_path).descriptors("sift").read("db/d.jpg").shape == (0, 128)
    read = KaptureFolder(tmp_path).keypoints("sift").read("db/a.jpg")
    assert np.array_equal(read, written["db/a.jpg"][0][:, :2])


# ------------------------------------------------------------------ the database


def test_a_database_that_is_still_being_written_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    write_database(path, FEATURES)
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode = WAL")  # as COLMAP writes
    writer.execute("UPDATE images SET name = 'new.jpg' WHERE image_id = 1")
    writer.commit()
    assert (tmp_path / "d.db-wal").stat().st_size > 0
    with pytest.raises(DataError, match=r"d\.db: was not closed: the content of d\.db-wal"):
        ColmapDatabase(path)
    writer.close()
    with ColmapDatabase(path) as database:
        assert "new.jpg" in database.images
        assert list(tmp_path.iterdir()) == [path]  # no files of SQLite


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("UPDATE images SET name = '../a' WHERE image_id = 1", "leads out of its folder"),
        ("UPDATE keypoints SET rows = 4", "not a COLMAP database"),
        ("DROP TABLE images", "no such table: images"),
    ],
)
def test_a_damaged_database_is_named(tmp_path: Path, statement: str, message: str) -> None:
    path = tmp_path / "d.db"
    write_database(path, FEATURES)
    with sqlite3.connect(path) as connection:
        connection.execute(statement)
    connection.close()
    with pytest.raises(DataError, match=rf"d\.db: .*{message}"), ColmapDatabase(path) as database:
        database.keypoints("db/a.png")
