"""The spool of variants' matches, and the files of the type ``T-pyramid``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    KaptureFolder,
    Sensor,
    write_sensors,
)
from megloc_kapture.io.kapture.features import FeatureReader, feature_folder
from megloc_kapture.matching.guided_pyramid import ImageVariant, VariantMatches
from megloc_kapture.stages.guided_pyramid import PyramidFeatures
from megloc_kapture.stages.pyramid_mapping import MatchSpool, Spooled
from megloc_kapture.values import Camera

KEYPOINTS = FeatureConfig("toy", np.dtype("float32"), 3)
DESCRIPTORS = FeatureConfig("toy", np.dtype("uint8"), 5, "toy", "L2")


def toy(root: Path, *, tar: bool = False) -> KaptureFolder:
    """An image with four features of a toy type."""
    data = KaptureData(sensors={"cam": Sensor.from_camera(Camera.pinhole(40, 30, 50.0))})
    data.records_camera[0, "cam"] = "a/1.png"
    write_sensors(root, data)
    rng = np.random.default_rng(0)
    keypoints = rng.random((4, 3)).astype(np.float32)
    descriptors = rng.integers(0, 255, (4, 5)).astype(np.uint8)
    for kind, config, array in (
        ("keypoints", KEYPOINTS, keypoints),
        ("descriptors", DESCRIPTORS, descriptors),
    ):
        with FeatureWriter(root, kind, "toy", config, orphan=True, tar=tar) as writer:
            writer.write("a/1.png", array)
    return KaptureFolder(root, features_dirs=[root])


def readers(folder: KaptureFolder) -> tuple[FeatureReader, FeatureReader]:
    return folder.keypoints("toy"), folder.descriptors("toy")


def _opened(root: Path, name: str) -> tuple[FeatureReader, FeatureReader]:
    places = {
        kind: [(root, feature_folder(root, kind, name, orphan=True))]
        for kind in ("keypoints", "descriptors")
    }
    return (
        FeatureReader("keypoints", name, places["keypoints"]),
        FeatureReader("descriptors", name, places["descriptors"]),
    )


def test_what_is_spooled_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    many = [
        VariantMatches(
            ImageVariant(0.5, 90),
            rng.random((count, 3)).astype(np.float32),
            rng.integers(0, 255, (count, 5)).astype(np.uint8),
            rng.integers(0, 2**40, count),
            rng.random(count).astype(np.float32),
        )
        for count in (3, 0, 5)
    ]
    spool = MatchSpool(tmp_path / "new", *readers(toy(tmp_path / "toy")))
    file, told = spool.write("a/1.png", [many[:1], [], many[1:]])
    assert file.is_relative_to(tmp_path / "new") and [len(one) for one in told] == [1, 0, 2]
    # as a journal keeps them
    plain = [place for one in json.loads(json.dumps(told)) for place in one]
    places = [Spooled(ImageVariant(*variant), *rest) for variant, *rest in plain]
    for matches, place in reversed(list(zip(many, places, strict=True))):
        found = spool.get("a/1.png", place)
        assert found.variant == matches.variant and len(found) == len(matches)
        np.testing.assert_array_equal(found.keypoints_px, matches.keypoints_px)
        np.testing.assert_array_equal(found.other_rows, matches.other_rows)
        np.testing.assert_array_equal(found.scores, matches.scores)
    asked = [(2, 4), (0, 1), (2, 0)]
    at = [spool.descriptor_at(places[number], match) for number, match in asked]
    found = spool.descriptors([("a/1.png", one) for one in at])
    expected = [many[number].descriptors[match] for number, match in asked]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("tar", [False, True])
def test_an_image_that_nothing_was_added_to_has_what_it_had(tmp_path: Path, tar: bool) -> None:
    folder = toy(tmp_path / "toy", tar=tar)
    PyramidFeatures(tmp_path / "out", folder, "toy").write_rest()
    sources = readers(folder)
    for source, written in zip(sources, _opened(tmp_path / "out", "toy-pyramid"), strict=True):
        np.testing.assert_array_equal(written.read("a/1.png"), source.read("a/1.png"))
        if not tar:  # no space twice
            assert Path(written.where("a/1.png")).samefile(source.where("a/1.png"))


def test_what_was_added_comes_behind_and_the_source_stays_as_it_is(tmp_path: Path) -> None:
    folder = toy(tmp_path / "toy")
    sources = readers(folder)
    before = [source.read("a/1.png") for source in sources]
    more = np.full((2, 3), 7.5, np.float32), np.full((2, 5), 9, np.uint8)
    features = PyramidFeatures(tmp_path / "out", folder, "toy")
    features.write("a/1.png", *more)
    features.write_rest()  # it is no image that nothing was added to
    opened = _opened(tmp_path / "out", "toy-pyramid")
    for source, written, own, added in zip(sources, opened, before, more, strict=True):
        np.testing.assert_array_equal(written.read("a/1.png"), np.concatenate([own, added]))
        np.testing.assert_array_equal(source.read("a/1.png"), own)
    assert opened[1].config.keypoints_type == "toy-pyramid"


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        MatchSpool(tmp_path / "file", *readers(toy(tmp_path / "toy"))).write("a.png", [])


def test_an_image_with_fewer_descriptors_than_keypoints_is_named(tmp_path: Path) -> None:
    folder = toy(tmp_path / "toy")
    with FeatureWriter(folder.root, "descriptors", "toy", DESCRIPTORS, orphan=True) as writer:
        writer.write("a/1.png", np.zeros((3, 5), np.uint8))
    with pytest.raises(DataError, match=r"1\.png.*: 3 descriptors for 4 keypoints"):
        PyramidFeatures(
            tmp_path / "out", KaptureFolder(folder.root, features_dirs=[folder.root]), "toy"
        )
