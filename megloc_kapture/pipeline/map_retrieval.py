"""The most similar images of a map to one query, from global features of either side."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features.vlad import Vocabulary, aggregate, train_vlad
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.pipeline.global_choice import GlobalFeaturesChoice
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.options import PipelineOptions
from megloc_kapture.pipeline.queries import Query
from megloc_kapture.pipeline.query_features import QueryFeatures
from megloc_kapture.plugins import GlobalFeatureExtractor
from megloc_kapture.stages.candidates import Candidates, Retrieval, vectors_of
from megloc_kapture.stages.global_vlad import VladSettings, read_vocabulary
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.values import LocalFeatures

_VLAD_WORDS = "VLAD over the map's descriptors"


class MapRetrieval:
    """Ranks a map's images for queries.

    Global features that map and query both bring are compared. Where they share none, those that
    the options name: of VLAD the map's own vocabulary or one trained on its descriptors; of an
    image network the vectors the map has, else its images are described once, in memory.

    Parameters
    ----------
    descriptors : of a map image (N, D), by its name.
    """

    def __init__(
        self,
        kapture_map: KaptureMap,
        options: PipelineOptions,
        query_features: QueryFeatures,
        descriptors: Callable[[str], NDArray[Any]],
    ) -> None:
        self._map, self._options = kapture_map, options
        self._query_features, self._descriptors = query_features, descriptors
        self._vectors: dict[str, NDArray[np.float32]] = {}
        self._extractors: dict[str, GlobalFeatureExtractor] = {}

    def rank(self, query: Query, local: LocalFeatures, permitted: Sequence[str]) -> list[str]:
        """Names of the permitted map images most similar to a query, best first.

        Raises
        ------
        DataError : the map has neither descriptors nor images to compare the query with.
        PluginError, MissingWeightsError : an image network cannot be used.
        """
        shared = self._shared(query.global_features)
        if shared:
            weight_of = {self._network_type(c): c.weight for c in self._networks()}
            weights = [weight_of.get(name, 1.0) for name in shared]
            vectors = [query.global_features[name] for name in shared]
            databases = [self._stored(name) for name in shared]
        else:
            choices = self._options.global_features
            weights = [chosen.weight for chosen in choices]
            described = [self._described(chosen, query, local) for chosen in choices]
            vectors = [vector for vector, _ in described]
            databases = [database for _, database in described]
        retrieval = Retrieval(tuple(shared), tuple(weights), self._options.fusion)
        rows = [_unit(np.asarray(v, np.float32).reshape(1, -1)) for v in vectors]
        members = np.flatnonzero(np.isin(self._map.images, list(permitted)))
        candidates = Candidates(
            lambda positions: [
                # the whole map is by far the most frequent pool: no copy of it
                database if len(positions) == len(database) else database[positions]
                for database in databases
            ],
            [self._map.poses[image] for image in self._map.images],
            retrieval,
        )
        index, _ = candidates.of(rows, members, self._options.query_pairs)
        return [self._map.images[i] for i in index[0] if i >= 0]

    def describe(self, global_types: Collection[str]) -> str:
        """How queries that bring these global features are compared, for people."""
        shared = self._shared(global_types)
        if shared:
            return f"global features {', '.join(shared)}"
        names = [
            _VLAD_WORDS if chosen.is_vlad else f"global features {chosen.name}"
            for chosen in self._options.global_features
        ]
        return ", ".join(names)

    def _shared(self, global_types: Collection[str]) -> list[str]:
        return [name for name in self._map.global_types() if name in global_types]

    def _networks(self) -> list[GlobalFeaturesChoice]:
        return [chosen for chosen in self._options.global_features if not chosen.is_vlad]

    def _network_type(self, chosen: GlobalFeaturesChoice) -> str:
        return self._extractor(chosen).name

    def _extractor(self, chosen: GlobalFeaturesChoice) -> GlobalFeatureExtractor:
        if chosen.name not in self._extractors:
            self._extractors[chosen.name] = chosen.make()
        return self._extractors[chosen.name]

    def _described(
        self, chosen: GlobalFeaturesChoice, query: Query, local: LocalFeatures
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The query's vector, and the rows of the map's images."""
        if chosen.is_vlad:
            vocabulary, settings, database = self._vlad
            return aggregate(local.descriptors, vocabulary, settings.options), database
        extractor = self._extractor(chosen)
        return self._query_features.describe(query, extractor), self._of_map(extractor)

    def _of_map(self, extractor: GlobalFeatureExtractor) -> NDArray[np.float32]:
        if extractor.name in self._map.global_types():
            return self._stored(extractor.name)
        if extractor.name not in self._vectors:
            if not self._map.has_images():
                raise DataError(
                    f"the map has no global features {extractor.name!r}, and no images to describe",
                    path=self._map.folder.root,
                )
            self._vectors[extractor.name] = np.stack(
                [self._describe(image, extractor) for image in self._map.images]
            )
        return self._vectors[extractor.name]

    def _describe(self, image: str, extractor: GlobalFeatureExtractor) -> NDArray[np.float32]:
        folder = self._map.folder
        pixels = read_image_of(folder.image_path(image), folder.read().camera_of(image))
        query = Query(self._map.camera(image), pixels, image)
        return self._query_features.describe(query, extractor)

    def _stored(self, global_type: str) -> NDArray[np.float32]:
        if global_type not in self._vectors:
            readers = [self._map.folder.global_features(global_type)]
            (source,) = vectors_of(readers, self._map.images)
            self._vectors[global_type] = source.read(0, len(source))
        return self._vectors[global_type]

    @cached_property
    def _vlad(self) -> tuple[Vocabulary, VladSettings, NDArray[np.float32]]:
        """Vocabulary, how it was made, and the map's vectors: the map's own where it has them."""
        folder = self._map.folder
        for name in self._map.global_types():
            stored = read_vocabulary(folder.root / "reconstruction" / "global_features" / name)
            if stored is not None and stored[1].local_type == base_type(self._map.local_type):
                return *stored, self._stored(name)
        chosen = next(one for one in self._options.global_features if one.is_vlad)
        options, images = chosen.vlad_options().of_vlad(), self._map.images
        vocabulary = train_vlad(
            images, lambda image: len(self._descriptors(image)), self._descriptors, options
        )
        vectors = [aggregate(self._descriptors(image), vocabulary, options) for image in images]
        settings = VladSettings(local_type=self._map.local_type, options=options)
        return vocabulary, settings, np.stack(vectors)


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    norm = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.divide(rows, norm, out=np.zeros_like(rows), where=norm > 0)
