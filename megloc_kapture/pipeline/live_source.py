"""Features, candidates and matches of a query, computed on demand."""

from __future__ import annotations

import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, check_option, require
from megloc_kapture.features.vlad import Vocabulary, aggregate, train_vlad
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.localization.cluster_poses import Clock
from megloc_kapture.localization.map_index import ImageMatches, QueryView, TypedMatches
from megloc_kapture.matching.guided_pyramid import base_type, equivalent_types
from megloc_kapture.pipeline.kapture_map import KaptureMap, MapKeypoints, plain_name
from megloc_kapture.pipeline.queries import Query, QueryImage
from megloc_kapture.plugin_loading import load_chosen, plugin_names
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    GlobalFeatureExtractor,
    LocalFeatureExtractor,
    Matcher,
    PluginChoice,
)
from megloc_kapture.retrieval.search import rank_rows
from megloc_kapture.stages.global_features import (
    GlobalFeaturesChoice,
    VladSettings,
    read_vocabulary,
    vlad_type,
)
from megloc_kapture.stages.guided_pyramid import PyramidMethod, retry_query
from megloc_kapture.stages.image_pairs import vectors_of
from megloc_kapture.stages.local_features import extract_all, read_frame, read_stored_image
from megloc_kapture.stages.map_features import rows_found_again
from megloc_kapture.stages.matches import (
    CACHED_IMAGES,
    Features,
    VerifiedMatches,
    match_all,
    pairs_to_rematch,
    verified,
)
from megloc_kapture.stages.options import LocalFeaturesChoice, PipelineOptions
from megloc_kapture.stages.preprocessing import ClassMasks, MaskOptions
from megloc_kapture.stages.reranking import counted, rerank
from megloc_kapture.stages.work import BATCH, batched
from megloc_kapture.values import RigidTransform

_MIN_FOUND_AGAIN = 0.5
_NO_MATCHES = VerifiedMatches(np.zeros((0, 2), np.int64), np.zeros(0, np.float32), 0)


class LocalType:
    """A keypoints type of the map, with its extractor and matchers; plugins are loaded lazily.

    ``points`` are the keypoints that observe map points. ``first`` are the keypoints of the first
    matching: the same, or with the guided pyramid the keypoints of the base type.
    """

    def __init__(
        self,
        kapture_map: KaptureMap,
        points: MapKeypoints,
        first: MapKeypoints,
        choice: LocalFeaturesChoice | None,
        options: PipelineOptions,
    ) -> None:
        self.points, self.first = points, first
        self.choice = choice
        self._map, self._options = kapture_map, options
        self._map_features = lru_cache(maxsize=CACHED_IMAGES)(self._load)
        self._again: dict[str, NDArray[Any]] | None = None

    def prepare(self) -> None:
        """Extract missing map descriptors again; call this before matching."""
        if lacking := self.first.without_descriptors(self._map.images):
            about = f"{len(lacking)} map images, such as {lacking[0]}, lack descriptors"
            self._again = extract_again(self._map, self.first, self.required_extractor(about))

    @property
    def name(self) -> str:
        return self.first.name

    @cached_property
    def matcher(self) -> Matcher:
        own_choice = None if self.choice is None else self.choice.matching
        chosen = own_choice or self._options.matching
        matcher: Matcher = load_chosen(MATCHERS, chosen, self._options.placement)
        return matcher

    @cached_property
    def second_matcher(self) -> Matcher | None:
        return self._options.make_second_matcher(of_queries=True)

    @cached_property
    def extractor(self) -> LocalFeatureExtractor:
        choice = self.brought()
        if choice is None:
            raise DataError(
                f"features of type {self.name!r} are missing and no extractor for them is "
                f"installed (known: {', '.join(plugin_names(LOCAL_FEATURES))}); give them with "
                "--features-dir, in the kapture folder, or for a COLMAP model by `megloc import "
                "colmap` with --database or --images; or, if a known extractor made "
                f"them, write its name first in {self.name}/keypoints.txt",
                path=self._map.folder.root,
            )
        extractor: LocalFeatureExtractor = load_chosen(
            LOCAL_FEATURES, choice, self._options.placement
        )
        return extractor

    def required_extractor(self, about: str) -> LocalFeatureExtractor:
        """Return the extractor; DataError that begins with ``about`` if it is not usable."""
        try:
            return self.extractor
        except DataError as error:
            raise DataError(f"{about}: {error.message}", path=error.path) from error

    def brought(self) -> PluginChoice | None:
        stored = self.first.extractor()
        if self.choice is None or (stored is not None and stored.name != self.choice.name):
            return stored
        known = {} if stored is None else stored.options
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

    def match(
        self, query: Features, images: Sequence[str], matcher: Matcher | None = None
    ) -> list[VerifiedMatches]:
        matches = dict.fromkeys(images, _NO_MATCHES)
        verification = self._options.verify_queries()
        # batches limit the features in memory
        for names in batched((image for image in images if image in self.first), BATCH):
            others = [self._map_features(self.first, name) for name in names]
            labels = [f"pair with {name}" for name in names]
            pairs = match_all(matcher or self.matcher, query, others, labels)
            for name, other, pair in zip(names, others, pairs, strict=True):
                matches[name] = verified(query, other, pair, verification)
        return [matches[image] for image in images]

    def match_again(
        self, query: Features, pairs: Mapping[str, VerifiedMatches], image: QueryImage
    ) -> tuple[NDArray[np.float32], list[ImageMatches], str]:
        """If enabled, match the map images that ``second_matching`` selects with its matcher, then
        those with few matches by guided pyramid matching.

        Return the query keypoints, followed by the added keypoints; the matches in the order of
        ``pairs``; and the reason if the pyramid or some of its variants were skipped, else "".
        """
        options = self._options
        if self.second_matcher is not None:
            verified = {("", name): len(pair.matches) for name, pair in pairs.items()}
            chosen = pairs_to_rematch(verified, options.second_matching, of_both=False)
            names = [name for _, name in chosen]
            again = self.match(query, names, self.second_matcher)
            pairs = {**pairs, **dict(zip(names, again, strict=True))}
        is_hard = options.guided_pyramid.is_hard
        matches = [(name, pair.matches, pair.scores) for name, pair in pairs.items()]
        if not any(is_hard(pair.num_found, len(pair.matches)) for pair in pairs.values()):
            return query.keypoints_px, matches, ""
        if reason := self.pyramid_obstacle or ("" if image.query.has_image() else "no image"):
            return query.keypoints_px, matches, f"guided pyramid matching: {reason}"
        method = PyramidMethod(
            self.extractor, self.matcher, options.verify_queries(), options.guided_pyramid
        )
        retried = retry_query(
            query,
            [each for each in matches if each[0] in self.first],
            lambda name: self._map_features(self.points, name),
            method,
            lambda: (image.pixels, image.feature_mask),
            num_found={name: pair.num_found for name, pair in pairs.items()},
            name=image.query.name,
        )
        skipped = retried.skipped
        remark = f"guided pyramid matching: {skipped}" if skipped else ""
        return np.concatenate([query.keypoints_px, retried.added_px]), retried.matches, remark

    @cached_property
    def pyramid_obstacle(self) -> str:
        """Return the reason why guided pyramid matching cannot extract this type, or ""."""
        try:
            _ = self.extractor
        except MissingWeightsError:
            return f"the weights to extract {self.name} are missing (megloc weights list)"
        except DataError as error:
            return error.message
        return ""

    def _load(self, keypoints: MapKeypoints, image: str) -> Features:
        stored = keypoints.keypoints_px(image)
        source = self if keypoints is self.first else keypoints
        descriptors = source.descriptors(image)
        # keypoints without a point are kept: in the mutual check they reject wrong matches
        return Features.of(self._map.camera(image), stored, descriptors)


def local_types_of(kapture_map: KaptureMap, options: PipelineOptions) -> list[LocalType]:
    """Return the keypoints types to match: those in the options, in order, then the others by name.

    Types without map points are matched only if the options name them, to rank candidates.
    """
    choices = options.local_features
    by_base = {base_type(name): keypoints for name, keypoints in kapture_map.keypoints.items()}
    for stored in kapture_map.folder.types("keypoints"):
        named = _rank(stored, choices) < len(choices)
        if named and base_type(stored) not in by_base:
            by_base[base_type(stored)] = kapture_map.keypoints_of(stored)
    types = []
    for base in sorted(by_base, key=lambda name: (_rank(name, choices), name)):
        points = by_base[base]
        first, rank = points, _rank(base, choices)
        if options.uses_pyramid() and base in kapture_map.folder.types("keypoints"):
            first = kapture_map.keypoints_of(base)
        choice = choices[rank] if rank < len(choices) else None
        types.append(LocalType(kapture_map, points, first, choice, options))
    return types


def _rank(local_type: str, choices: Sequence[LocalFeaturesChoice]) -> int:
    plain = plain_name(base_type(local_type))
    fitting = (
        rank for rank, choice in enumerate(choices) if plain.startswith(plain_name(choice.name))
    )
    return next(fitting, len(choices))


def extract_again(
    kapture_map: KaptureMap, keypoints: MapKeypoints, extractor: LocalFeatureExtractor
) -> dict[str, NDArray[Any]]:
    """Extract descriptors of all stored map keypoints; zero if a keypoint is not detected again."""
    require(
        kapture_map.has_images(),
        f"the map has no descriptors of type {keypoints.name!r}, and no images to extract "
        "them from again",
        path=kapture_map.folder.root,
    )
    descriptors_of: dict[str, NDArray[Any]] = {}
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
        descriptors_of[image] = descriptors
        seen, _ = keypoints.index.observed(image)
        again += int(hit[seen].sum())
        observed += len(seen)
    require(
        again >= _MIN_FOUND_AGAIN * observed,
        f"the map has no descriptors, and extracting {extractor.name} again finds only "
        f"{again} of {observed} observed keypoints: the map was made with other options",
        path=kapture_map.folder.root,
    )
    return descriptors_of


@dataclass(frozen=True)
class _GlobalType:
    """A type of global features to compare; ``choice`` is None if queries provide the vectors.

    ``extractor`` is None for VLAD, or if weights are missing. ``stored`` means that the map has the
    vectors, and for VLAD the vocabulary.
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


class MapMatching:
    """Preparation, retrieval, matching and reranking of queries against a map; thread-safe.

    Retrieval uses the global features that map and query share; if some are in the options, only
    those. If none are shared, it uses the options' types that are VLAD or stored in the map, or
    else all the options' types. Missing vectors of map images are computed in memory.
    """

    def __init__(self, kapture_map: KaptureMap, options: PipelineOptions) -> None:
        self._map, self.options = kapture_map, options
        self.types = local_types_of(kapture_map, options)
        masks = options.preprocessing.masks
        check_option(
            masks == MaskOptions(segmenter=masks.segmenter, dynamic=masks.dynamic),
            "preprocessing.masks.fixed, unchanging and user_masks are for folders of images "
            "(`megloc preprocess`); give the mask of a query as Query(mask=...)",
        )
        self._vectors: dict[str, NDArray[np.float32]] = {}
        self._vocabularies: dict[str, tuple[Vocabulary, VladSettings]] = {}
        self._lock = threading.RLock()

    def image(self, query: Query) -> QueryImage:
        """Prepare a query lazily, as the preprocessing stage does."""
        return QueryImage(query, self.options, lambda: self._classes)

    @cached_property
    def _classes(self) -> ClassMasks | None:
        return self.options.preprocessing.masks.make_classes(self.options.placement)

    def features(self, image: QueryImage) -> list[Features]:
        """Return the features of a query, given or extracted, by keypoints type."""
        return [local.of_query(image) for local in self.types]

    def candidates(self, image: QueryImage, features: Sequence[Features]) -> tuple[list[str], bool]:
        """Return the map images to match, and whether they are ranked, best first.

        With exhaustive pairs, all permitted images are returned unranked; likewise in a small map
        without vectors to rank them by.
        """
        query = image.query
        if query.candidates is not None:
            return self._usable(query, query.candidates), True
        permitted = self._permitted(query)
        options = self.options.query_pairs
        if options.by == "exhaustive" or not permitted:
            return permitted, False
        if len(permitted) <= options.top_k and not self.is_at_hand(query.global_features):
            return permitted, False
        return self.rank(image, features, permitted), True

    def ranked(self, image: QueryImage) -> list[str]:
        """Return the given candidates, or the most similar map images, best first."""
        if image.query.candidates is not None:
            return self._usable(image.query, image.query.candidates)
        features = self.features(image)
        images = self.rank(image, features, self._permitted(image.query))
        if self.options.reranking.reranks():
            matches = self.match(features, images)
            images = [images[row] for row in self.rerank(matches)]
        return images

    def match(
        self, features: Sequence[Features], images: Sequence[str]
    ) -> list[list[VerifiedMatches]]:
        """Return verified matches by keypoints type and map image."""
        return [
            local.match(of_query, images)
            for local, of_query in zip(self.types, features, strict=True)
        ]

    def rerank(self, matches: Sequence[Sequence[VerifiedMatches]]) -> list[int]:
        """Return the rows of the images to keep, best first; all if reranking is off."""
        how = self.options.reranking
        numbers = [
            [counted(pair, how.by) for pair in of_type]
            for local, of_type in zip(self.types, matches, strict=True)
            if local.name in self._counted_types
        ]
        return rerank(numbers, how)[0]

    @cached_property
    def _counted_types(self) -> Sequence[str]:
        names = [local.name for local in self.types]
        # a map from another tool may lack the types of the preset
        return self.options.reranking.types_named(names) or names

    def _permitted(self, query: Query) -> list[str]:
        if query.prior is None:
            return self._map.images
        return sorted(self._usable(query, query.prior))

    def _usable(self, query: Query, images: Sequence[str]) -> list[str]:
        unknown = set(images) - self._known_images
        if unknown:
            raise DataError(
                f"query {query.name} has the candidate {min(unknown)}, which is not an image of "
                "the map",
                path=self._map.folder.root,
            )
        return [image for image in dict.fromkeys(images) if image in self._map.poses]

    @cached_property
    def _known_images(self) -> frozenset[str]:
        return frozenset(self._map.folder.read().image_names())

    def rank(
        self, image: QueryImage, features: Sequence[Features], permitted: Sequence[str]
    ) -> list[str]:
        """Return the permitted map images most similar to a query, best first."""
        compared = self._compared(image.query.global_features)
        vectors = [self._of_query(kind, image, features) for kind in compared]
        vectors = [_unit(np.asarray(v, np.float32).reshape(1, -1)) for v in vectors]
        databases = [self._of_map(kind) for kind in compared]
        images = self._map.images
        # usually the whole map is permitted; do not copy its vectors
        if len(chosen := set(permitted)) < len(images):
            members = [row for row, name in enumerate(images) if name in chosen]
            databases = [of_map[members] for of_map in databases]
            images = [images[row] for row in members]
        weights = [kind.weight for kind in compared]
        top_k, fusion = self.options.query_pairs.top_k, self.options.fusion
        rows, _ = rank_rows(vectors, databases, top_k, fusion, weights)
        return [images[row] for row in rows[0]]

    def is_at_hand(self, brought: Collection[str]) -> bool:
        """Return whether the map has vectors to compare with queries that have these types."""
        return all(kind.is_at_hand for kind in self._compared(brought))

    def describe_candidates(self, brought: Collection[str]) -> str:
        """Describe the choice of candidates for queries with these global features."""
        count, top_k = len(self._map.images), self.options.query_pairs.top_k
        how = ", ".join(
            "VLAD over the map's descriptors" if kind.is_vlad else f"global features {kind.name}"
            for kind in self._compared(brought)
        )
        if self.options.query_pairs.by == "exhaustive" or count <= top_k:
            ranked = f"ranked by {how}" if self.is_at_hand(brought) else "not ranked"
            return f"all {count} map images, {ranked}"
        return f"the {top_k} of {count} map images that are most similar by {how}"

    def _compared(self, brought: Collection[str]) -> Sequence[_GlobalType]:
        shared = [name for name in self._map.global_types if name in brought]
        with self._lock:
            if not shared:
                usable = [kind for kind in self._wanted if kind.stored or kind.is_vlad]
                return usable or self._wanted
            weights = {kind.name: kind.weight for kind in self._wanted}
        named = [name for name in shared if name in weights] or shared
        return [_GlobalType(name, weights.get(name, 1.0), stored=True) for name in named]

    @cached_property
    def _wanted(self) -> Sequence[_GlobalType]:
        return [self._wanted_type(choice) for choice in self.options.global_features]

    def _wanted_type(self, choice: GlobalFeaturesChoice) -> _GlobalType:
        if choice.is_vlad:
            name = self._vlad_name(choice)
            return _GlobalType(name, choice.weight, name in self._stored_vocabularies, choice)
        try:
            extractor = choice.make(self.options.placement)
        except MissingWeightsError:  # raised again when the type is used
            stored = any(name.startswith(choice.name) for name in self._map.global_types)
            return _GlobalType(choice.name, choice.weight, stored, choice)
        stored = extractor.name in self._map.global_types
        return _GlobalType(extractor.name, choice.weight, stored, choice, extractor)

    def _vlad_name(self, choice: GlobalFeaturesChoice) -> str:
        """Return the map's VLAD type of the chosen local features, or a new name."""
        local_type = choice.vlad_options().local_type
        for name, (_, settings) in sorted(self._stored_vocabularies.items()):
            if local_type in (None, settings.local_type):
                return name
        name = vlad_type(local_type or base_type(self.types[0].name))
        return name if name not in self._map.global_types else f"{name}, newly trained"

    @cached_property
    def _stored_vocabularies(self) -> dict[str, tuple[Vocabulary, VladSettings]]:
        folder = self._map.folder
        known = {base_type(local.name) for local in self.types}
        vocabularies: dict[str, tuple[Vocabulary, VladSettings]] = {}
        for name in self._map.global_types:
            places = [folder.root / "reconstruction" / "global_features" / name]
            places += [
                d / "global_features" / name / "global_features" for d in folder.features_dirs
            ]
            for stored in filter(None, map(read_vocabulary, places)):
                if stored[1].local_type in known:
                    vocabularies.setdefault(name, stored)
        return vocabularies

    def _of_query(
        self, kind: _GlobalType, image: QueryImage, features: Sequence[Features]
    ) -> NDArray[np.float32]:
        if kind.choice is None:
            return np.asarray(image.query.global_features[kind.name])
        if not kind.is_vlad:
            return image.describe(kind.extractor or kind.choice.make(self.options.placement))
        vocabulary, settings = self._vlad(kind)
        descriptors = features[self._position(settings.local_type)].descriptors
        return aggregate(descriptors, vocabulary)

    def _of_map(self, kind: _GlobalType) -> NDArray[np.float32]:
        with self._lock:
            if kind.name not in self._vectors:
                self._vectors[kind.name] = self._read_or_describe(kind)
            return self._vectors[kind.name]

    def _read_or_describe(self, kind: _GlobalType) -> NDArray[np.float32]:
        images = self._map.images
        if kind.stored or kind.choice is None:
            (source,) = vectors_of([self._map.folder.global_features(kind.name)], images)
            return source[:]
        if kind.is_vlad:
            vocabulary, settings = self._vlad(kind)
            local = self.types[self._position(settings.local_type)]
            return np.stack([aggregate(local.descriptors(name), vocabulary) for name in images])
        require(
            self._map.has_images(),
            f"the map has no global features {kind.name!r}, and no images to compute them from",
            path=self._map.folder.root,
        )
        extractor = kind.extractor or kind.choice.make(self.options.placement)
        return np.stack([self._map_image(name).describe(extractor) for name in images])

    def _map_image(self, name: str) -> QueryImage:
        pixels = read_stored_image(self._map.folder, name)
        return self.image(Query(self._map.camera(name), pixels, name))

    def _vlad(self, kind: _GlobalType) -> tuple[Vocabulary, VladSettings]:
        with self._lock:
            if kind.name not in self._vocabularies:
                stored = self._stored_vocabularies.get(kind.name)
                self._vocabularies[kind.name] = stored or self._trained(kind)
            return self._vocabularies[kind.name]

    def _trained(self, kind: _GlobalType) -> tuple[Vocabulary, VladSettings]:
        assert kind.choice is not None
        options = kind.choice.vlad_options()
        local = self.types[self._position(options.local_type or self.types[0].name)]
        images = [image for image in self._map.images if image in local.first]
        vocabulary = train_vlad(
            images, lambda image: len(local.descriptors(image)), local.descriptors, options
        )
        return vocabulary, VladSettings(local_type=local.name, options=options)

    def _position(self, local_type: str) -> int:
        names = [base_type(local.name) for local in self.types]
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


class LiveSource:
    """Matches of one camera, computed for the requested number of candidates.

    With reranking, a second matcher or guided pyramids, all candidates are matched at once.
    """

    def __init__(
        self, matching: MapMatching, image: QueryImage, cam_from_rig: RigidTransform
    ) -> None:
        self.image, self.clock = image, Clock()
        self.remarks: list[str] = []
        self._matching, self._cam_from_rig = matching, cam_from_rig
        self._features = matching.features(image)
        self.clock.lap("extraction")
        self._images, ranked = matching.candidates(image, self._features)
        self.candidates = self._images
        self.clock.lap("retrieval")
        self._matches: list[list[VerifiedMatches]] = [[] for _ in matching.types]
        options = matching.options
        self._needs_all = options.reranking.reranks() or options.rematches_queries()
        self.in_turn = ranked and not self._needs_all
        if self._needs_all:
            self._view = self._match(len(self._images))

    def view(self, count: int) -> QueryView:
        view = self._view if self._needs_all else self._match(count)
        return view.among(self.candidates[:count])

    def _match(self, count: int) -> QueryView:
        """Match the first ``count`` candidates unless already matched; return all matches."""
        self.clock.start()
        images, types = self._images[:count], self._matching.types
        num_matched = min(map(len, self._matches), default=0)
        new = self._matching.match(self._features, images[num_matched:])
        for matches, added in zip(self._matches, new, strict=True):
            matches += added
        kept = self._matching.rerank(self._matches)
        typed, self.remarks = [], []
        for local, features, matches in zip(types, self._features, self._matches, strict=True):
            pairs = {images[row]: matches[row] for row in kept}
            keypoints_px, named, remark = local.match_again(features, pairs, self.image)
            self.remarks += [remark] if remark else []
            typed.append(TypedMatches(local.points.index, keypoints_px, named))
        if self._needs_all:
            self.candidates = [images[row] for row in kept]
        self.clock.lap("matching")
        image = self.image
        return QueryView(image.query.name, image.camera, tuple(typed), self._cam_from_rig)
