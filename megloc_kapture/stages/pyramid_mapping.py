"""Stage: guided pyramid matching of map images, which adds keypoints to both images of a pair.

What images' variants give lies in a spool until all is there; then the pairs are gone through in
order, so that the rows of added keypoints do not depend on the workers. Map images whose poses
leave them no view in common are not tried.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.image_variants import ImageVariant
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import remove, write_bytes
from megloc_kapture.io.kapture import (
    FeatureReader,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
)
from megloc_kapture.io.paths import safe_join
from megloc_kapture.mapping.pairs import views_can_overlap
from megloc_kapture.matching.guided_pyramid import (
    GuidedPyramidOptions,
    PairVerifier,
    VariantMatches,
    pyramid_type,
)
from megloc_kapture.matching.pyramid_combination import (
    Combined,
    KeypointUnion,
    TriedVariant,
    combine,
)
from megloc_kapture.matching.verification import KnownPoseOptions, known_pose_of_variants
from megloc_kapture.plugins import LocalFeatureExtractor, Matcher
from megloc_kapture.stages.guided_pyramid import (
    MatchedVariants,
    PyramidMethod,
    RetriedPairs,
    described,
    match_image_again,
)
from megloc_kapture.stages.local_features import image_inputs, read_frame
from megloc_kapture.stages.matches import (
    MATCHING_OPTIONS,
    Features,
    cached_features,
    mapping_pairs,
)
from megloc_kapture.stages.pyramid_queries import COLUMNS, PyramidFeatures, table_path
from megloc_kapture.stages.stage import (
    FEATURES,
    LOCAL_FEATURES,
    MAPPING_MATCHES,
    MAPPING_PAIRS,
    MAPPING_PYRAMID,
    Layout,
    PipelineStage,
    StageWork,
)
from megloc_kapture.stages.work import HERE, Digest, FolderSpec, Work, feature_inputs

_Pair = tuple[str, str]


def pyramid_mapping(
    mapping: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    extractor: LocalFeatureExtractor,
    matcher: Matcher,
    verification: KnownPoseOptions,
    options: GuidedPyramidOptions,
    output: Path,
    *,
    mask_margin_px: float = 0.0,
    work: Work = HERE,
) -> dict[str, float]:
    """Try mapping pairs with few matches again, each image's variants with the other as it is.

    Parameters
    ----------
    mapping : images with poses, with the features and verified matches of ``local_type``.
    pairs : those that were matched.
    output : gets ``local_features/T-pyramid``: keypoints, descriptors, matches of all pairs, and
        ``guided_pyramid.csv``, a row per pair that was tried.

    Returns
    -------
    Counts for the log, and ``seconds_per_tried_pair``, of one worker.

    Raises
    ------
    DataError : features or matches are missing, or an image; or the extractor's features are not
        like those of ``local_type``.
    """
    data, poses = mapping.read(), mapping.read().poses()
    method = PyramidMethod(extractor, matcher, verification, options)

    def can_gain(first: str, second: str) -> bool:
        if not (first in poses and second in poses):
            return False  # poses are what verifies
        return views_can_overlap(
            data.camera_of(first), poses[first], data.camera_of(second), poses[second]
        )

    # kept in one file, so (a, b) and (b, a) are one pair
    named = sorted({(min(p.query, p.map), max(p.query, p.map)) for p in pairs})
    stored = mapping.matches(local_type)
    counts = {pair: len(stored.read(*pair)[0]) for pair in named}
    hard = [pair for pair in named if method.is_hard(counts[pair]) and can_gain(*pair)]
    hard.sort(key=lambda pair: -counts[pair])
    others: dict[str, tuple[list[str], list[str]]] = defaultdict(lambda: ([], []))
    for a, b in hard:
        others[a][0].append(b)
        # turning one image is turning the other: b is turned only where it is scaled
        others[b][1].append(a)
    spec = FolderSpec(mapping)
    jobs = [
        _Job(spec, local_type, method, mask_margin_px, image, *map(tuple, others[image]))
        for image in sorted(others)
    ]

    @cache
    def side(image: str, digest: Digest) -> list[object]:
        readers = keypoints, mapping.descriptors(local_type)
        pose = mapping.read().cam_from_world(image)
        known = [astuple(data.camera_of(image)), pose and astuple(pose)]
        return [known, *(feature_inputs(reader, image, digest) for reader in readers)]

    def inputs(image: str, digest: Digest) -> object:
        beside = [[other, side(other, digest)] for names in others[image] for other in names]
        frame = [mask_margin_px, image_inputs(mapping, image, digest)]
        return [frame, side(image, digest), len(others[image][0]), beside]

    features = PyramidFeatures(output, mapping, local_type)
    keypoints = mapping.keypoints(local_type)
    added: dict[str, _Added] = defaultdict(_Added)
    tried, hard_pairs = RetriedPairs(), set(hard)
    spool = MatchSpool(output / ".variants", keypoints, mapping.descriptors(local_type))
    items = work.items(f"variants of {local_type}", [job.image for job in jobs], inputs)
    todo = [job for job in jobs if job.image not in items.done]
    results = work.map(
        _match_again, todo, items.label("guided pyramid"), plugins=(extractor, matcher)
    )
    for job, matched in zip(todo, results, strict=True):
        file, found = spool.write(job.image, matched.found)
        told = [found, matched.num_variants, described(matched.skipped), matched.seconds]
        items.add(job.image, [file], told)
    with closing(MatchesWriter(output, pyramid_type(local_type), orphan=True)) as writer:
        again = _AllMatched()
        for job in jobs:
            again.put(job, *items.done[job.image])
        tried.seconds = again.seconds
        for pair in named:
            matches, scores = stored.read(*pair)
            if pair in hard_pairs:
                combined = again.combine(pair, (matches, scores), options, spool, keypoints, added)
                tried.count(pair, len(matches), combined, *again.told(pair, combined))
                matches, scores = combined.matches, combined.scores
            writer.write(*pair, matches, scores)
        for image, own in sorted(added.items()):
            if own.px is not None:
                features.write(image, own.px, spool.descriptors(own.descriptors_at))
        features.write_rest()
    remove(spool.folder)  # a run that is stopped leaves it to the next
    write_csv_table(table_path(output, local_type), COLUMNS, tried.rows)
    return {
        "images_extracted_again": len(jobs),
        "images_extended": sum(own.px is not None for own in added.values()),
        "pairs": len(named),
        **tried.counts(),
    }


@dataclass(frozen=True)
class _Job:
    """An image to extract again, and whom to match its variants with."""

    mapping: FolderSpec
    local_type: str
    method: PyramidMethod
    mask_margin_px: float
    image: str
    others: tuple[str, ...]
    only_scaled: tuple[str, ...]


def _match_again(job: _Job) -> MatchedVariants:
    folder, verification = job.mapping.open(), job.method.verification
    itself = cached_features(job.mapping, folder, job.local_type, job.image)

    def judge(other: str, features: Features) -> PairVerifier:
        image_from_world = folder.read().cam_from_world(job.image)
        other_from_world = folder.read().cam_from_world(other)
        if image_from_world is None or other_from_world is None:
            raise DataError(f"{job.image} or {other} has no pose, and is to be verified with it")
        if not isinstance(verification, KnownPoseOptions):
            raise ValueError("map images are verified with their poses")
        return known_pose_of_variants(
            itself.camera,
            features.rays,
            features.slopes,
            other_from_world @ image_from_world.inverse(),
            verification,
        )

    return match_image_again(
        itself,
        *read_frame(folder, job.image, margin_px=job.mask_margin_px),
        job.others,
        lambda other: cached_features(job.mapping, folder, job.local_type, other),
        judge,
        job.method,
        only_scaled=job.only_scaled,
        name=job.image,
    )


@dataclass(eq=False)
class _Added:
    """What was added to an image: keypoints (A, C), and where their descriptors are spooled."""

    px: NDArray[np.float32] | None = None
    descriptors_at: list[tuple[str, int]] = field(default_factory=list)


@dataclass(eq=False)
class _AllMatched:
    """What the images' variants found, by image and the other one."""

    found: dict[_Pair, list[Spooled]] = field(default_factory=dict)
    num_variants: dict[_Pair, int] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    def put(
        self,
        job: _Job,
        found: Sequence[Sequence[Sequence[Any]]],
        num_variants: Sequence[int],
        skipped: str,
        seconds: float,
    ) -> None:
        """Keep what the variants of one image came to; ``found`` as :meth:`MatchSpool.write`."""
        self.seconds += seconds
        self.skipped[job.image] = skipped
        others = (*job.others, *job.only_scaled)
        for other, places, count in zip(others, found, num_variants, strict=True):
            self.found[job.image, other] = [
                Spooled(ImageVariant(*variant), *rest) for variant, *rest in places
            ]
            self.num_variants[job.image, other] = count

    def of_pair(self, pair: _Pair) -> list[tuple[str, Spooled]]:
        """The variants of both images of a pair that match: whose, and where; in order."""
        return [
            (image, place)
            for image, other in (pair, pair[::-1])
            for place in self.found.get((image, other), ())
        ]

    def combine(
        self,
        pair: _Pair,
        base: tuple[NDArray[np.int64], NDArray[np.float64]],
        options: GuidedPyramidOptions,
        spool: MatchSpool,
        keypoints: FeatureReader,
        added: dict[str, _Added],
    ) -> Combined:
        """The matches of a pair with those of the variants; what they add goes to ``added``."""
        if options.mode == "off":
            raise ValueError("only pairs that are tried again are combined")
        places = self.of_pair(pair)
        tried = [
            TriedVariant(0 if image == pair[0] else 1, spool.get(image, at)) for image, at in places
        ]
        first, second = (KeypointUnion(keypoints.read(one), added[one].px) for one in pair)
        combined = combine(base, tried, options.mode, (first, second))
        for image, union, new in zip(pair, (first, second), combined.added, strict=True):
            if len(new):
                added[image].px = union.added()
                added[image].descriptors_at += [
                    (places[number][0], places[number][1].descriptor_at(match, spool.row_bytes))
                    for number, match in new.tolist()
                ]
        return combined

    def told(self, pair: _Pair, combined: Combined) -> tuple[int, str, str]:
        """Of a pair the number of variants tried, the best one and those skipped."""
        tried = sum(self.num_variants.get(one, 0) for one in (pair, pair[::-1]))
        best = ""
        if combined.best is not None:
            image, place = self.of_pair(pair)[combined.best]
            best = f"{'image' if image == pair[0] else 'other'} {place.variant}"
        return tried, best, " | ".join(self._skipped(pair))

    def _skipped(self, pair: _Pair) -> Iterator[str]:
        for name, directed in (("image", pair), ("other", pair[::-1])):
            if directed in self.found and self.skipped[directed[0]]:
                yield f"{name} {self.skipped[directed[0]]}"


@dataclass(frozen=True)
class Spooled:
    """Where in the spool the matches of a variant lie."""

    variant: ImageVariant
    count: int
    keypoints_at: int
    rows_at: int
    scores_at: int
    descriptors_at: int

    def descriptor_at(self, match: int, row_bytes: int) -> int:
        """Where the descriptor of one of its matches begins."""
        return self.descriptors_at + match * row_bytes


class MatchSpool:
    """Variants' matches on disk until all are there: a large map's are too many for memory.

    A file per image below ``folder``.
    """

    def __init__(self, folder: Path, keypoints: FeatureReader, descriptors: FeatureReader) -> None:
        self.folder = folder
        self._columns = keypoints.config.dsize
        self._values = descriptors.config.dsize
        self._descriptor_type = descriptors.config.dtype
        self.row_bytes = descriptors.config.row_bytes

    def write(
        self, image: str, found: Sequence[Sequence[VariantMatches]]
    ) -> tuple[Path, list[list[Any]]]:
        """Keep the matches of an image's variants with each of the others.

        Returns
        -------
        The file, and for ``found`` the fields of :class:`Spooled`, as plain values.

        Raises
        ------
        OutputError : the disk is full.
        """
        path, content = safe_join(self.folder, f"{image}.variants"), bytearray()
        told: list[list[Any]] = []
        for of_other in found:
            told.append([])
            for matches in of_other:
                places = []
                for part, kind in (
                    (matches.keypoints_px, np.float32),
                    (matches.other_rows, np.int64),
                    (matches.scores, np.float32),
                    (matches.descriptors, self._descriptor_type),
                ):
                    places.append(len(content))
                    content += np.ascontiguousarray(part, kind).tobytes()
                told[-1].append([astuple(matches.variant), len(matches), *places])
        write_bytes(path, bytes(content))
        return path, told

    def get(self, image: str, place: Spooled) -> VariantMatches:
        """The matches that were put there, without their descriptors."""
        return VariantMatches(
            place.variant,
            self._read(image, place.keypoints_at, (place.count, self._columns), np.float32),
            np.zeros((place.count, 0), self._descriptor_type),
            self._read(image, place.rows_at, (place.count,), np.int64),
            self._read(image, place.scores_at, (place.count,), np.float32),
        )

    def descriptors(self, places: list[tuple[str, int]]) -> NDArray[Any]:
        """Descriptors (N, D) by the image whose variant they are of, and where they begin."""
        found = np.empty((len(places), self._values), self._descriptor_type)
        for row, (image, at) in enumerate(places):
            found[row] = self._read(image, at, (self._values,), self._descriptor_type)
        return found

    def _read(self, image: str, at: int, shape: tuple[int, ...], kind: DTypeLike) -> NDArray[Any]:
        path = safe_join(self.folder, f"{image}.variants")
        count = int(np.prod(shape))
        return np.fromfile(path, np.dtype(kind), count=count, offset=at).reshape(shape)


class PyramidMapping(PipelineStage):
    """Match map images with few matches again, at other scales and turns."""

    name = "mapping_pyramid"
    version = 2
    uses = (*MATCHING_OPTIONS, "mapping_verification", "guided_pyramid", "mask_margin_px")
    inputs = (Layout.mapping, LOCAL_FEATURES, MAPPING_PAIRS, MAPPING_MATCHES)
    outputs = (MAPPING_PYRAMID,)

    def is_wanted(self) -> bool:
        return self.options.matches_again() and self.options.triangulates()

    def plugins(self) -> Sequence[object]:
        extractors = self.options.make_extractors()
        return [*extractors, *(self.options.make_matcher(one.name) for one in extractors)]

    def run(self, work: StageWork) -> Mapping[str, float]:
        counts: dict[str, float] = {}
        mapping = work.folder(self.layout.mapping(), FEATURES, MAPPING_MATCHES)
        for extractor in self.options.make_extractors():
            found = pyramid_mapping(
                mapping,
                mapping_pairs(work, mapping),
                extractor.name,
                extractor,
                self.options.make_matcher(extractor.name),
                self.options.mapping_verification,
                self.options.guided_pyramid,
                work.out / MAPPING_PYRAMID,
                mask_margin_px=self.options.mask_margin_px,
                work=work,
            )
            counts |= {f"{extractor.name} {name}": count for name, count in found.items()}
        return counts
