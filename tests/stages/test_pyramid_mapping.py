"""The files of the type ``T-pyramid``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import (
    KaptureData,
    KaptureFolder,
    Sensor,
    write_sensors,
)
from megloc_kapture.io.kapture.features import FeatureReader
from megloc_kapture.stages.guided_pyramid import PyramidFeatures
from megloc_kapture.values import Camera

IMAGE = "a/1.png"


@pytest.fixture
def toy(write_features: Any, tmp_path: Path) -> Callable[..., KaptureFolder]:
    """Makes an image with four features of a toy type."""

    def make(*, num_descriptors: int = 4, tar: bool = False) -> KaptureFolder:
        root = tmp_path / "toy"
        data = KaptureData(sensors={"cam": Sensor.from_camera(Camera.pinhole(40, 30, 50.0))})
        data.records_camera[0, "cam"] = IMAGE
        write_sensors(root, data)
        rng = np.random.default_rng(0)
        keypoints = rng.random((4, 3)).astype(np.float32)
        descriptors = rng.integers(0, 255, (num_descriptors, 5)).astype(np.uint8)
        write_features(root, "keypoints", "toy", {IMAGE: keypoints}, tar=tar)
        write_features(root, "descriptors", "toy", {IMAGE: descriptors}, tar=tar)
        return KaptureFolder(root, features_dirs=[root])

    return make


def opened(folder: KaptureFolder, name: str = "toy") -> tuple[FeatureReader, FeatureReader]:
    return folder.keypoints(name), folder.descriptors(name)


@pytest.mark.parametrize("tar", [False, True])
@pytest.mark.parametrize("added", [0, 2])
def test_what_was_added_comes_behind_and_the_source_stays_as_it_is(
    toy: Any, tmp_path: Path, added: int, tar: bool
) -> None:
    folder = toy(tar=tar)
    before = [source.read(IMAGE) for source in opened(folder)]
    more = np.full((added, 3), 7.5, np.float32), np.full((added, 5), 9, np.uint8)
    features = PyramidFeatures(tmp_path / "out", folder, "toy")
    if added:
        features.write(IMAGE, *more)
    features.write_rest()  # of the images that nothing was added to
    written = opened(folder.with_features([tmp_path / "out"]), "toy-pyramid")
    for source, one, own, new in zip(opened(folder), written, before, more, strict=True):
        np.testing.assert_array_equal(one.read(IMAGE), np.concatenate([own, new]))
        np.testing.assert_array_equal(source.read(IMAGE), own)
        if not (tar or added):  # no space twice
            assert Path(one.where(IMAGE)).samefile(source.where(IMAGE))
    assert written[1].config.keypoints_type == "toy-pyramid"


def test_unequal_numbers_of_keypoints_and_descriptors_are_named(toy: Any, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"1\.png.*: 3 descriptors for 4 keypoints"):
        PyramidFeatures(tmp_path / "out", toy(num_descriptors=3), "toy")
