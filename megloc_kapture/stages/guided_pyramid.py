"""Guided pyramid matching of one image with others, and the files that hold what it adds.

MegLoc, section "Guided pyramid matching": when mapping, both images of a pair are extracted again
at other scales and turns, when localizing the query alone. An image is extracted again once,
however many pairs it is in.

What comes of it is a keypoints type of its own: ``T-pyramid`` has of every image the keypoints of T
first, unchanged, then those that were added, and the matches of all pairs. So every index into T is
one into T-pyramid, and what reads kapture reads it.
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

from megloc_kapture.errors import DataError
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
from megloc_kapture.stages.devices import BATCH
from megloc_kapture.stages.local_features import extract_all
from megloc_kapture.stages.matches import Features, NoVerification, Verification, match_all
from megloc_kapture.stages.work import batched

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
    """How pairs with few matches are tried again.

    ``mask_margin_px``: keypoints nearer than this to a masked pixel are none.
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
    """Matches of an image's variants.

    Attributes
    ----------
    found : for each of the other images the variants that match it.
    num_variants : number of variants tried with each of these, skipped ones included.
    skipped : the variants without features, grouped by reason.
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
    """Extract the variants of an image, and match them with other images as they are.

    Parameters
    ----------
    itself : features of the image as it is.
    pixels, mask : RGB (H, W, 3), and True = use (H, W) or None.
    others : matched with all variants.
    load : features of another image; a few at a time are in memory.
    judge : the verifier of the matches with another image, by its name and features.
    only_scaled : matched with the variants of another scale only. Their results follow those of
        ``others``.
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
    """A pair as ``guided_pyramid.csv`` has it, see :data:`COLUMNS`."""
    added = [len(new) for new in combined.added]
    return [*pair, *map(str, (before, len(combined.matches), *added, tried)), best, skipped]


def write_tried(
    output: Path, local_type: str, rows: Sequence[Sequence[str]], seconds: float
) -> dict[str, float]:
    """Write the table of pairs that were tried; returns its sums for the log.

    ``seconds`` are those that all workers took together. Warns of variants that were skipped.
    """
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
    """The table of the pairs of ``local_type`` that were tried, beside their matches."""
    matches = feature_folder(output, "matches", pyramid_type(local_type), orphan=True)
    return matches.with_name("guided_pyramid.csv")


class PyramidFeatures:
    """Writes the type ``T-pyramid``: of each image the features of T, then those added.

    Files of images that nothing was added to are hard links to those of T where the file system
    has them, so that they take no space twice. Raises DataError where an image of ``folder`` has
    more or fewer descriptors of ``local_type`` than keypoints.
    """

    def __init__(self, output: Path, folder: KaptureFolder, local_type: str) -> None:
        name = pyramid_type(local_type)
        keypoints, descriptors = folder.keypoints(local_type), folder.descriptors(local_type)
        self._left = [image for image in sorted(folder.read().image_names()) if image in keypoints]
        for image in self._left:
            lengths = descriptors.length(image), keypoints.length(image)
            if lengths[0] != lengths[1]:
                message = f"{lengths[0]} descriptors for {lengths[1]} keypoints"
                raise DataError(message, path=descriptors.where(image))
        # the name in the files stays that of the method: by it the extractor is found again
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
        """Write an image's features, with those added to it."""
        self._left.remove(image)
        added = (added_px, added_descriptors)
        for (source, writer, folder), more in zip(self._kinds, added, strict=True):
            stored = Path(source.where(image))
            if len(more) == 0 and stored.is_file():  # else it is a member of a tar
                hard_link(stored, folder / f"{image}{SUFFIX[source.kind]}")
            else:
                writer.write(image, np.concatenate([source.read(image), more]))

    def write_rest(self) -> None:
        """Write the features of the images that nothing is added to."""
        px, descriptors = (
            np.zeros((0, source.config.dsize), source.config.dtype) for source, *_ in self._kinds
        )
        for image in list(self._left):
            self.write(image, px, descriptors)


@dataclass(frozen=True, eq=False)
class RetriedQuery:
    """A query after guided pyramid matching.

    Attributes
    ----------
    added_px, added_descriptors : (A, C) and (A, D), keypoints behind the query's own.
    matches : of all candidates, in their order.
    rows : of the candidates that were tried, see :data:`COLUMNS`; and the seconds it took.
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
    """Try a query's candidates with few matches again: its variants with the map's keypoints.

    Parameters
    ----------
    matches : of each candidate, best first: its name, verified matches (K, 2), scores (K,).
    load : features of a candidate.
    frame : pixels and mask of the query; called only where a candidate has few matches.
    num_found : matches of each candidate before verification; as many as in ``matches`` unless
        given.
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
