"""The pairs of guided pyramid matching: which are tried again, what came of it, and its files.

What images' variants give lies in a spool until all is there; then the pairs are gone through in
order, so that the rows of added keypoints do not depend on the workers.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.kapture import KaptureFolder, MatchesReader, MatchesWriter
from megloc_kapture.io.kapture.features import feature_folder
from megloc_kapture.matching.guided_pyramid import pyramid_type
from megloc_kapture.matching.pyramid_combination import (
    Combined,
    KeypointUnion,
    TriedVariant,
    combine,
)
from megloc_kapture.stages.pyramid_files import MatchSpool, PyramidFeatures, Spooled
from megloc_kapture.stages.pyramid_jobs import HowToRetry, Retry, described, retry
from megloc_kapture.stages.work import Work

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
_Pair = tuple[str, str]


def table_path(output: Path, local_type: str) -> Path:
    """The table of the pairs of ``local_type`` that were tried, beside their matches."""
    matches = feature_folder(output, "matches", pyramid_type(local_type), orphan=True)
    return matches.with_name("guided_pyramid.csv")


@dataclass(eq=False)
class _Added:
    """What was added to an image: keypoints (A, C), and where their descriptors are spooled."""

    px: NDArray[np.float32] | None = None
    descriptors_at: list[int] = field(default_factory=list)


class PyramidPairs:
    """The pairs of one call: which are tried again, and what came of them."""

    def __init__(
        self,
        first: KaptureFolder,
        second: KaptureFolder,
        how: HowToRetry,
        matches: MatchesReader,
        pairs: Sequence[_Pair],
    ) -> None:
        self._first, self._how, self._matches, self._pairs = first, how, matches, pairs
        # on one side of a pair or on both
        self._both = first is second
        self._keypoints = first.keypoints(how.first_type)
        self._descriptors = first.descriptors(how.first_type)
        self.hard: list[_Pair] = []

    def find_hard(self, can_gain: Callable[[str, str], bool] = lambda first, second: True) -> None:
        """Find the pairs with few matches, the ones with most of them first.

        Parameters
        ----------
        can_gain : of two images, whether they may have matches at all.
        """
        options = self._how.options
        if options.mode == "off":
            return
        found = []
        for pair in self._pairs:
            count = len(self._matches.read(*pair)[0])
            if count < options.min_matches and can_gain(*pair):
                found.append((-count, pair))
        # of equal counts in the order of the pairs
        self.hard = [pair for _, pair in sorted(found, key=lambda each: each[0])]

    def write(self, jobs: Sequence[Retry], output: Path, work: Work) -> dict[str, float]:
        name = pyramid_type(self._how.first_type)
        images = self._images()
        with (
            MatchSpool(output, self._keypoints, self._descriptors) as spool,
            closing(MatchesWriter(output, name, orphan=True)) as writer,
        ):
            retried = _retried(jobs, spool, work)
            added: dict[str, _Added] = defaultdict(_Added)
            rows = []
            hard = set(self.hard)
            totals = _Totals()
            for pair in self._pairs:
                matches, scores = self._matches.read(*pair)
                if pair in hard:
                    combined = self._combine(pair, (matches, scores), retried, spool, added)
                    rows.append(retried.row(pair, len(matches), combined))
                    totals.count(len(matches), combined)
                    matches, scores = combined.matches, combined.scores
                writer.write(*pair, matches, scores)
            features = PyramidFeatures(output, self._keypoints, self._descriptors)
            for image in images:
                own = added.get(image, _Added())
                px = np.zeros((0, self._keypoints.config.dsize), np.float32)
                features.write(
                    image,
                    px if own.px is None else own.px,
                    spool.descriptors(own.descriptors_at),
                )
        write_csv_table(table_path(output, self._how.first_type), COLUMNS, rows)
        seconds = round(retried.seconds / max(len(self.hard), 1), 3)
        return {
            "images_extracted_again": len(jobs),
            "images_extended": sum(own.px is not None for own in added.values()),
            "pairs": len(self._pairs),
            **totals.counts(),
            "seconds_per_tried_pair": seconds,
        }

    def _images(self) -> list[str]:
        """The images that have features, each as many descriptors as keypoints; sorted."""
        images = [
            image for image in sorted(self._first.read().image_names()) if image in self._keypoints
        ]
        for image in images:
            if self._keypoints.length(image) != self._descriptors.length(image):
                raise DataError(
                    f"{self._descriptors.length(image)} descriptors for "
                    f"{self._keypoints.length(image)} keypoints",
                    path=self._descriptors.where(image),
                )
        return images

    def _combine(
        self,
        pair: _Pair,
        base: tuple[NDArray[np.int64], NDArray[np.float64]],
        retried: _AllRetried,
        spool: MatchSpool,
        added: dict[str, _Added],
    ) -> Combined:
        places = retried.of_pair(pair)
        tried = [TriedVariant(0 if image == pair[0] else 1, spool.get(at)) for image, at in places]
        mode = self._how.options.mode
        unions = [
            KeypointUnion(self._keypoints.read(image), added[image].px)
            if at == 0 or self._both
            else None
            for at, image in enumerate(pair)
        ]
        first, second = unions
        if first is None or mode == "off":
            raise ValueError("only pairs that are tried again are combined")
        combined = combine(base, tried, mode, (first, second))
        for image, union, new in zip(pair, unions, combined.added, strict=True):
            if union is not None and len(new):
                added[image].px = union.added()
                added[image].descriptors_at += [
                    places[number][1].descriptor_at(match, spool.row_bytes)
                    for number, match in new.tolist()
                ]
        return combined


@dataclass(eq=False)
class _Totals:
    """Sums over the pairs that were tried."""

    pairs: int = 0
    gained: int = 0
    before: int = 0
    after: int = 0
    added: int = 0

    def count(self, before: int, combined: Combined) -> None:
        self.pairs += 1
        self.gained += len(combined.matches) > before
        self.before += before
        self.after += len(combined.matches)
        self.added += sum(map(len, combined.added))

    def counts(self) -> dict[str, int]:
        return {
            "pairs_tried": self.pairs,
            "pairs_gained": self.gained,
            "matches_before": self.before,
            "matches_after": self.after,
            "keypoints_added": self.added,
        }


@dataclass(eq=False)
class _AllRetried:
    """What the images' variants found, by image and the other one."""

    found: dict[_Pair, list[Spooled]] = field(default_factory=dict)
    num_variants: dict[_Pair, int] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    def of_pair(self, pair: _Pair) -> list[tuple[str, Spooled]]:
        """The variants of both images of a pair that match: whose, and where; in order."""
        a, b = pair
        both = ((a, self.found.get((a, b), ())), (b, self.found.get((b, a), ())))
        return [(image, place) for image, places in both for place in places]

    def row(self, pair: _Pair, before: int, combined: Combined) -> list[str]:
        """The pair's row of the table."""
        a, b = pair
        tried = self.num_variants.get((a, b), 0) + self.num_variants.get((b, a), 0)
        best = ""
        if combined.best is not None:
            image, place = self.of_pair(pair)[combined.best]
            best = f"{'image' if image == a else 'other'} {place.variant}"
        return [
            a,
            b,
            str(before),
            str(len(combined.matches)),
            *(str(len(new)) for new in combined.added),
            str(tried),
            best,
            " | ".join(self._skipped(pair)),
        ]

    def _skipped(self, pair: _Pair) -> Iterator[str]:
        a, b = pair
        for name, image, directed in (("image", a, (a, b)), ("other", b, (b, a))):
            if directed in self.found and self.skipped[image]:
                yield f"{name} {self.skipped[image]}"


def _retried(jobs: Sequence[Retry], spool: MatchSpool, work: Work) -> _AllRetried:
    done = _AllRetried()
    results = work.map(retry, jobs, "guided pyramid")
    for job, result in zip(jobs, results, strict=True):
        done.seconds += result.seconds
        done.skipped[job.image] = described(result.skipped)
        for other, found, count in zip(
            (*job.others, *job.only_scaled), result.found, result.num_variants, strict=True
        ):
            done.found[job.image, other] = [spool.put(matches) for matches in found]
            done.num_variants[job.image, other] = count
    return done
