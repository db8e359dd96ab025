"""Stage: reranking of each query's candidates by local matches.

MegLoc, "Reranking of Global Features".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import OptionError, suggestion
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.retrieval.search import greedy_coverage
from megloc_kapture.stages import paths
from megloc_kapture.stages.matches import VerifiedMatches, candidates_of
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.values import Options

Matched = int | NDArray[np.int64]


class RerankingOptions(Options):
    by: Literal["none", "matches", "verified", "coverage"] = Field(
        default="none",
        description="score of a candidate; matches: number of matches; verified: number of "
        "verified matches; coverage: number of verified matches at query keypoints that better "
        "candidates do not match",
    )
    local_type: str | None = Field(
        default=None,
        description="type or plugin of the local features whose matches are counted; none: all "
        "types together",
    )
    keep: int = Field(default=20, gt=0, description="number of candidates to keep, the paper's N")

    def reranks(self) -> bool:
        return self.by != "none"

    def types_named(self, local_types: Sequence[str]) -> list[str]:
        """Return the types that ``local_type`` selects; all if it is None or nothing is ranked."""
        name = self.local_type
        if name is None or not self.reranks():
            return list(local_types)
        # in a type's name, the name of the weights may follow that of the plugin
        types = [local_type for local_type in local_types if base_type(local_type) == name]
        followed = f"{name}-", f"{name}_"
        return types or [
            local_type for local_type in local_types if local_type.startswith(followed)
        ]

    def counted_types(self, local_types: Sequence[str]) -> list[str]:
        types = self.types_named(local_types)
        if not types:
            raise OptionError(
                f"reranking.local_type: no local features of type {self.local_type!r}; "
                f"{suggestion(str(self.local_type), map(base_type, local_types))}"
            )
        return types


def rerank(
    of_types: Sequence[Sequence[Matched]], options: RerankingOptions
) -> tuple[list[int], list[int]]:
    """Rank the candidates of one query by matches; return kept positions and their counts.

    Ties keep the retrieval order. ``of_types`` has, by type and candidate, the number of matches,
    or for ``coverage`` the matched keypoint rows (K,).
    """
    of_candidates = list(zip(*of_types, strict=True))
    if options.by == "coverage":
        # keypoint k of type t gets the number k * (number of types) + t
        keypoints = [
            np.concatenate(
                [np.unique(rows) * len(of_types) + number for number, rows in enumerate(matched)]
            )
            for matched in of_candidates
        ]
        return greedy_coverage(keypoints, options.keep)
    counts = [sum(map(int, matched)) for matched in of_candidates]
    order = list(range(len(counts)))
    if options.reranks():
        order = sorted(order, key=lambda at: -counts[at])[: options.keep]
    return order, [counts[at] for at in order]


def counted(pair: VerifiedMatches, by: str) -> Matched:
    """Return the quantity that :func:`rerank` compares."""
    if by == "coverage":
        return pair.matches[:, 0]
    return pair.num_found if by == "matches" else len(pair.matches)


def reranked(
    pairs: Sequence[ImagePair],
    query: KaptureFolder,
    matches: Path,
    local_types: Sequence[str],
    options: RerankingOptions,
) -> list[ImagePair]:
    """Rerank candidates by stored matches.

    The score of a pair is its count plus a fraction that keeps the order of equal counts.
    """
    if not options.reranks():
        return list(pairs)
    counted_types = options.counted_types(local_types)
    stored = [_stored(query, matches, name, options.by) for name in counted_types]
    ranking = []
    for image, candidates in candidates_of(pairs).items():
        of_types = [[matched(image, other) for other in candidates] for matched in stored]
        for place, (at, count) in enumerate(zip(*rerank(of_types, options), strict=True)):
            ranking.append(ImagePair(image, candidates[at], count + 1.0 / (2.0 + place)))
    return ranking


def _stored(
    query: KaptureFolder, matches_dir: Path, local_type: str, by: str
) -> Callable[[str, str], Matched]:
    if by != "coverage":
        rows = read_match_counts(matches_dir, local_type)
        counts = {
            pair: row.matches if by == "matches" else row.verified for pair, row in rows.items()
        }
        return lambda image, other: counts.get((image, other), 0)
    matches, none = query.matches(local_type), np.zeros(0, np.int64)

    def matched(image: str, other: str) -> Matched:
        return matches.read(image, other)[0][:, 0] if (image, other) in matches else none

    return matched


class RerankQueries(PipelineStage):
    """Keep each query's best candidates by local matches."""

    name = "query_pairs"
    version = 4
    uses = ("reranking", *LOCAL_TYPES)
    explained_by = ("reranking.by", "reranking.keep", "reranking.local_type")
    inputs = (
        PipelineStage.query,
        paths.LOCAL_FEATURES,
        paths.QUERY_CANDIDATES,
        paths.QUERY_MATCHES,
    )
    outputs = (paths.QUERY_PAIRS,)

    def is_wanted(self) -> bool:
        return self.options.reranking.reranks()

    def run(self, work: StageWork) -> Mapping[str, float]:
        pairs = reranked(
            read_pairs(work.path(paths.QUERY_CANDIDATES)),
            work.folder(self.query(), paths.FEATURES, paths.QUERY_MATCHES),
            work.path(paths.QUERY_MATCHES),
            self.options.local_types(),
            self.options.reranking,
        )
        write_pairs(work.out / paths.QUERY_PAIRS, pairs)
        matched = sum(pair.score >= 1 for pair in pairs)
        return {"pairs": len(pairs), "with_correspondences": matched}
