"""Stage: candidates of queries in a new order, by what local matching makes of them.

MegLoc, section "Image retrieval": M images are retrieved, local features of the query are matched
with each, and the N with the most valid correspondences are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.retrieval.fusion import greedy_coverage
from megloc_kapture.stages.layout import (
    FEATURES,
    LOCAL_FEATURES,
    QUERY_CANDIDATES,
    QUERY_MATCHES,
    QUERY_PAIRS,
)
from megloc_kapture.stages.matches import VerifiedMatches, iterate_candidates
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.values import Options

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions


Matched = int | NDArray[np.int64]


class RerankingOptions(Options):
    """How the retrieved images of a query are put in a new order."""

    by: Literal["none", "matches", "verified", "coverage"] = Field(
        default="none",
        description="matches: their number; verified: of those that two-view geometry leaves; "
        "coverage: of these, at keypoints that the images before do not match. All types of local "
        "features together",
    )
    keep: int = Field(default=20, gt=0, description="images that stay, N")

    def idle(self) -> dict[str, str]:
        return {} if self.reranks() else {"keep": "reranking.by is none"}

    def reranks(self) -> bool:
        """Whether anything is done."""
        return self.by != "none"


def rerank(
    of_types: Sequence[Sequence[Matched]], options: RerankingOptions
) -> tuple[list[int], list[int]]:
    """Positions of the candidates of one query that stay, best first, and what each has.

    Of equal counts, and so where nothing matches, retrieval's order stays.

    Parameters
    ----------
    of_types : of each type of local features and each candidate, in retrieval's order, the number
        of its matches; for coverage the rows (K,) of the query's keypoints that they are of.
    """
    num = len(of_types[0]) if of_types else 0
    if options.by == "coverage":
        rows = [[np.unique(np.asarray(matched)) for matched in own] for own in of_types]
        # keypoints are numbered through the types
        sizes = [max((int(ids[-1]) + 1 for ids in own if len(ids)), default=0) for own in rows]
        starts = np.cumsum([0, *sizes[:-1]])
        keypoints = [
            np.concatenate([start + own[at] for start, own in zip(starts, rows, strict=True)])
            for at in range(num)
        ]
        return greedy_coverage(keypoints, options.keep)
    counts = [sum(int(own[at]) for own in of_types) for at in range(num)]
    order = list(range(num))
    if options.reranks():
        order = sorted(order, key=lambda at: (-counts[at], at))[: options.keep]
    return order, [counts[at] for at in order]


def counted(pair: VerifiedMatches, by: str) -> Matched:
    """What reranking looks at in the matches of a candidate, see :func:`rerank`."""
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
    """Candidates as the options want them, from matches that are stored; sorted by query.

    The score is what a candidate has, and below one a part that keeps their order in the file.

    Parameters
    ----------
    query : with matches of the types.
    matches : the features folder that the matches are in.

    Raises
    ------
    DataError : matches, or the tables of their numbers, are missing or broken.
    """
    if not options.reranks():
        return list(pairs)
    stored = [_stored(query, matches, name, options.by) for name in local_types]
    found = []
    for image, candidates in iterate_candidates(pairs):
        of_types = [[matched(image, other) for other in candidates] for matched in stored]
        for place, (at, count) in enumerate(zip(*rerank(of_types, options), strict=True)):
            found.append(ImagePair(image, candidates[at], count + 1.0 / (2.0 + place)))
    return found


def _stored(
    query: KaptureFolder, matches_dir: Path, local_type: str, by: str
) -> Callable[[str, str], Matched]:
    """Reads what :func:`counted` says of a query and a candidate; of unmatched pairs nothing."""
    if by != "coverage":
        rows = read_match_counts(matches_dir, local_type)
        counts = {
            (row.image, row.other): row.matches if by == "matches" else row.verified for row in rows
        }
        return lambda image, other: counts.get((image, other), 0)
    matches, none = query.matches(local_type), np.zeros(0, np.int64)

    def matched(image: str, other: str) -> Matched:
        return matches.read(image, other)[0][:, 0] if (image, other) in matches else none

    return matched


class RerankQueries(PipelineStage):
    """Keep of each query's candidates those that its local features say are right."""

    name = "query_pairs"
    version = 4
    uses = ("reranking", *LOCAL_TYPES)
    writes = (QUERY_PAIRS,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (self.layout.query, LOCAL_FEATURES, QUERY_CANDIDATES, QUERY_MATCHES)

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.reranking.reranks()

    def run(self, work: StageWork) -> Mapping[str, float]:
        pairs = reranked(
            read_pairs(work.path(QUERY_CANDIDATES)),
            work.folder(self.layout.query, FEATURES, QUERY_MATCHES),
            work.path(QUERY_MATCHES),
            self.options.local_types(),
            self.options.reranking,
        )
        write_pairs(work.out / QUERY_PAIRS, pairs)
        matched = sum(pair.score >= 1 for pair in pairs)
        return {"pairs": len(pairs), "with_correspondences": matched}
