"""Candidates and matches of a query, computed when they are needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from megloc_kapture.errors import DataError
from megloc_kapture.localization.cluster_poses import Clock
from megloc_kapture.localization.map_index import QueryView, TypedMatches
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.local_types import LocalType
from megloc_kapture.pipeline.map_retrieval import MapRetrieval
from megloc_kapture.pipeline.queries import Query, QueryImage
from megloc_kapture.stages.image_pairs import counted, rerank
from megloc_kapture.stages.matches import Features, VerifiedMatches
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import RigidTransform


@dataclass(frozen=True, eq=False)
class MapMatching:
    """Retrieval, matching and reranking of queries against a map."""

    map: KaptureMap
    options: PipelineOptions
    types: Sequence[LocalType]
    retrieval: MapRetrieval

    def features(self, image: QueryImage) -> list[Features]:
        """Return the features of a query, given or extracted, by keypoints type."""
        return [local.of_query(image) for local in self.types]

    def candidates(self, image: QueryImage, features: Sequence[Features]) -> list[str]:
        """Return the map images to match, best first; all of a small map in its own order."""
        query = image.query
        if query.candidates is not None:
            return self._usable(query, query.candidates)
        permitted = self._permitted(query)
        options = self.options.query_pairs
        if options.by == "exhaustive" or not permitted:
            return permitted
        all_taken = len(permitted) <= options.top_k
        in_order = self.options.localization.sure_confidence is not None
        if all_taken and not in_order and not self.retrieval.is_at_hand(query.global_features):
            return permitted
        return self.retrieval.rank(image, features, permitted)

    def ranked(self, image: QueryImage) -> list[str]:
        """Return the most similar map images, best first, with reranking if enabled."""
        features = self.features(image)
        images = self.retrieval.rank(image, features, self._permitted(image.query))
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
        """Return the rows of the images that stay, best first; all if reranking is off."""
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
        # a foreign map may lack the types of the preset
        return self.options.reranking.types_named(names) or names

    def _permitted(self, query: Query) -> list[str]:
        if query.prior is None:
            return self.map.images
        return sorted(self._usable(query, query.prior))

    def _usable(self, query: Query, images: Sequence[str]) -> list[str]:
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


class LiveSource:
    """Matches of one camera, computed with as many candidates as are asked for.

    Reranking, a second matcher and guided pyramids need the matches with all candidates first.
    """

    def __init__(
        self, matching: MapMatching, image: QueryImage, cam_from_rig: RigidTransform
    ) -> None:
        self.image, self.clock = image, Clock()
        self.remarks: list[str] = []
        self._matching, self._cam_from_rig = matching, cam_from_rig
        self._features = matching.features(image)
        self.clock.lap("extraction")
        self._ranked = self.candidates = matching.candidates(image, self._features)
        self.clock.lap("retrieval")
        self._matches: list[list[VerifiedMatches]] = [[] for _ in matching.types]
        options = matching.options
        self._needs_all = options.reranking.reranks() or options.matches_again()
        if self._needs_all:
            self._view = self._match(len(self._ranked))

    def view(self, count: int) -> QueryView:
        view = self._view if self._needs_all else self._match(count)
        return view.among(self.candidates[:count])

    def _match(self, count: int) -> QueryView:
        """Match the first ``count`` ranked images, as far as they are not matched yet."""
        self.clock.start()
        images, types = self._ranked[:count], self._matching.types
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
