"""Stage: guided pyramid matching of map images, which adds keypoints to both images of a pair.

What images' variants give lies in a spool until all is there; then the pairs are gone through in
order, so that the rows of added keypoints do not depend on the workers. Map images whose poses
leave them no view in common are not tried.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.image_variants import ImageVariant
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import output_error
from megloc_kapture.io.kapture import (
    FeatureReader,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
)
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
from megloc_kapture.stages.layout import (
    FEATURES,
    LOCAL_FEATURES,
    MAPPING_MATCHES,
    MAPPING_PAIRS,
    MAPPING_PYRAMID,
)
from megloc_kapture.stages.local_features import read_frame
from megloc_kapture.stages.matches import (
    MATCHING_OPTIONS,
    Features,
    cached_features,
    mapping_pairs,
)
from megloc_kapture.stages.pyramid_queries import COLUMNS, PyramidFeatures, table_path
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, FolderSpec, Work

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions

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
    features = PyramidFeatures(output, mapping, local_type)
    keypoints = mapping.keypoints(local_type)
    added: dict[str, _Added] = defaultdict(_Added)
    tried, hard_pairs = RetriedPairs(), set(hard)
    with (
        MatchSpool(output, keypoints, mapping.descriptors(local_type)) as spool,
        closing(MatchesWriter(output, pyramid_type(local_type), orphan=True)) as writer,
    ):
        again = _AllMatched()
        for job, found in zip(jobs, work.map(_match_again, jobs, "guided pyramid"), strict=True):
            again.put(job, found, spool)
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
    descriptors_at: list[int] = field(default_factory=list)


@dataclass(eq=False)
class _AllMatched:
    """What the images' variants found, by image and the other one."""

    found: dict[_Pair, list[Spooled]] = field(default_factory=dict)
    num_variants: dict[_Pair, int] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    def put(self, job: _Job, matched: MatchedVariants, spool: MatchSpool) -> None:
        """Keep what the variants of one image came to."""
        self.seconds += matched.seconds
        self.skipped[job.image] = described(matched.skipped)
        others = (*job.others, *job.only_scaled)
        for other, found, count in zip(others, matched.found, matched.num_variants, strict=True):
            self.found[job.image, other] = [spool.put(matches) for matches in found]
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
        tried = [TriedVariant(0 if image == pair[0] else 1, spool.get(at)) for image, at in places]
        first, second = (KeypointUnion(keypoints.read(one), added[one].px) for one in pair)
        combined = combine(base, tried, options.mode, (first, second))
        for image, union, new in zip(pair, (first, second), combined.added, strict=True):
            if len(new):
                added[image].px = union.added()
                added[image].descriptors_at += [
                    places[number][1].descriptor_at(match, spool.row_bytes)
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

    A file without a name below ``folder``, gone when it is closed. Use as a context manager.
    """

    def __init__(self, folder: Path, keypoints: FeatureReader, descriptors: FeatureReader) -> None:
        self._columns = keypoints.config.dsize
        self._values = descriptors.config.dsize
        self._descriptor_type = descriptors.config.dtype
        self.row_bytes = descriptors.config.row_bytes
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by __exit__
        except OSError as error:
            raise output_error(folder, error) from error
        self._end = 0

    def __enter__(self) -> MatchSpool:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def put(self, matches: VariantMatches) -> Spooled:
        """Keep the matches of a variant; raises OutputError where the disk is full."""
        parts = (
            np.ascontiguousarray(matches.keypoints_px, np.float32),
            np.ascontiguousarray(matches.other_rows, np.int64),
            np.ascontiguousarray(matches.scores, np.float32),
            np.ascontiguousarray(matches.descriptors, self._descriptor_type),
        )
        places = []
        for part in parts:
            places.append(self._end)
            try:
                self._end += self._file.write(part.tobytes())
            except OSError as error:
                raise output_error(self._folder, error) from error
        return Spooled(matches.variant, len(matches), *places)

    def get(self, place: Spooled) -> VariantMatches:
        """The matches that were put there, without their descriptors."""
        return VariantMatches(
            place.variant,
            self._read(place.keypoints_at, (place.count, self._columns), np.float32),
            np.zeros((place.count, 0), self._descriptor_type),
            self._read(place.rows_at, (place.count,), np.int64),
            self._read(place.scores_at, (place.count,), np.float32),
        )

    def descriptors(self, places: list[int]) -> NDArray[Any]:
        """Descriptors (N, D) by where they begin."""
        found = np.empty((len(places), self._values), self._descriptor_type)
        for row, at in enumerate(places):
            found[row] = self._read(at, (self._values,), self._descriptor_type)
        return found

    def _read(self, at: int, shape: tuple[int, ...], kind: DTypeLike) -> NDArray[Any]:
        self._file.seek(at)
        dtype = np.dtype(kind)
        content = self._file.read(int(np.prod(shape)) * dtype.itemsize)
        return np.frombuffer(content, dtype).reshape(shape)


class PyramidMapping(PipelineStage):
    """Match map images with few matches again, at other scales and turns."""

    name = "mapping_pyramid"
    uses = (*MATCHING_OPTIONS, "mapping_verification", "guided_pyramid", "mask_margin_px")
    writes = (MAPPING_PYRAMID,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (self.layout.mapping, LOCAL_FEATURES, MAPPING_PAIRS, MAPPING_MATCHES)

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.matches_again() and options.triangulates()

    def plugins(self) -> Sequence[object]:
        extractors = self.options.make_extractors()
        return [*extractors, *(self.options.make_matcher(one.name) for one in extractors)]

    def run(self, work: StageWork) -> Mapping[str, float]:
        counts: dict[str, float] = {}
        mapping = work.folder(self.layout.mapping, FEATURES, MAPPING_MATCHES)
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
