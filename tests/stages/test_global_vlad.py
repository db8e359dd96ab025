"""VLAD as a stage: vectors, the stored vocabulary, broken files."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.features.vlad import VladOptions, Vocabulary, aggregate
from megloc_kapture.io.kapture_store import FeatureConfig, FeatureWriter, KaptureFolder
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.stages.global_vlad import (
    SETTINGS_FILE,
    VOCABULARY_FILE,
    extract_vlad,
    read_vocabulary,
    train_on_map,
    write_vocabulary,
)

VLAD = VladOptions(num_clusters=8, training_descriptors=2000)


def type_folder(world: Any) -> Path:
    return Path(world.features_dir / "global_features" / "vlad_rootsift")


def test_vectors_come_from_the_stored_vocabulary(world: Any) -> None:
    found = read_vocabulary(type_folder(world))
    assert found is not None
    vocabulary, settings = found
    assert (settings.local_type, settings.options) == ("rootsift", VLAD)
    assert vocabulary.centres.shape == (8, 128)
    for folder in (world.mapping(), world.query()):
        stored = folder.global_features("vlad_rootsift")
        for image in folder.read().image_names():
            descriptors = folder.descriptors("rootsift").read(image)
            np.testing.assert_allclose(
                stored.read(image), aggregate(descriptors, vocabulary, VLAD), atol=1e-6
            )


def test_the_vocabulary_knows_nothing_of_the_queries(
    world: Any, tmp_path: Path, folder_bytes: Callable[[Path], dict[str, bytes]]
) -> None:
    with single_threaded():
        extract_vlad(world.mapping(), [world.mapping()], "rootsift", tmp_path, VLAD)
    alone = folder_bytes(tmp_path / "global_features" / "vlad_rootsift")
    both = folder_bytes(type_folder(world))
    assert set(both) - set(alone) == {f"global_features/{q}.gfeat" for q in world.query_poses}
    assert all(both[name] == content for name, content in alone.items())


def test_workers_write_the_same_bytes(
    world: Any,
    two_processes: Executor,
    tmp_path: Path,
    folder_bytes: Callable[[Path], dict[str, bytes]],
) -> None:
    with single_threaded():
        counts = extract_vlad(
            world.mapping(), [world.query(), world.mapping()], "rootsift", tmp_path, VLAD,
            executor=two_processes,
        )  # fmt: skip
    assert counts == {"images": 7, "clusters": 8}
    assert folder_bytes(tmp_path / "global_features") == folder_bytes(
        world.features_dir / "global_features"
    )


def test_a_small_budget_trains_on_some_descriptors_of_every_image(world: Any) -> None:
    folder = world.mapping()
    images = folder.read().image_names()
    options = VladOptions(num_clusters=4, training_descriptors=100)
    first = train_on_map(folder.descriptors("rootsift"), images, options)
    other = train_on_map(
        folder.descriptors("rootsift"), images, options.model_copy(update={"seed": 1})
    )
    assert first.centres.shape == (4, 128)
    assert not np.array_equal(first.centres, other.centres)


def folder_with_descriptors(root: Path, world: Any, rows: int) -> KaptureFolder:
    config = FeatureConfig("rootsift", np.dtype("float32"), 4, "rootsift", "L2")
    with FeatureWriter(root, "descriptors", "rootsift", config, orphan=True) as writer:
        for image in world.map_poses:
            writer.write(image, np.eye(4, dtype=np.float32)[:rows])
    return KaptureFolder(world.mapping().root, features_dirs=[root])


def test_a_map_without_descriptors_is_refused(world: Any, tmp_path: Path) -> None:
    folder = folder_with_descriptors(tmp_path / "features", world, rows=0)
    with pytest.raises(DataError, match="no descriptors of type rootsift"):
        extract_vlad(folder, [folder], "rootsift", tmp_path / "out", VLAD)


def test_a_map_with_too_few_descriptors_is_refused(world: Any, tmp_path: Path) -> None:
    folder = folder_with_descriptors(tmp_path / "features", world, rows=3)
    with pytest.raises(DataError, match="fewer clusters"):
        extract_vlad(folder, [folder], "rootsift", tmp_path / "out", VladOptions(num_clusters=4))


def test_a_vocabulary_comes_back_as_it_was(tmp_path: Path) -> None:
    assert read_vocabulary(tmp_path) is None
    centres = np.random.default_rng(0).normal(size=(3, 5)).astype(np.float32)
    write_vocabulary(tmp_path, Vocabulary(centres), "r2d2", VladOptions(assignment="soft"))
    found = read_vocabulary(tmp_path)
    assert found is not None
    np.testing.assert_array_equal(found[0].centres, centres)
    assert found[1].local_type == "r2d2" and found[1].options.assignment == "soft"


@pytest.mark.parametrize("damage", ["truncated", "text", "float64", "nan", "flat", "pickled"])
def test_a_broken_vocabulary_is_refused_by_name(tmp_path: Path, damage: str) -> None:
    write_vocabulary(tmp_path, Vocabulary(np.ones((3, 5), np.float32)), "r2d2", VladOptions())
    place = tmp_path / VOCABULARY_FILE
    if damage == "truncated":
        place.write_bytes(place.read_bytes()[:-7])
    elif damage == "text":
        place.write_text("no array")
    elif damage == "float64":
        np.save(place, np.ones((3, 5)))
    elif damage == "nan":
        np.save(place, np.full((3, 5), np.nan, np.float32))
    elif damage == "flat":
        np.save(place, np.ones(5, np.float32))
    else:
        np.save(place, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match=rf"{VOCABULARY_FILE}: not a vocabulary"):
        read_vocabulary(tmp_path)


def test_broken_settings_are_refused_by_name(tmp_path: Path) -> None:
    write_vocabulary(tmp_path, Vocabulary(np.ones((3, 5), np.float32)), "r2d2", VladOptions())
    (tmp_path / SETTINGS_FILE).write_text('{"local_type": 3}')
    with pytest.raises(DataError, match=SETTINGS_FILE):
        read_vocabulary(tmp_path)
