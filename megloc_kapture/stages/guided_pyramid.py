"""Repeated matching of pairs by a second matcher, then by guided pyramids (MegLoc).

The second matcher matches the best pairs of each image; guided pyramids match pairs with few
matches at other scales and rotations.

Guided pyramids give a keypoints type ``T-pyramid`` with the matches of all pairs: the keypoints of
type T, unchanged, followed by the added keypoints. Indices into T are therefore valid in T-pyramid.
All variants of all map pairs are matched before the matches of a pair are combined, so that the
order of the added keypoints does not depend on the workers.
"""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.kapture import (
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
)
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.localization.map_index import ImageMatches
from megloc_kapture.mapping.pairs import views_can_overlap
from megloc_kapture.matching.guided_pyramid import (
    GuidedPyramidOptions,
    ImageVariant,
    PairVerifier,
    VariantMatches,
    extract_variants,
    match_variants,
    pyramid_type,
)
from megloc_kapture.matching.pyramid_combination import KeypointUnion, combine
from megloc_kapture.matching.verification import (
    KnownPoseOptions,
    known_pose_of_variants,
    two_view_of_variants,
)
from megloc_kapture.plugins import LocalFeatureExtractor, Matcher
from megloc_kapture.stages import paths
from megloc_kapture.stages.local_features import check_lengths, extract_all, read_frame
from megloc_kapture.stages.matches import (
    MATCHING_OPTIONS,
    Features,
    Verification,
    cached_features,
    mapping_pairs,
    match_all,
    match_pairs,
    one_way,
    pairs_to_rematch,
)
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import BATCH, HERE, Work, batched

_log = logging.getLogger(__name__)


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
) -> tuple[list[list[VariantMatches]], str]:
    """Extract the variants of an image and match them with other images.

    Return the matches by image and variant, and why variants were skipped.

    Parameters
    ----------
    pixels, mask : RGB (H, W, 3); bool (H, W), True = use, or None.
    only_scaled : images to match with scaled, unrotated variants; their results come last.
    """
    every = method.options.variants(itself.camera.width, itself.camera.height)
    scaled = [variant for variant in every if variant.scale != 1.0]
    variants, skipped = extract_variants(
        pixels,
        mask,
        every if others else scaled,
        lambda image, mask: extract_all(method.extractor, [(image, mask)], [name])[0],
        like=itself,
    )
    of_scale = [item for item in variants if item.variant.scale != 1.0]
    matches: list[list[VariantMatches]] = []
    for names, used in ((others, variants), (only_scaled, of_scale)):
        for batch in batched(names, BATCH):
            loaded = [load(other) for other in batch]
            pairs = [f"pair {name}, {other}" for other in batch]
            match_with = partial(match_all, method.matcher, names=pairs)
            matches += match_variants(used, loaded, match_with, list(map(judge, batch, loaded)))
    return matches, _described(skipped)


def _described(skipped: Mapping[ImageVariant, str]) -> str:
    by_reason: dict[str, list[ImageVariant]] = {}
    for variant, reason in skipped.items():
        by_reason.setdefault(reason, []).append(variant)
    return "; ".join(f"{' '.join(map(str, some))}: {reason}" for reason, some in by_reason.items())


def _counts(tried: Sequence[tuple[int, int]]) -> dict[str, int]:
    """Return counts for the log from the numbers of matches of each pair before and after."""
    return {
        "pairs_tried": len(tried),
        "pairs_gained": sum(after > before for before, after in tried),
        "matches_before": sum(before for before, _ in tried),
        "matches_after": sum(after for _, after in tried),
    }


def _warn_of_skipped(local_type: str, skipped: Counter[str]) -> None:
    """Warn about skipped variants, given the number of pairs by reason."""
    del skipped[""]
    if skipped:
        message = "guided pyramid of %s: variants of %d pairs are skipped, most often %s"
        _log.warning(message, local_type, skipped.total(), skipped.most_common(1)[0][0])


class PyramidFeatures:
    """Writer of the type ``T-pyramid``, with hard links to unchanged files of T where possible."""

    def __init__(self, output: Path, folder: KaptureFolder, local_type: str) -> None:
        name = pyramid_type(local_type)
        keypoints, descriptors = folder.keypoints(local_type), folder.descriptors(local_type)
        self._left = [image for image in sorted(folder.read().image_names()) if image in keypoints]
        for image in self._left:
            check_lengths(keypoints, descriptors, image)
        # the configurations keep their ``name``, which identifies the extractor
        configs = keypoints.config, replace(descriptors.config, keypoints_type=name)
        self._kinds = [
            (source, FeatureWriter(output, source.kind, name, config, orphan=True))
            for source, config in zip((keypoints, descriptors), configs, strict=True)
        ]

    def write(
        self, image: str, added_px: NDArray[np.float32], added_descriptors: NDArray[Any]
    ) -> None:
        self._left.remove(image)
        for (source, writer), added in zip(self._kinds, (added_px, added_descriptors), strict=True):
            if len(added):
                writer.write(image, np.concatenate([source.read(image), added]))
            else:
                writer.copy(image, source)

    def write_rest(self) -> None:
        for image, (source, writer) in product(self._left, self._kinds):
            writer.copy(image, source)


@dataclass(frozen=True, eq=False)
class RetriedQuery:
    """A query after guided pyramid matching.

    The added keypoints (A, C) and descriptors (A, D) follow those of the query. ``matches`` are in
    the order of the candidates. ``tried`` has the numbers of matches, before and after, of the
    candidates that were matched again, ``skipped`` the reasons for skipping variants.
    """

    added_px: NDArray[np.float32]
    added_descriptors: NDArray[Any]
    matches: list[ImageMatches]
    tried: list[tuple[int, int]]
    skipped: str


def retry_query(
    query: Features,
    matches: Sequence[ImageMatches],
    load: Callable[[str], Features],
    method: PyramidMethod,
    frame: Callable[[], tuple[NDArray[np.uint8], NDArray[np.bool_] | None]],
    *,
    num_found: Mapping[str, int],
    name: str,
) -> RetriedQuery:
    """Match candidates with few matches again, using variants of the query.

    Parameters
    ----------
    matches : name, verified matches (K, 2) and scores (K,) of each candidate, best first.
    frame : reads pixels and mask of the query; called only if a candidate has few matches.
    num_found : by candidate, the number of matches before verification.
    """
    base = {other: pairs for other, pairs, _ in matches}
    is_hard = method.options.is_hard
    hard = [other for other, pairs in base.items() if is_hard(num_found[other], len(pairs))]
    mode, verification = method.options.mode, method.verification
    if mode == "off" or not hard:
        none = query.keypoints_px[:0], query.descriptors[:0]
        return RetriedQuery(*none, list(matches), [], "")
    assert not isinstance(verification, KnownPoseOptions)

    def judge(other: str, features: Features) -> PairVerifier:
        if verification is None:
            return UNVERIFIED
        return two_view_of_variants(
            query.camera, query.keypoints_px, features.camera, features.keypoints_px, base[other],
            verification,
        )  # fmt: skip

    matched, skipped = match_image_again(query, *frame(), hard, load, judge, method, name=name)
    of_other = dict(zip(hard, matched, strict=True))
    keypoints = KeypointUnion(query.keypoints_px)
    richer: list[ImageMatches] = []
    tried = []
    for other, pairs, scores in matches:
        if other in of_other:
            variants = [(0, each) for each in of_other[other]]
            pairs, scores = combine((pairs, scores), variants, mode, [keypoints])
            tried.append((len(base[other]), len(pairs)))
        richer.append((other, pairs, scores))
    added = np.array(keypoints.descriptors, query.descriptors.dtype)
    added = added.reshape(-1, query.descriptors.shape[1])
    return RetriedQuery(keypoints.added(), added, richer, tried, skipped)


_Pair = tuple[str, str]


def pyramid_mapping(
    mapping: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    method: PyramidMethod,
    output: Path,
    *,
    num_found: Mapping[_Pair, int],
    work: Work = HERE,
) -> dict[str, float]:
    """Match mapping pairs with few matches again, using scaled and rotated variants of each image.

    ``output`` receives ``local_features/T-pyramid``. ``num_found`` counts matches before
    verification. Return counts for the log.
    """
    data, poses = mapping.read(), mapping.read().poses()

    def can_gain(a: str, b: str) -> bool:
        if not (a in poses and b in poses):
            return False  # cannot triangulate without a pose
        return views_can_overlap(data.camera_of(a), poses[a], data.camera_of(b), poses[b])

    named = sorted(set(map(one_way, pairs)))
    stored, keypoints = mapping.matches(local_type), mapping.keypoints(local_type)
    verified = {pair: len(stored.read(*pair)[0]) for pair in named}
    is_hard, mode = method.options.is_hard, method.options.mode
    hard = [p for p in named if is_hard(num_found[p], verified[p]) and can_gain(*p)]
    others: dict[str, tuple[list[str], list[str]]] = defaultdict(lambda: ([], []))
    for a, b in hard:
        others[a][0].append(b)
        # rotating a is equivalent to rotating b, so b is only scaled
        others[b][1].append(a)

    features = PyramidFeatures(output, mapping, local_type)
    again = partial(_match_again, mapping, local_type, method)
    jobs = [(image, *others[image]) for image in sorted(others)]
    plugins = method.extractor, method.matcher
    results = work.map(again, jobs, "guided pyramid", plugins=plugins)
    matched_of: dict[_Pair, tuple[list[VariantMatches], str]] = {}
    for (image, *names), (of_pairs, skipped) in zip(jobs, results, strict=True):
        for other, of_pair in zip(chain(*names), of_pairs, strict=True):
            matched_of[image, other] = of_pair, skipped
    unions: dict[str, KeypointUnion] = {}
    tried, reasons, hard_pairs = [], Counter[str](), set(hard)
    writer = MatchesWriter(output, pyramid_type(local_type), orphan=True)
    for pair in named:
        matches, scores = stored.read(*pair)
        if pair in hard_pairs and mode != "off":
            directed = matched_of[pair], matched_of[pair[::-1]]
            variants = [
                (at, variant) for at, (of_pair, _) in enumerate(directed) for variant in of_pair
            ]
            for image in set(pair) - unions.keys():
                unions[image] = KeypointUnion(keypoints.read(image))
            both = unions[pair[0]], unions[pair[1]]
            matches, scores = combine((matches, scores), variants, mode, both)
            tried.append((verified[pair], len(matches)))
            reasons[" | ".join(reason for _, reason in directed if reason)] += 1
        writer.write(*pair, matches, scores)
    extended = {image: union for image, union in sorted(unions.items()) if union.descriptors}
    for image, union in extended.items():
        features.write(image, union.added(), np.stack(union.descriptors))
    features.write_rest()
    _warn_of_skipped(local_type, reasons)
    return {
        "images_extracted_again": len(jobs),
        "images_extended": len(extended),
        "pairs": len(named),
        **_counts(tried),
        "keypoints_added": sum(len(union.descriptors) for union in extended.values()),
    }


def _match_again(
    mapping: KaptureFolder,
    local_type: str,
    method: PyramidMethod,
    job: tuple[str, Sequence[str], Sequence[str]],
) -> tuple[list[list[VariantMatches]], str]:
    image, others, only_scaled = job
    verification = method.verification
    itself = cached_features(mapping, local_type, image)

    def judge(other: str, features: Features) -> PairVerifier:
        if verification is None:
            return UNVERIFIED
        image_from_world = mapping.read().cam_from_world(image)
        other_from_world = mapping.read().cam_from_world(other)
        assert image_from_world is not None and other_from_world is not None
        assert isinstance(verification, KnownPoseOptions)
        other_from_image = other_from_world @ image_from_world.inverse()
        return known_pose_of_variants(
            itself.camera, features.rays, features.slopes, other_from_image, verification
        )

    return match_image_again(
        itself,
        *read_frame(mapping, image, margin_px=method.mask_margin_px),
        others,
        partial(cached_features, mapping, local_type),
        judge,
        method,
        only_scaled=only_scaled,
        name=image,
    )


def pyramid_queries(
    query: KaptureFolder,
    mapping: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    method: PyramidMethod,
    output: Path,
    *,
    num_found: Mapping[_Pair, int],
    work: Work = HERE,
) -> dict[str, float]:
    """Match query pairs with few matches again: variants of the query with the map's keypoints.

    The map stays unchanged; its type ``T-pyramid`` is matched if it has that type. Output and
    ``num_found`` are as in :func:`pyramid_mapping`.
    """
    larger = pyramid_type(local_type)
    has_larger = all(larger in mapping.types(kind) for kind in ("keypoints", "descriptors"))
    types = local_type, larger if has_larger else local_type
    candidates: dict[str, list[str]] = {}
    both = dict.fromkeys((pair.query, pair.map) for pair in pairs)
    for image, other in sorted(both, key=itemgetter(0)):
        candidates.setdefault(image, []).append(other)
    jobs = [
        (image, others, {name: num_found[image, name] for name in others})
        for image, others in candidates.items()
    ]
    features = PyramidFeatures(output, query, local_type)
    retry = partial(_retry, query, mapping, types, method)
    plugins = method.extractor, method.matcher
    tried, skipped = list[tuple[int, int]](), Counter[str]()
    retried = extended = added = 0
    writer = MatchesWriter(output, larger, orphan=True)
    results = work.map(retry, jobs, "guided pyramid", plugins=plugins)
    for (image, *_), result in zip(jobs, results, strict=True):
        for matches in result.matches:
            writer.write(image, *matches)
        features.write(image, result.added_px, result.added_descriptors)
        tried += result.tried
        skipped[result.skipped] += len(result.tried)
        retried += len(result.tried) > 0
        extended += len(result.added_px) > 0
        added += len(result.added_px)
    features.write_rest()
    _warn_of_skipped(local_type, skipped)
    return {
        "images_extracted_again": retried,
        "images_extended": extended,
        "pairs": len(both),
        **_counts(tried),
        "keypoints_added": added,
    }


def _retry(
    query: KaptureFolder,
    mapping: KaptureFolder,
    types: tuple[str, str],
    method: PyramidMethod,
    job: tuple[str, Sequence[str], Mapping[str, int]],
) -> RetriedQuery:
    image, candidates, num_found = job
    stored = query.matches(types[0])
    return retry_query(
        cached_features(query, types[0], image),
        [(other, *stored.read(image, other)) for other in candidates],
        partial(cached_features, mapping, types[1]),
        method,
        lambda: read_frame(query, image, margin_px=method.mask_margin_px),
        num_found=num_found,
        name=image,
    )


class _Rematching(PipelineStage):
    """Match some pairs again by a second matcher, then pairs with few matches by pyramids."""

    version = 4
    matches: ClassVar[str]
    of_queries: ClassVar[bool]
    uses: ClassVar[tuple[str, ...]] = (
        *MATCHING_OPTIONS,
        "second_matching",
        "guided_pyramid",
        "mask_margin_px",
    )
    explained_by: ClassVar[tuple[str, ...]] = (
        "second_matching.matcher",
        "second_matching.min_matches",
        "guided_pyramid.mode",
        "guided_pyramid.min_matches",
        "guided_pyramid.count",
    )

    def second_matcher(self) -> Matcher | None:
        return self.options.make_second_matcher(of_queries=self.of_queries)

    def plugins(self) -> Sequence[object]:
        extractors, second = self.options.make_extractors(), self.second_matcher()
        matchers = [self.options.make_matcher(extractor.name) for extractor in extractors]
        return [*extractors, *matchers, *(() if second is None else (second,))]

    def _match_again(
        self,
        work: StageWork,
        first: KaptureFolder,
        second: KaptureFolder,
        pairs: Sequence[ImagePair],
        verification: Verification,
    ) -> dict[str, float]:
        options, out = self.options, work.out / self.writes[0]
        second_matcher = self.second_matcher()
        counts: dict[str, float] = {}
        for extractor in options.make_extractors():
            name = extractor.name
            rows = read_match_counts(work.path(self.matches), name)
            if second_matcher is not None:
                named = {(p.query, p.map) if self.of_queries else one_way(p) for p in pairs}
                chosen = pairs_to_rematch(
                    {pair: rows[pair].verified for pair in named & rows.keys()},
                    options.second_matching,
                    of_both=not self.of_queries,
                )
                again = [ImagePair(*pair, 1.0) for pair in chosen]
                matched = match_pairs(
                    first, second, again, name, second_matcher, verification, out, work=work
                )
                rows |= read_match_counts(out, name)
                counts |= {f"{name} second {key}": count for key, count in matched.items()}
            if options.uses_pyramid():
                matcher, margin_px = options.make_matcher(name), options.mask_margin_px
                method = PyramidMethod(
                    extractor, matcher, verification, options.guided_pyramid, margin_px
                )
                folder = first.with_features([out, *first.features_dirs])
                retry = partial(pyramid_mapping, folder)
                if self.of_queries:
                    retry = partial(pyramid_queries, folder, second)
                num_found = {pair: row.matches for pair, row in rows.items()}
                retried = retry(pairs, name, method, out, num_found=num_found, work=work)
                counts |= {f"{name} {key}": count for key, count in retried.items()}
        return counts


class RematchMapping(_Rematching):
    """Match pairs of map images again: by a second matcher, and at other scales and rotations."""

    name = "mapping_rematching"
    matches, of_queries = paths.MAPPING_MATCHES, False
    uses = (*_Rematching.uses, "mapping_verification")
    inputs = (
        PipelineStage.mapping,
        paths.LOCAL_FEATURES,
        paths.MAPPING_PAIRS,
        paths.MAPPING_MATCHES,
    )
    outputs = (paths.MAPPING_PYRAMID,)

    def is_wanted(self) -> bool:
        return self.options.rematches_map()

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping = work.folder(self.mapping(), paths.FEATURES, paths.MAPPING_MATCHES)
        pairs = mapping_pairs(work, mapping)
        return self._match_again(work, mapping, mapping, pairs, self.options.verify_mapping())


class RematchQueries(_Rematching):
    """Match queries with candidates again; see :class:`RematchMapping`."""

    name = "query_rematching"
    explained_by = ("second_matching.queries", *_Rematching.explained_by)
    matches, of_queries = paths.QUERY_MATCHES, True
    uses = (*_Rematching.uses, "map", "query_verification")
    inputs = (
        PipelineStage.mapping,
        PipelineStage.query,
        paths.LOCAL_FEATURES,
        PipelineStage.mapping_matches,
        paths.QUERY_PAIRS,
        paths.QUERY_MATCHES,
    )
    outputs = (paths.QUERY_PYRAMID,)

    def is_wanted(self) -> bool:
        return self.options.rematches_queries()

    def run(self, work: StageWork) -> Mapping[str, float]:
        query = work.folder(self.query(), paths.FEATURES, paths.QUERY_MATCHES)
        mapping = work.folder(self.mapping(), paths.FEATURES, *self.mapping_matches())
        pairs = read_pairs(work.path(paths.QUERY_PAIRS))
        return self._match_again(work, query, mapping, pairs, self.options.verify_queries())
