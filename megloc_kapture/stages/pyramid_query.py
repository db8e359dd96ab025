"""Guided pyramid matching of one query that is localized alone, from arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.matching.guided_pyramid import (
    GuidedPyramidOptions,
    PairVerifier,
    extract_variants,
)
from megloc_kapture.matching.pyramid_combination import KeypointUnion, TriedVariant, combine
from megloc_kapture.matching.verification import TwoViewOptions, two_view_of_variants
from megloc_kapture.plugins import LocalFeatureExtractor, Matcher
from megloc_kapture.stages.matches import Features
from megloc_kapture.stages.pyramid_jobs import extraction, match_in_batches

NamedMatches = tuple[str, NDArray[np.int64], NDArray[np.floating]]


def retry_query(
    query: Features,
    matches: Sequence[NamedMatches],
    load: Callable[[str], Features],
    extractor: LocalFeatureExtractor,
    matcher: Matcher,
    *,
    image: Callable[[], NDArray[np.uint8]],
    mask: Callable[[], NDArray[np.bool_] | None],
    verification: TwoViewOptions,
    options: GuidedPyramidOptions,
    name: str = "query",
) -> tuple[NDArray[np.float32], list[NamedMatches]]:
    """Try a query's candidates with few matches again, as :func:`pyramid_queries` does from files.

    Parameters
    ----------
    matches : of each candidate, best first: its name, verified matches (K, 2), scores (K,).
    load : features of a candidate.
    image, mask : of the query; called only where a candidate has few matches.
    name : of the query, for messages.

    Returns
    -------
    The query's keypoints float32 (N + A, C), those that were added behind its own, and the
    candidates with their matches, in their order.

    Raises
    ------
    DataError : the image cannot be read, or its features are of another size than the query's.
    """
    hard = [(len(found), other) for other, found, _ in matches if len(found) < options.min_matches]
    few = [other for _, other in sorted(hard, key=lambda each: -each[0])]
    if options.mode == "off" or not few:
        return query.keypoints_px, list(matches)
    camera = query.camera
    variants, _ = extract_variants(
        image(),
        mask(),
        options.variants(camera.width, camera.height),
        extraction(extractor, name),
        like=query.for_matcher(),
    )

    base = {other: pairs for other, pairs, _ in matches}

    def judge(other: str, features: Features) -> PairVerifier:
        return two_view_of_variants(
            camera, query.keypoints_px, features.camera, features.keypoints_px, base[other],
            verification,
        )  # fmt: skip

    by_other, _ = match_in_batches(variants, few, load, matcher, judge, options)
    found = dict(zip(few, by_other, strict=True))
    keypoints = KeypointUnion(query.keypoints_px)
    richer: list[NamedMatches] = []
    for other, pairs, scores in matches:
        if other in found:
            tried = [TriedVariant(0, each) for each in found[other]]
            combined = combine((pairs, scores), tried, options.mode, (keypoints, None))
            pairs, scores = combined.matches, combined.scores
        richer.append((other, pairs, scores))
    return keypoints.keypoints_px(), richer
