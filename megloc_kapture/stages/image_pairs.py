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
    mapping: KaptureFolder, options: MappingPairsOptions, *, global_type: str | None
) -> list[ImagePair]:
    """Pairs of map images with a pose, each once, first name before second, sorted.

    The score is the cosine similarity where retrieval named the pair, else 1.
    """
    data = mapping.read()
    poses = data.poses()
    images = sorted(poses)
    scores: dict[tuple[int, int], float] = {}
    similarities: dict[tuple[int, int], float] = {}
    for method in options.by:
        if method == "exhaustive":
            found = exhaustive_pairs(len(images))
        elif method == "poses":
            found = pairs_by_poses([poses[image] for image in images], options.poses)
        else:
            if global_type is None:
                raise DataError("pairs by retrieval need global features of the map")
            vectors = read_global_features(mapping.global_features(global_type), images)
            index, similarity = rank_by_similarity(vectors, vectors, options.top_k + 1)
            rows = np.repeat(np.arange(len(images)), index.shape[1])
            both = np.stack([rows, index.ravel()], axis=1)
            # an image is its own nearest, or ties with its copies: it must not use up a place
            others = both[:, 0] != both[:, 1]
            rank = np.cumsum(others.reshape(index.shape), axis=1).ravel()
            keep = others & (rank <= options.top_k) & (both[:, 1] >= 0)
            for (i, j), score in zip(
                np.sort(both[keep], axis=1).tolist(), similarity.ravel()[keep].tolist(), strict=True
            ):
                similarities[i, j] = max(score, similarities.get((i, j), -1.0))
            continue
        for i, j in unique_pairs(found).tolist():
            scores[i, j] = 1.0
    scores.update(similarities)
    return [ImagePair(images[i], images[j], score) for (i, j), score in sorted(scores.items())]


def pair_queries(
    mapping: KaptureFolder,
    query: KaptureFolder,
    options: QueryPairsOptions,
    *,
    global_type: str | None,
) -> list[ImagePair]:
    """Candidates of every query among the posed map images: sorted by query, best first."""
    images = sorted(mapping.read().poses())
    queries = query.read().image_names()
    if options.by == "exhaustive":
        return [ImagePair(q, m, 1.0) for q in queries for m in images]
    if global_type is None:
        raise DataError("retrieval needs global features of map and queries")
    map_vectors = read_global_features(mapping.global_features(global_type), images)
    query_vectors = read_global_features(query.global_features(global_type), queries)
    index, scores = rank_by_similarity(query_vectors, map_vectors, options.top_k)
    return [
        ImagePair(name, images[i], float(score))
        for name, row, row_scores in zip(queries, index.tolist(), scores.tolist(), strict=True)
        for i, score in zip(row, row_scores, strict=True)
        if i >= 0
    ]
