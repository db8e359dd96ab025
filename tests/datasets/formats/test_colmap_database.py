"""Databases of COLMAP, written by pycolmap and by kapture; damaged ones."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kapture.converter.colmap.database import COLMAPDatabase

from megloc_kapture.datasets.reference_map import ColmapDatabase
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
def test_a_database_is_read_and_stays_unchanged(tmp_path: Path, write: Any) -> None:
    path = tmp_path / "all of it?#100%.db"
    written = write(tmp_path / "plain.db")
    os.rename(tmp_path / "plain.db", path)
    before = sorted(tmp_path.iterdir()), path.read_bytes()
    with ColmapDatabase(path) as database:
        assert list(database.images) == sorted(written)
        for name, (keypoints, descriptors) in written.items():
            read = database.keypoints(name)
            assert read.dtype == np.float32
            assert np.array_equal(read, keypoints[:, :2])
            if len(keypoints):
                values = database.descriptors(name)
                assert values is not None and values.dtype == np.uint8
                assert np.array_equal(values, descriptors)
            else:
                assert database.descriptors(name) is None
        with pytest.raises(DataError, match="has no image 'd.jpg'"):
            database.keypoints("d.jpg")
        # SQLite leaves no files next to the user's
        assert sorted(tmp_path.iterdir()) == before[0]
    assert (sorted(tmp_path.iterdir()), path.read_bytes()) == before


def test_a_database_that_is_still_being_written_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    write_with_pycolmap(path)
    writer = sqlite3.connect(path)
    writer.execute("UPDATE images SET name = 'new.jpg' WHERE image_id = 1")
    writer.commit()
    assert (tmp_path / "d.db-wal").stat().st_size > 0
    with pytest.raises(DataError, match=r"d\.db: was not closed: the content of d\.db-wal"):
        ColmapDatabase(path)
    writer.close()
    with ColmapDatabase(path) as database:
        assert "new.jpg" in database.images


@pytest.mark.parametrize(
    ("statement", "match"),
    [
        ("UPDATE images SET name = '../a' WHERE image_id = 1", "leads out of its folder"),
        ("UPDATE keypoints SET rows = 4", "not a COLMAP database"),
        ("DROP TABLE images", "no such table: images"),
    ],
)
def test_a_damaged_database_is_named(tmp_path: Path, statement: str, match: str) -> None:
    path = tmp_path / "d.db"
    write_with_kapture(path)
    run(path, "PRAGMA foreign_keys = OFF", statement)
    with pytest.raises(DataError, match=match) as caught, ColmapDatabase(path) as database:
        database.keypoints("db/7.jpg")
        database.descriptors("db/7.jpg")
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
