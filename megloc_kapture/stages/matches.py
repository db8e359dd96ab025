"""Stage: local feature matching and verification of image pairs, stored as kapture matches."""

from __future__ import annotations

import logging
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import combinations, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import PluginError, require
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.kapture import (
    FeatureReader,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
)
from megloc_kapture.io.tables import (
    PairCount,
    append_match_counts,
    read_match_counts,
    write_match_counts,
)
from megloc_kapture.matching.guided_pyramid import verify_best_first
from megloc_kapture.matching.pose_check import PairEvidence, count_fitting, pose_contradiction
from megloc_kapture.matching.verification import (
    KnownPoseOptions,
    TwoViewOptions,
    agree_by_chance,
    ray_slopes,
    verify_two_view,
    verify_with_poses,
)
from megloc_kapture.plugin_loading import checked_array
from megloc_kapture.plugins import Matcher, PluginChoice
from megloc_kapture.stages import paths
from megloc_kapture.stages.local_features import check_lengths
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, Batched, Work, batched, in_batches
from megloc_kapture.values import Camera, ImageFeatures, Options, RigidTransform

_log = logging.getLogger(__name__)

CACHED_IMAGES = 80  # in each process; about 250 MB of RootSIFT
_PAIRS_PER_ITEM = 32  # pairs of one image, whose features are read once
# the given poses are checked against the matches within this number of image groups
_CHECKED_GROUPS = 6
# a group has one image, and those with these ranks among its partners, the most similar first
_RANKS = (0, 1, 3, 7, 15)


Verification = KnownPoseOptions | TwoViewOptions | None
"""Options of a verification by known poses or by a two-view model; None keeps every match."""


class SecondMatchingOptions(Options):
    """Second pass of matching: some pairs of each image are matched again by another matcher."""

    matcher: PluginChoice | None = Field(
        default=None,
        description="matcher whose matches replace those of the best pairs; none: no second pass",
    )
    pairs: int = Field(
        default=5,
        gt=0,
        description="number of pairs per image that are matched again: those of a query, or of a "
        "map image, that have the most verified matches",
    )
    min_matches: int | None = Field(
        default=None,
        gt=0,
        description="match again only pairs with fewer verified matches; none: all",
    )
    queries: bool = Field(
        default=True, description="also match queries again; false: only map images"
    )


@dataclass(frozen=True, eq=False)
class Features(ImageFeatures):
    """Local features of one image, with lazily computed rays and slopes."""

    camera: Camera

    @classmethod
    def of(
        cls, camera: Camera, keypoints_px: NDArray[np.float32], descriptors: NDArray[Any]
    ) -> Features:
        """Create from keypoints (N, 2 or more) and descriptors (N, D)."""
        return cls(keypoints_px, descriptors, camera.width, camera.height, camera)

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """Unit rays of the keypoints (N, 3)."""
        return bearing_rays(self.camera, self.keypoints_px[:, :2])

    @cached_property
    def slopes(self) -> NDArray[np.float64]:
        """``ray_slopes`` of the keypoints (N, 2, 2)."""
        return ray_slopes(self.camera, self.keypoints_px[:, :2], self.rays)


_PairMatches = tuple[NDArray[np.int64], NDArray[np.float32]]


class VerifiedMatches(NamedTuple):
    """Verified matches of a pair, their scores, and the number of matches before verification."""

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
    """Match image pairs of two folders and write the verified matches; return counts for the log.

    A pair without verified matches is also written, which marks it as finished.
    """
    within_one = first.root == second.root
    # within a map (a, b) and (b, a) are one pair, stored in one file, and (a, a) is not a pair
    if within_one:
        ordered = sorted({one_way(pair) for pair in pairs if pair.query != pair.map})
    else:
        ordered = sorted({(pair.query, pair.map) for pair in pairs})
    writer = MatchesWriter(output, local_type, orphan=True)
    counts: dict[tuple[str, str], PairCount] = {}
    if work.resume:
        counts = read_match_counts(output, local_type, missing_ok=True)
    todo, label = work.unfinished(
        ordered, lambda pair: pair in writer and pair in counts, "matching"
    )
    jobs: list[_Job] = []
    for image, group in groupby(todo, key=itemgetter(0)):
        jobs += [(image, some) for some in batched((b for _, b in group), _PAIRS_PER_ITEM)]
    folders = first, second
    verify = partial(_verify, folders, local_type, verification)
    steps = _matching(folders, local_type, matcher, verify)
    results = work.map(steps, jobs, label)
    for (image, others), verified_pairs in zip(jobs, results, strict=True):
        new_counts = [
            PairCount(image, other, pair.num_found, len(pair.matches))
            for other, pair in zip(others, verified_pairs, strict=True)
        ]
        counts |= {(image, count.other): count for count in new_counts}
        append_match_counts(output, local_type, new_counts)
        for other, pair in zip(others, verified_pairs, strict=True):
            writer.write(image, other, pair.matches, pair.scores)  # marks the pair as finished
    rows = [counts[pair] for pair in ordered]
    write_match_counts(output, local_type, rows)
    return {
        "pairs": len(ordered),
        "pairs_with_matches": sum(row.verified > 0 for row in rows),
        "matches": sum(row.verified for row in rows),
    }


def pairs_to_rematch(
    verified: Mapping[tuple[str, str], int], options: SecondMatchingOptions, *, of_both: bool
) -> list[tuple[str, str]]:
    """Return the pairs of the second matching, from the number of verified matches of all pairs.

    These are the ``pairs`` best of each first image; with ``min_matches``, the best of those with
    fewer matches. With ``of_both``, also those of each second image; a pair then counts for both of
    its images. Ties are broken by name, and the result is sorted by name.
    """
    limit = options.min_matches
    eligible = [pair for pair, n in verified.items() if limit is None or n < limit]
    chosen: set[tuple[str, str]] = set()
    taken: Counter[str] = Counter()
    for pair in sorted(eligible, key=lambda pair: (-verified[pair], pair)):
        for image in pair if of_both else pair[:1]:
            taken[image] += 1
            if taken[image] <= options.pairs:
                chosen.add(pair)
    return sorted(chosen)


def check_given_poses(
    mapping: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    matcher: Matcher,
    work: Work = HERE,
) -> None:
    """Compare the given poses of map images with two-view models of a sample of their pairs.

    Log a warning if some poses contradict the matches. If most do, raise DataError unless
    ``work.force``.
    """
    finish = partial(_evidence, mapping, local_type)
    steps = _matching((mapping, mapping), local_type, matcher, finish)
    evidence = work.map(steps, _sampled(pairs), "checking the given poses")
    contradiction = pose_contradiction([pair for of_image in evidence for pair in of_image])
    if contradiction is None:
        return
    message, most = contradiction
    require(not most or work.force, f"{message} (--force continues anyway)", path=mapping.root)
    _log.warning("%s", message)


def _sampled(pairs: Sequence[ImagePair]) -> list[_Job]:
    """Sample pairs within groups of similar images; the groups are spread over the map.

    Among pairs of equal score, images with close positions in the sorted list count as more
    similar, as they are often consecutive. Each image of a group is also paired with the image most
    similar to it, since the group's images may merely look alike.
    """
    images = sorted({image for pair in pairs for image in (pair.query, pair.map)})
    position = {image: at for at, image in enumerate(images)}
    ranked: dict[str, list[tuple[float, int, str]]] = defaultdict(list)
    for pair in pairs:
        apart = abs(position[pair.query] - position[pair.map])
        ranked[pair.query].append((-pair.score, apart, pair.map))
        ranked[pair.map].append((-pair.score, apart, pair.query))
    chosen: dict[str, set[str]] = defaultdict(set)
    for image in images[:: max(1, math.ceil(len(images) / _CHECKED_GROUPS))]:
        others = list(dict.fromkeys(other for *_, other in sorted(ranked[image])))
        group = {image, *(others[rank] for rank in _RANKS if rank < len(others))}
        most_similar = ((member, min(ranked[member])[-1]) for member in group)
        for a, b in map(sorted, (*combinations(group, 2), *most_similar)):
            chosen[a].add(b)
    return [(image, sorted(others)) for image, others in sorted(chosen.items())]


def _evidence(
    mapping: KaptureFolder,
    local_type: str,
    matched_job: tuple[_Job, Sequence[_PairMatches]],
) -> list[PairEvidence]:
    """Return the pairs of an image that a two-view model explains better than chance."""
    (image, others), matched = matched_job
    data, options = mapping.read(), TwoViewOptions()
    a, *read = _read((mapping, mapping), local_type, (image, others))
    evidence = []
    for other, b, pair in zip(others, read, matched, strict=True):
        poses = data.cam_from_world(image), data.cam_from_world(other)
        if poses[0] is None or poses[1] is None:
            continue
        rows, _, number = verified(a, b, pair, options)
        i, j = rows.T
        pixels_a, pixels_b = a.keypoints_px[i, :2], b.keypoints_px[j, :2]
        if agree_by_chance(pixels_a, a.camera, pixels_b, b.camera, number, options):
            continue
        rays = a.rays[i], a.slopes[i], b.rays[j], b.slopes[j]
        side_px = max(a.width, a.height, b.width, b.height)
        fitting = count_fitting(*rays, (poses[0], poses[1]), side_px)
        evidence.append(PairEvidence(image, other, len(rows), fitting))
    return evidence


_Job = tuple[str, Sequence[str]]  # an image of the first folder, and some of the second
_Folders = tuple[KaptureFolder, KaptureFolder]
_Result = TypeVar("_Result")


def one_way(pair: ImagePair) -> tuple[str, str]:
    """Return the names of a pair of map images in the order in which it is stored."""
    return min(pair.query, pair.map), max(pair.query, pair.map)


def _matching(
    folders: _Folders, local_type: str, matcher: Matcher, finish: Callable[..., list[_Result]]
) -> Batched[_Job, list[_Result]]:
    """Return the steps that match an image with others; ``finish`` judges the matches."""
    match: Any = partial(_match, matcher)
    return Batched(partial(_read, folders, local_type), match, matcher, "match_many", None, finish)


def _read(folders: _Folders, local_type: str, job: _Job) -> list[Features]:
    image, others = job
    others_read = [cached_features(folders[1], local_type, other) for other in others]
    return [cached_features(folders[0], local_type, image), *others_read]


def _match(
    matcher: Matcher, jobs: Sequence[_Job], features: Sequence[Sequence[Features]]
) -> list[list[_PairMatches]]:
    return [
        match_all(matcher, a, read, [f"pair {image}, {other}" for other in others])
        for (image, others), (a, *read) in zip(jobs, features, strict=True)
    ]


def _verify(
    folders: _Folders,
    local_type: str,
    verification: Verification,
    matched_job: tuple[_Job, Sequence[_PairMatches]],
) -> list[VerifiedMatches]:
    (image, others), matched = matched_job
    first, second = (folder.read() for folder in folders)

    def relative(other: str) -> RigidTransform | None:
        a_from_world, b_from_world = first.cam_from_world(image), second.cam_from_world(other)
        if a_from_world is None or b_from_world is None:
            return None
        return b_from_world @ a_from_world.inverse()

    a, *read = _read(folders, local_type, (image, others))
    return [
        verified(a, b, pair, verification, relative(other))
        for other, b, pair in zip(others, read, matched, strict=True)
    ]


def match_all(
    matcher: Matcher, a: ImageFeatures, others: Sequence[ImageFeatures], names: Sequence[str]
) -> list[_PairMatches]:
    """Match one image with several others, in batches that fit into memory."""
    many: Any = matcher

    def match(batch: Sequence[ImageFeatures]) -> Sequence[_PairMatches]:
        return many.match_many(a, batch) if len(batch) > 1 else [matcher.match(a, batch[0])]

    pairs = in_batches(matcher, "match_many", match, others, name=names.__getitem__)
    for pair, other, name in zip(pairs, others, names, strict=True):
        who = f"matcher {type(matcher).__name__} on {name}"
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise PluginError(f"{who}: got {type(pair).__name__}, expected (matches, scores)")
        matches, scores = pair
        checked_array(who, matches, (None, 2), "int64", "int32", "uint64", "uint32")
        checked_array(who, scores, (len(matches),), "float32", "float64")
        bounds = len(a.keypoints_px), len(other.keypoints_px)
        if ((matches < 0) | (matches >= bounds)).any():
            raise PluginError(
                f"{who}: keypoint index out of range ({bounds[0]} and {bounds[1]} keypoints)"
            )
    return pairs


def verified(
    a: Features,
    b: Features,
    pair: _PairMatches,
    verification: Verification,
    b_from_a: RigidTransform | None = None,
) -> VerifiedMatches:
    """Return the correct matches of a pair.

    Verification by known poses rejects every match if the relative pose is unknown.
    """

    def are_correct(matches: NDArray[np.int64]) -> NDArray[np.bool_]:
        rows_a, rows_b = matches.T
        if verification is None:
            return np.ones(len(matches), dtype=bool)
        if isinstance(verification, TwoViewOptions):
            points_px = a.keypoints_px[rows_a, :2], b.keypoints_px[rows_b, :2]
            return verify_two_view(points_px[0], a.camera, points_px[1], b.camera, verification)
        if b_from_a is None:
            return np.zeros(len(matches), dtype=bool)
        rays = a.rays[rows_a], a.slopes[rows_a], b.rays[rows_b], b.slopes[rows_b]
        return verify_with_poses(*rays, b_from_a, verification)

    matches, scores = pair
    good = verify_best_first(are_correct, matches, scores)
    return VerifiedMatches(matches[good], scores[good], len(matches))


@lru_cache(maxsize=8)
def _readers(folder: KaptureFolder, local_type: str) -> tuple[FeatureReader, FeatureReader]:
    return folder.keypoints(local_type), folder.descriptors(local_type)


@lru_cache(maxsize=CACHED_IMAGES)
def cached_features(folder: KaptureFolder, local_type: str, image: str) -> Features:
    keypoints, descriptors = _readers(folder, local_type)
    check_lengths(keypoints, descriptors, image)
    camera = folder.read().camera_of(image)
    return Features.of(camera, keypoints.read(image), descriptors.read(image))


def candidates_of(pairs: Iterable[ImagePair]) -> dict[str, list[str]]:
    """Return the candidates of each query, best first; queries are sorted by name."""
    candidates: dict[str, list[str]] = {}
    for pair in sorted(pairs, key=lambda pair: (pair.query, -pair.score, pair.map)):
        candidates.setdefault(pair.query, []).append(pair.map)
    return candidates


# options that determine the local feature types and their matching
MATCHING_OPTIONS = ("local_features", "matching", "verification")
EXPLAINED = ("map", *MATCHING_OPTIONS)


def mapping_pairs(work: StageWork, mapping: KaptureFolder) -> list[ImagePair]:
    """Read the pairs of map images, without those of unregistered photographs."""
    names = set(mapping.read().image_names())
    return [p for p in read_pairs(work.path(paths.MAPPING_PAIRS)) if {p.query, p.map} <= names]


class MatchMapping(PipelineStage):
    """Match and verify pairs of map images."""

    name = "mapping_matches"
    version = 3
    resumes = True
    explained_by = EXPLAINED
    uses = (*MATCHING_OPTIONS, "mapping_verification")
    inputs = (PipelineStage.mapping, paths.LOCAL_FEATURES, paths.MAPPING_PAIRS)
    outputs = (paths.MAPPING_MATCHES,)

    def is_wanted(self) -> bool:
        return self.options.triangulates()

    def plugins(self) -> Sequence[object]:
        return [self.options.make_matcher(name) for name in self.options.local_types()]

    def verification(self) -> Verification:
        return self.options.verify_mapping()

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping = work.folder(self.mapping(), paths.FEATURES)
        pairs, out = mapping_pairs(work, mapping), work.out / self.writes[0]
        # the poses of photographs are not given, but estimated from the same matches
        if isinstance(self.verification(), KnownPoseOptions) and not self.posed:
            name = self.options.main_type()
            check_given_poses(mapping, pairs, name, self.options.make_matcher(name), work)
        counts: Counter[str] = Counter()
        for name in self.options.local_types():
            matcher, how = self.options.make_matcher(name), self.verification()
            counts.update(match_pairs(mapping, mapping, pairs, name, matcher, how, out, work=work))
        return counts


class MatchQueries(PipelineStage):
    """Match queries with their candidates and verify the matches."""

    name = "query_matches"
    version = 4
    resumes = True
    explained_by = EXPLAINED
    uses = (*MATCHING_OPTIONS, "query_verification")
    inputs = (
        PipelineStage.mapping,
        PipelineStage.query,
        paths.LOCAL_FEATURES,
        PipelineStage.candidates,
    )
    outputs = (paths.QUERY_MATCHES,)

    def plugins(self) -> Sequence[object]:
        return [self.options.make_matcher(name) for name in self.options.local_types()]

    def run(self, work: StageWork) -> Mapping[str, float]:
        query = work.folder(self.query(), paths.FEATURES)
        mapping = work.folder(self.mapping(), paths.FEATURES)
        pairs, out = read_pairs(work.path(self.candidates())), work.out / paths.QUERY_MATCHES
        counts: Counter[str] = Counter()
        for name in self.options.local_types():
            matcher, how = self.options.make_matcher(name), self.options.verify_queries()
            counts.update(match_pairs(query, mapping, pairs, name, matcher, how, out, work=work))
        return counts
