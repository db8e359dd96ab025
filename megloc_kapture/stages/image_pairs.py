"""Stages: image pairs to match, within the map and between queries and map.

Pairs of similar images are retrieved with one or several global features.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.dataset_tables import (
    NO_TABLES,
    SIDE_TABLES,
    SideTables,
    read_side_tables,
)
from megloc_kapture.io.kapture import FeatureReader, ImagePair, KaptureFolder, write_pairs
from megloc_kapture.io.kapture.features import KaptureVectors
from megloc_kapture.mapping.pairs import (
    PairsByCovisibilityOptions,
    PairsByPosesOptions,
    PairsBySequenceOptions,
    exhaustive_pairs,
    pairs_by_covisibility,
    pairs_by_poses,
    pairs_by_sequence,
)
from megloc_kapture.retrieval.search import (
    FusionOptions,
    Ranking,
    VectorRows,
    common_length,
    rank_rows,
)
from megloc_kapture.stages import paths
from megloc_kapture.stages.scene import check_points
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.values import Options

_QUERY_ELEMENTS = 1 << 27  # elements of query vectors in memory at once: 512 MiB of float32


class QueryPairsOptions(Options):
    by: Literal["retrieval", "exhaustive"] = Field(
        default="retrieval",
        description="candidates of a query; retrieval: the most similar map images; exhaustive: "
        "all map images",
    )
    top_k: int = Field(default=50, gt=0, description="number of most similar map images per query")


@dataclass(frozen=True)
class Retrieval:
    """Kapture types of global features, and their fusion weights; without weights all are equal."""

    types: tuple[str, ...]
    weights: tuple[float, ...] = ()
    fusion: FusionOptions = field(default_factory=FusionOptions)

    def readers(self, folder: KaptureFolder) -> list[FeatureReader]:
        return [folder.global_features(name) for name in self.types]

    def rank(
        self,
        queries: Sequence[VectorRows],
        database: Sequence[VectorRows],
        top_k: int,
    ) -> Ranking:
        """Return indices and scores, (Q, at most ``top_k``), of the most similar database rows.

        ``queries`` and ``database`` have the unit vectors of each type as rows; they are read in
        blocks.
        """
        total, width = common_length(queries), sum(source.shape[1] for source in queries)
        step = max(1, _QUERY_ELEMENTS // max(width, 1))
        blocks = []
        for start in range(0, total, step) or (0,):
            rows = [source[start : start + step] for source in queries]
            blocks.append(rank_rows(rows, database, top_k, self.fusion, self.weights or None))
        indices, scores = (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
        return indices, scores


def vectors_of(readers: Sequence[FeatureReader], images: Sequence[str]) -> list[KaptureVectors]:
    """Return the unit vectors of the images by type; they are read lazily."""
    for reader in readers:
        missing = [image for image in images if image not in reader]
        if missing:
            raise DataError(
                f"{len(missing)} images have no global feature of type {reader.type_name}, "
                f"the first is {missing[0]}"
            )
    return [KaptureVectors(reader, images) for reader in readers]


PairingMethod = Literal["poses", "covisibility", "retrieval", "sequence", "exhaustive"]


class MappingPairsOptions(Options):
    by: tuple[PairingMethod, ...] = Field(
        default=("retrieval",),
        min_length=1,
        description="pairing methods; a pair is matched if one of them chooses it",
    )
    top_k: int = Field(
        default=20, gt=0, description="number of most similar images per image (retrieval)"
    )
    poses: PairsByPosesOptions = PairsByPosesOptions()
    covisibility: PairsByCovisibilityOptions = PairsByCovisibilityOptions()
    sequence: PairsBySequenceOptions = PairsBySequenceOptions()

    def needs_points(self) -> bool:
        return "covisibility" in self.by


def _seen_points(
    folder: KaptureFolder, images: Sequence[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the point id and the row in ``images`` of each observation, (O,) each."""
    check_points(folder, "pair images by co-visibility")
    row_of = {image: row for row, image in enumerate(images)}
    points, seeing = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for _, observations in sorted(folder.observations().items()):
        rows = np.array([row_of.get(name, -1) for name in observations.image_names], np.int64)
        image_ids = rows[observations.image_ids]
        points.append(observations.point_ids[image_ids >= 0])
        seeing.append(image_ids[image_ids >= 0])
    point_ids = np.concatenate(points)
    require(len(point_ids) != 0, "none of the images to pair observes a point", path=folder.root)
    return point_ids, np.concatenate(seeing)


def pair_map_images(
    mapping: KaptureFolder,
    options: MappingPairsOptions,
    *,
    retrieval: Retrieval | None,
    tables: SideTables = NO_TABLES,
    covisible: KaptureFolder | None = None,
) -> list[ImagePair]:
    """Pair the posed map images of each coordinate frame; return sorted pairs of sorted names.

    If no image has a pose, all images are paired; ``poses`` then raises DataError. The score of a
    pair is its (fused) similarity if retrieval chose it, else 1. ``covisible`` is a map of the same
    images whose points are used for co-visibility, by default ``mapping``.
    """
    data = mapping.read()
    poses = data.poses()
    if not poses and "poses" in options.by:
        raise DataError("pairs by poses: no image has a pose", path=mapping.root)
    images = sorted(poses) or data.image_names()
    point_ids, image_ids = np.zeros(0, np.int64), np.zeros(0, np.int64)
    if options.needs_points():
        point_ids, image_ids = _seen_points(covisible or mapping, images)
    pairs_by_source, similarities = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0)]
    for members in tables.frames(images):
        names = [images[member] for member in members]
        row_of = np.full(len(images), -1, dtype=np.int64)
        row_of[members] = np.arange(len(members))
        rows = row_of[image_ids]
        seen = point_ids[rows >= 0], rows[rows >= 0]  # rows index ``names``
        for method in options.by:
            similarity = None
            if method == "retrieval":
                if retrieval is None:
                    raise DataError("pairs by retrieval need global features of the map")
                vectors = vectors_of(retrieval.readers(mapping), names)
                pairs, similarity = _most_similar(vectors, retrieval, options.top_k)
            elif method == "poses":
                pairs = pairs_by_poses([poses[name] for name in names], options.poses)
            elif method == "sequence":
                records = [data.record_of(name) for name in names]
                cameras, timestamps = [sensor for _, sensor in records], [t for t, _ in records]
                pairs = pairs_by_sequence(cameras, timestamps, options.sequence)
            elif method == "covisibility":
                pairs = pairs_by_covisibility(len(names), *seen, options.covisibility)
            else:
                pairs = exhaustive_pairs(len(names))
            pairs_by_source.append(members[pairs])
            similarities.append(np.full(len(pairs), -np.inf) if similarity is None else similarity)
    return _united(images, np.concatenate(pairs_by_source), np.concatenate(similarities))


def _united(
    images: Sequence[str], pairs: NDArray[np.int64], similarities: NDArray[np.float64]
) -> list[ImagePair]:
    """Return each pair once with its best similarity, or 1 if that is -inf (unknown)."""
    keys, rows = np.unique(pairs[:, 0] * len(images) + pairs[:, 1], return_inverse=True)
    scores = np.full(len(keys), -np.inf)
    np.maximum.at(scores, rows, similarities)
    scores[np.isneginf(scores)] = 1.0
    first, second = np.divmod(keys, max(len(images), 1))
    return [
        ImagePair(images[i], images[j], score)
        for i, j, score in zip(first.tolist(), second.tolist(), scores.tolist(), strict=True)
    ]


def _most_similar(
    vectors: Sequence[KaptureVectors], retrieval: Retrieval, top_k: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the pairs (P, 2), i < j, of rows and their ``top_k`` neighbours, with similarities."""
    index, similarity = retrieval.rank(vectors, vectors, top_k + 1)
    rows = np.repeat(np.arange(len(index)), index.shape[1])
    both = np.stack([rows, index.ravel()], axis=1)
    # an image is among its own results, but not always first if it has duplicates
    others = both[:, 0] != both[:, 1]
    rank = np.cumsum(others.reshape(index.shape), axis=1).ravel()
    keep = others & (rank <= top_k) & (both[:, 1] >= 0)
    return np.sort(both[keep], axis=1), similarity.ravel()[keep].astype(np.float64)


def pair_queries(
    mapping: KaptureFolder,
    query: KaptureFolder,
    options: QueryPairsOptions,
    *,
    retrieval: Retrieval | None,
    tables: SideTables = NO_TABLES,
) -> list[ImagePair]:
    """Choose candidates of every query among the posed map images that its prior permits."""
    poses = mapping.read().poses()
    images = sorted(poses)
    queries = query.read().image_names()
    of_query: list[list[ImagePair]] = [[] for _ in queries]
    pools = tables.pools(queries, images)
    if options.by == "exhaustive":
        for positions, permitted in pools:
            for at in positions:
                of_query[at] = [ImagePair(queries[at], images[i], 1.0) for i in permitted]
        return list(chain(*of_query))
    if retrieval is None:
        raise DataError("retrieval needs global features of map and queries")
    database, described = retrieval.readers(mapping), retrieval.readers(query)
    for positions, permitted in pools:
        asked = vectors_of(described, [queries[at] for at in positions])
        members = [images[member] for member in permitted.tolist()]
        vectors = vectors_of(database, members)
        index, scores = retrieval.rank(asked, vectors, options.top_k)
        for at, row, row_scores in zip(positions, index.tolist(), scores.tolist(), strict=True):
            of_query[at] = [
                ImagePair(queries[at], members[i], score)
                for i, score in zip(row, row_scores, strict=True)
                if i >= 0  # -1 if there are too few images
            ]
    return list(chain(*of_query))


# options that determine the global feature types and their fusion
RETRIEVAL_OPTIONS = ("global_features", "fusion", *LOCAL_TYPES)


class PairMapping(PipelineStage):
    """Choose pairs of map images to match."""

    name = "mapping_pairs"
    version = 4
    uses = ("mapping_pairs", *RETRIEVAL_OPTIONS)
    explained_by = ("map", "mapping_pairs.by")
    inputs = (
        PipelineStage.mapping,
        SIDE_TABLES,
        paths.GLOBAL_FEATURES,
        PipelineStage.pairing_points,
    )
    outputs = (paths.MAPPING_PAIRS,)

    def is_wanted(self) -> bool:
        return self.options.triangulates()

    def run(self, work: StageWork) -> Mapping[str, float]:
        pairs = pair_map_images(
            work.folder(self.mapping(), paths.FEATURES),
            self.options.mapping_pairs,
            retrieval=self.options.retrieval(),
            tables=read_side_tables(work.path(SIDE_TABLES)),
            covisible=work.folder(paths.REFERENCE) if self.options.pairs_by_points() else None,
        )
        write_pairs(work.out / paths.MAPPING_PAIRS, pairs)
        return {"pairs": len(pairs)}


class PairQueries(PipelineStage):
    """Choose map images to match with each query."""

    version = 3
    uses = ("query_pairs", *RETRIEVAL_OPTIONS)
    explained_by = ("query_pairs.by", "query_pairs.top_k")
    inputs = (PipelineStage.mapping, PipelineStage.query, SIDE_TABLES, paths.GLOBAL_FEATURES)
    outputs = (PipelineStage.candidates,)

    @property
    def name(self) -> str:  # type: ignore[override]
        return "query_pairs" if self.candidates() == paths.QUERY_PAIRS else "query_candidates"

    def run(self, work: StageWork) -> Mapping[str, float]:
        pairs = pair_queries(
            work.folder(self.mapping(), paths.FEATURES),
            work.folder(self.query(), paths.FEATURES),
            self.options.query_pairs,
            retrieval=self.options.retrieval(),
            tables=read_side_tables(work.path(SIDE_TABLES)),
        )
        write_pairs(work.out / self.candidates(), pairs)
        return {"pairs": len(pairs)}
