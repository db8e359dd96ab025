"""Stage: candidates of queries in a new order, by what local matching makes of them.

MegLoc, section "Image retrieval": M images are retrieved, local features of the query are matched
with each, and the N with the most valid correspondences are kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.retrieval.reranking import greedy_coverage
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


Pair = tuple[str, str]
Counted = Literal["matches", "verified"]


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


def rerank_pairs(
    pairs: Sequence[ImagePair], counts: Mapping[Pair, int], keep: int
) -> list[ImagePair]:
    """The ``keep`` candidates of each query with the most correspondences, best first.

    Of equal counts, and so where nothing matches, retrieval's order stays. Sorted by query. The
    score is the count, and below one a part that keeps that order in the file.

    Parameters
    ----------
    counts : (query, map image) to correspondences; 0 for pairs that are not in it.
    """
    found = []
    for query, images in iterate_candidates(pairs):
        own = [counts.get((query, image), 0) for image in images]
        for place, rank in enumerate(_greatest(own, keep)):
            found.append(ImagePair(query, images[rank], own[rank] + 1.0 / (2.0 + place)))
    return found


def _greatest(counts: Sequence[int], keep: int) -> list[int]:
    """Positions of the greatest counts, greatest first; of equal ones the first stays first."""
    return sorted(range(len(counts)), key=lambda at: (-counts[at], at))[:keep]


def reranked(
    pairs: Sequence[ImagePair],
    query: KaptureFolder,
    matches: Path,
    local_types: Sequence[str],
    options: RerankingOptions,
) -> list[ImagePair]:
    """Candidates as the options want them, from matches that are stored.

    Parameters
    ----------
    query : with keypoints and matches of the types.
    matches : the features folder that the matches are in.

    Raises
    ------
    DataError : matches are missing or broken.
    """
    if options.by == "none":
        return list(pairs)
    if options.by == "coverage":
        return cover_pairs(pairs, matched_keypoints(query, local_types), options.keep)
    return rerank_pairs(pairs, correspondences(matches, local_types, options.by), options.keep)


def kept_candidates(
    of_types: Sequence[Sequence[VerifiedMatches]], options: RerankingOptions
) -> list[int]:
    """Positions of the candidates of one query that stay, best first, as :func:`reranked` has it.

    Parameters
    ----------
    of_types : of each type of local features the matches with each candidate, best first.
    """
    count = len(of_types[0]) if of_types else 0
    if options.by == "none":
        return list(range(count))
    if options.by == "coverage":
        rows = [[np.unique(pair.matches[:, 0]) for pair in own] for own in of_types]
        # keypoints are numbered through the types
        sizes = [max((int(ids[-1]) + 1 for ids in own if len(ids)), default=0) for own in rows]
        starts = np.cumsum([0, *sizes[:-1]])
        keypoints = [
            np.concatenate([start + own[at] for start, own in zip(starts, rows, strict=True)])
            for at in range(count)
        ]
        return greedy_coverage(keypoints, options.keep)[0]
    by_matches = options.by == "matches"
    counts = [
        sum(own[at].num_found if by_matches else len(own[at].matches) for own in of_types)
        for at in range(count)
    ]
    return _greatest(counts, options.keep)


def cover_pairs(
    pairs: Sequence[ImagePair],
    matched: Callable[[str, str], NDArray[np.int64]],
    keep: int,
) -> list[ImagePair]:
    """The ``keep`` candidates of each query that together match most of its keypoints.

    As :func:`rerank_pairs`; the score counts the keypoints that an image adds.

    Parameters
    ----------
    matched : of (query, map image) the query's keypoints that are matched, numbered through its
        types; see :func:`matched_keypoints`.
    """
    found = []
    for query, images in iterate_candidates(pairs):
        order, added = greedy_coverage([matched(query, image) for image in images], keep)
        for place, (at, count) in enumerate(zip(order, added, strict=True)):
            found.append(ImagePair(query, images[at], count + 1.0 / (2.0 + place)))
    return found


def matched_keypoints(
    query: KaptureFolder, local_types: Sequence[str]
) -> Callable[[str, str], NDArray[np.int64]]:
    """Reads the keypoints of a query that a map image matches; see :func:`cover_pairs`.

    Parameters
    ----------
    query : with keypoints and matches of the types.
    """
    readers = [(query.keypoints(name), query.matches(name)) for name in local_types]

    def matched(image: str, other: str) -> NDArray[np.int64]:
        ids, first = [np.zeros(0, np.int64)], 0
        for keypoints, matches in readers:
            if (image, other) in matches:
                ids.append(first + np.unique(matches.read(image, other)[0][:, 0]))
            first += keypoints.length(image)
        return np.concatenate(ids)

    return matched


def correspondences(features_dir: Path, local_types: Iterable[str], by: Counted) -> Counter[Pair]:
    """(query, map image) to correspondences, the sum over types of local features.

    Parameters
    ----------
    features_dir : where :func:`~megloc_kapture.stages.matches.match_pairs` wrote them.

    Raises
    ------
    DataError : there is no table of counts, or a broken one.
    """
    total: Counter[Pair] = Counter()
    for local_type in local_types:
        for row in read_match_counts(features_dir, local_type):
            total[row.image, row.other] += row.matches if by == "matches" else row.verified
    return total


class RerankQueries(PipelineStage):
    """Keep of each query's candidates those that its local features say are right."""

    name = "query_pairs"
    version = 3
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
