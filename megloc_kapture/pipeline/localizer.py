"""Localize images in a kapture map, from Python: see :class:`Localizer`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.localization.cluster_poses import (
    ClusterLocalization,
    QueryView,
    TypedMatches,
    in_turn,
)
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.map_descriptors import extract_again
from megloc_kapture.pipeline.map_retrieval import MapRetrieval
from megloc_kapture.pipeline.options import PipelineOptions
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.queries import KaptureQueries, Query
from megloc_kapture.pipeline.query_features import QueryFeatures
from megloc_kapture.plugins import LOCAL_FEATURES, LocalFeatureExtractor, load_plugin
from megloc_kapture.retrieval.coverage import most_covering
from megloc_kapture.stages.matches import (
    BATCH,
    FeatureCache,
    Features,
    VerifiedMatches,
    batched,
    match_and_verify,
    two_view_verification,
)
from megloc_kapture.stages.parallel import ordered_map
from megloc_kapture.stages.pyramid_query import retry_query
from megloc_kapture.stages.query_poses import localize_views
from megloc_kapture.stages.ranking_scene import KaptureScene
from megloc_kapture.values import Camera, Failure, LocalFeatures, Pose, RigidTransform

# a map this small is matched whole where nothing can rank its images
MAX_EXHAUSTIVE_IMAGES = 50

_Matches = list[tuple[str, NDArray[np.int64], NDArray[np.floating[Any]]]]


class Localizer:
    """Finds camera poses in a map of any tool.

    Query features come with the query, or are extracted where the map's type has an extractor
    plugin. Candidates come from global features that map and query both bring, else from VLAD over
    the map's own descriptors, else, for small maps, from all images.

    Parameters
    ----------
    kapture_map : the map.
    preset : options by name; ``options`` gives them whole instead.

    Raises
    ------
    DataError : the map has no descriptors, and they cannot be made again.
    OptionError, PluginError : the options cannot be used.

    Examples
    --------
    >>> localizer = Localizer(KaptureMap.open("map"))             # doctest: +SKIP
    >>> found = localizer.localize("query.jpg", camera)           # doctest: +SKIP
    >>> found.cam_from_world if found else found.reason           # doctest: +SKIP
    """

    def __init__(
        self,
        kapture_map: KaptureMap,
        preset: str = "classic",
        *,
        options: PipelineOptions | None = None,
    ) -> None:
        self.map = kapture_map
        self.options = options or options_of_preset(preset)
        self._matcher = self.options.make_matcher(kapture_map.local_type)
        self._ranker = self.options.localization.make_ranker()
        self._query_features = QueryFeatures(self.options)
        self._descriptors: dict[str, NDArray[Any]] | None = None
        if not kapture_map.has_descriptors():
            self._descriptors = extract_again(kapture_map, self._extractor)
        self._cache = FeatureCache()
        self._retrieval = MapRetrieval(
            kapture_map, self.options, self._query_features, self._map_descriptors
        )

    # ------------------------------------------------------------------ the public calls

    def localize(
        self,
        image: Path | str | NDArray[np.uint8],
        camera: Camera,
        *,
        prior: Sequence[str] | None = None,
    ) -> Pose | Failure:
        """Localize one image.

        Parameters
        ----------
        image : path of an image file, or uint8 (H, W, 3) RGB.
        camera : its intrinsics, COLMAP's models and pixel origin.
        prior : names of the map images it may be matched with.

        Returns
        -------
        Pose, or Failure, which is falsy and says why.

        Raises
        ------
        DataError : the image cannot be read, is not of its camera's size, or its features cannot
            be extracted because the map's type has no extractor.
        """
        permitted = None if prior is None else tuple(prior)
        return self.localize_query(replace(_query_of(image, camera), prior=permitted))

    def localize_many(
        self,
        queries: Iterable[Query | tuple[Path | str | NDArray[np.uint8], Camera]],
        executor: Executor | None = None,
        *,
        candidates: Mapping[str, Sequence[str]] | None = None,
    ) -> Iterator[Pose | Failure]:
        """Localize lazily, results in the order of the queries.

        Parameters
        ----------
        executor : a thread pool suits: it shares the map, and the work is done outside Python.
        candidates : query name to the map images it is matched with, instead of retrieval.
        """
        wrapped = (q if isinstance(q, Query) else _query_of(*q) for q in queries)
        if candidates is not None:
            wrapped = (replace(q, candidates=tuple(candidates.get(q.name, ()))) for q in wrapped)
        return ordered_map(self.localize_query, wrapped, executor)

    def localize_kapture(
        self, folder: KaptureFolder | Path | str, executor: Executor | None = None
    ) -> Iterator[tuple[str, Pose | Failure]]:
        """Localize the images of a kapture folder: (name, result), sorted by name."""
        opened = folder if isinstance(folder, KaptureFolder) else KaptureFolder(folder)
        queries = KaptureQueries(opened, self.map)
        results = self.localize_many(queries, executor)
        return zip(queries.names, results, strict=True)

    def localize_query(self, query: Query) -> Pose | Failure:
        """Localize a query that may bring its features."""
        with single_threaded():
            return self._localize([(query, RigidTransform.identity())]).result

    def localize_rig(self, views: Sequence[tuple[Query, RigidTransform]]) -> Pose | Failure:
        """Localize several cameras of a rig at once.

        Parameters
        ----------
        views : each camera's query and its ``cam_from_rig``.

        Returns
        -------
        Pose whose ``cam_from_world`` is ``rig_from_world``, or Failure.
        """
        with single_threaded():
            return self._localize(views).result

    def _localize(self, views: Sequence[tuple[Query, RigidTransform]]) -> ClusterLocalization:
        matched = []
        for query, cam_from_rig in views:
            keypoints_px, matches = self._match(query)
            typed = TypedMatches(self.map.index, keypoints_px[:, :2], matches)
            matched.append(QueryView(query.name, query.camera, (typed,), cam_from_rig))
        candidates = in_turn(
            [[image for image, _, _ in typed.matches] for view in matched for typed in view.matches]
        )
        named = {query.name: query for query, _ in views}
        return localize_views(
            matched,
            candidates,
            [self.map.restrictions.frame(image) for image in candidates],
            self.options.localization,
            centers={image: self.map.poses[image].center() for image in candidates},
            ranker=self._ranker,
            scene=KaptureScene(self.map.folder, read_query=lambda name: named[name].read_image()),
        )

    # ------------------------------------------------------------------ the steps

    def candidates(self, query: Query, local: LocalFeatures) -> list[str]:
        """The map images to match a query with: few as they are, many by retrieval, best first."""
        if query.candidates is not None:
            return self._usable(query, query.candidates)
        permitted = self._permitted(query)
        options = self.options.query_pairs
        if options.by == "exhaustive" or len(permitted) <= options.top_k:
            return permitted
        return self._rank(query, local, permitted)

    def ranked(self, query: Query) -> list[str]:
        """The most similar map images of a query, best first, however few there are."""
        local = query.features or self._extract(query)
        return self._rank(query, local, self._permitted(query))

    def _permitted(self, query: Query) -> list[str]:
        if query.prior is None:
            return self.map.images
        return self._usable(query, query.prior)

    def _usable(self, query: Query, images: Sequence[str]) -> list[str]:
        """Those of the images that have a pose and see points; the others cannot help."""
        unknown = set(images) - self._known_images
        if unknown:
            raise DataError(
                f"query {query.name} is to be matched with {min(unknown)}, which is no image of "
                "the map",
                path=self.map.folder.root,
            )
        return [image for image in dict.fromkeys(images) if image in self.map.poses]

    @cached_property
    def _known_images(self) -> frozenset[str]:
        return frozenset(self.map.folder.read().image_names())

    def _rank(self, query: Query, local: LocalFeatures, permitted: Sequence[str]) -> list[str]:
        return self._retrieval.rank(query, local, permitted)

    def describe_retrieval(self, global_types: Collection[str]) -> str:
        """How the candidates of queries that bring these global features are found, for people."""
        options = self.options.query_pairs
        if options.by == "exhaustive" or len(self.map.images) <= options.top_k:
            return f"all {len(self.map.images)} map images"
        return self._retrieval.describe(global_types)

    def _match(self, query: Query) -> tuple[NDArray[np.float32], _Matches]:
        """The query's keypoints, and their matches with each candidate."""
        local = query.features or self._extract(query)
        features = Features.of(query.camera, local.keypoints_px, local.descriptors)
        verification = two_view_verification(self.options.query_verification)
        if self.options.verification == "none":
            verification = _keep_all
        found: list[tuple[str, VerifiedMatches]] = []
        for images in batched(self.candidates(query, local), BATCH):
            pairs = match_and_verify(
                features,
                [self._map_features(image) for image in images],
                self._matcher,
                [verification] * len(images),
            )
            found += zip(images, pairs, strict=True)
        matches = [(image, pair.matches, pair.scores) for image, pair in self._reranked(found)]
        if not self.options.matches_again():
            return features.keypoints_px, matches
        return retry_query(
            features,
            matches,
            self._map_features,
            self._extractor,
            self._matcher,
            image=query.read_image,
            mask=lambda: self._query_features.mask(query),
            verification=self.options.query_verification,
            options=self.options.guided_pyramid,
            name=query.name,
        )

    def _reranked(
        self, found: list[tuple[str, VerifiedMatches]]
    ) -> list[tuple[str, VerifiedMatches]]:
        """Those of the candidates that are kept, best first; all without reranking."""
        options = self.options.reranking
        if not options.reranks():
            return found
        if options.by == "coverage":
            keypoints = [np.unique(pair.matches[:, 0]) for _, pair in found]
            order, _ = most_covering(keypoints, options.keep)
            return [found[rank] for rank in order]

        def count(rank: int) -> int:
            pair = found[rank][1]
            return pair.num_found if options.by == "matches" else len(pair.matches)

        best = sorted(range(len(found)), key=lambda rank: (-count(rank), rank))
        return [found[rank] for rank in best[: options.keep]]

    def _extract(self, query: Query) -> LocalFeatures:
        return self._query_features.extract(query, self._extractor)

    @cached_property
    def _extractor(self) -> LocalFeatureExtractor:
        found = self.map.extractor()
        if found is None:
            raise DataError(
                f"features of type {self.map.local_type!r} are missing and no extractor for them "
                "is installed; give them with --features-dir, or in the kapture folder",
                path=self.map.folder.root,
            )
        chosen = {one.name: one.options for one in self.options.local_features}
        options = {**chosen.get(found.name, {}), **found.options}
        extractor: LocalFeatureExtractor = load_plugin(LOCAL_FEATURES, found.name, options)
        if not isinstance(extractor, LocalFeatureExtractor):
            raise PluginError(f"plugin {found.name!r} is no extractor of local features")
        return extractor

    def _map_features(self, image: str) -> Features:
        return self._cache.get(image, lambda: self._load_map_features(image))

    def _load_map_features(self, image: str) -> Features:
        keypoints = self.map.keypoints_px(image)
        descriptors = self._map_descriptors(image)
        if len(keypoints) != len(descriptors):
            raise DataError(
                f"{image} has {len(keypoints)} keypoints and {len(descriptors)} descriptors",
                path=self.map.folder.root,
            )
        camera = self.map.camera(image)
        # only keypoints that observe a point can help a pose, but all take part in the mutual
        # check: without its rivals a wrong match would look unrivalled
        return Features.of(camera, keypoints, descriptors)

    def _map_descriptors(self, image: str) -> NDArray[Any]:
        if self._descriptors is not None:
            return self._descriptors[image]
        return self.map.descriptors(image)


def _query_of(image: Path | str | NDArray[np.uint8], camera: Camera) -> Query:
    return Query(camera, image, str(image) if isinstance(image, str | Path) else "query")


def _keep_all(a: Features, b: Features, matches: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.ones(len(matches), dtype=bool)
