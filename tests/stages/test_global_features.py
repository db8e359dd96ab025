"""One vector per image: batches, what plugins may not return, and what is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages import devices
from megloc_kapture.stages.global_features import describe_images, extract_global_features
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
