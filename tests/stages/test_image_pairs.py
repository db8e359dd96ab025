"""Pairs of the small world against all similarities and all poses."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_store import FeatureConfig, FeatureWriter, KaptureFolder
from megloc_kapture.mapping.pairs import PairsByPosesOptions
from megloc_kapture.stages.image_pairs import (
    MappingPairsOptions,
    QueryPairsOptions,
    pair_map_images,
    pair_queries,
    read_global_features,
)

VECTORS = {
    # two copies, one near them, one across, one opposite
    "left/0.png": [1.0, 0.0, 0.0],
    "left/1.png": [2.0, 0.0, 0.0],
    "right/2.png": [0.9, 0.1, 0.0],
    "right/3.png": [0.0, 0.0, 3.0],
    "right/4.png": [-1.0, 0.0, 0.1],
    "query/a.png": [1.0, 0.1, 0.0],
    "query/b.png": [0.0, 0.2, 1.0],
}


def unit(vector: list[float]) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


@pytest.fixture
def folders(world: Any, tmp_path: Path) -> tuple[KaptureFolder, KaptureFolder]:
    """Map and queries with the vectors above, of another length than one."""
    config = FeatureConfig("toy", np.dtype("float32"), 3, None, "L2")
    with FeatureWriter(tmp_path, "global_features", "toy", config, orphan=True) as writer:
        for image, vector in VECTORS.items():
            writer.write(image, np.array(vector, dtype=np.float32))
    return (
        KaptureFolder(world.mapping().root, features_dirs=[tmp_path]),
        KaptureFolder(world.query().root, features_dirs=[tmp_path]),
    )


def names(pairs: list[Any]) -> list[tuple[str, str]]:
    return [(pair.query, pair.map) for pair in pairs]


@pytest.mark.parametrize("top_k", [1, 2, 3, 30])
def test_map_pairs_by_retrieval(
    world: Any, folders: tuple[KaptureFolder, KaptureFolder], top_k: int
) -> None:
    images = sorted(world.map_poses)
    expected = {}
    for i, image in enumerate(images):
        others = [j for j in range(len(images)) if j != i]
        others.sort(key=lambda j: (-np.dot(unit(VECTORS[image]), unit(VECTORS[images[j]])), j))
        for j in others[:top_k]:
            key = (images[min(i, j)], images[max(i, j)])
            expected[key] = float(np.dot(unit(VECTORS[key[0]]), unit(VECTORS[key[1]])))
    found = pair_map_images(folders[0], MappingPairsOptions(top_k=top_k), global_type="toy")
    assert names(found) == sorted(expected)
    np.testing.assert_allclose(
        [p.score for p in found], [expected[k] for k in sorted(expected)], atol=1e-6
    )


def test_an_image_is_never_paired_with_itself_even_among_copies(
    folders: tuple[KaptureFolder, KaptureFolder],
) -> None:
    found = pair_map_images(folders[0], MappingPairsOptions(top_k=1), global_type="toy")
    assert ("left/0.png", "left/1.png") in names(found)
    assert all(pair.query < pair.map for pair in found)


def test_copies_do_not_take_more_places_than_there_are(world: Any, tmp_path: Path) -> None:
    config = FeatureConfig("toy", np.dtype("float32"), 3, None, "L2")
    with FeatureWriter(tmp_path, "global_features", "toy", config, orphan=True) as writer:
        for image in world.map_poses:
            writer.write(image, np.ones(3, dtype=np.float32))
    folder = KaptureFolder(world.mapping().root, features_dirs=[tmp_path])
    first, *others = sorted(world.map_poses)
    found = pair_map_images(folder, MappingPairsOptions(top_k=1), global_type="toy")
    # each has one partner, the first of the others
    assert names(found) == [(first, other) for other in others]


def test_map_pairs_by_poses_and_exhaustively(world: Any) -> None:
    images = sorted(world.map_poses)
    everything = pair_map_images(
        world.mapping(), MappingPairsOptions(by=("exhaustive",)), global_type=None
    )
    assert names(everything) == list(combinations(images, 2))
    assert {pair.score for pair in everything} == {1.0}
    options = MappingPairsOptions(by=("poses",), poses=PairsByPosesOptions(num_neighbours=1))
    # the cameras stand in a row, about 0.8 m apart
    centers = {image: world.map_poses[image].center() for image in images}
    expected = set()
    for image in images:
        other = min(
            (o for o in images if o != image),
            key=lambda o: float(np.linalg.norm(centers[o] - centers[image])),
        )
        expected.add((min(image, other), max(image, other)))
    assert names(pair_map_images(world.mapping(), options, global_type=None)) == sorted(expected)


@pytest.mark.parametrize("by", [("exhaustive", "retrieval"), ("retrieval", "exhaustive")])
def test_methods_add_up_and_retrieval_gives_the_score(
    folders: tuple[KaptureFolder, KaptureFolder], by: Any
) -> None:
    found = pair_map_images(folders[0], MappingPairsOptions(by=by, top_k=1), global_type="toy")
    assert len(found) == 10
    scores = {(pair.query, pair.map): pair.score for pair in found}
    assert scores["left/0.png", "left/1.png"] == pytest.approx(1.0, abs=1e-6)
    expected = float(np.dot(unit(VECTORS["left/0.png"]), unit(VECTORS["right/2.png"])))
    assert scores["left/0.png", "right/2.png"] == pytest.approx(expected, abs=1e-6)
    assert scores["left/0.png", "right/4.png"] == 1.0  # named by no retrieval


def test_query_pairs_are_best_first(folders: tuple[KaptureFolder, KaptureFolder]) -> None:
    found = pair_queries(*folders, QueryPairsOptions(top_k=3), global_type="toy")
    assert names(found) == [
        ("query/a.png", "right/2.png"),
        ("query/a.png", "left/0.png"),  # equal to its copy: the order of names
        ("query/a.png", "left/1.png"),
        ("query/b.png", "right/3.png"),
        ("query/b.png", "right/4.png"),
        ("query/b.png", "right/2.png"),
    ]
    expected = [float(np.dot(unit(VECTORS[p.query]), unit(VECTORS[p.map]))) for p in found]
    np.testing.assert_allclose([pair.score for pair in found], expected, atol=1e-6)


def test_query_pairs_exhaustively(world: Any) -> None:
    found = pair_queries(
        world.mapping(), world.query(), QueryPairsOptions(by="exhaustive"), global_type=None
    )
    assert names(found) == [
        (q, m) for q in sorted(world.query_poses) for m in sorted(world.map_poses)
    ]


def test_vlad_ranks_the_nearest_view_first(world: Any) -> None:
    found = pair_queries(
        world.mapping(), world.query(), QueryPairsOptions(), global_type="vlad_rootsift"
    )
    for query, pose in world.query_poses.items():
        ranked = [pair.map for pair in found if pair.query == query]
        assert len(ranked) == 5
        distance = {
            m: np.linalg.norm(p.center() - pose.center()) for m, p in world.map_poses.items()
        }
        assert ranked[0] in sorted(distance, key=lambda m: float(distance[m]))[:2]


def test_retrieval_needs_global_features(world: Any) -> None:
    with pytest.raises(DataError, match="need global features"):
        pair_map_images(world.mapping(), MappingPairsOptions(), global_type=None)
    with pytest.raises(DataError, match="needs global features"):
        pair_queries(world.mapping(), world.query(), QueryPairsOptions(), global_type=None)


def test_images_without_global_features_are_named(world: Any) -> None:
    reader = world.mapping().global_features("vlad_rootsift")
    with pytest.raises(DataError, match=r"2 images have no .* vlad_rootsift, the first is x\.png"):
        read_global_features(reader, ["left/0.png", "x.png", "y.png"])


def test_global_features_come_at_unit_length_and_zero_stays_zero(tmp_path: Path) -> None:
    config = FeatureConfig("toy", np.dtype("float64"), 2, None, "L2")
    with FeatureWriter(tmp_path, "global_features", "toy", config, orphan=True) as writer:
        writer.write("a.png", np.array([3.0, 4.0]))
        writer.write("b.png", np.zeros(2))
    folder = KaptureFolder(tmp_path / "none", features_dirs=[tmp_path])
    rows = read_global_features(folder.global_features("toy"), ["a.png", "b.png"])
    np.testing.assert_allclose(rows, [[0.6, 0.8], [0, 0]])
