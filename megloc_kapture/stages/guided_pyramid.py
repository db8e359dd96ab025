"""Guided pyramid matching of one image with others (MegLoc), and its output files.

The result is a keypoints type ``T-pyramid``: the keypoints of T, unchanged, followed by the added
ones, with the matches of all pairs. Indices into T are therefore valid in T-pyramid.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import hard_link
from megloc_kapture.io.kapture import FeatureWriter, KaptureFolder
from megloc_kapture.io.kapture.features import SUFFIX, feature_folder
from megloc_kapture.localization.map_index import ImageMatches
from megloc_kapture.matching.guided_pyramid import (
    GuidedPyramidOptions,
    ImageVariant,
    PairVerifier,
    VariantMatches,
    extract_variants,
    match_variants,
    pyramid_type,
)
from megloc_kapture.matching.pyramid_combination import Combined, KeypointUnion, combine
from megloc_kapture.matching.verification import KnownPoseOptions, two_view_of_variants
from megloc_kapture.plugins import LocalFeatureExtractor, Matcher
from megloc_kapture.stages.local_features import check_lengths, extract_all
from megloc_kapture.stages.matches import Features, NoVerification, Verification, match_all
from megloc_kapture.stages.work import BATCH, batched

_log = logging.getLogger(__name__)

COLUMNS = (
    "image",
    "other",
    "matches_before",
    "matches_after",
    "added_to_image",
    "added_to_other",
    "variants_tried",
    "best_variant",
    "skipped",
)


@dataclass(frozen=True)
class PyramidMethod:
    """Plugins and options of guided pyramid matching.

    Keypoints closer than ``mask_margin_px`` to a masked pixel are dropped.
    """

    extractor: LocalFeatureExtractor
    matcher: Matcher
    verification: Verification
    options: GuidedPyramidOptions
    mask_margin_px: float = 0.0


UNVERIFIED = PairVerifier(lambda _, matches: np.ones(len(matches), dtype=bool))
"""Keeps every match of every variant."""


@dataclass(frozen=True, eq=False)
class MatchedVariants:
    """Matches of an image's variants with each other image.

    ``num_variants`` includes skipped ones; ``skipped`` lists the reasons.
    """

    found: list[list[VariantMatches]]
    num_variants: list[int]
    skipped: str
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
    """Extract the variants of an image and match them with other images.

    Parameters
    ----------
    pixels, mask : RGB (H, W, 3), and True = use (H, W) or None.
    only_scaled : images to match with scaled, unrotated variants; their results come last.
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
    of_scale = [one for one in variants if one.variant.scale != 1.0]
    found: list[list[VariantMatches]] = []
    for names, used in ((others, variants), (only_scaled, of_scale)):
        for batch in batched(names, BATCH):
            loaded = [load(other) for other in batch]
            pairs = [f"pair {name}, {other}" for other in batch]
            match_with = partial(match_all, method.matcher, names=pairs)
            found += match_variants(used, loaded, match_with, list(map(judge, batch, loaded)))
    counts = [len(every)] * len(others) + [len(scaled)] * len(only_scaled)
    return MatchedVariants(found, counts, _described(skipped), time.perf_counter() - started)


def _described(skipped: Mapping[ImageVariant, str]) -> str:
    by_reason: dict[str, list[ImageVariant]] = {}
    for variant, reason in skipped.items():
        by_reason.setdefault(reason, []).append(variant)
    return "; ".join(f"{' '.join(map(str, some))}: {reason}" for reason, some in by_reason.items())


def tried_row(
    pair: tuple[str, str], before: int, combined: Combined, tried: int, best: str, skipped: str
) -> list[str]:
    """Format a row of ``guided_pyramid.csv``; see :data:`COLUMNS`."""
    added = [len(new) for new in combined.added]
    return [*pair, *map(str, (before, len(combined.matches), *added, tried)), best, skipped]


def write_tried(
    output: Path, local_type: str, rows: Sequence[Sequence[str]], seconds: float
) -> dict[str, float]:
    """Write the table of retried pairs, warn of skipped variants, and return sums for the log."""
    path = table_path(output, local_type)
    write_csv_table(path, COLUMNS, rows)
    skipped = Counter(row[-1] for row in rows if row[-1])
    if skipped:
        said = "guided pyramid of %s: variants of %d pairs are skipped, most often %s; see %s"
        often = skipped.most_common(1)[0][0]
        _log.warning(said, local_type, skipped.total(), often, path.name)
    numbers = np.array([row[2:6] for row in rows], np.int64).reshape(-1, 4)
    before, after = numbers[:, 0], numbers[:, 1]
    return {
        "pairs_tried": len(rows),
        "pairs_gained": int((after > before).sum()),
        "matches_before": int(before.sum()),
        "matches_after": int(after.sum()),
        "keypoints_added": int(numbers[:, 2:].sum()),
        "seconds_per_tried_pair": round(seconds / max(len(rows), 1), 3),
    }


def table_path(output: Path, local_type: str) -> Path:
    matches = feature_folder(output, "matches", pyramid_type(local_type), orphan=True)
    return matches.with_name("guided_pyramid.csv")


class PyramidFeatures:
    """Writer of the type ``T-pyramid``, with hard links to unchanged files of T where possible."""

    def __init__(self, output: Path, folder: KaptureFolder, local_type: str) -> None:
        name = pyramid_type(local_type)
        keypoints, descriptors = folder.keypoints(local_type), folder.descriptors(local_type)
        self._left = [image for image in sorted(folder.read().image_names()) if image in keypoints]
        for image in self._left:
            check_lengths(keypoints, descriptors, image)
        # the files keep the method's name, which identifies the extractor
        configs = keypoints.config, replace(descriptors.config, keypoints_type=name)
        self._kinds = [
            (
                source,
                FeatureWriter(output, source.kind, name, config, orphan=True),
                feature_folder(output, source.kind, name, orphan=True),
            )
            for source, config in zip((keypoints, descriptors), configs, strict=True)
        ]

    def write(
        self, image: str, added_px: NDArray[np.float32], added_descriptors: NDArray[Any]
    ) -> None:
        self._left.remove(image)
        added = (added_px, added_descriptors)
        for (source, writer, folder), more in zip(self._kinds, added, strict=True):
            stored = Path(source.where(image))
            if len(more) == 0 and stored.is_file():  # members of a tar cannot be linked
                hard_link(stored, folder / f"{image}{SUFFIX[source.kind]}")
            else:
                writer.write(image, np.concatenate([source.read(image), more]))

    def write_rest(self) -> None:
        px, descriptors = (
            np.zeros((0, source.config.dsize), source.config.dtype) for source, *_ in self._kinds
        )
        for image in list(self._left):
            self.write(image, px, descriptors)


@dataclass(frozen=True, eq=False)
class RetriedQuery:
    """A query after guided pyramid matching.

    Added keypoints (A, C) and descriptors (A, D) follow the query's; matches are in order of the
    candidates.
    """

    added_px: NDArray[np.float32]
    added_descriptors: NDArray[Any]
    matches: list[ImageMatches]
    rows: list[list[str]]
    seconds: float


def retry_query(
    query: Features,
    matches: Sequence[ImageMatches],
    load: Callable[[str], Features],
    method: PyramidMethod,
    frame: Callable[[], tuple[NDArray[np.uint8], NDArray[np.bool_] | None]],
    *,
    num_found: Mapping[str, int] | None = None,
    name: str = "query",
) -> RetriedQuery:
    """Match candidates with few matches again, using variants of the query.

    Parameters
    ----------
    matches : name, verified matches (K, 2) and scores (K,) of each candidate, best first.
    frame : reads pixels and mask of the query; called only if a candidate has few matches.
    num_found : matches of each candidate before verification; by default as in ``matches``.
    """
    base = {other: pairs for other, pairs, _ in matches}
    found = num_found or {}
    hard = [
        other
        for other, pairs in base.items()
        if method.options.is_hard(found.get(other, len(pairs)), len(pairs))
    ]
    mode, verification = method.options.mode, method.verification
    if mode == "off" or not hard:
        return RetriedQuery(
            query.keypoints_px[:0], query.descriptors[:0], list(matches), [], seconds=0.0
        )
    if isinstance(verification, KnownPoseOptions):
        raise ValueError("a query has no pose to verify with")

    def judge(other: str, features: Features) -> PairVerifier:
        if isinstance(verification, NoVerification):
            return UNVERIFIED
        return two_view_of_variants(
            query.camera, query.keypoints_px, features.camera, features.keypoints_px, base[other],
            verification,
        )  # fmt: skip

    matched = match_image_again(query, *frame(), hard, load, judge, method, name=name)
    of_other = dict(zip(hard, zip(matched.found, matched.num_variants, strict=True), strict=True))
    skipped = f"image {matched.skipped}" if matched.skipped else ""
    keypoints = KeypointUnion(query.keypoints_px)
    descriptors: list[NDArray[Any]] = []
    richer: list[ImageMatches] = []
    rows = []
    for other, pairs, scores in matches:
        if other in of_other:
            variants, num_variants = of_other[other]
            tried_ones = [(0, each) for each in variants]
            combined = combine((pairs, scores), tried_ones, mode, (keypoints, None))
            best = "" if combined.best is None else f"image {variants[combined.best].variant}"
            rows.append(tried_row((name, other), len(pairs), combined, num_variants, best, skipped))
            descriptors += [variants[at].descriptors[k] for at, k in combined.added[0].tolist()]
            pairs, scores = combined.matches, combined.scores
        richer.append((other, pairs, scores))
    added = np.array(descriptors, query.descriptors.dtype).reshape(-1, query.descriptors.shape[1])
    return RetriedQuery(keypoints.added(), added, richer, rows, matched.seconds)
