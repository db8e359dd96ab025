"""Stage: guided pyramid matching of pairs with few matches, as a keypoints type of its own.

MegLoc, section "Guided pyramid matching": when mapping, both images of a pair are extracted again
at other scales and turns, when localizing the query alone. ``T-pyramid`` has of every image the
keypoints of T first, unchanged, then those that were added, and the matches of all pairs: so every
index into T is one into T-pyramid, and what reads kapture reads it.

An image is extracted again once, however many pairs it is in: the work goes by images, not by
pairs. Map images whose poses leave them no view in common are not tried.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs
from megloc_kapture.mapping.pairs import views_can_overlap
from megloc_kapture.matching.guided_pyramid import GuidedPyramidOptions, pyramid_type
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.plugins import LocalFeatureExtractor, Matcher
from megloc_kapture.stages.layout import (
    FEATURES,
    LOCAL_FEATURES,
    MAP,
    MAPPING_MATCHES,
    MAPPING_PAIRS,
    MAPPING_PYRAMID,
    QUERY_MATCHES,
    QUERY_PAIRS,
    QUERY_PYRAMID,
)
from megloc_kapture.stages.map_points import matched_images
from megloc_kapture.stages.matches import MATCHING_OPTIONS
from megloc_kapture.stages.pyramid_jobs import HowToRetry, Retry
from megloc_kapture.stages.pyramid_pairs import PyramidPairs
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, FolderSpec, Work

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions


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
    spec = FolderSpec(mapping)
    how = HowToRetry(
        spec, spec, local_type, local_type, extractor, matcher, verification, options,
        mask_margin_px,
    )  # fmt: skip
    data, poses = mapping.read(), mapping.read().poses()

    def can_gain(first: str, second: str) -> bool:
        if not (first in poses and second in poses):
            return False  # poses are what verifies
        return views_can_overlap(
            data.camera_of(first), poses[first], data.camera_of(second), poses[second]
        )

    # kept in one file, so (a, b) and (b, a) are one pair
    named = sorted({(min(p.query, p.map), max(p.query, p.map)) for p in pairs})
    run = PyramidPairs(mapping, mapping, how, mapping.matches(local_type), named)
    run.find_hard(can_gain)
    jobs = []
    others: dict[str, tuple[list[str], list[str]]] = defaultdict(lambda: ([], []))
    for a, b in run.hard:
        others[a][0].append(b)
        # turning one image is turning the other: b is turned only where it is scaled
        others[b][1].append(a)
    for image in sorted(others):
        jobs.append(Retry(how, image, *map(tuple, others[image])))
    return run.write(jobs, output, work)


def pyramid_queries(
    query: KaptureFolder,
    mapping: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    extractor: LocalFeatureExtractor,
    matcher: Matcher,
    verification: TwoViewOptions,
    options: GuidedPyramidOptions,
    output: Path,
    *,
    mask_margin_px: float = 0.0,
    work: Work = HERE,
) -> dict[str, float]:
    """Try query pairs with few matches again: the query's variants with the map's keypoints.

    The map is neither extracted again nor changed. Where it has keypoints of ``T-pyramid`` the
    variants are matched with those, which begin with those of T.

    Parameters
    ----------
    query : images, with the features and the matches of ``local_type``.
    mapping : images of the map with features of ``local_type``.
    pairs : those that were matched, and ``output``: see :func:`pyramid_mapping`.

    Returns
    -------
    Counts, see :func:`pyramid_mapping`.

    Raises
    ------
    DataError : see :func:`pyramid_mapping`.
    """
    larger = pyramid_type(local_type)
    there = all(larger in mapping.types(kind) for kind in ("keypoints", "descriptors"))
    how = HowToRetry(
        FolderSpec(query),
        FolderSpec(mapping),
        local_type,
        larger if there else local_type,
        extractor,
        matcher,
        verification,
        options,
        mask_margin_px,
    )
    named = list(dict.fromkeys((pair.query, pair.map) for pair in pairs))
    run = PyramidPairs(query, mapping, how, query.matches(local_type), named)
    run.find_hard()
    others: dict[str, list[str]] = defaultdict(list)
    for image, other in run.hard:
        others[image].append(other)
    jobs = [Retry(how, image, tuple(others[image])) for image in sorted(others)]
    return run.write(jobs, output, work)


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

    def run(self, work: StageWork) -> Mapping[str, float]:
        counts: dict[str, float] = {}
        for extractor in self.options.make_extractors():
            found = pyramid_mapping(
                work.folder(self.layout.mapping, FEATURES, MAPPING_MATCHES),
                read_pairs(work.path(MAPPING_PAIRS)),
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


class PyramidQueries(PipelineStage):
    """Match queries with few matches again; see :class:`PyramidMapping`."""

    name = "query_pyramid"
    uses = (*MATCHING_OPTIONS, "query_verification", "guided_pyramid", "mask_margin_px")
    writes = (QUERY_PYRAMID,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        images = (self.layout.mapping, self.layout.query)
        return (*images, LOCAL_FEATURES, MAP, QUERY_PAIRS, QUERY_MATCHES)

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.matches_again()

    def run(self, work: StageWork) -> Mapping[str, float]:
        counts: dict[str, float] = {}
        pairs = read_pairs(work.path(QUERY_PAIRS))
        for extractor in self.options.query_extractors():
            mapping = matched_images(work, self, extractor.name)
            described = mapping.descriptors(extractor.name)
            found = pyramid_queries(
                work.folder(self.layout.query, FEATURES, QUERY_MATCHES),
                mapping,
                [pair for pair in pairs if pair.map in described],
                extractor.name,
                extractor,
                self.options.make_matcher(extractor.name),
                self.options.query_verification,
                self.options.guided_pyramid,
                work.out / QUERY_PYRAMID,
                mask_margin_px=self.options.mask_margin_px,
                work=work,
            )
            counts |= {f"{extractor.name} {name}": count for name, count in found.items()}
        return counts
