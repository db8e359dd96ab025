"""One vector per image: batches, what plugins may not return, and what is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.features.vlad import PcaWhitening, VladOptions, Vocabulary, aggregate
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, KaptureFolder
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.stages import devices
from megloc_kapture.stages.global_features import (
    MEAN_FILE,
    PROJECTION_FILE,
    SETTINGS_FILE,
    VOCABULARY_FILE,
    describe_images,
    extract_global_features,
    extract_vlad,
    read_vocabulary,
    train_on_map,
    write_vocabulary,
)
from megloc_kapture.stages.work import Work


class Colours:
    """Mean, deviation and corner of the colours: cheap, and tells images apart."""

    name = "colours"

    def describe(self, image: np.ndarray) -> np.ndarray:
        flat = image.reshape(-1, 3).astype(np.float32)
        found = np.concatenate([flat.mean(axis=0), flat.std(axis=0), flat[0]])
        return np.asarray(found / np.linalg.norm(found), dtype=np.float32)


class ManyColours(Colours):
    """The same, several images at once."""

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


def test_every_image_of_map_and_queries_is_described(world: Any, tmp_path: Path) -> None:
    counts = extract_global_features([world.mapping(), world.query()], Colours(), tmp_path)
    found = read(tmp_path, "colours")
    assert counts == {"images": len(found)}
    assert sorted(found) == sorted({**world.map_poses, **world.query_poses})
    vectors = np.stack(list(found.values()))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, rtol=1e-6)
    assert len(np.unique(vectors, axis=0)) == len(vectors)


def test_batches_give_the_same_vectors(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices, "BATCH", 4)
    one, many = Colours(), ManyColours()
    extract_global_features([world.mapping(), world.query()], one, tmp_path)
    extract_global_features([world.mapping(), world.query()], many, tmp_path)
    singly, together = read(tmp_path, "colours"), read(tmp_path, "many_colours")
    assert singly.keys() == together.keys()
    for image, vector in singly.items():
        np.testing.assert_array_equal(vector, together[image])
    assert max(many.seen) == 4


def test_threads_write_the_same_bytes(
    world: Any, tmp_path: Path, folder_bytes: Callable[[Path], dict[str, bytes]]
) -> None:
    extract_global_features([world.mapping()], Colours(), tmp_path / "here")
    with ThreadPoolExecutor(3) as executor:
        extract_global_features(
            [world.mapping()], Colours(), tmp_path / "there", work=Work(executor)
        )
    assert folder_bytes(tmp_path / "here") == folder_bytes(tmp_path / "there")


@pytest.mark.parametrize(
    ("returned", "what"),
    [
        ([1.0, 0.0], "not float32"),
        (np.array([1.0, 0.0]), "not float32"),
        (np.ones((1, 2), np.float32), "not float32"),
        (np.array([np.nan, 1], np.float32), "not finite"),
        (np.array([3, 4], np.float32), "a vector of length 5, not 1"),
        (np.zeros(2, np.float32), "a vector of length 0, not 1"),
    ],
)
def test_what_a_plugin_may_not_return(returned: Any, what: str) -> None:
    class Wrong:
        name = "wrong"

        def describe(self, image: np.ndarray) -> Any:
            return returned

    with pytest.raises(PluginError, match=f"'wrong' on image a.png: .*{what}"):
        describe_images(Wrong(), [np.zeros((4, 4, 3), np.uint8)], ["a.png"])


def test_vectors_of_different_lengths_are_refused(world: Any, tmp_path: Path) -> None:
    class Growing:
        name = "growing"
        size = 2

        def describe(self, image: np.ndarray) -> np.ndarray:
            self.size += 1
            return np.eye(self.size, dtype=np.float32)[0]

    with pytest.raises(PluginError, match="growing.*4 values, 3 of the images before"):
        extract_global_features([world.mapping()], Growing(), tmp_path)


def test_an_image_in_two_folders_is_refused(world: Any, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="stands in two kapture folders"):
        extract_global_features([world.mapping(), world.mapping()], Colours(), tmp_path)


# ------------------------------------------------------------------------------------ global vlad


VLAD = VladOptions(num_clusters=8, training_descriptors=2000)


def type_folder(world: Any) -> Path:
    return Path(world.features_dir / "global_features" / "vlad_rootsift")


def test_vectors_come_from_the_stored_vocabulary(world: Any) -> None:
    found = read_vocabulary(type_folder(world))
    assert found is not None
    vocabulary, settings = found
    assert (settings.local_type, settings.options) == ("rootsift", VLAD)
    assert vocabulary.centres.shape == (1, 8, 128)
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
            work=Work(two_processes),
        )  # fmt: skip
    assert counts == {"images": 7, "clusters": 8, "dimensions": 1024}
    assert folder_bytes(tmp_path / "global_features") == folder_bytes(
        world.features_dir / "global_features"
    )


def test_a_small_budget_trains_on_some_descriptors_of_every_image(world: Any) -> None:
    folder = world.mapping()
    options = VladOptions(num_clusters=4, training_descriptors=100)
    first = train_on_map(folder, "rootsift", options)
    other = train_on_map(folder, "rootsift", options.model_copy(update={"seed": 1}))
    assert first.centres.shape == (1, 4, 128)
    assert not np.array_equal(first.centres, other.centres)


WHITENED = VLAD.model_copy(update={"vocabularies": 2, "dimensions": 3})


def test_whitened_vectors_come_from_what_is_stored_beside_them(
    world: Any, two_processes: Executor, tmp_path: Path
) -> None:
    folders = [world.mapping(), world.query()]
    with single_threaded():
        counts = extract_vlad(
            world.mapping(),
            folders,
            "rootsift",
            tmp_path / "two",
            WHITENED,
            work=Work(two_processes),
        )
        extract_vlad(world.mapping(), folders, "rootsift", tmp_path / "one", WHITENED)
    assert counts == {"images": 7, "clusters": 8, "dimensions": 3}
    place = Path("global_features", "vlad_rootsift")
    found = read_vocabulary(tmp_path / "two" / place)
    assert found is not None
    vocabulary, settings = found
    assert settings.options == WHITENED
    assert vocabulary.whitening is not None
    assert vocabulary.whitening.projection.shape == (3, 2 * 8 * 128)
    for folder in folders:
        described = KaptureFolder(folder.root, features_dirs=[tmp_path / "two"])
        stored = described.global_features("vlad_rootsift")
        for image in folder.read().image_names():
            descriptors = folder.descriptors("rootsift").read(image)
            np.testing.assert_allclose(
                stored.read(image), aggregate(descriptors, vocabulary, WHITENED), atol=1e-5
            )
    files = sorted(p.relative_to(tmp_path / "two") for p in (tmp_path / "two").rglob("*.*"))
    assert len(files) == 7 + 5  # vectors, their header, settings, vocabulary, mean, projection
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


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


def some_vocabulary(*, whitening: bool) -> tuple[Vocabulary, VladOptions]:
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(2, 3, 5)).astype(np.float32)
    mean = rng.normal(size=30).astype(np.float32)
    projection = rng.normal(size=(4, 30)).astype(np.float32)
    options = VladOptions(assignment="soft", vocabularies=2, dimensions=7 if whitening else None)
    return Vocabulary(centres, PcaWhitening(mean, projection) if whitening else None), options


@pytest.mark.parametrize("whitening", [False, True])
def test_a_vocabulary_comes_back_as_it_was(
    tmp_path: Path, whitening: bool, folder_bytes: Callable[[Path], dict[str, bytes]]
) -> None:
    assert read_vocabulary(tmp_path) is None
    vocabulary, options = some_vocabulary(whitening=whitening)
    write_vocabulary(tmp_path / "a", vocabulary, "r2d2", options)
    write_vocabulary(tmp_path / "b", vocabulary, "r2d2", options)
    assert folder_bytes(tmp_path / "a") == folder_bytes(tmp_path / "b")
    found = read_vocabulary(tmp_path / "a")
    assert found is not None
    np.testing.assert_array_equal(found[0].centres, vocabulary.centres)
    assert found[1].local_type == "r2d2" and found[1].options == options
    if vocabulary.whitening is None:
        assert found[0].whitening is None
    else:
        assert found[0].whitening is not None
        np.testing.assert_array_equal(found[0].whitening.mean, vocabulary.whitening.mean)
        np.testing.assert_array_equal(
            found[0].whitening.projection, vocabulary.whitening.projection
        )


def test_a_vocabulary_of_the_form_before_several_is_read(tmp_path: Path) -> None:
    vocabulary, _ = some_vocabulary(whitening=False)
    write_vocabulary(tmp_path, vocabulary, "r2d2", VladOptions())
    np.save(tmp_path / VOCABULARY_FILE, vocabulary.centres[0])
    (tmp_path / SETTINGS_FILE).write_text(
        '{"local_type": "r2d2", "options": {"num_clusters": 3, "assignment": "hard"}}'
    )
    found = read_vocabulary(tmp_path)
    assert found is not None
    np.testing.assert_array_equal(found[0].centres, vocabulary.centres[:1])


DAMAGES = ["truncated", "text", "float64", "nan", "flat", "pickled"]


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", [VOCABULARY_FILE, MEAN_FILE, PROJECTION_FILE])
def test_a_broken_vocabulary_is_refused_by_name(tmp_path: Path, damage: str, name: str) -> None:
    write_vocabulary(tmp_path, *_swap(some_vocabulary(whitening=True)))
    place = tmp_path / name
    if damage == "truncated":
        place.write_bytes(place.read_bytes()[:-7])
    elif damage == "text":
        place.write_text("no array")
    elif damage == "float64":
        np.save(place, np.load(place).astype(np.float64))
    elif damage == "nan":
        np.save(place, np.full_like(np.load(place), np.nan))
    elif damage == "flat":
        np.save(place, np.ones(5, np.float32))
    else:
        np.save(place, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(
        DataError, match=r"\.npy: (not a (vocabulary|whitening)|mean .* do not fit)"
    ):
        read_vocabulary(tmp_path)


def _swap(made: tuple[Vocabulary, VladOptions]) -> tuple[Vocabulary, str, VladOptions]:
    return made[0], "r2d2", made[1]


def test_a_missing_projection_is_refused_by_name(tmp_path: Path) -> None:
    write_vocabulary(tmp_path, *_swap(some_vocabulary(whitening=True)))
    (tmp_path / PROJECTION_FILE).unlink()
    with pytest.raises(DataError, match=PROJECTION_FILE):
        read_vocabulary(tmp_path)


def test_broken_settings_are_refused_by_name(tmp_path: Path) -> None:
    write_vocabulary(tmp_path, *_swap(some_vocabulary(whitening=False)))
    (tmp_path / SETTINGS_FILE).write_text('{"local_type": 3}')
    with pytest.raises(DataError, match=SETTINGS_FILE):
        read_vocabulary(tmp_path)
