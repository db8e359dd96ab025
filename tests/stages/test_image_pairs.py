"""Pairs of the small world against all similarities and all poses."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.dataset_tables import ImageGroup
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureData,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
    write_observations,
    write_pairs,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.tables import PairCount, match_counts_path, write_match_counts
from megloc_kapture.mapping.pairs import (
    PairsByCovisibilityOptions,
    PairsByPosesOptions,
    PairsBySequenceOptions,
)
from megloc_kapture.stages.candidates import QueryPairsOptions, Restrictions, Retrieval, vectors_of
from megloc_kapture.stages.image_pairs import (
    MappingPairsOptions,
    RerankingOptions,
    counted,
    pair_map_images,
    pair_queries,
    rerank,
    reranked,
)
from megloc_kapture.stages.matches import VerifiedMatches, iterate_candidates

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
    found = pair_map_images(
        folders[0], MappingPairsOptions(top_k=top_k), retrieval=Retrieval(("toy",))
    )
    assert names(found) == sorted(expected)
    np.testing.assert_allclose(
        [p.score for p in found], [expected[k] for k in sorted(expected)], atol=1e-6
    )


def test_an_image_is_never_paired_with_itself_even_among_copies(
    folders: tuple[KaptureFolder, KaptureFolder],
) -> None:
    found = pair_map_images(folders[0], MappingPairsOptions(top_k=1), retrieval=Retrieval(("toy",)))
    assert ("left/0.png", "left/1.png") in names(found)
    assert all(pair.query < pair.map for pair in found)


def test_copies_do_not_take_more_places_than_there_are(world: Any, tmp_path: Path) -> None:
    config = FeatureConfig("toy", np.dtype("float32"), 3, None, "L2")
    with FeatureWriter(tmp_path, "global_features", "toy", config, orphan=True) as writer:
        for image in world.map_poses:
            writer.write(image, np.ones(3, dtype=np.float32))
    folder = KaptureFolder(world.mapping().root, features_dirs=[tmp_path])
    first, *others = sorted(world.map_poses)
    found = pair_map_images(folder, MappingPairsOptions(top_k=1), retrieval=Retrieval(("toy",)))
    # each has one partner, the first of the others
    assert names(found) == [(first, other) for other in others]


def test_map_pairs_by_poses_and_exhaustively(world: Any) -> None:
    images = sorted(world.map_poses)
    everything = pair_map_images(
        world.mapping(), MappingPairsOptions(by=("exhaustive",)), retrieval=None
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
    assert names(pair_map_images(world.mapping(), options, retrieval=None)) == sorted(expected)


@pytest.mark.parametrize("by", [("exhaustive", "retrieval"), ("retrieval", "exhaustive")])
def test_methods_add_up_and_retrieval_gives_the_score(
    folders: tuple[KaptureFolder, KaptureFolder], by: Any
) -> None:
    found = pair_map_images(
        folders[0], MappingPairsOptions(by=by, top_k=1), retrieval=Retrieval(("toy",))
    )
    assert len(found) == 10
    scores = {(pair.query, pair.map): pair.score for pair in found}
    assert scores["left/0.png", "left/1.png"] == pytest.approx(1.0, abs=1e-6)
    expected = float(np.dot(unit(VECTORS["left/0.png"]), unit(VECTORS["right/2.png"])))
    assert scores["left/0.png", "right/2.png"] == pytest.approx(expected, abs=1e-6)
    assert scores["left/0.png", "right/4.png"] == 1.0  # named by no retrieval


def shared_points(folder: KaptureFolder) -> dict[tuple[str, str], int]:
    """Number of points that two images observe both, counted with sets."""
    seen: dict[str, set[int]] = {}
    for observations in folder.observations().values():
        for point, image in zip(observations.point_ids, observations.image_ids, strict=True):
            seen.setdefault(observations.image_names[image], set()).add(int(point))
    return {(a, b): len(seen[a] & seen[b]) for a, b in combinations(sorted(seen), 2)}


def test_map_pairs_by_covisibility(world: Any) -> None:
    shared = shared_points(world.map())
    least = sorted(shared.values())[5]
    options = MappingPairsOptions(
        by=("covisibility",), covisibility=PairsByCovisibilityOptions(min_shared_points=least)
    )
    expected = sorted(pair for pair, count in shared.items() if count >= least)
    assert 0 < len(expected) < 10
    found = pair_map_images(world.map(), options, retrieval=None)
    assert names(found) == expected and {pair.score for pair in found} == {1.0}
    # images of one kapture, points of another
    mapping = world.mapping()
    assert pair_map_images(mapping, options, retrieval=None, covisible=world.map()) == found
    with pytest.raises(DataError, match="mapping: co-visibility and overlap need a map's points"):
        pair_map_images(mapping, options, retrieval=None)


def test_points_of_all_types_count(world: Any, tmp_path: Path) -> None:
    """Two images that share points of two types share the sum."""
    shutil.copytree(world.root / "map" / "reconstruction", tmp_path / "reconstruction")
    shutil.copytree(
        world.root / "map" / "sensors", tmp_path / "sensors", ignore=lambda *_: ["records_data"]
    )
    observations = world.map().observations()["rootsift"]
    num_points = len(world.map().points3d())
    again = replace(
        observations, keypoints_type="other", point_ids=observations.point_ids + num_points
    )
    write_points3d(tmp_path, np.concatenate([world.map().points3d()] * 2))
    write_observations(tmp_path, {"rootsift": observations, "other": again})
    shared = shared_points(world.map())
    most = max(shared.values())
    covisibility = PairsByCovisibilityOptions(min_shared_points=2 * most)
    options = MappingPairsOptions(by=("covisibility",), covisibility=covisibility)
    found = pair_map_images(KaptureFolder(tmp_path), options, retrieval=None)
    assert names(found) == sorted(pair for pair, count in shared.items() if count == most)


def test_a_map_of_other_images_is_refused(world: Any, tmp_path: Path) -> None:
    shutil.copytree(world.root / "map" / "reconstruction", tmp_path / "reconstruction")
    strangers = replace(
        world.map().observations()["rootsift"], image_names=tuple(f"{k}.jpg" for k in range(5))
    )
    write_observations(tmp_path, {"rootsift": strangers})
    options = MappingPairsOptions(by=("covisibility",))
    with pytest.raises(DataError, match="no image to be paired observes its points"):
        pair_map_images(world.mapping(), options, retrieval=None, covisible=KaptureFolder(tmp_path))


def test_near_images_that_see_other_things_are_no_pairs(world: Any) -> None:
    folder = world.map()
    near = MappingPairsOptions(by=("poses",))
    assert len(pair_map_images(folder, near, retrieval=None)) == 10
    shares = {}
    xyz = folder.points3d()[:, :3]
    observations = folder.observations()["rootsift"]
    for a, b in combinations(observations.image_names, 2):
        of_pair = []
        for image, other in ((a, b), (b, a)):
            own = observations.image_ids == observations.image_names.index(image)
            points = xyz[np.unique(observations.point_ids[own])]
            pixels = project(folder.read().camera_of(other), world.map_poses[other], points)
            of_pair.append(((pixels >= 0) & (pixels < (400, 300))).all(axis=1).mean())
        shares[a, b] = max(of_pair)
    least = sorted(shares.values())[4]
    assert least > min(shares.values())
    by_overlap = MappingPairsOptions(by=("poses",), poses=PairsByPosesOptions(min_overlap=least))
    expected = sorted(pair for pair, share in shares.items() if share >= least)
    found = pair_map_images(
        world.mapping(), by_overlap, retrieval=None, covisible=KaptureFolder(folder.root)
    )
    assert names(found) == expected
    with pytest.raises(DataError, match="need a map's points"):
        pair_map_images(world.mapping(), by_overlap, retrieval=None)


def test_map_pairs_by_sequence_are_within_a_camera(world: Any, tmp_path: Path) -> None:
    images = sorted(world.map_poses)
    sequence = PairsBySequenceOptions(window=1)
    options = MappingPairsOptions(by=("sequence",), sequence=sequence)
    # the images were taken in the order of their names
    found = pair_map_images(world.mapping(), options, retrieval=None)
    assert names(found) == list(pairwise(images))
    data = world.mapping().read()
    sensors, taken = {**data.sensors, "other": data.sensors["cam"]}, {}
    for (timestamp, sensor), image in data.records_camera.items():
        taken[10 - timestamp, "other" if image.startswith("right") else sensor] = image
    poses = {key: world.map_poses[image] for key, image in taken.items()}
    write_sensors(tmp_path, KaptureData(sensors=sensors, trajectories=poses, records_camera=taken))
    looped = MappingPairsOptions(
        by=("sequence",), sequence=PairsBySequenceOptions(window=1, loop=True)
    )
    backwards = KaptureFolder(tmp_path)
    left, right = images[:2], images[2:]
    expected = [tuple(left), *pairwise(right)]
    assert names(pair_map_images(backwards, options, retrieval=None)) == expected
    assert names(pair_map_images(backwards, looped, retrieval=None)) == [
        tuple(left),
        *combinations(right, 2),
    ]


FRAMES = Restrictions(
    groups={
        image: ImageGroup(frame="a" if k % 2 else "b") for k, image in enumerate(sorted(VECTORS))
    }
)


@pytest.mark.parametrize(
    "by", [("exhaustive",), ("poses",), ("retrieval",), ("sequence",), ("covisibility",)]
)
def test_frames_never_mix(
    world: Any, folders: tuple[KaptureFolder, KaptureFolder], by: Any
) -> None:
    found = pair_map_images(
        folders[0],
        MappingPairsOptions(
            by=by, covisibility=PairsByCovisibilityOptions(top_k=1, min_shared_points=1)
        ),
        retrieval=Retrieval(("toy",)),
        restrictions=FRAMES,
        covisible=world.map(),
    )
    images = sorted(world.map_poses)
    within = [pair for pair in combinations(images, 2) if len({*map(FRAMES.frame, pair)}) == 1]
    assert 0 < len(within) < 10
    assert set(names(found)) <= set(within)
    # the best of its own frame is found though a better one stands in the other
    assert {image for pair in names(found) for image in pair} == set(images)


def test_all_methods_together_name_each_pair_once(
    world: Any, folders: tuple[KaptureFolder, KaptureFolder]
) -> None:
    each = {}
    for method in ("sequence", "covisibility", "poses", "retrieval"):
        options = {
            "top_k": 1,
            "covisibility": {"top_k": 1},
            "sequence": {"window": 1},
            "poses": {"num_neighbours": 1},
        }
        for by in ((method,), ("sequence", "covisibility", "poses", "retrieval")):
            found = pair_map_images(
                folders[0],
                MappingPairsOptions(by=by, **options),
                retrieval=Retrieval(("toy",)),
                covisible=world.map(),
            )
            each[by] = found
    together = each["sequence", "covisibility", "poses", "retrieval"]
    alone = [found for by, found in each.items() if len(by) == 1]
    assert names(together) == sorted({pair for found in alone for pair in names(found)})
    assert len(names(together)) > max(len(found) for found in alone)


def test_query_pairs_are_best_first(folders: tuple[KaptureFolder, KaptureFolder]) -> None:
    found = pair_queries(*folders, QueryPairsOptions(top_k=3), retrieval=Retrieval(("toy",)))
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
        world.mapping(), world.query(), QueryPairsOptions(by="exhaustive"), retrieval=None
    )
    assert names(found) == [
        (q, m) for q in sorted(world.query_poses) for m in sorted(world.map_poses)
    ]


def test_vlad_ranks_the_nearest_view_first(world: Any) -> None:
    found = pair_queries(
        world.mapping(), world.query(), QueryPairsOptions(), retrieval=Retrieval(("vlad_rootsift",))
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
        pair_map_images(world.mapping(), MappingPairsOptions(), retrieval=None)
    with pytest.raises(DataError, match="needs global features"):
        pair_queries(world.mapping(), world.query(), QueryPairsOptions(), retrieval=None)


def test_images_without_global_features_are_named(world: Any) -> None:
    reader = world.mapping().global_features("vlad_rootsift")
    with pytest.raises(DataError, match=r"2 images have no .* vlad_rootsift, the first is x\.png"):
        vectors_of([reader], ["left/0.png", "x.png", "y.png"])


def test_global_features_come_at_unit_length_and_zero_stays_zero(tmp_path: Path) -> None:
    config = FeatureConfig("toy", np.dtype("float64"), 2, None, "L2")
    with FeatureWriter(tmp_path, "global_features", "toy", config, orphan=True) as writer:
        writer.write("a.png", np.array([3.0, 4.0]))
        writer.write("b.png", np.zeros(2))
    folder = KaptureFolder(tmp_path / "none", features_dirs=[tmp_path])
    (source,) = vectors_of([folder.global_features("toy")], ["a.png", "b.png"])
    rows = source.read(0, 2)
    np.testing.assert_allclose(rows, [[0.6, 0.8], [0, 0]])


# -------------------------------------------------------------------------------------- reranking


PAIRS = [
    ImagePair("q1", "z", 0.9),
    ImagePair("q1", "y", 0.8),
    ImagePair("q1", "x", 0.7),
    ImagePair("q1", "w", 0.6),
    ImagePair("q2", "x", 0.3),
    ImagePair("q2", "y", 0.2),
]


def write_matches(root: Path, counts: dict[tuple[str, str], tuple[int, int]], name: str) -> None:
    """Matches and their table: of each pair how many were found and verified."""
    table = []
    with MatchesWriter(root, name, orphan=True) as writer:
        for (image, other), (found, verified) in counts.items():
            rows = np.stack([np.arange(verified)] * 2, axis=1)
            writer.write(image, other, rows, np.ones(verified))
            table.append(PairCount(image, other, found, verified))
    write_match_counts(root, name, table)


def run(root: Path, names: list[str], by: Any, keep: int) -> list[ImagePair]:
    query = KaptureFolder(root, features_dirs=[root])
    return reranked(PAIRS, query, root, names, RerankingOptions(by=by, keep=keep))


def test_most_correspondences_first_and_no_more_than_asked(tmp_path: Path) -> None:
    counts = {("q1", "w"): (40, 30), ("q1", "y"): (50, 10), ("q2", "y"): (4, 4)}
    write_matches(tmp_path, counts, "a")
    found = run(tmp_path, ["a"], "verified", 3)
    assert [(pair.query, pair.map) for pair in found] == [
        ("q1", "w"),
        ("q1", "y"),
        ("q1", "z"),
        ("q2", "y"),
        ("q2", "x"),
    ]
    assert [pair.map for pair in run(tmp_path, ["a"], "matches", 2)] == ["y", "w", "y", "x"]


def test_equal_counts_keep_retrievals_order_also_in_the_file(tmp_path: Path) -> None:
    write_matches(tmp_path, {("q1", "x"): (7, 7), ("q1", "z"): (7, 7)}, "a")
    found = run(tmp_path, ["a"], "verified", 4)
    write_pairs(tmp_path / "pairs.txt", found)
    ranked = dict(iterate_candidates(read_pairs(tmp_path / "pairs.txt")))
    assert ranked == {"q1": ["z", "x", "y", "w"], "q2": ["x", "y"]}
    # the score tells the count
    assert [int(pair.score) for pair in found] == [7, 7, 0, 0, 0, 0]


def test_coverage_counts_each_keypoint_once(tmp_path: Path) -> None:
    matched = {"z": [0, 1, 2, 3], "y": [0, 1, 2], "x": [5, 6, 5], "w": []}
    with MatchesWriter(tmp_path, "a", orphan=True) as writer:
        for image, rows in matched.items():
            both = np.stack([rows, np.arange(len(rows))], axis=1).astype(np.int64)
            writer.write("q1", image, both, np.ones(len(rows)))
    found = [pair for pair in run(tmp_path, ["a"], "coverage", 3) if pair.query == "q1"]
    assert [(pair.map, int(pair.score)) for pair in found] == [("z", 4), ("x", 2), ("y", 0)]
    # the same from arrays
    of_image = [np.array(matched[image], np.int64) for image in ("z", "y", "x", "w")]
    assert rerank([of_image], RerankingOptions(by="coverage", keep=3)) == ([0, 2, 1], [4, 2, 0])


def test_keypoints_of_several_types_are_told_apart() -> None:
    options = RerankingOptions(by="coverage", keep=2)
    # row 1 of one type is no row of the other
    of_types = [[np.array([2]), np.array([1])], [np.array([1, 2]), np.array([1, 3])]]
    assert rerank(of_types, options) == ([0, 1], [3, 2])
    assert rerank([[np.array([0]), np.array([0])]], options) == ([0, 1], [1, 0])


def test_counts_of_all_types_are_added(tmp_path: Path) -> None:
    write_matches(tmp_path, {("q1", "y"): (9, 4), ("q1", "x"): (2, 0)}, "a")
    write_matches(tmp_path, {("q1", "y"): (5, 1)}, "b")
    counts = {
        by: [int(pair.score) for pair in run(tmp_path, ["a", "b"], by, 2)][:2]
        for by in ("matches", "verified")
    }
    assert counts == {"matches": [14, 2], "verified": [5, 0]}


def test_matches_count_alike_stored_and_at_hand() -> None:
    pair = VerifiedMatches(np.array([[3, 0], [5, 1]]), np.ones(2, np.float32), num_found=9)
    assert (counted(pair, "matches"), counted(pair, "verified")) == (9, 2)
    assert np.asarray(counted(pair, "coverage")).tolist() == [3, 5]


def test_a_broken_table_is_named_with_its_line(tmp_path: Path) -> None:
    write_matches(tmp_path, {("q", "m"): (9, 4)}, "a")
    path = match_counts_path(tmp_path, "a")
    path.write_text(path.read_text() + "q,n,many,1\n")
    with pytest.raises(DataError, match=r"match_counts\.csv:3: matches 'many'"):
        run(tmp_path, ["a"], "verified", 1)
    with pytest.raises(DataError, match=r"match_counts\.csv"):
        run(tmp_path, ["none"], "verified", 1)


def test_nothing_is_reranked_unless_asked() -> None:
    assert not RerankingOptions().reranks()
    assert rerank([[3, 9], [0, 0]], RerankingOptions()) == ([0, 1], [3, 9])
    assert reranked(PAIRS, KaptureFolder("none"), Path("none"), ["a"], RerankingOptions()) == PAIRS
