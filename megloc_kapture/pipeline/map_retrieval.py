"""Which images of a map resemble a query most."""

from __future__ import annotations

import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features.vlad import Vocabulary, aggregate, train_vlad
from megloc_kapture.io.weights import MissingWeightsError, registry
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.local_types import LocalType
from megloc_kapture.pipeline.queries import Preprocessor, Query, QueryImage
from megloc_kapture.plugin_loading import plugin_names
from megloc_kapture.plugins import GLOBAL_FEATURES, GlobalFeatureExtractor
from megloc_kapture.stages.candidates import Candidates, Retrieval, vectors_of
from megloc_kapture.stages.devices import with_device
from megloc_kapture.stages.global_features import (
    GlobalFeaturesChoice,
    VladSettings,
    read_vocabulary,
    vlad_type,
)
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.stages.matches import Features
from megloc_kapture.stages.options import PipelineOptions

# names of vectors in naver's kapture datasets; deep-image-retrieval's extract_kapture.py made them,
# neither whitened nor of images made smaller
_PUBLISHED = {
    name: GlobalFeaturesChoice(
        name="apgem", options={"weights": weights, "whitening": "", "max_size_px": None}
    )
    for name, weights in (
        ("AP-GeM-LM18", "apgem-resnet101-lm18"),
        ("Resnet101-AP-GeM-LM18", "apgem-resnet101-lm18"),
        ("Resnet-101-AP-GeM", "apgem-resnet101"),
    )
}


@dataclass(frozen=True)
class _Compared:
    """One type of vectors that a query is compared by.

    Attributes
    ----------
    name : the map's kapture type; of vectors that it has not, the one they would have.
    choice : what makes the query's; None where the query brings them.
    stored : whether the map has them.
    lacks_weights : whether the query's cannot be made, as the network's weights are not there.
    """

    name: str
    choice: GlobalFeaturesChoice | None
    weight: float
    stored: bool
    lacks_weights: bool = False

    @property
    def is_vlad(self) -> bool:
        """Whether VLAD makes the query's."""
        return self.choice is not None and self.choice.is_vlad


class MapRetrieval:
    """Ranks a map's images for queries.

    Compared are, first, global features that map and query both bring (of these, where there are
    any, those that the options name); else those of the options that the map has vectors of, or,
    of VLAD, descriptors to train it on; else those of the map that an extractor is known for; else
    those of the options, for which the map's images are described once, in memory. Threads may
    share it: what is found out about the map is found out by one of them.
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
        self._ranking: dict[tuple[str, ...], Candidates] = {}
        self._extractors: dict[str, GlobalFeatureExtractor] = {}
        self._vocabularies: dict[str, tuple[Vocabulary, VladSettings]] = {}
        self._lock = threading.RLock()

    def rank(
        self, image: QueryImage, features: Sequence[Features], permitted: Sequence[str]
    ) -> list[str]:
        """Names of the permitted map images most similar to a query, best first.

        Parameters
        ----------
        features : local features of the query, of each type.

        Raises
        ------
        DataError : the map has neither descriptors nor images to compare the query with.
        PluginError, MissingWeightsError : an image network cannot be used.
        """
        compared = self._compared(image.query.global_features)
        vectors = [self._of_query(one, image, features) for one in compared]
        rows = [_unit(np.asarray(v, np.float32).reshape(1, -1)) for v in vectors]
        members = np.array(sorted({self._positions[name] for name in permitted}), np.int64)
        index, _ = self._candidates(compared).of(rows, members, self._options.query_pairs)
        return [self._map.images[i] for i in index[0] if i >= 0]

    def _candidates(self, compared: Sequence[_Compared]) -> Candidates:
        databases = [self._of_map(one) for one in compared]
        names, weights = zip(*((one.name, one.weight) for one in compared), strict=True)
        if names not in self._ranking:
            self._ranking[names] = Candidates(
                lambda positions: [
                    # the whole map is by far the most frequent pool: no copy of it
                    database if len(positions) == len(database) else database[positions]
                    for database in databases
                ],
                Retrieval(names, weights, self._options.fusion),
            )
        return self._ranking[names]

    def is_at_hand(self, brought: Collection[str]) -> bool:
        """Whether queries that bring these global features are ranked by what is there.

        Else the map would have to be described first, or weights are lacking.
        """
        compared = self._compared(brought)
        return all(one.stored and not one.lacks_weights for one in compared)

    def names_one_of(self, brought: Collection[str]) -> bool:
        """Whether the options name one of the types that queries bring."""
        with self._lock:
            return any(one.name in brought for one in self._wanted)

    def describe(self, global_types: Collection[str]) -> str:
        """How queries that bring these global features are compared, for people."""
        return ", ".join(
            "VLAD over the map's descriptors" if one.is_vlad else f"global features {one.name}"
            for one in self._compared(global_types)
        )

    def describe_candidates(self, brought: Collection[str]) -> str:
        """The map images that queries which bring these features are matched with, for people."""
        how, count = self.describe(brought), len(self._map.images)
        top_k = self._options.query_pairs.top_k
        if count <= top_k:
            ranked = f"ranked by {how}" if self.is_at_hand(brought) else "not ranked"
            return f"all {count} map images, {ranked}"
        for one in self._compared(brought):
            if one.lacks_weights:
                return f"not possible: the weights that make {one.name} are missing"
        return f"the {top_k} of {count} map images that are most similar by {how}"

    def _compared(self, brought: Collection[str]) -> Sequence[_Compared]:
        shared = [name for name in self._map.global_types() if name in brought]
        with self._lock:
            if shared:
                weight_of = {one.name: one.weight for one in self._wanted}
                named = [name for name in shared if name in weight_of]
                return [
                    _Compared(name, None, weight_of.get(name, 1.0), stored=True)
                    for name in named or shared
                ]
            usable = [one for one in self._wanted if one.stored or one.is_vlad]
            return usable or self.known or self._wanted

    @cached_property
    def _wanted(self) -> tuple[_Compared, ...]:
        """The options' features."""
        return tuple(map(self._asked_for, self._options.global_features))

    @cached_property
    def known(self) -> tuple[_Compared, ...]:
        """The map's vectors that an extractor is known for."""
        where = self._options.device, self._options.precision
        return tuple(
            self._made_by(with_device(choice, *where), name, 1.0, stored=True)
            for name in self._map.global_types()
            if (choice := _choice_of(name)) is not None
        )

    @cached_property
    def _positions(self) -> dict[str, int]:
        return {name: at for at, name in enumerate(self._map.images)}

    def _asked_for(self, choice: GlobalFeaturesChoice) -> _Compared:
        """One of the options' features, under the name that the map knows them by."""
        if choice.is_vlad:
            name = self._vlad_name(choice)
            return _Compared(name, choice, choice.weight, name in self._stored_vocabularies)
        there = self._map.global_types()
        try:
            name = self._extractor(choice).name
        except MissingWeightsError:  # named when they are needed
            name = next((name for name in there if name.startswith(choice.name)), choice.name)
        if name in there:
            return self._made_by(choice, name, choice.weight, stored=True)
        for other in there:
            if other in _PUBLISHED and _PUBLISHED[other].name == choice.name:
                return self._made_by(_PUBLISHED[other], other, choice.weight, stored=True)
        return self._made_by(choice, name, choice.weight, stored=False)

    def _made_by(
        self, choice: GlobalFeaturesChoice, name: str, weight: float, *, stored: bool
    ) -> _Compared:
        """Vectors of an image network."""
        try:
            self._extractor(choice)
        except MissingWeightsError:
            return _Compared(name, choice, weight, stored, lacks_weights=True)
        return _Compared(name, choice, weight, stored)

    def _vlad_name(self, choice: GlobalFeaturesChoice) -> str:
        """The type of VLAD's vectors: those that the map has, where the options allow them."""
        local_type = choice.vlad_options().local_type
        asked = {key: value for key, value in choice.options.items() if key != "local_type"}
        for name, (_, settings) in sorted(self._stored_vocabularies.items()):
            same = settings.options.model_copy(update=asked) == settings.options
            if same and local_type in (None, settings.local_type):
                return name
        # not the map's own, which were made with other options
        name = vlad_type(local_type or base_type(self._types[0].name))
        return name if name not in self._map.global_types() else f"{name}, trained anew"

    def _of_query(
        self, one: _Compared, image: QueryImage, features: Sequence[Features]
    ) -> NDArray[np.float32]:
        if one.choice is None:
            return np.asarray(image.query.global_features[one.name])
        if not one.choice.is_vlad:
            return image.describe(self._extractor(one.choice))
        vocabulary, settings = self._vlad(one)
        position = self._position(settings.local_type)
        return aggregate(features[position].descriptors, vocabulary, settings.options)

    def _of_map(self, one: _Compared) -> NDArray[np.float32]:
        with self._lock:
            if one.name not in self._vectors:
                self._vectors[one.name] = self._read_or_describe(one)
            return self._vectors[one.name]

    def _read_or_describe(self, one: _Compared) -> NDArray[np.float32]:
        if one.stored:
            readers = [self._map.folder.global_features(one.name)]
            (source,) = vectors_of(readers, self._map.images)
            return source.read(0, len(source))
        if one.choice is None or one.choice.is_vlad:
            vocabulary, settings = self._vlad(one)
            local = self._types[self._position(settings.local_type)]
            rows = [
                aggregate(local.descriptors(image), vocabulary, settings.options)
                for image in self._map.images
            ]
            return np.stack(rows)
        if not self._map.has_images():
            raise DataError(
                f"the map has no global features {one.name!r}, and no images to describe",
                path=self._map.folder.root,
            )
        extractor = self._extractor(one.choice)
        return np.stack([self._map_image(name).describe(extractor) for name in self._map.images])

    def _map_image(self, name: str) -> QueryImage:
        """A map image, pre-processed as queries are."""
        folder = self._map.folder
        pixels = read_image_of(folder.image_path(name), folder.read().camera_of(name))
        return self._preprocessor.of(Query(self._map.camera(name), pixels, name))

    def _extractor(self, choice: GlobalFeaturesChoice) -> GlobalFeatureExtractor:
        key = f"{choice.name} {sorted(choice.options.items())}"
        if key not in self._extractors:
            self._extractors[key] = choice.make()
        return self._extractors[key]

    def _vlad(self, one: _Compared) -> tuple[Vocabulary, VladSettings]:
        """Vocabulary, and how it was made: the map's own where it has one."""
        if one.name not in self._vocabularies:
            stored = self._stored_vocabularies.get(one.name)
            self._vocabularies[one.name] = stored or self._trained(one)
        return self._vocabularies[one.name]

    @cached_property
    def _stored_vocabularies(self) -> dict[str, tuple[Vocabulary, VladSettings]]:
        """Those that lie beside the map's vectors, of local features that queries have."""
        folder = self._map.folder
        known = {base_type(one.name) for one in self._types}
        found: dict[str, tuple[Vocabulary, VladSettings]] = {}
        for name in self._map.global_types():
            places = [folder.root / "reconstruction" / "global_features" / name]
            places += [
                d / "global_features" / name / "global_features" for d in folder.features_dirs
            ]
            for place in places:
                stored = read_vocabulary(place)
                if stored is not None and stored[1].local_type in known:
                    found.setdefault(name, stored)
        return found

    def _trained(self, one: _Compared) -> tuple[Vocabulary, VladSettings]:
        if one.choice is None:
            raise ValueError("vectors that a query brings need no vocabulary")
        vlad = one.choice.vlad_options()
        local = self._types[self._position(vlad.local_type or self._types[0].name)]
        options, images = vlad.of_vlad(), [i for i in self._map.images if i in local.first]
        vocabulary = train_vlad(
            images, lambda image: len(local.descriptors(image)), local.descriptors, options
        )
        return vocabulary, VladSettings(local_type=local.name, options=options)

    def _position(self, local_type: str) -> int:
        names = [base_type(one.name) for one in self._types]
        if base_type(local_type) not in names:
            raise DataError(
                f"VLAD over {local_type} needs local features of this type; queries have "
                f"{', '.join(names)}",
                path=self._map.folder.root,
            )
        return names.index(base_type(local_type))


def _choice_of(global_type: str) -> GlobalFeaturesChoice | None:
    """The extractor of a type of vectors that a map has, where it can be made; else None."""
    if global_type in _PUBLISHED:
        return _PUBLISHED[global_type]
    for plugin in plugin_names(GLOBAL_FEATURES):
        weights = [name for name in registry() if global_type.startswith(name)]
        if not global_type.startswith(plugin) or not weights:
            continue
        choice = GlobalFeaturesChoice(name=plugin, options={"weights": max(weights, key=len)})
        try:
            if choice.make().name == global_type:
                return choice
        except MissingWeightsError:
            return None
    return None


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    norm = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.divide(rows, norm, out=np.zeros_like(rows), where=norm > 0)
