"""Ranking of map images by similarity to a query."""

from __future__ import annotations

import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features.vlad import Vocabulary, aggregate, train_vlad
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.local_types import LocalType
from megloc_kapture.pipeline.queries import Preprocessor, Query, QueryImage
from megloc_kapture.plugins import GlobalFeatureExtractor
from megloc_kapture.stages.candidates import Candidates, Retrieval, vectors_of
from megloc_kapture.stages.global_features import (
    GlobalFeaturesChoice,
    VladSettings,
    read_vocabulary,
    vlad_type,
)
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.stages.matches import Features
from megloc_kapture.stages.options import PipelineOptions


@dataclass(frozen=True)
class _GlobalType:
    """Global features for comparison; ``choice`` is None if queries provide them.

    ``extractor`` is None for VLAD and without weights, ``stored`` true if the map has vectors.
    """

    name: str
    weight: float
    stored: bool
    choice: GlobalFeaturesChoice | None = None
    extractor: GlobalFeatureExtractor | None = None

    @property
    def is_vlad(self) -> bool:
        return self.choice is not None and self.choice.is_vlad

    @property
    def is_at_hand(self) -> bool:
        return self.stored and (self.choice is None or self.is_vlad or self.extractor is not None)


class MapRetrieval:
    """Ranks map images for queries; thread-safe.

    Uses global features shared by map and query, else those of the options that the map has, else
    describes map images in memory.
    """

    def __init__(
        self,
        kapture_map: KaptureMap,
        options: PipelineOptions,
        types: Sequence[LocalType],
        preprocessor: Preprocessor,
    ) -> None:
        self._map, self._options, self._types = kapture_map, options, types
        self._preprocessor = preprocessor
        self._vectors: dict[str, NDArray[np.float32]] = {}
        self._candidates: dict[tuple[str, ...], Candidates] = {}
        self._vocabularies: dict[str, tuple[Vocabulary, VladSettings]] = {}
        self._lock = threading.RLock()

    def rank(
        self, image: QueryImage, features: Sequence[Features], permitted: Sequence[str]
    ) -> list[str]:
        """Return the permitted map images most similar to a query, best first."""
        compared = self._compared(image.query.global_features)
        vectors = [self._of_query(one, image, features) for one in compared]
        rows = [_unit(np.asarray(v, np.float32).reshape(1, -1)) for v in vectors]
        members = np.array(sorted({self._positions[name] for name in permitted}), np.int64)
        candidates = self._candidates_by(compared)
        index, _ = candidates.of(rows, members, self._options.query_pairs)
        return [self._map.images[i] for i in index[0] if i >= 0]

    def is_at_hand(self, brought: Collection[str]) -> bool:
        """Return whether queries with these global features can be ranked immediately."""
        return all(one.is_at_hand for one in self._compared(brought))

    def describe(self, brought: Collection[str]) -> str:
        return ", ".join(
            "VLAD over the map's descriptors" if one.is_vlad else f"global features {one.name}"
            for one in self._compared(brought)
        )

    def describe_candidates(self, brought: Collection[str]) -> str:
        how, count = self.describe(brought), len(self._map.images)
        top_k = self._options.query_pairs.top_k
        if count <= top_k:
            ranked = f"ranked by {how}" if self.is_at_hand(brought) else "not ranked"
            return f"all {count} map images, {ranked}"
        return f"the {top_k} of {count} map images that are most similar by {how}"

    def _compared(self, brought: Collection[str]) -> Sequence[_GlobalType]:
        shared = [name for name in self._map.global_types() if name in brought]
        with self._lock:
            if not shared:
                usable = [one for one in self._wanted if one.stored or one.is_vlad]
                return usable or self._wanted
            weights = {one.name: one.weight for one in self._wanted}
        named = [name for name in shared if name in weights] or shared
        return [_GlobalType(name, weights.get(name, 1.0), stored=True) for name in named]

    @cached_property
    def _wanted(self) -> Sequence[_GlobalType]:
        return [self._wanted_type(choice) for choice in self._options.global_features]

    def _wanted_type(self, choice: GlobalFeaturesChoice) -> _GlobalType:
        if choice.is_vlad:
            name = self._vlad_name(choice)
            return _GlobalType(name, choice.weight, name in self._stored_vocabularies, choice)
        try:
            extractor = choice.make(self._options.placement)
        except MissingWeightsError:  # raised again on use
            stored = any(name.startswith(choice.name) for name in self._map.global_types())
            return _GlobalType(choice.name, choice.weight, stored, choice)
        stored = extractor.name in self._map.global_types()
        return _GlobalType(extractor.name, choice.weight, stored, choice, extractor)

    def _vlad_name(self, choice: GlobalFeaturesChoice) -> str:
        """Return the map's VLAD type made with these options, or a new name."""
        local_type = choice.vlad_options().local_type
        asked = {key: value for key, value in choice.options.items() if key != "local_type"}
        for name, (_, settings) in sorted(self._stored_vocabularies.items()):
            same = settings.options.model_copy(update=asked) == settings.options
            if same and local_type in (None, settings.local_type):
                return name
        name = vlad_type(local_type or base_type(self._types[0].name))
        return name if name not in self._map.global_types() else f"{name}, trained anew"

    @cached_property
    def _stored_vocabularies(self) -> dict[str, tuple[Vocabulary, VladSettings]]:
        folder = self._map.folder
        known = {base_type(one.name) for one in self._types}
        found: dict[str, tuple[Vocabulary, VladSettings]] = {}
        for name in self._map.global_types():
            places = [folder.root / "reconstruction" / "global_features" / name]
            places += [
                d / "global_features" / name / "global_features" for d in folder.features_dirs
            ]
            for stored in filter(None, map(read_vocabulary, places)):
                if stored[1].local_type in known:
                    found.setdefault(name, stored)
        return found

    def _candidates_by(self, compared: Sequence[_GlobalType]) -> Candidates:
        databases = [self._of_map(one) for one in compared]
        names, weights = zip(*((one.name, one.weight) for one in compared), strict=True)
        if names not in self._candidates:
            self._candidates[names] = Candidates(
                lambda positions: [
                    # do not copy the whole map, the usual pool
                    database if len(positions) == len(database) else database[positions]
                    for database in databases
                ],
                Retrieval(names, weights, self._options.fusion),
            )
        return self._candidates[names]

    def _of_query(
        self, one: _GlobalType, image: QueryImage, features: Sequence[Features]
    ) -> NDArray[np.float32]:
        if one.choice is None:
            return np.asarray(image.query.global_features[one.name])
        if not one.is_vlad:
            return image.describe(one.extractor or one.choice.make(self._options.placement))
        vocabulary, settings = self._vlad(one)
        descriptors = features[self._position(settings.local_type)].descriptors
        return aggregate(descriptors, vocabulary, settings.options)

    def _of_map(self, one: _GlobalType) -> NDArray[np.float32]:
        with self._lock:
            if one.name not in self._vectors:
                self._vectors[one.name] = self._read_or_describe(one)
            return self._vectors[one.name]

    def _read_or_describe(self, one: _GlobalType) -> NDArray[np.float32]:
        images = self._map.images
        if one.stored or one.choice is None:
            (source,) = vectors_of([self._map.folder.global_features(one.name)], images)
            return source.read(0, len(source))
        if one.is_vlad:
            vocabulary, settings = self._vlad(one)
            local = self._types[self._position(settings.local_type)]
            return np.stack(
                [
                    aggregate(local.descriptors(name), vocabulary, settings.options)
                    for name in images
                ]
            )
        if not self._map.has_images():
            raise DataError(
                f"the map has no global features {one.name!r}, and no images to describe",
                path=self._map.folder.root,
            )
        extractor = one.extractor or one.choice.make(self._options.placement)
        return np.stack([self._map_image(name).describe(extractor) for name in images])

    def _map_image(self, name: str) -> QueryImage:
        folder = self._map.folder
        pixels = read_image_of(folder.image_path(name), folder.read().camera_of(name))
        return self._preprocessor.of(Query(self._map.camera(name), pixels, name))

    def _vlad(self, one: _GlobalType) -> tuple[Vocabulary, VladSettings]:
        with self._lock:
            if one.name not in self._vocabularies:
                stored = self._stored_vocabularies.get(one.name)
                self._vocabularies[one.name] = stored or self._trained(one)
            return self._vocabularies[one.name]

    def _trained(self, one: _GlobalType) -> tuple[Vocabulary, VladSettings]:
        assert one.choice is not None
        vlad = one.choice.vlad_options()
        local = self._types[self._position(vlad.local_type or self._types[0].name)]
        options, images = vlad.of_vlad(), [i for i in self._map.images if i in local.first]
        vocabulary = train_vlad(
            images, lambda image: len(local.descriptors(image)), local.descriptors, options
        )
        return vocabulary, VladSettings(local_type=local.name, options=options)

    @cached_property
    def _positions(self) -> dict[str, int]:
        return {name: at for at, name in enumerate(self._map.images)}

    def _position(self, local_type: str) -> int:
        names = [base_type(one.name) for one in self._types]
        if base_type(local_type) not in names:
            raise DataError(
                f"VLAD over {local_type} needs local features of this type; queries have "
                f"{', '.join(names)}",
                path=self._map.folder.root,
            )
        return names.index(base_type(local_type))


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    norm = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.divide(rows, norm, out=np.zeros_like(rows), where=norm > 0)
