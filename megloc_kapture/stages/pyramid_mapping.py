"""Stages: guided pyramid matching of map images, and of queries; which add keypoints to images.

What variants of map images give lies in a spool until all is there; then the pairs are gone through
in order, so that the rows of added keypoints do not depend on the workers. Map images whose poses
leave them no view in common are not tried.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import remove
from megloc_kapture.io.kapture import (
    FeatureReader,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
)
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.mapping.pairs import views_can_overlap
from megloc_kapture.matching.guided_pyramid import ImageVariant, PairVerifier, pyramid_type
from megloc_kapture.matching.pyramid_combination import Combined, KeypointUnion, combine
from megloc_kapture.matching.verification import KnownPoseOptions, known_pose_of_variants
from megloc_kapture.plugins import LocalFeatureExtractor
from megloc_kapture.stages.given_map import matched_images
from megloc_kapture.stages.guided_pyramid import (
    UNVERIFIED,
    MatchedVariants,
    MatchSpool,
    PyramidFeatures,
    PyramidMethod,
    RetriedQuery,
    Spooled,
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
    cached_features,
    mapping_pairs,
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
    """Try mapping pairs with few matches again, each image's variants with the other as it is.

    Parameters
    ----------
    mapping : images with poses, with the features and verified matches of ``local_type``.
    pairs : those that were matched.
    output : gets ``local_features/T-pyramid``: keypoints, descriptors, matches of all pairs, and
        ``guided_pyramid.csv``, a row per pair that was tried.
    num_found : matches of each pair before verification; as many as are stored unless given.

    Returns
    -------
    Counts for the log, and ``seconds_per_tried_pair``, of one worker.
    """
    data, poses = mapping.read(), mapping.read().poses()

    def can_gain(a: str, b: str) -> bool:
        if not (a in poses and b in poses):
            return False  # an image without a pose gives no points
        return views_can_overlap(data.camera_of(a), poses[a], data.camera_of(b), poses[b])

    # kept in one file, so (a, b) and (b, a) are one pair
    named = sorted({(min(p.query, p.map), max(p.query, p.map)) for p in pairs})
    stored, keypoints = mapping.matches(local_type), mapping.keypoints(local_type)
    counts = {pair: len(stored.read(*pair)[0]) for pair in named}
    found = num_found or {}
    is_hard = method.options.is_hard
    hard = [p for p in named if is_hard(found.get(p, counts[p]), counts[p]) and can_gain(*p)]
    hard.sort(key=lambda pair: -counts[pair])
    others: dict[str, tuple[list[str], list[str]]] = defaultdict(lambda: ([], []))
    for a, b in hard:
        others[a][0].append(b)
        # turning one image is turning the other: b is turned only where it is scaled
        others[b][1].append(a)

    features = PyramidFeatures(output, mapping, local_type)
    spool = MatchSpool(output / ".variants", keypoints, mapping.descriptors(local_type))
    images = sorted(others)
    again = partial(_match_again, FolderSpec(mapping), local_type, method)
    plugins = method.extractor, method.matcher
    jobs = [(image, *others[image]) for image in images]
    results = work.map(again, jobs, "guided pyramid", plugins=plugins)
    variants = _AllMatched(spool, keypoints)
    for (image, before, after), matched in zip(jobs, results, strict=True):
        _, spooled = spool.write(image, matched.found)
        variants.put(
            image,
            [*before, *after],
            spooled,
            matched.num_variants,
            matched.skipped,
            matched.seconds,
        )
    rows, hard_pairs = [], set(hard)
    with closing(MatchesWriter(output, pyramid_type(local_type), orphan=True)) as writer:
        for pair in named:
            matches, scores = stored.read(*pair)
            if pair in hard_pairs:
                combined, row = variants.combine(pair, (matches, scores), method)
                rows.append(row)
                matches, scores = combined.matches, combined.scores
            writer.write(*pair, matches, scores)
    extended = {image: own for image, own in sorted(variants.added.items()) if own.px is not None}
    for image, own in extended.items():
        assert own.px is not None
        features.write(image, own.px, spool.descriptors(own.descriptors_at))
    features.write_rest()
    remove(spool.folder)
    return {
        "images_extracted_again": len(images),
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
    """What was added to an image: keypoints (A, C), and the records of their descriptors."""

    px: NDArray[np.float32] | None = None
    descriptors_at: list[tuple[str, int]] = field(default_factory=list)


class _Directed(NamedTuple):
    """What the variants of an image found in another one, how many were tried, and not at all."""

    spooled: list[Spooled]
    num_variants: int
    skipped: str


class _AllMatched:
    """What the images' variants found, by image and the other one, and what it adds to images."""

    def __init__(self, spool: MatchSpool, keypoints: FeatureReader) -> None:
        self._spool, self._keypoints = spool, keypoints
        self._found: dict[_Pair, _Directed] = {}
        self.added: dict[str, _Added] = defaultdict(_Added)
        self.seconds = 0.0

    def put(
        self,
        image: str,
        others: Sequence[str],
        found: Sequence[Sequence[Sequence[Any]]],
        num_variants: Sequence[int],
        skipped: str,
        seconds: float,
    ) -> None:
        """Keep what the variants of one image came to; ``found`` as :meth:`MatchSpool.write`."""
        self.seconds += seconds
        for other, of_other, count in zip(others, found, num_variants, strict=True):
            spooled = [Spooled(ImageVariant(*variant), *rows) for variant, *rows in of_other]
            self._found[image, other] = _Directed(spooled, count, skipped)

    def combine(
        self, pair: _Pair, base: tuple[NDArray[np.int64], NDArray[Any]], method: PyramidMethod
    ) -> tuple[Combined, list[str]]:
        """The matches of a pair with those of the variants of both its images, and its row."""
        if method.options.mode == "off":
            raise ValueError("only pairs that are tried again are combined")
        names, found = ("image", "other"), dict[Literal[0, 1], _Directed]()
        if pair in self._found:
            found[0] = self._found[pair]
        if pair[::-1] in self._found:
            found[1] = self._found[pair[::-1]]
        spooled = [(side, one) for side, own in found.items() for one in own.spooled]
        tried = [(side, self._spool.get(pair[side], one)) for side, one in spooled]
        first, second = (
            KeypointUnion(self._keypoints.read(one), self.added[one].px) for one in pair
        )
        combined = combine(base, tried, method.options.mode, (first, second))
        for image, union, new in zip(pair, (first, second), combined.added, strict=True):
            if len(new):
                self.added[image].px = union.added()
            for number, match in new.tolist():
                side, one = spooled[number]
                self.added[image].descriptors_at.append((pair[side], one.begin + match))
        best = ""
        if combined.best is not None:
            side, one = spooled[combined.best]
            best = f"{names[side]} {one.variant}"
        count = sum(own.num_variants for own in found.values())
        why = [f"{names[side]} {own.skipped}" for side, own in found.items() if own.skipped]
        return combined, tried_row(pair, len(base[0]), combined, count, best, " | ".join(why))


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
    """Try query pairs with few matches again: the query's variants with the map's keypoints.

    The map is neither extracted again nor changed. Where it has keypoints of ``T-pyramid`` the
    variants are matched with those, which begin with those of T.

    Parameters
    ----------
    query : images, with the features and the matches of ``local_type``.
    mapping : images of the map with features of ``local_type``.
    pairs, output, num_found : see :func:`pyramid_mapping`, as what is returned and raised.
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
    rows: list[Any] = []
    seconds, num_extended = 0.0, 0
    with closing(MatchesWriter(output, larger, orphan=True)) as writer:
        results = work.map(retry, jobs, "guided pyramid", plugins=plugins)
        for (image, *_), found in zip(jobs, results, strict=True):
            for one in found.matches:
                writer.write(image, *one)
            features.write(image, found.added_px, found.added_descriptors)
            num_extended += len(found.added_px) > 0
            rows += found.rows
            seconds += found.seconds
    features.write_rest()
    counts = write_tried(output, local_type, rows, seconds)
    return {
        "images_extracted_again": len({row[0] for row in rows}),
        "images_extended": num_extended,
        "pairs": sum(map(len, candidates.values())),
        **counts,
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


def _num_found(work: StageWork, matches: str, local_type: str) -> dict[_Pair, int]:
    """Matches of each pair before verification, as the stage that matched them wrote them."""
    rows = read_match_counts(work.path(matches), local_type)
    return {(row.image, row.other): row.matches for row in rows}


class _PyramidStage(PipelineStage):
    def _extractors(self) -> list[LocalFeatureExtractor]:
        return self.options.query_extractors()

    def plugins(self) -> Sequence[object]:
        extractors = self._extractors()
        return [*extractors, *(self.options.make_matcher(one.name) for one in extractors)]

    def _methods(self, verification: Verification) -> Iterator[tuple[str, PyramidMethod]]:
        """How pairs are tried again, by keypoints type."""
        options = self.options
        for extractor in self._extractors():
            matcher = options.make_matcher(extractor.name)
            yield (
                extractor.name,
                PyramidMethod(
                    extractor, matcher, verification, options.guided_pyramid, options.mask_margin_px
                ),
            )


class PyramidMapping(_PyramidStage):
    """Match map images with few matches again, at other scales and turns."""

    name = "mapping_pyramid"
    version = 2
    uses = (*MATCHING_OPTIONS, "mapping_verification", "guided_pyramid", "mask_margin_px")
    explained_by = ("guided_pyramid.mode", "guided_pyramid.min_matches")
    inputs = (Layout.mapping, LOCAL_FEATURES, MAPPING_PAIRS, MAPPING_MATCHES)
    outputs = (MAPPING_PYRAMID,)

    def is_wanted(self) -> bool:
        return self.options.matches_again() and self.options.triangulates()

    def _extractors(self) -> list[LocalFeatureExtractor]:
        return self.options.make_extractors()

    def run(self, work: StageWork) -> Mapping[str, float]:
        counts: dict[str, float] = {}
        mapping = work.folder(self.layout.mapping(), FEATURES, MAPPING_MATCHES)
        pairs, out = mapping_pairs(work, mapping), work.out / MAPPING_PYRAMID
        for name, method in self._methods(self.options.verify_mapping()):
            before = _num_found(work, MAPPING_MATCHES, name)
            found = pyramid_mapping(mapping, pairs, name, method, out, num_found=before, work=work)
            counts |= {f"{name} {key}": count for key, count in found.items()}
        return counts


class PyramidQueries(_PyramidStage):
    """Match queries with few matches again; see :class:`PyramidMapping`."""

    name = "query_pyramid"
    version = 2
    uses = (*MATCHING_OPTIONS, "query_verification", "guided_pyramid", "mask_margin_px")
    explained_by = ("guided_pyramid.mode", "guided_pyramid.min_matches")
    inputs = (Layout.mapping, Layout.query, LOCAL_FEATURES, MAP, QUERY_PAIRS, QUERY_MATCHES)
    outputs = (QUERY_PYRAMID,)

    def is_wanted(self) -> bool:
        return self.options.matches_again()

    def run(self, work: StageWork) -> Mapping[str, float]:
        counts: dict[str, float] = {}
        query = work.folder(self.layout.query(), FEATURES, QUERY_MATCHES)
        pairs, out = read_pairs(work.path(QUERY_PAIRS)), work.out / QUERY_PYRAMID
        for name, method in self._methods(self.options.verify_queries()):
            before = _num_found(work, QUERY_MATCHES, name)
            mapping = matched_images(work, self, name)
            described = mapping.descriptors(name)
            some = [pair for pair in pairs if pair.map in described]
            found = pyramid_queries(
                query, mapping, some, name, method, out, num_found=before, work=work
            )
            counts |= {f"{name} {key}": count for key, count in found.items()}
        return counts
