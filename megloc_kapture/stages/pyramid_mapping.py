"""Stages that match pairs of map images, or of queries, again by stronger means.

A second matcher matches the best pairs of each image, and guided pyramids then match poor pairs at
other scales and rotations. All variants are matched before pairs are combined, so that the order of
the added keypoints does not depend on the workers.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import (
    FeatureReader,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
)
from megloc_kapture.io.tables import PairCount, read_match_counts
from megloc_kapture.mapping.pairs import views_can_overlap
from megloc_kapture.matching.guided_pyramid import PairVerifier, VariantMatches, pyramid_type
from megloc_kapture.matching.pyramid_combination import Combined, KeypointUnion, combine
from megloc_kapture.matching.verification import KnownPoseOptions, known_pose_of_variants
from megloc_kapture.plugins import LocalFeatureExtractor
from megloc_kapture.stages.given_map import matched_images
from megloc_kapture.stages.guided_pyramid import (
    UNVERIFIED,
    MatchedVariants,
    PyramidFeatures,
    PyramidMethod,
    RetriedQuery,
    match_image_again,
    retry_query,
    tried_row,
    write_tried,
)
from megloc_kapture.stages.local_features import read_frame
from megloc_kapture.stages.matches import (
    MATCHING_OPTIONS,
    Features,
    NoVerification,
    Verification,
    best_pairs,
    cached_features,
    mapping_pairs,
    match_pairs,
)
from megloc_kapture.stages.stage import (
    FEATURES,
    LOCAL_FEATURES,
    MAP,
    MAPPING_MATCHES,
    MAPPING_PAIRS,
    MAPPING_PYRAMID,
    QUERY_MATCHES,
    QUERY_PAIRS,
    QUERY_PYRAMID,
    Layout,
    PipelineStage,
    StageWork,
)
from megloc_kapture.stages.work import HERE, FolderSpec, Work

_Pair = tuple[str, str]


def pyramid_mapping(
    mapping: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    method: PyramidMethod,
    output: Path,
    *,
    num_found: Mapping[_Pair, int] | None = None,
    work: Work = HERE,
) -> dict[str, float]:
    """Match mapping pairs with few matches again, using scaled and rotated variants of each image.

    ``output`` receives ``local_features/T-pyramid`` and ``guided_pyramid.csv``, a row per retried
    pair. ``num_found`` counts matches before verification, by default the stored ones. Return
    counts for the log.
    """
    data, poses = mapping.read(), mapping.read().poses()

    def can_gain(a: str, b: str) -> bool:
        if not (a in poses and b in poses):
            return False  # cannot triangulate without a pose
        return views_can_overlap(data.camera_of(a), poses[a], data.camera_of(b), poses[b])

    named = sorted({(min(p.query, p.map), max(p.query, p.map)) for p in pairs})
    stored, keypoints = mapping.matches(local_type), mapping.keypoints(local_type)
    counts = {pair: len(stored.read(*pair)[0]) for pair in named}
    found = num_found or {}
    is_hard = method.options.is_hard
    hard = [p for p in named if is_hard(found.get(p, counts[p]), counts[p]) and can_gain(*p)]
    others: dict[str, tuple[list[str], list[str]]] = defaultdict(lambda: ([], []))
    for a, b in hard:
        others[a][0].append(b)
        # rotating either image is equivalent, so b only gets scaled
        others[b][1].append(a)

    features = PyramidFeatures(output, mapping, local_type)
    again = partial(_match_again, FolderSpec(mapping), local_type, method)
    jobs = [(image, *others[image]) for image in sorted(others)]
    plugins = method.extractor, method.matcher
    results = work.map(again, jobs, "guided pyramid", plugins=plugins)
    variants = _VariantsOfMap(keypoints)
    for (image, *names), matched in zip(jobs, results, strict=True):
        variants.put(image, list(chain(*names)), matched)
    rows, hard_pairs = [], set(hard)
    with MatchesWriter(output, pyramid_type(local_type), orphan=True) as writer:
        for pair in named:
            matches, scores = stored.read(*pair)
            if pair in hard_pairs:
                combined, row = variants.combine(pair, (matches, scores), method)
                rows.append(row)
                matches, scores = combined.matches, combined.scores
            writer.write(*pair, matches, scores)
    extended = {image: own for image, own in sorted(variants.added.items()) if own.descriptors}
    for image, own in extended.items():
        features.write(image, own.keypoints_px, np.stack(own.descriptors))
    features.write_rest()
    return {
        "images_extracted_again": len(jobs),
        "images_extended": len(extended),
        "pairs": len(named),
        **write_tried(output, local_type, rows, variants.seconds),
    }


def _match_again(
    mapping: FolderSpec,
    local_type: str,
    method: PyramidMethod,
    job: tuple[str, Sequence[str], Sequence[str]],
) -> MatchedVariants:
    image, others, only_scaled = job
    folder, verification = mapping.open(), method.verification
    itself = cached_features(mapping, local_type, image)

    def judge(other: str, features: Features) -> PairVerifier:
        if isinstance(verification, NoVerification):
            return UNVERIFIED
        image_from_world = folder.read().cam_from_world(image)
        other_from_world = folder.read().cam_from_world(other)
        if image_from_world is None or other_from_world is None:
            raise DataError(f"{image} or {other} has no pose, and is to be verified with it")
        if not isinstance(verification, KnownPoseOptions):
            raise ValueError("map images are verified with their poses")
        other_from_image = other_from_world @ image_from_world.inverse()
        return known_pose_of_variants(
            itself.camera, features.rays, features.slopes, other_from_image, verification
        )

    return match_image_again(
        itself,
        *read_frame(folder, image, margin_px=method.mask_margin_px),
        others,
        partial(cached_features, mapping, local_type),
        judge,
        method,
        only_scaled=only_scaled,
        name=image,
    )


@dataclass(eq=False)
class _Added:
    """Keypoints (A, C) added to an image, and their descriptors (D,)."""

    keypoints_px: NDArray[np.float32]
    descriptors: list[NDArray[Any]] = field(default_factory=list)


class _VariantsOfMap:
    def __init__(self, keypoints: FeatureReader) -> None:
        self._keypoints = keypoints
        # matches by variant, number of variants and reasons of skipped ones
        self._found: dict[_Pair, tuple[list[VariantMatches], int, str]] = {}
        self.added: dict[str, _Added] = {}
        self.seconds = 0.0

    def put(self, image: str, others: Sequence[str], matched: MatchedVariants) -> None:
        self.seconds += matched.seconds
        for other, own, count in zip(others, matched.found, matched.num_variants, strict=True):
            self._found[image, other] = own, count, matched.skipped

    def combine(
        self, pair: _Pair, base: tuple[NDArray[np.int64], NDArray[Any]], method: PyramidMethod
    ) -> tuple[Combined, list[str]]:
        """Combine a pair's matches with its variant matches; return them and the table row."""
        if method.options.mode == "off":
            raise ValueError("only pairs that are tried again are combined")
        directed = self._found[pair], self._found[pair[::-1]]
        tried = [(side, one) for side, (own, *_) in enumerate(directed) for one in own]
        unions = []
        for image in pair:
            stored = self._keypoints.read(image)
            if image not in self.added:
                self.added[image] = _Added(stored[:0])
            unions.append(KeypointUnion(stored, self.added[image].keypoints_px))
        combined = combine(base, tried, method.options.mode, (unions[0], unions[1]))
        for image, union, new in zip(pair, unions, combined.added, strict=True):
            added = self.added[image]
            added.keypoints_px = union.added()
            added.descriptors += [tried[number][1].descriptors[row] for number, row in new.tolist()]
        names, best = ("image", "other"), ""
        if combined.best is not None:
            side, one = tried[combined.best]
            best = f"{names[side]} {one.variant}"
        skipped = [f"{names[side]} {why}" for side, (*_, why) in enumerate(directed) if why]
        count = sum(number for _, number, _ in directed)
        return combined, tried_row(pair, len(base[0]), combined, count, best, " | ".join(skipped))


def pyramid_queries(
    query: KaptureFolder,
    mapping: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    method: PyramidMethod,
    output: Path,
    *,
    num_found: Mapping[_Pair, int] | None = None,
    work: Work = HERE,
) -> dict[str, float]:
    """Match query pairs with few matches again: variants of the query with the map's keypoints.

    The map stays unchanged; its keypoints of ``T-pyramid`` are used if it has any. See
    :func:`pyramid_mapping`.
    """
    before = num_found or {}
    larger = pyramid_type(local_type)
    there = all(larger in mapping.types(kind) for kind in ("keypoints", "descriptors"))
    types = local_type, larger if there else local_type
    candidates: dict[str, list[str]] = {}
    both = dict.fromkeys((pair.query, pair.map) for pair in pairs)
    for image, other in sorted(both, key=itemgetter(0)):
        candidates.setdefault(image, []).append(other)
    jobs = [
        (image, others, {one: before[image, one] for one in others if (image, one) in before})
        for image, others in candidates.items()
    ]
    features = PyramidFeatures(output, query, local_type)
    retry = partial(_retry, FolderSpec(query), FolderSpec(mapping), types, method)
    plugins = method.extractor, method.matcher
    rows, seconds, extended = [], 0.0, 0
    with MatchesWriter(output, larger, orphan=True) as writer:
        results = work.map(retry, jobs, "guided pyramid", plugins=plugins)
        for (image, *_), found in zip(jobs, results, strict=True):
            for one in found.matches:
                writer.write(image, *one)
            features.write(image, found.added_px, found.added_descriptors)
            rows += found.rows
            seconds += found.seconds
            extended += len(found.added_px) > 0
    features.write_rest()
    return {
        "images_extracted_again": len({row[0] for row in rows}),
        "images_extended": extended,
        "pairs": sum(map(len, candidates.values())),
        **write_tried(output, local_type, rows, seconds),
    }


def _retry(
    query: FolderSpec,
    mapping: FolderSpec,
    types: tuple[str, str],
    method: PyramidMethod,
    job: tuple[str, Sequence[str], Mapping[str, int]],
) -> RetriedQuery:
    image, candidates, num_found = job
    folder, stored = query.open(), query.open().matches(types[0])
    return retry_query(
        cached_features(query, types[0], image),
        [(other, *stored.read(image, other)) for other in candidates],
        partial(cached_features, mapping, types[1]),
        method,
        lambda: read_frame(folder, image, margin_px=method.mask_margin_px),
        num_found=num_found,
        name=image,
    )


class _AgainStage(PipelineStage):
    """Match the best pairs again with a second matcher, and poor pairs in guided pyramids."""

    version = 3
    matches: ClassVar[str]
    explained_by = (
        "guided_pyramid.mode",
        "guided_pyramid.min_matches",
        "guided_pyramid.count",
        "second_matching.matcher",
        "second_matching.pairs",
    )

    def is_wanted(self) -> bool:
        return self.options.matches_again()

    def plugins(self) -> Sequence[object]:
        extractors, second = self._extractors(), self.options.make_second_matcher()
        matchers = [self.options.make_matcher(one.name) for one in extractors]
        return [*extractors, *matchers, *(() if second is None else (second,))]

    def _extractors(self) -> list[LocalFeatureExtractor]:
        return self.options.query_extractors()

    @abstractmethod
    def _verification(self) -> Verification: ...

    @abstractmethod
    def _inputs(
        self, work: StageWork, local_type: str
    ) -> tuple[KaptureFolder, KaptureFolder, list[ImagePair]]:
        """Return the folders of the first and second images, and the pairs."""

    def run(self, work: StageWork) -> Mapping[str, float]:
        options, out = self.options, work.out / self.writes[0]
        verification, second_matcher = self._verification(), options.make_second_matcher()
        counts: dict[str, float] = {}
        for extractor in self._extractors():
            name = extractor.name
            first, second, pairs = self._inputs(work, name)
            within_one = first.root == second.root
            rows = _match_counts(work.path(self.matches), name)
            if second_matcher is not None:
                best = best_pairs(
                    {pair: rows[pair].verified for pair in _named(pairs) & rows.keys()},
                    options.second_matching.pairs,
                    of_both=within_one,
                )
                again = [ImagePair(*pair, 1.0) for pair in best]
                matched = match_pairs(
                    first, second, again, name, second_matcher, verification, out, work=work
                )
                rows |= _match_counts(out, name)
                counts |= {f"{name} second {key}": count for key, count in matched.items()}
            if options.uses_pyramid():
                matcher, margin_px = options.make_matcher(name), options.mask_margin_px
                method = PyramidMethod(
                    extractor, matcher, verification, options.guided_pyramid, margin_px
                )
                first = first.with_features([out, *first.features_dirs])
                num_found = {pair: row.matches for pair, row in rows.items()}
                how: dict[str, Any] = {"num_found": num_found, "work": work}
                if within_one:
                    found = pyramid_mapping(first, pairs, name, method, out, **how)
                else:
                    found = pyramid_queries(first, second, pairs, name, method, out, **how)
                counts |= {f"{name} {key}": count for key, count in found.items()}
        return counts


def _match_counts(features_dir: Path, local_type: str) -> dict[_Pair, PairCount]:
    return {(row.image, row.other): row for row in read_match_counts(features_dir, local_type)}


def _named(pairs: Sequence[ImagePair]) -> set[_Pair]:
    """Return the names of the pairs in both orders, as map pairs are stored in one."""
    return {names for one in pairs for names in ((one.query, one.map), (one.map, one.query))}


class PyramidMapping(_AgainStage):
    """Match pairs of map images again: with a second matcher, at other scales and rotations."""

    name = "mapping_pyramid"
    matches = MAPPING_MATCHES
    uses = (
        *MATCHING_OPTIONS,
        "mapping_verification",
        "second_matching",
        "guided_pyramid",
        "mask_margin_px",
    )
    inputs = (Layout.mapping, LOCAL_FEATURES, MAPPING_PAIRS, MAPPING_MATCHES)
    outputs = (MAPPING_PYRAMID,)

    def is_wanted(self) -> bool:
        return super().is_wanted() and self.options.triangulates()

    def _extractors(self) -> list[LocalFeatureExtractor]:
        return self.options.make_extractors()

    def _verification(self) -> Verification:
        return self.options.verify_mapping()

    def _inputs(
        self, work: StageWork, local_type: str
    ) -> tuple[KaptureFolder, KaptureFolder, list[ImagePair]]:
        mapping = work.folder(self.layout.mapping(), FEATURES, MAPPING_MATCHES)
        return mapping, mapping, mapping_pairs(work, mapping)


class PyramidQueries(_AgainStage):
    """Match queries with candidates again; see :class:`PyramidMapping`."""

    name = "query_pyramid"
    matches = QUERY_MATCHES
    uses = (
        *MATCHING_OPTIONS,
        "query_verification",
        "second_matching",
        "guided_pyramid",
        "mask_margin_px",
    )
    inputs = (Layout.mapping, Layout.query, LOCAL_FEATURES, MAP, QUERY_PAIRS, QUERY_MATCHES)
    outputs = (QUERY_PYRAMID,)

    def _verification(self) -> Verification:
        return self.options.verify_queries()

    def _inputs(
        self, work: StageWork, local_type: str
    ) -> tuple[KaptureFolder, KaptureFolder, list[ImagePair]]:
        query = work.folder(self.layout.query(), FEATURES, QUERY_MATCHES)
        mapping = matched_images(work, self, local_type)
        described = mapping.descriptors(local_type)
        pairs = read_pairs(work.path(QUERY_PAIRS))
        return query, mapping, [pair for pair in pairs if pair.map in described]
