"""Keypoints types for localization, with their extraction and matching."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.localization.map_index import ImageMatches
from megloc_kapture.matching.guided_pyramid import base_type, equivalent_types
from megloc_kapture.pipeline.kapture_map import KaptureMap, MapKeypoints, plain_name
from megloc_kapture.pipeline.queries import QueryImage
from megloc_kapture.plugin_loading import load_chosen, plugin_names
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    LocalFeatureExtractor,
    Matcher,
    PluginChoice,
)
from megloc_kapture.stages.guided_pyramid import PyramidMethod, retry_query
from megloc_kapture.stages.local_features import extract_all, read_frame
from megloc_kapture.stages.map_features import rows_found_again
from megloc_kapture.stages.matches import (
    FeatureCache,
    Features,
    VerifiedMatches,
    match_all,
    verification_of,
    verified,
)
from megloc_kapture.stages.options import LocalFeaturesChoice, PipelineOptions
from megloc_kapture.stages.work import BATCH, batched

_MIN_FOUND_AGAIN = 0.5
_NO_MATCHES = VerifiedMatches(np.zeros((0, 2), np.int64), np.zeros(0, np.float32), 0)


class LocalType:
    """A keypoints type of the map with its query extraction and matching; plugins load lazily.

    ``points`` observe the map's points; ``first`` is matched first and differs from ``points`` in
    guided pyramids. ``cache`` holds map features, shared with other types.
    """

    def __init__(
        self,
        kapture_map: KaptureMap,
        points: MapKeypoints,
        first: MapKeypoints,
        choice: LocalFeaturesChoice | None,
        options: PipelineOptions,
        cache: FeatureCache,
    ) -> None:
        self.points, self.first = points, first
        self.choice = choice
        self._map, self._options, self._cache = kapture_map, options, cache
        self._again: dict[str, NDArray[Any]] | None = None

    def prepare(self) -> None:
        """Extract missing map descriptors again; call this before matching."""
        if not self.first.has_descriptors(self._map.images):
            self._again = extract_again(self._map, self.first, self.extractor)

    @property
    def name(self) -> str:
        return self.first.name

    @cached_property
    def matcher(self) -> Matcher:
        own = None if self.choice is None else self.choice.matching
        chosen = own or self._options.matching
        found: Matcher = load_chosen(MATCHERS, chosen, self._options.placement)
        return found

    @cached_property
    def extractor(self) -> LocalFeatureExtractor:
        found = self.brought()
        if found is None:
            raise DataError(
                f"features of type {self.name!r} are missing and no extractor for them is "
                f"installed (known: {', '.join(plugin_names(LOCAL_FEATURES))}); give them with "
                "--features-dir, or in the kapture folder; or, if one of the known ones made "
                f"them, write its name first into {self.name}/keypoints.txt",
                path=self._map.folder.root,
            )
        extractor: LocalFeatureExtractor = load_chosen(
            LOCAL_FEATURES, found, self._options.placement
        )
        return extractor

    def brought(self) -> PluginChoice | None:
        found = self.first.extractor()
        if self.choice is None or (found is not None and found.name != self.choice.name):
            return found
        known = {} if found is None else found.options
        return PluginChoice(name=self.choice.name, options={**self.choice.options, **known})

    def of_query(self, image: QueryImage) -> Features:
        """Return the query's own features, or extract them."""
        brought = image.query.features
        local = next((brought[n] for n in equivalent_types(self.name) if n in brought), None)
        if local is None:
            local = image.extract(self.extractor)
        return Features.of(image.camera, local.keypoints_px, local.descriptors)

    def descriptors(self, image: str) -> NDArray[Any]:
        """Return descriptors (N, D) of a map image."""
        return self.first.descriptors(image) if self._again is None else self._again[image]

    def match(self, query: Features, images: Sequence[str]) -> list[VerifiedMatches]:
        found = dict.fromkeys(images, _NO_MATCHES)
        verify = verification_of(self._options.verify_queries())
        # limits the features in memory
        for names in batched((image for image in images if image in self.first), BATCH):
            others = [self._map_features(self.first, name) for name in names]
            labels = [f"pair with {name}" for name in names]
            pairs = match_all(self.matcher, query, others, labels)
            for name, other, pair in zip(names, others, pairs, strict=True):
                found[name] = verified(query, other, pair, verify)
        return [found[image] for image in images]

    def match_again(
        self, query: Features, pairs: Mapping[str, VerifiedMatches], image: QueryImage
    ) -> tuple[NDArray[np.float32], list[ImageMatches], str]:
        """Match map images with few matches by guided pyramid matching, if enabled.

        Returns query keypoints with added ones last, matches in the order of ``pairs``, and the
        reason if the pyramid was skipped, else "".
        """
        options = self._options
        is_hard = options.guided_pyramid.is_hard
        matches = [(name, pair.matches, pair.scores) for name, pair in pairs.items()]
        if not any(is_hard(pair.num_found, len(pair.matches)) for pair in pairs.values()):
            return query.keypoints_px, matches, ""
        if reason := self.pyramid_obstacle or ("" if image.query.has_image() else "no image"):
            return query.keypoints_px, matches, f"guided pyramid matching: {reason}"
        method = PyramidMethod(
            self.extractor, self.matcher, options.verify_queries(), options.guided_pyramid
        )
        found = retry_query(
            query,
            [each for each in matches if each[0] in self.first],
            lambda name: self._map_features(self.points, name),
            method,
            lambda: (image.pixels, image.feature_mask),
            num_found={name: pair.num_found for name, pair in pairs.items()},
            name=image.query.name,
        )
        skipped = next((one.skipped for one in found.tried), "")
        remark = f"guided pyramid matching: skipped {skipped}" if skipped else ""
        return np.concatenate([query.keypoints_px, found.added_px]), found.matches, remark

    @cached_property
    def pyramid_obstacle(self) -> str:
        """Return the reason why guided pyramid matching cannot extract this type, or ""."""
        try:
            _ = self.extractor
        except MissingWeightsError:
            return f"the weights that extract {self.name} are missing (megloc weights list)"
        except DataError as error:
            return error.message
        return ""

    def _map_features(self, keypoints: MapKeypoints, image: str) -> Features:
        return self._cache.get((keypoints.name, image), lambda: self._load(keypoints, image))

    def _load(self, keypoints: MapKeypoints, image: str) -> Features:
        stored = keypoints.keypoints_px(image)
        source = self if keypoints is self.first else keypoints
        descriptors = source.descriptors(image)
        # keypoints without a point help no pose, but reject wrong matches in the mutual check
        return Features.of(self._map.camera(image), stored, descriptors)


def local_types_of(
    kapture_map: KaptureMap, options: PipelineOptions, cache: FeatureCache
) -> list[LocalType]:
    """Return the types for localization, in the options' order, then others by name.

    Types in the options without map points only help to rank candidates.
    """
    choices = options.local_features
    by_base = {base_type(name): keypoints for name, keypoints in kapture_map.keypoints.items()}
    for stored in kapture_map.stored_types():
        named = _rank(stored, choices) < len(choices)
        if named and base_type(stored) not in by_base:
            by_base[base_type(stored)] = kapture_map.keypoints_of(stored)
    found = []
    for base in sorted(by_base, key=lambda name: (_rank(name, choices), name)):
        points = by_base[base]
        first, rank = points, _rank(base, choices)
        if options.uses_pyramid() and base in kapture_map.stored_types():
            first = kapture_map.keypoints_of(base)
        choice = choices[rank] if rank < len(choices) else None
        found.append(LocalType(kapture_map, points, first, choice, options, cache))
    return found


def _rank(local_type: str, choices: Sequence[LocalFeaturesChoice]) -> int:
    plain = plain_name(base_type(local_type))
    fitting = (rank for rank, one in enumerate(choices) if plain.startswith(plain_name(one.name)))
    return next(fitting, len(choices))


def extract_again(
    kapture_map: KaptureMap, keypoints: MapKeypoints, extractor: LocalFeatureExtractor
) -> dict[str, NDArray[Any]]:
    """Extract descriptors of all stored map keypoints; zero for keypoints not detected again."""
    if not kapture_map.has_images():
        raise DataError(
            f"the map has no descriptors of type {keypoints.name!r}, and no images to extract "
            "them from again",
            path=kapture_map.folder.root,
        )
    found: dict[str, NDArray[Any]] = {}
    again = observed = 0
    for image in kapture_map.images:
        if image not in keypoints:
            continue
        frame = read_frame(kapture_map.folder, image)
        features = extract_all(extractor, [frame], [image])[0]
        stored = keypoints.keypoints_px(image)
        rows = rows_found_again(stored[:, :2], features.keypoints_px[:, :2])
        descriptors = np.zeros((len(stored), features.descriptors.shape[1]), np.float32)
        hit = rows >= 0
        descriptors[hit] = features.descriptors[rows[hit]]
        found[image] = descriptors
        seen, _ = keypoints.index.observed(image)
        again += int(hit[seen].sum())
        observed += len(seen)
    if again < _MIN_FOUND_AGAIN * observed:
        raise DataError(
            f"the map has no descriptors, and extracting {extractor.name} again finds only "
            f"{again} of {observed} observed keypoints: it was made with other options",
            path=kapture_map.folder.root,
        )
    return found
