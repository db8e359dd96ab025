"""Stage: guided pyramid matching of queries, as a keypoints type of its own.

``T-pyramid`` has of every image the keypoints of T first, unchanged, then those that were added,
and the matches of all pairs: so every index into T is one into T-pyramid, and what reads kapture
reads it. The work goes by images, not by pairs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import hard_link
from megloc_kapture.io.kapture import (
    FeatureReader,
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
)
from megloc_kapture.io.kapture.features import SUFFIX, feature_folder
from megloc_kapture.matching.guided_pyramid import GuidedPyramidOptions, pyramid_type
from megloc_kapture.matching.verification import TwoViewOptions
from megloc_kapture.plugins import LocalFeatureExtractor, Matcher
from megloc_kapture.stages.guided_pyramid import (
    PyramidMethod,
    RetriedPairs,
    RetriedQuery,
    retry_query,
)
from megloc_kapture.stages.local_features import image_inputs, read_frame
from megloc_kapture.stages.map_points import matched_images
from megloc_kapture.stages.matches import MATCHING_OPTIONS, cached_features
from megloc_kapture.stages.stage import (
    FEATURES,
    LOCAL_FEATURES,
    MAP,
    QUERY_MATCHES,
    QUERY_PAIRS,
    QUERY_PYRAMID,
    Layout,
    PipelineStage,
    StageWork,
)
from megloc_kapture.stages.work import HERE, Digest, FolderSpec, Work, content_of, feature_inputs

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
class _Job:
    query: FolderSpec
    mapping: FolderSpec
    local_type: str
    type_in_map: str
    method: PyramidMethod
    mask_margin_px: float
    image: str
    candidates: tuple[str, ...]


def _retry(job: _Job) -> RetriedQuery:
    folder, mapping = job.query.open(), job.mapping.open()
    stored = folder.matches(job.local_type)
    return retry_query(
        cached_features(job.query, folder, job.local_type, job.image),
        [(other, *stored.read(job.image, other)) for other in job.candidates],
        lambda other: cached_features(job.mapping, mapping, job.type_in_map, other),
        job.method,
        lambda: read_frame(folder, job.image, margin_px=job.mask_margin_px),
        name=job.image,
    )


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
    pairs : those that were matched, and ``output``: see
        :func:`~megloc_kapture.stages.pyramid_mapping.pyramid_mapping`.

    Returns
    -------
    Counts, see :func:`pyramid_mapping`.

    Raises
    ------
    DataError : see :func:`pyramid_mapping`.
    """
    larger = pyramid_type(local_type)
    there = all(larger in mapping.types(kind) for kind in ("keypoints", "descriptors"))
    specs = FolderSpec(query), FolderSpec(mapping)
    types = local_type, larger if there else local_type
    method = PyramidMethod(extractor, matcher, verification, options)
    candidates: dict[str, list[str]] = {}
    for image, other in dict.fromkeys((pair.query, pair.map) for pair in pairs):
        candidates.setdefault(image, []).append(other)
    features = PyramidFeatures(output, query, local_type)
    stored = query.matches(local_type)

    @cache
    def side(number: int, image: str, digest: Digest) -> list[object]:
        folder = (query, mapping)[number]
        readers = folder.keypoints(types[number]), folder.descriptors(types[number])
        camera = astuple(folder.read().camera_of(image))
        return [camera, *(feature_inputs(reader, image, digest) for reader in readers)]

    def inputs(image: str, digest: Digest) -> object:
        of_pairs = [
            [other, side(1, other, digest), content_of(stored.read(image, other))]
            for other in candidates[image]
        ]
        return [
            mask_margin_px,
            image_inputs(query, image, digest),
            side(0, image, digest),
            of_pairs,
        ]

    items = work.items(local_type, sorted(candidates), inputs)
    jobs = [
        _Job(*specs, *types, method, mask_margin_px, image, tuple(candidates[image]))
        for image in sorted(candidates)
        if image not in items.done
    ]
    features.leave(items.done)
    with closing(MatchesWriter(output, larger, orphan=True)) as writer:
        results = work.map(
            _retry, jobs, items.label("guided pyramid"), plugins=(extractor, matcher)
        )
        for job, found in zip(jobs, results, strict=True):
            files = [writer.write(job.image, *one) for one in found.matches]
            files += features.write(job.image, found.added_px, found.added_descriptors)
            items.add(job.image, files, [len(found.added_px) > 0, vars(found.tried)])
    tried, extended = RetriedPairs(), 0
    for image in sorted(candidates):
        more, of_image = items.done[image]
        tried.add(RetriedPairs(**of_image))
        extended += more
    features.write_rest()
    write_csv_table(table_path(output, local_type), COLUMNS, tried.rows)
    return {
        "images_extracted_again": len({row[0] for row in tried.rows}),
        "images_extended": extended,
        "pairs": sum(map(len, candidates.values())),
        **tried.counts(),
    }


def table_path(output: Path, local_type: str) -> Path:
    """The table of the pairs of ``local_type`` that were tried, beside their matches."""
    matches = feature_folder(output, "matches", pyramid_type(local_type), orphan=True)
    return matches.with_name("guided_pyramid.csv")


class PyramidFeatures:
    """Writes the type ``T-pyramid``: of each image the features of T, then those added.

    Files of images that nothing was added to are hard links to those of T where the file system
    has them, so that they take no space twice.

    Parameters
    ----------
    folder : images with the features of ``local_type``.

    Raises
    ------
    DataError : an image has more or fewer descriptors than keypoints.
    """

    def __init__(self, output: Path, folder: KaptureFolder, local_type: str) -> None:
        name = pyramid_type(local_type)
        keypoints, descriptors = folder.keypoints(local_type), folder.descriptors(local_type)
        self._sources: tuple[FeatureReader, FeatureReader] = (keypoints, descriptors)
        self._left = [one for one in sorted(folder.read().image_names()) if one in keypoints]
        for image in self._left:
            lengths = descriptors.length(image), keypoints.length(image)
            if lengths[0] != lengths[1]:
                told = f"{lengths[0]} descriptors for {lengths[1]} keypoints"
                raise DataError(told, path=descriptors.where(image))
        # the name in the files stays that of the method: by it the extractor is found again
        configs = keypoints.config, replace(descriptors.config, keypoints_type=name)
        kinds = keypoints.kind, descriptors.kind
        self._writers = [
            FeatureWriter(output, kind, name, config, orphan=True)
            for kind, config in zip(kinds, configs, strict=True)
        ]
        self._folders = [feature_folder(output, kind, name, orphan=True) for kind in kinds]

    def leave(self, images: Iterable[str]) -> None:
        """Let images be that have been written before."""
        done = set(images)
        self._left = [image for image in self._left if image not in done]

    def write(
        self, image: str, added_px: NDArray[np.float32], added_descriptors: NDArray[Any]
    ) -> list[Path]:
        """Write an image's features, with those added to it; the files. Raises OutputError."""
        added, files = (added_px, added_descriptors), []
        self._left.remove(image)
        for source, writer, folder, more in zip(
            self._sources, self._writers, self._folders, added, strict=True
        ):
            place = folder / f"{image}{SUFFIX[source.kind]}"
            stored = Path(source.where(image))
            if len(more) == 0 and stored.is_file():  # else it is a member of a tar
                hard_link(stored, place)
                files.append(place)
                continue
            files += writer.write(image, np.concatenate([source.read(image), more]))
        return files

    def write_rest(self) -> None:
        """Write the features of the images that nothing is added to; raises OutputError."""
        for image in list(self._left):
            px, descriptors = (np.zeros((0, s.config.dsize), s.config.dtype) for s in self._sources)
            self.write(image, px, descriptors)


class PyramidQueries(PipelineStage):
    """Match queries with few matches again; see :class:`PyramidMapping`."""

    name = "query_pyramid"
    version = 2
    uses = (*MATCHING_OPTIONS, "query_verification", "guided_pyramid", "mask_margin_px")
    inputs = (Layout.mapping, Layout.query, LOCAL_FEATURES, MAP, QUERY_PAIRS, QUERY_MATCHES)
    outputs = (QUERY_PYRAMID,)

    def is_wanted(self) -> bool:
        return self.options.matches_again()

    def plugins(self) -> Sequence[object]:
        extractors = self.options.query_extractors()
        return [*extractors, *(self.options.make_matcher(one.name) for one in extractors)]

    def run(self, work: StageWork) -> Mapping[str, float]:
        counts: dict[str, float] = {}
        pairs = read_pairs(work.path(QUERY_PAIRS))
        for extractor in self.options.query_extractors():
            mapping = matched_images(work, self, extractor.name)
            described = mapping.descriptors(extractor.name)
            found = pyramid_queries(
                work.folder(self.layout.query(), FEATURES, QUERY_MATCHES),
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
