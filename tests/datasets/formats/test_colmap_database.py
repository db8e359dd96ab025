"""COLMAP's databases: those pycolmap and kapture write, and broken ones."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kapture.converter.colmap.database import COLMAPDatabase

from megloc_kapture.datasets.formats.colmap_database import ColmapDatabase
from megloc_kapture.errors import DataError

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

RNG = np.random.default_rng(0)


def run(path: Path, *statements: str) -> None:
    connection = sqlite3.connect(path)
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()


KEYPOINTS = {"db/7.jpg": 5, "rear/8.png": 3, "c.jpg": 0}


def features(count: int, columns: int) -> tuple[Any, Any]:
    keypoints = RNG.uniform(0, 1000, (count, columns)).astype(np.float32)
    return keypoints, RNG.integers(0, 256, (count, 128)).astype(np.uint8)


def write_with_kapture(path: Path, columns: int = 6) -> dict[str, tuple[Any, Any]]:
    """The schema before version 4, by kapture's copy of COLMAP's script."""
    database = COLMAPDatabase.connect(str(path))
    database.create_tables()
    camera_id = database.add_camera(2, 1600, 1063, np.array([1243.94, 800.0, 531.5, -0.10977]))
    written = {}
    for name, count in KEYPOINTS.items():
        image_id = database.add_image(name, camera_id)
        written[name] = features(count, columns)
        database.add_keypoints(image_id, written[name][0])
        database.add_descriptors(image_id, written[name][1])
    database.commit()
    database.close()
    return written


def write_with_pycolmap(path: Path) -> dict[str, tuple[Any, Any]]:
    """The schema of version 4, in WAL mode."""
    database = pycolmap.Database.open(str(path))
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=1600, height=1063, params=[1243.94, 800.0, 531.5, -0.10977]
    )
    camera_id = database.write_camera(camera)
    written = {}
    for name, count in KEYPOINTS.items():
        image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        written[name] = features(count, 4)
        database.write_keypoints(image_id, written[name][0])
        kind = pycolmap.FeatureExtractorType.SIFT
        database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, written[name][1]))
    database.close()
    return written


@pytest.mark.parametrize("write", [write_with_kapture, write_with_pycolmap])
def test_what_others_write_is_read(tmp_path: Path, write: Any) -> None:
    path = tmp_path / "all of it?#100%.db"
    written = write(tmp_path / "plain.db")
    os.rename(tmp_path / "plain.db", path)
    before = sorted(tmp_path.iterdir()), path.read_bytes()
    with ColmapDatabase(path) as database:
        assert list(database.images) == sorted(written)
        for name, (keypoints, descriptors) in written.items():
            found = database.keypoints(name)
            assert found.dtype == np.float32
            assert np.array_equal(found, keypoints[:, :2])
            if len(keypoints):
                found = database.descriptors(name)
                assert found is not None and found.dtype == np.uint8
                assert np.array_equal(found, descriptors)
            else:
                assert database.descriptors(name) is None
        with pytest.raises(DataError, match="has no image 'd.jpg'"):
            database.keypoints("d.jpg")
        # nothing of sqlite's own lies beside the user's file
        assert sorted(tmp_path.iterdir()) == before[0]
    assert (sorted(tmp_path.iterdir()), path.read_bytes()) == before


def test_a_database_without_features_has_images(tmp_path: Path) -> None:
    run(
        tmp_path / "d.db",
        "CREATE TABLE cameras (camera_id, model, width, height, params)",
        "CREATE TABLE images (image_id, name, camera_id)",
        "INSERT INTO images VALUES (1, './db/7.jpg', 1)",
    )
    with ColmapDatabase(tmp_path / "d.db") as database:
        assert list(database.images) == ["db/7.jpg"]
        assert database.keypoints("db/7.jpg").shape == (0, 2)
        assert database.descriptors("db/7.jpg") is None


def test_a_database_that_is_still_being_written_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    write_with_pycolmap(path)
    writer = sqlite3.connect(path)
    writer.execute("UPDATE images SET name = 'new.jpg' WHERE image_id = 1")
    writer.commit()
    assert (tmp_path / "d.db-wal").stat().st_size > 0
    with pytest.raises(DataError, match=r"d\.db: was not closed: what is in d\.db-wal"):
        ColmapDatabase(path)
    writer.close()
    with ColmapDatabase(path) as database:
        assert "new.jpg" in database.images


@pytest.mark.parametrize(
    ("statement", "match"),
    [
        ("UPDATE descriptors SET data = 'text'", "expected 640 bytes of data, got no bytes"),
        ("UPDATE images SET name = x'ff' WHERE image_id = 1", "has no name or no camera"),
        ("UPDATE images SET name = '../a' WHERE image_id = 1", "leads out of its folder"),
        ("UPDATE images SET name = './c.jpg' WHERE image_id = 1", "'c.jpg' is listed twice"),
        ("UPDATE images SET name = CAST(x'ff' AS TEXT) WHERE image_id = 1", "UTF-8"),
        ("UPDATE keypoints SET rows = 4", "keypoints of .*: expected 96 bytes of data, got 120"),
        ("UPDATE keypoints SET rows = -1", "keypoints of .*: rows is -1"),
        ("UPDATE keypoints SET rows = 2147483647", "expected 51539607528 bytes of data, got 120"),
        ("UPDATE keypoints SET cols = 5", "have 5 columns, not 2, 4 or 6"),
        ("UPDATE keypoints SET data = zeroblob(119)", "expected 120 bytes of data, got 119"),
        ("UPDATE keypoints SET data = CAST(x'0000807f' || zeroblob(116) AS BLOB)", "not finite"),
        ("UPDATE descriptors SET cols = 127", "descriptors of .*: expected 635 bytes"),
        ("ALTER TABLE descriptors ADD COLUMN type INTEGER DEFAULT 1", "are not SIFT"),
        ("ALTER TABLE descriptors DROP COLUMN data", "no readable COLMAP database: no such col"),
        ("DROP TABLE images", "it has no table 'images'"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, statement: str, match: str) -> None:
    path = tmp_path / "d.db"
    write_with_kapture(path)
    run(path, "PRAGMA foreign_keys = OFF", statement)
    with pytest.raises(DataError, match=match) as caught, ColmapDatabase(path) as database:
        database.keypoints("db/7.jpg")
        database.descriptors("db/7.jpg")
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_view_that_never_ends_is_not_looked_into(tmp_path: Path) -> None:
    run(
        tmp_path / "d.db",
        "CREATE VIEW images AS WITH RECURSIVE r(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM r) "
        "SELECT x AS image_id, 'a' || x AS name, 1 AS camera_id FROM r",
    )
    with pytest.raises(DataError, match="it has no table 'images'"):
        ColmapDatabase(tmp_path / "d.db")


def test_a_column_that_computes_more_than_the_file_holds_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    write_with_kapture(path)
    run(
        path,
        "DROP TABLE keypoints",
        "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, "
        "data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL)",
        "INSERT INTO keypoints VALUES (1, 37500000, 6)",
    )
    with (
        ColmapDatabase(path) as database,
        pytest.raises(DataError, match="d.db: no readable COLMAP database: .*too big"),
    ):
        database.keypoints("db/7.jpg")  # the first that was written


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0", b"no database at all" * 100])
def test_files_that_are_no_databases(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "d.db"
    with pytest.raises(DataError, match=r"d\.db: file is missing"):
        ColmapDatabase(path)
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"d\.db: no (readable )?COLMAP database"):
        ColmapDatabase(path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DataError, match=r"d\.db: not a plain file"):
        ColmapDatabase(path)
