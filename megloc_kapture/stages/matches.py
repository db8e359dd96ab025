"""Stage: match local features of image pairs, verified; stored as kapture matches.

Mapping pairs are verified with their known poses, query pairs by a two-view model.
"""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.kapture import (
    FeatureReader,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
)
from megloc_kapture.io.tables import PairCount, write_match_counts
from megloc_kapture.matching.verification import (
    KnownPoseOptions,
    TwoViewOptions,
    ray_slopes,
    verify_two_view,
    verify_with_poses,
)
from megloc_kapture.plugins import Matcher
from megloc_kapture.stages.layout import (
    FEATURES,
    LOCAL_FEATURES,
    MAP,
    MAPPING_MATCHES,
    MAPPING_PAIRS,
    QUERY_MATCHES,
)
from megloc_kapture.stages.map_points import matched_images
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, FolderSpec, Work
from megloc_kapture.values import Camera, ImageFeatures, Options

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions


Item = TypeVar("Item")

_CACHE_BYTES = 256 << 20  # descriptors kept per process: about a hundred images
BATCH = 8  # pairs that a matcher gets at once, where it can use them


class NoVerification(Options):
    """Keep every match."""

    kind: Literal["none"] = "none"


Verification = KnownPoseOptions | TwoViewOptions | NoVerification


@dataclass(frozen=True, eq=False)
class Features:
    """What matching needs of one image: keypoints (N, 2 or more), rays (N, 3), descriptors."""

    camera: Camera
    keypoints_px: NDArray[np.float32]
    rays: NDArray[np.float64]
    descriptors: NDArray[Any]

    @classmethod
    def of(
        cls, camera: Camera, keypoints_px: NDArray[np.float32], descriptors: NDArray[Any]
    ) -> Features:
        """With the rays of the keypoints."""
        return cls(camera, keypoints_px, bearing_rays(camera, keypoints_px[:, :2]), descriptors)

    def for_matcher(self) -> ImageFeatures:
        """What a matcher gets of them."""
        return ImageFeatures(
            self.keypoints_px, self.descriptors, self.camera.width, self.camera.height
        )

    @cached_property
    def slopes(self) -> NDArray[np.float64]:
        """``ray_slopes`` of the keypoints (N, 2, 2), worked out when first asked for."""
        return ray_slopes(self.camera, self.keypoints_px[:, :2], self.rays)


@dataclass(frozen=True)
class _Job:
    first: FolderSpec
    second: FolderSpec
    local_type: str
    matcher: Matcher
    verification: Verification
    image: str
    others: tuple[str, ...]


_PairMatches = tuple[NDArray[np.int64], NDArray[np.float32]]


class VerifiedMatches(NamedTuple):
    """Matches of a pair that are verified, their scores, and how many there were before."""

    matches: NDArray[np.int64]
    scores: NDArray[np.float32]
    num_found: int


def match_pairs(
    first: KaptureFolder,
    second: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    matcher: Matcher,
    verification: Verification,
    output: Path,
    *,
    work: Work = HERE,
) -> dict[str, int]:
    """Match each pair (image of ``first``, image of ``second``) and write what is verified.

    A pair without verified matches is written with none, so that it is known to be done. How many
    matches each pair had before and has after verification stands in ``match_counts.csv``.

    Returns
    -------
    Counts for the log: pairs, pairs with matches, matches.
    """
    specs = [FolderSpec(f) for f in (first, second)]
    jobs = []
    within_one = first.root == second.root
    ordered = sorted(
        {
            # within a map (a, b) and (b, a) are one pair, kept in one file
            (min(pair.query, pair.map), max(pair.query, pair.map))
            if within_one
            else (pair.query, pair.map)
            for pair in pairs
        }
    )
    for image, group in groupby(ordered, key=lambda pair: pair[0]):
        others = tuple(other for _, other in group)
        jobs.append(_Job(specs[0], specs[1], local_type, matcher, verification, image, others))
    writer = MatchesWriter(output, local_type, orphan=True)
    counts: list[PairCount] = []
    for job, found in zip(jobs, work.map(_match, jobs, "matching"), strict=True):
        for other, pair in zip(job.others, found, strict=True):
            writer.write(job.image, other, pair.matches, pair.scores)
            counts.append(PairCount(job.image, other, pair.num_found, len(pair.matches)))
    write_match_counts(output, local_type, counts)
    return {
        "pairs": len(ordered),
        "pairs_with_matches": sum(count.verified > 0 for count in counts),
        "matches": sum(count.verified for count in counts),
    }


def _match(job: _Job) -> list[VerifiedMatches]:
    first, second = job.first.open(), job.second.open()
    features = cached_features(job.first, first, job.local_type, job.image)
    found: list[VerifiedMatches] = []
    for others in batched(job.others, BATCH):  # not all at once: their features are in memory
        found += match_and_verify(
            features,
            [cached_features(job.second, second, job.local_type, other) for other in others],
            job.matcher,
            [
                _relative_verification(job.verification, first, second, job.image, other)
                for other in others
            ],
        )
    return found


def match_and_verify(
    a: Features, others: Sequence[Features], matcher: Matcher, verifications: Sequence[Any]
) -> list[VerifiedMatches]:
    """Match one image with several, and keep the matches that are verified.

    Parameters
    ----------
    verifications : for each pair a function of (a, other, matches) that is the mask of those to
        keep.
    """
    matched = match_all(matcher, a.for_matcher(), [other.for_matcher() for other in others])
    found = []
    for other, verify, (matches, scores) in zip(others, verifications, matched, strict=True):
        good = verify(a, other, matches) if len(matches) else np.zeros(0, bool)
        found.append(VerifiedMatches(matches[good], scores[good], len(matches)))
    return found


def match_all(
    matcher: Matcher, a: ImageFeatures, others: Sequence[ImageFeatures]
) -> list[_PairMatches]:
    """Matches of one image with each of several, at once where the matcher can."""
    at_once = getattr(matcher, "match_many", None)
    if at_once is None:
        return [matcher.match(a, other) for other in others]
    found: list[_PairMatches] = []
    for batch in batched(others, BATCH):
        found += at_once(a, batch)
    return found


def batched(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    """The items in lists of at most ``size``."""
    waiting = iter(items)
    while batch := list(islice(waiting, size)):
        yield batch


def two_view_verification(options: TwoViewOptions) -> Any:
    """Verification by a two-view model, for :func:`match_and_verify`."""

    def verify(a: Features, b: Features, matches: NDArray[np.int64]) -> NDArray[np.bool_]:
        return verify_two_view(
            a.keypoints_px[matches[:, 0], :2],
            a.camera,
            b.keypoints_px[matches[:, 1], :2],
            b.camera,
            options,
        )

    return verify


def _relative_verification(
    options: Verification, first: KaptureFolder, second: KaptureFolder, image: str, other: str
) -> Any:
    if isinstance(options, TwoViewOptions):
        return two_view_verification(options)
    if isinstance(options, NoVerification):
        return lambda a, b, matches: np.ones(len(matches), dtype=bool)
    a_from_world = first.read().cam_from_world(image)
    b_from_world = second.read().cam_from_world(other)

    def verify(a: Features, b: Features, matches: NDArray[np.int64]) -> NDArray[np.bool_]:
        if a_from_world is None or b_from_world is None:
            return np.zeros(len(matches), dtype=bool)
        rows_a, rows_b = matches.T
        return verify_with_poses(
            a.rays[rows_a],
            a.slopes[rows_a],
            b.rays[rows_b],
            b.slopes[rows_b],
            b_from_world @ a_from_world.inverse(),
            options,
        )

    return verify


def read_features(
    keypoints: FeatureReader, descriptors: FeatureReader, camera: Camera, image: str
) -> Features:
    """Read what matching needs of one image."""
    return Features.of(camera, keypoints.read(image), descriptors.read(image))


class FeatureCache:
    """Features of the images used last, bounded in bytes; shared by threads."""

    def __init__(self, max_bytes: int = _CACHE_BYTES) -> None:
        self._items: OrderedDict[Hashable, Features] = OrderedDict()
        self._bytes = 0
        self._max_bytes = max_bytes
        self._lock = threading.Lock()

    def get(self, key: Hashable, load: Callable[[], Features]) -> Features:
        """The features of a key, loaded when they are not there."""
        with self._lock:
            if key in self._items:
                self._items.move_to_end(key)
                return self._items[key]
        features = load()
        with self._lock:
            if key not in self._items:
                self._items[key] = features
                self._bytes += _size(features)
            while self._bytes > self._max_bytes and len(self._items) > 1:
                _, old = self._items.popitem(last=False)
                self._bytes -= _size(old)
        return features


def _size(features: Features) -> int:
    slopes = 4 * features.rays.itemsize * len(features.rays)  # there or not
    arrays = (features.descriptors, features.keypoints_px, features.rays)
    return sum(array.nbytes for array in arrays) + slopes


_cache = FeatureCache()


def cached_features(
    spec: FolderSpec, folder: KaptureFolder, local_type: str, image: str
) -> Features:
    """The features of an image of a folder that a work item opened; kept in this process."""
    return _cache.get(
        (*spec.key, local_type, image),
        lambda: read_features(
            folder.keypoints(local_type),
            folder.descriptors(local_type),
            folder.read().camera_of(image),
            image,
        ),
    )


def iterate_candidates(pairs: Sequence[ImagePair]) -> Iterator[tuple[str, list[str]]]:
    """Queries with their candidates, best first; queries sorted."""
    candidates: dict[str, list[ImagePair]] = {}
    for pair in pairs:
        candidates.setdefault(pair.query, []).append(pair)
    for query in sorted(candidates):
        best_first = sorted(candidates[query], key=lambda pair: (-pair.score, pair.map))
        yield query, [pair.map for pair in best_first]


# what decides which types of local features there are, and how each is matched
MATCHING_OPTIONS = ("map", "local_features", "given_features", "matching", "verification")


class MatchMapping(PipelineStage):
    """Match and verify pairs of map images."""

    name = "mapping_matches"
    version = 2
    uses = (*MATCHING_OPTIONS, "mapping_verification")
    writes = (MAPPING_MATCHES,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (self.layout.mapping, LOCAL_FEATURES, MAPPING_PAIRS)

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.triangulates()

    def plugins(self) -> Sequence[object]:
        return [self.options.make_matcher(name) for name in self.options.own_types()]

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping = work.folder(self.layout.mapping, FEATURES)
        pairs = read_pairs(work.path(MAPPING_PAIRS))
        counts: Counter[str] = Counter()
        for local_type in self.options.own_types():
            found = match_pairs(
                mapping,
                mapping,
                pairs,
                local_type,
                self.options.make_matcher(local_type),
                self.options.verify_mapping(),
                work.out / MAPPING_MATCHES,
                work=work,
            )
            counts.update(found)
        return counts


class MatchQueries(PipelineStage):
    """Match and verify queries with their candidates; where those are reranked, with all."""

    name = "query_matches"
    version = 3
    uses = (*MATCHING_OPTIONS, "query_verification")
    writes = (QUERY_MATCHES,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        given = (MAP,) if self.options.uses_given_map() else ()
        images = (self.layout.mapping, self.layout.query)
        return (*images, LOCAL_FEATURES, self.layout.candidates, *given)

    def plugins(self) -> Sequence[object]:
        return [self.options.make_matcher(name) for name in self.options.local_types()]

    def run(self, work: StageWork) -> Mapping[str, float]:
        pairs = read_pairs(work.path(self.layout.candidates))
        counts: Counter[str] = Counter()
        for local_type in self.options.local_types():
            mapping = matched_images(work, self, local_type)
            described = mapping.descriptors(local_type)
            found = match_pairs(
                work.folder(self.layout.query, FEATURES),
                mapping,
                [pair for pair in pairs if pair.map in described],
                local_type,
                self.options.make_matcher(local_type),
                self.options.verify_queries(),
                work.out / QUERY_MATCHES,
                work=work,
            )
            counts.update(found)
        return counts
