"""Global features as a stage: batches, checks of plugins and stored vocabularies."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.features.vlad import VladOptions, aggregate
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.stages import work as devices
from megloc_kapture.stages.global_features import (
    describe_images,
    extract_global_features,
    extract_vlad,
    read_vocabulary,
)
from megloc_kapture.stages.work import Work
from tests.worlds import folder_bytes


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
