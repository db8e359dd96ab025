"""Local and global features as stages: masks, batches, vocabularies and rejected inputs."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.features.vlad import PcaWhitening, VladOptions, Vocabulary, aggregate
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.stages import work as devices
from megloc_kapture.stages.global_features import (
    describe_images,
    extract_global_features,
    extract_vlad,
    read_vocabulary,
    write_vocabulary,
)
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, LocalFeatures
from tests.worlds import folder_bytes

Image = NDArray[np.uint8]
EXTRACTOR = RootSift(RootSiftOptions(max_keypoints=800))


def noise(height: int = 120, width: int = 160, seed: int = 0) -> Image:
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3))
    return np.repeat(np.repeat(coarse, 8, axis=0), 8, axis=1).astype(np.uint8)


def test_masks_with_a_margin_remove_keypoints(small_kapture: Any, tmp_path: Path) -> None:
    folder = small_kapture({"a.png": noise(), "b.png": noise()})
    mask = np.zeros((120, 160, 3), dtype=np.uint8)
    mask[:, 80:] = 255
    write_image(folder.root / "sensors" / "masks" / "a.png.png", mask)
    output = tmp_path / "features"
    counts = extract_local_features([folder], EXTRACTOR, output)
    found = KaptureFolder(folder.root, features_dirs=[output]).keypoints("rootsift")
    masked, free = found.read("a.png"), found.read("b.png")
    assert len(masked) > 10 and masked[:, 0].min() >= 80
    assert free[:, 0].min() < 40
    unmasked = EXTRACTOR.extract(read_image_rgb(folder.image_path("a.png"))).keypoints_px
    removed = int((unmasked[:, 0] < 80).sum())
    assert removed > 10
    assert (counts["images_with_mask"], counts["keypoints_masked"]) == (1, removed)
    extract_local_features([folder], EXTRACTOR, tmp_path / "margin", mask_margin_px=10)
    strict = KaptureFolder(folder.root, features_dirs=[tmp_path / "margin"]).keypoints("rootsift")
    near = masked[:, 0] < 90
    assert near.any()
    np.testing.assert_array_equal(strict.read("a.png"), masked[~near])


def test_damaged_inputs_are_refused(small_kapture: Any, tmp_path: Path) -> None:
    def refused(message: str, *folders: KaptureFolder) -> DataError:
        with pytest.raises(DataError, match=message) as caught:
            extract_local_features(folders, EXTRACTOR, tmp_path / "features")
        assert not (tmp_path / "features").exists()
        return caught.value

    folder = small_kapture({"a.png": noise()})
    other = small_kapture({"a.png": noise()}, name="other")
    refused(r"image a\.png is in two kapture folders", folder, other)
    mask = folder.root / "sensors" / "masks" / "a.png.png"
    write_image(mask, np.zeros((60, 80, 3), dtype=np.uint8))
    assert refused("mask is 80x60, its image 160x120", folder).path == mask
    mask.unlink()
    folder.image_path("a.png").unlink()
    refused(r"a\.png", folder)
    camera = Camera("SIMPLE_PINHOLE", 320, 240, (300.0, 160.0, 120.0))
    larger = small_kapture({"a.png": noise()}, name="larger", camera=camera)
    refused(r"a.png: the image is 160x120, its camera says 320x240", larger)


def test_images_without_features_are_stored(small_kapture: Any, tmp_path: Path) -> None:
    folder = small_kapture({"a.png": noise(), "gray.png": np.full((120, 160, 3), 90, np.uint8)})
    extract_local_features([folder], EXTRACTOR, tmp_path / "features")
    assert folder.keypoints("rootsift").read("gray.png").shape == (0, 2)
    assert folder.descriptors("rootsift").read("gray.png").shape == (0, 128)
    assert folder.keypoints("rootsift").length("a.png") > 0


class Inconsistent:
    """An extractor that returns fewer descriptors than keypoints."""

    name = "inconsistent"

    def extract(self, image: Image, mask: NDArray[np.bool_] | None = None) -> LocalFeatures:
        keypoints_px, descriptors = np.ones((3, 2), np.float32), np.ones((2, 4), np.float32)
        return LocalFeatures(keypoints_px, np.ones(3, np.float32), descriptors)


def test_wrong_features_of_a_plugin_are_refused(small_kapture: Any, tmp_path: Path) -> None:
    folder = small_kapture({"a.png": noise()})
    message = r"'inconsistent' on image a\.png: .*got float32 \(2, 4\), expected .*3, N"
    with pytest.raises(PluginError, match=message):
        extract_local_features([folder], Inconsistent(), tmp_path / "features")


class Colours:
    """Mean, deviation and first pixel of the colours: cheap and distinct."""

    name = "colours"

    def describe(self, image: np.ndarray) -> np.ndarray:
        flat = image.reshape(-1, 3).astype(np.float32)
        found = np.concatenate([flat.mean(axis=0), flat.std(axis=0), flat[0]])
        return np.asarray(found / np.linalg.norm(found), dtype=np.float32)


class ManyColours(Colours):
    name = "many_colours"

    def __init__(self) -> None:
        self.seen: list[int] = []

    def describe_many(self, images: Sequence[np.ndarray]) -> np.ndarray:
        self.seen.append(len(images))
        assert len({image.shape for image in images}) == 1
        return np.stack([self.describe(image) for image in images])


def read(folder: Path, name: str) -> dict[str, np.ndarray]:
    reader = KaptureFolder(folder, features_dirs=[folder]).global_features(name)
    return {image: reader.read(image).reshape(-1) for image in reader.names}


def test_images_are_described_alone_or_in_batches(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices, "BATCH", 4)
    folders, many = [world.mapping(), world.query()], ManyColours()
    counts = extract_global_features(folders, Colours(), tmp_path)
    extract_global_features(folders, many, tmp_path)
    singly, together = read(tmp_path, "colours"), read(tmp_path, "many_colours")
    assert singly.keys() == together.keys() == {**world.map_poses, **world.query_poses}.keys()
    assert counts == {"images": len(singly)} and max(many.seen) == 4
    for image, vector in singly.items():
        np.testing.assert_array_equal(vector, together[image])
    with ThreadPoolExecutor(3) as executor:
        extract_global_features(folders, Colours(), tmp_path / "threads", work=Work(executor))
    place = Path("global_features", "colours")
    assert folder_bytes(tmp_path / "threads" / place) == folder_bytes(tmp_path / place)


def test_wrong_vectors_of_a_plugin_are_refused() -> None:
    class Wrong:
        name = "wrong"

        def describe(self, image: np.ndarray) -> Any:
            return np.array([3, 4], np.float32)

    message = "'wrong' on image a.png: .*a vector of length 5, expected 1"
    with pytest.raises(PluginError, match=message):
        describe_images(Wrong(), [np.zeros((4, 4, 3), np.uint8)], ["a.png"])


# ------------------------------------------------------------------------------------ global vlad


VLAD = VladOptions(num_clusters=8)


PLACE = Path("global_features", "vlad_rootsift")


def assert_described_by(root: Path, folders: list[KaptureFolder], options: VladOptions) -> None:
    """Compare all vectors with those by the vocabulary in the same folder."""
    found = read_vocabulary(root / PLACE)
    assert found is not None
    vocabulary, settings = found
    assert (settings.local_type, settings.options) == ("rootsift", options)
    assert vocabulary.centres.shape == (options.vocabularies, 8, 128)
    for folder in folders:
        stored = folder.with_features([root]).global_features("vlad_rootsift")
        for image in folder.read().image_names():
            expected = aggregate(folder.descriptors("rootsift").read(image), vocabulary, options)
            np.testing.assert_allclose(stored.read(image), expected, atol=1e-5)


def test_the_vocabulary_does_not_depend_on_the_queries(world: Any, tmp_path: Path) -> None:
    assert_described_by(world.features_dir, [world.mapping(), world.query()], VLAD)
    with single_threaded():
        extract_vlad(world.mapping(), [world.mapping()], "rootsift", tmp_path, VLAD)
    alone, both = folder_bytes(tmp_path / PLACE), folder_bytes(world.features_dir / PLACE)
    assert set(both) - set(alone) == {f"global_features/{q}.gfeat" for q in world.query_poses}
    assert all(both[name] == content for name, content in alone.items())


def test_a_map_without_descriptors_is_refused(
    world: Any, write_features: Any, tmp_path: Path
) -> None:
    few = dict.fromkeys(world.map_poses, np.zeros((0, 4), np.float32))
    write_features(tmp_path, "descriptors", "rootsift", few)
    folder = world.mapping().with_features([tmp_path])
    with pytest.raises(DataError, match="no descriptors of type rootsift"):
        extract_vlad(folder, [folder], "rootsift", tmp_path / "out", VLAD)


def test_a_stored_vocabulary_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    mean, projection, centres = (
        rng.normal(size=size).astype(np.float32) for size in (30, (4, 30), (2, 3, 5))
    )
    vocabulary = Vocabulary(centres, PcaWhitening(mean, projection))
    write_vocabulary(tmp_path, vocabulary, "r2d2", VladOptions(vocabularies=2, dimensions=4))
    stored, settings = read_vocabulary(tmp_path) or pytest.fail("no vocabulary")
    assert (settings.local_type, settings.options.vocabularies) == ("r2d2", 2)
    assert stored.whitening is not None
    np.testing.assert_array_equal(stored.centres, centres)
    np.testing.assert_array_equal(stored.whitening.mean, mean)
    np.testing.assert_array_equal(stored.whitening.projection, projection)
