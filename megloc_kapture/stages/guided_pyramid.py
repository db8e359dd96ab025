"""Guided pyramid matching of one image with others, from arrays.

MegLoc, section "Guided pyramid matching": when mapping, both images of a pair are extracted again
at other scales and turns, when localizing the query alone. An image is extracted again once,
however many pairs it is in.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.localization.map_index import ImageMatches
from megloc_kapture.matching.guided_pyramid import (
    GuidedPyramidOptions,
    ImageVariant,
    PairVerifier,
    VariantFeatures,
    VariantMatches,
    extract_variants,
    match_probed,
    match_variants,
)
from megloc_kapture.matching.pyramid_combination import (
    Combined,
    KeypointUnion,
    combine,
)
from megloc_kapture.matching.verification import (
    KnownPoseOptions,
    TwoViewOptions,
    two_view_of_variants,
)
from megloc_kapture.plugins import LocalFeatureExtractor, Matcher
from megloc_kapture.stages.devices import BATCH
from megloc_kapture.stages.local_features import extract_all
from megloc_kapture.stages.matches import Features, match_all
from megloc_kapture.stages.work import batched


@dataclass(frozen=True)
class PyramidMethod:
    """How pairs with few matches are tried again."""

    extractor: LocalFeatureExtractor
    matcher: Matcher
    verification: KnownPoseOptions | TwoViewOptions
    options: GuidedPyramidOptions

    def is_hard(self, num_matches: int) -> bool:
        """Whether a pair with so many verified matches is tried again."""
        return self.options.mode != "off" and num_matches < self.options.min_matches


@dataclass(frozen=True, eq=False)
class MatchedVariants:
    """What the variants of an image came to.

    Attributes
    ----------
    found : for each of the other images the variants that match it.
    num_variants : that were tried with each of these, the skipped ones among them.
    """

    found: list[list[VariantMatches]]
    num_variants: list[int]
    skipped: dict[ImageVariant, str]
    seconds: float


def match_image_again(
    itself: Features,
    pixels: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    others: Sequence[str],
    load: Callable[[str], Features],
    judge: Callable[[str, Features], PairVerifier],
    method: PyramidMethod,
    *,
    only_scaled: Sequence[str] = (),
    name: str,
) -> MatchedVariants:
    """Extract the variants of an image, and match them with other images as they are.

    Parameters
    ----------
    itself : features of the image as it is.
    pixels, mask : RGB (H, W, 3), and True = use (H, W) or None.
    others : matched with all variants; those with most matches first, as they are probed first.
    load : features of another image; not all are in memory at once.
    judge : of the matches with another image, by its name and features.
    only_scaled : matched with the variants of another scale only; in the same order.
    name : of the image, for messages.

    Returns
    -------
    What was found with ``others``, then with ``only_scaled``.

    Raises
    ------
    DataError : its features are of another size than the extractor's.
    """
    started = time.perf_counter()
    every = method.options.variants(itself.camera.width, itself.camera.height)
    scaled = [variant for variant in every if variant.scale != 1.0]
    variants, skipped = extract_variants(
        pixels,
        mask,
        every if others else scaled,
        lambda image, mask: extract_all(method.extractor, [(image, mask)], [name])[0],
        like=itself,
    )

    def match(
        names: Sequence[str], some: Sequence[VariantFeatures], which: range
    ) -> list[list[VariantMatches]]:
        found = []
        for batch in batched(names[which.start : which.stop], BATCH):
            loaded = [load(other) for other in batch]
            judgements = [
                judge(other, features) for other, features in zip(batch, loaded, strict=True)
            ]
            pairs = [f"pair {name}, {other}" for other in batch]
            match_with = partial(match_all, method.matcher, names=pairs)
            found += match_variants(some, loaded, match_with, judgements)
        return found

    found: list[list[VariantMatches]] = []
    counts: list[int] = []
    of_scale = [one for one in variants if one.variant.scale != 1.0]
    for names, used, num in ((others, variants, every), (only_scaled, of_scale, scaled)):
        matches, num_left = match_probed(used, len(names), partial(match, names), method.options)
        probed = min(len(names), method.options.probed_pairs)
        found += matches
        counts += [len(num)] * probed + [num_left] * (len(names) - probed)
    return MatchedVariants(found, counts, skipped, time.perf_counter() - started)


@dataclass(eq=False)
class RetriedPairs:
    """Sums over the pairs that were tried, and a row of ``guided_pyramid.csv`` for each."""

    rows: list[list[str]] = field(default_factory=list)
    gained: int = 0
    before: int = 0
    after: int = 0
    added: int = 0
    seconds: float = 0.0

    def count(
        self, pair: tuple[str, str], before: int, combined: Combined, tried: int, *told: str
    ) -> None:
        """Add a pair: matches that it had, what it has, variants tried, best one, skipped ones."""
        after, added = len(combined.matches), [len(new) for new in combined.added]
        self.gained += after > before
        self.before += before
        self.after += after
        self.added += sum(added)
        self.rows.append([*pair, *map(str, (before, after, *added, tried)), *told])

    def add(self, other: RetriedPairs) -> None:
        """Add the pairs of another image."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def counts(self) -> dict[str, float]:
        """For the log; seconds are of one worker."""
        return {
            "pairs_tried": len(self.rows),
            "pairs_gained": self.gained,
            "matches_before": self.before,
            "matches_after": self.after,
            "keypoints_added": self.added,
            "seconds_per_tried_pair": round(self.seconds / max(len(self.rows), 1), 3),
        }


@dataclass(frozen=True, eq=False)
class RetriedQuery:
    """A query after guided pyramid matching.

    Attributes
    ----------
    added_px, added_descriptors : (A, C) and (A, D), keypoints behind the query's own.
    matches : of all candidates, in their order.
    """

    added_px: NDArray[np.float32]
    added_descriptors: NDArray[Any]
    matches: list[ImageMatches]
    tried: RetriedPairs


def retry_query(
    query: Features,
    matches: Sequence[ImageMatches],
    load: Callable[[str], Features],
    method: PyramidMethod,
    frame: Callable[[], tuple[NDArray[np.uint8], NDArray[np.bool_] | None]],
    *,
    name: str = "query",
) -> RetriedQuery:
    """Try a query's candidates with few matches again: its variants with the map's keypoints.

    Parameters
    ----------
    matches : of each candidate, best first: its name, verified matches (K, 2), scores (K,).
    load : features of a candidate.
    frame : pixels and mask of the query; called only where a candidate has few matches.
    name : of the query, for messages.

    Raises
    ------
    DataError : the image cannot be read, or its features are of another size than the query's.
    """
    tried = RetriedPairs()
    base = {other: pairs for other, pairs, _ in matches}
    hard = [other for other, pairs in base.items() if method.is_hard(len(pairs))]
    hard.sort(key=lambda other: -len(base[other]))
    mode = method.options.mode
    if mode == "off" or not hard:
        nothing = query.keypoints_px[:0], query.descriptors[:0]
        return RetriedQuery(*nothing, list(matches), tried)
    verification = method.verification
    if not isinstance(verification, TwoViewOptions):
        raise ValueError("a query has no pose to verify with")

    def judge(other: str, features: Features) -> PairVerifier:
        return two_view_of_variants(
            query.camera, query.keypoints_px, features.camera, features.keypoints_px, base[other],
            verification,
        )  # fmt: skip

    matched = match_image_again(query, *frame(), hard, load, judge, method, name=name)
    tried.seconds = matched.seconds
    of_other = dict(zip(hard, zip(matched.found, matched.num_variants, strict=True), strict=True))
    skipped = described(matched.skipped)
    keypoints = KeypointUnion(query.keypoints_px)
    descriptors: list[NDArray[Any]] = []
    richer: list[ImageMatches] = []
    for other, pairs, scores in matches:
        if other in of_other:
            found, num_variants = of_other[other]
            tried_ones = [(0, each) for each in found]
            combined = combine((pairs, scores), tried_ones, mode, (keypoints, None))
            best = "" if combined.best is None else f"image {found[combined.best].variant}"
            why = f"image {skipped}" if skipped else ""
            tried.count((name, other), len(pairs), combined, num_variants, best, why)
            descriptors += [found[at].descriptors[k] for at, k in combined.added[0].tolist()]
            pairs, scores = combined.matches, combined.scores
        richer.append((other, pairs, scores))
    added = np.array(descriptors, query.descriptors.dtype).reshape(-1, query.descriptors.shape[1])
    return RetriedQuery(keypoints.added(), added, richer, tried)


def described(skipped: Mapping[ImageVariant, str]) -> str:
    """The variants that gave nothing, and why, as one line; those of one reason together."""
    by_reason: dict[str, list[ImageVariant]] = {}
    for variant, reason in skipped.items():
        by_reason.setdefault(reason, []).append(variant)
    return "; ".join(
        f"{' '.join(map(str, variants))}: {reason}" for reason, variants in by_reason.items()
    )
