"""COLMAP's databases as we write them, read by COLMAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import OutputError
from megloc_kapture.io.colmap import DatabaseFeatures, write_feature_database
from megloc_kapture.values import Camera

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

CAMERA = Camera("SIMPLE_RADIAL", 1600, 1063, (1243.94, 800.0, 531.5, -0.10977))
OTHER = Camera("PINHOLE", 64, 48, (50.0, 51.0, 32.0, 24.0))


def features(name: str, camera: Camera, count: int) -> DatabaseFeatures:
    rng = np.random.default_rng(count)
    keypoints = rng.uniform(0, 48, (count, 2)).astype(np.float32)
    return DatabaseFeatures(name, camera, keypoints, rng.integers(0, 256, (count, 128), np.uint8))


IMAGES = [
    features("db/7.jpg", CAMERA, 5),
    features("db/3.jpg", OTHER, 0),
    features("a.png", CAMERA, 3),
]


def test_colmap_reads_what_is_written(tmp_path: Path) -> None:
    path = tmp_path / "new" / "some.db"
    write_feature_database(path, iter(IMAGES))
    assert [file.name for file in path.parent.iterdir()] == ["some.db"]
    database = pycolmap.Database.open(str(path))
    stored = {image.name: image for image in database.read_all_images()}
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    assert len(cameras) == 2
    # ids in the order given
    assert [stored[image.name].image_id for image in IMAGES] == [1, 2, 3]
    for image in IMAGES:
        camera = cameras[stored[image.name].camera_id]
        assert camera.model.name == image.camera.model
        assert (camera.width, camera.height) == (image.camera.width, image.camera.height)
        assert tuple(camera.params) == image.camera.params
        image_id = stored[image.name].image_id
        keypoints = database.read_keypoints(image_id)
        np.testing.assert_array_equal(keypoints[:, :2].reshape(-1, 2), image.keypoints_px)
        descriptors = database.read_descriptors(image_id)
        assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
        np.testing.assert_array_equal(descriptors.data.reshape(-1, 128), image.descriptors)
    database.close()


def test_the_same_features_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.db", "b.db"):
        write_feature_database(tmp_path / name, IMAGES)
    assert (tmp_path / "a.db").read_bytes() == (tmp_path / "b.db").read_bytes()


def test_nothing_is_written_over(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    write_feature_database(path, IMAGES[:1])
    before = path.read_bytes()
    with pytest.raises(OutputError, match=r"a\.db: is there already"):
        write_feature_database(path, IMAGES)
    assert path.read_bytes() == before
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputError, match="cannot be written"):
        write_feature_database(tmp_path / "file" / "b.db", IMAGES)
