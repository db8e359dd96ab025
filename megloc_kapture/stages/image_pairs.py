"""Stage: which images are matched: within the map, and queries with the map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_store import FeatureReader, ImagePair, KaptureFolder
from megloc_kapture.mapping.pairs import (
    PairsByPosesOptions,
    exhaustive_pairs,
    pairs_by_poses,
    unique_pairs,
)
from megloc_kapture.retrieval.search import rank_by_similarity
from megloc_kapture.stages.restrictions import UNRESTRICTED, Restrictions
from megloc_kapture.values import Options

PairingMethod = Literal["poses", "retrieval", "exhaustive"]


class MappingPairsOptions(Options):
    """How the map's images are paired: the union of the methods named."""

    by: tuple[PairingMethod, ...] = Field(default=("retrieval",), min_length=1)
    top_k: int = Field(default=20, gt=0, description="most similar images per image (retrieval)")
    poses: PairsByPosesOptions = PairsByPosesOptions()


class QueryPairsOptions(Options):
    """How a query's candidates among the map's images are chosen."""

    by: Literal["retrieval", "exhaustive"] = "retrieval"
    top_k: int = Field(default=50, gt=0, description="most similar map images per query")


def read_global_features(reader: FeatureReader, images: Sequence[str]) -> NDArray[np.float32]:
    """Global features of the images, unit rows: float32 (N, D).

    Raises
    ------
    DataError : an image has none.
    """
    missing = [image for image in images if image not in reader]
    if missing:
        raise DataError(
            f"{len(missing)} images have no global feature of type {reader.type_name}, "
            f"the first is {missing[0]}"
        )
    rows = np.zeros((len(images), reader.config.dsize), dtype=np.float32)
    for row, image in zip(rows, images, strict=True):
        row[:] = reader.read(image).reshape(-1)
    return unit_rows(rows)


def unit_rows(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rows scaled to unit length; zero rows stay zero."""
    norm = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.divide(rows, norm, out=np.zeros_like(rows), where=norm > 0)


def pair_map_images(
    mapping: KaptureFolder,
    options: MappingPairsOptions,
    *,
    global_type: str | None,
    restrictions: Restrictions = UNRESTRICTED,
) -> list[ImagePair]:
    """Pairs of map images with a pose, each once, first name before second, sorted.

    Images of different coordinate frames are never paired. The score is the cosine similarity
    where retrieval named the pair, else 1.
    """
    data = mapping.read()
    poses = data.poses()
    images = sorted(poses)
    scores: dict[tuple[int, int], float] = {}
    similarities: dict[tuple[int, int], float] = {}
    for members in restrictions.frames(images):
        names = [images[member] for member in members]
        for method in options.by:
            if method == "retrieval":
                if global_type is None:
                    raise DataError("pairs by retrieval need global features of the map")
                vectors = read_global_features(mapping.global_features(global_type), names)
                for pair, score in _most_similar(vectors, options.top_k):
                    i, j = (int(member) for member in members[pair])
                    similarities[i, j] = max(score, similarities.get((i, j), -1.0))
                continue
            if method == "exhaustive":
                found = exhaustive_pairs(len(names))
            else:
                found = pairs_by_poses([poses[name] for name in names], options.poses)
            for i, j in members[unique_pairs(found)].tolist():
                scores[i, j] = 1.0
    scores.update(similarities)
    return [ImagePair(images[i], images[j], score) for (i, j), score in sorted(scores.items())]


def _most_similar(vectors: NDArray[np.float32], top_k: int) -> list[tuple[list[int], float]]:
    """Pairs (i, j), i < j, of each row and its ``top_k`` most similar others, and similarities."""
    index, similarity = rank_by_similarity(vectors, vectors, top_k + 1)
    rows = np.repeat(np.arange(len(vectors)), index.shape[1])
    both = np.stack([rows, index.ravel()], axis=1)
    # an image is its own nearest, or ties with its copies: it must not use up a place
    others = both[:, 0] != both[:, 1]
    rank = np.cumsum(others.reshape(index.shape), axis=1).ravel()
    keep = others & (rank <= top_k) & (both[:, 1] >= 0)
    pairs = np.sort(both[keep], axis=1).tolist()
    return list(zip(pairs, similarity.ravel()[keep].tolist(), strict=True))


def pair_queries(
    mapping: KaptureFolder,
    query: KaptureFolder,
    options: QueryPairsOptions,
    *,
    global_type: str | None,
    restrictions: Restrictions = UNRESTRICTED,
) -> list[ImagePair]:
    """Candidates of every query among the posed map images its prior permits, best first.

    Sorted by query. A query that nothing is permitted to has no candidate.
    """
    images = sorted(mapping.read().poses())
    queries = query.read().image_names()
    if options.by == "retrieval" and global_type is None:
        raise DataError("retrieval needs global features of map and queries")
    if options.by == "exhaustive" or global_type is None:
        of_query: list[list[ImagePair]] = [[] for _ in queries]
        for positions, permitted in restrictions.pools(queries, images):
            for at in positions:
                of_query[at] = [ImagePair(queries[at], images[i], 1.0) for i in permitted]
        return [pair for pairs in of_query for pair in pairs]
    map_vectors = read_global_features(mapping.global_features(global_type), images)
    query_vectors = read_global_features(query.global_features(global_type), queries)
    of_query = [[] for _ in queries]
    for positions, permitted in restrictions.pools(queries, images):
        # the whole map is by far the most frequent pool: no copy of it
        among = map_vectors if len(permitted) == len(images) else map_vectors[permitted]
        index, scores = rank_by_similarity(query_vectors[positions], among, options.top_k)
        for at, row, row_scores in zip(positions, index.tolist(), scores.tolist(), strict=True):
            of_query[at] = [
                ImagePair(queries[at], images[int(permitted[i])], float(score))
                for i, score in zip(row, row_scores, strict=True)
                if i >= 0
            ]
    return [pair for pairs in of_query for pair in pairs]
