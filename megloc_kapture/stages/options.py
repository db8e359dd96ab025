"""Options of the whole pipeline, with defaults and units."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal

from pydantic import Field

from megloc_kapture.errors import OptionError
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.matching.guided_pyramid import GuidedPyramidOptions, base_type, pyramid_type
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.plugin_loading import NetworkOptions, load_chosen
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    LocalFeatureExtractor,
    Matcher,
    PluginChoice,
)
from megloc_kapture.retrieval.search import FusionOptions
from megloc_kapture.stages.densifying import DensifyOptions
from megloc_kapture.stages.global_features import GlobalFeaturesChoice
from megloc_kapture.stages.image_pairs import MappingPairsOptions, QueryPairsOptions, Retrieval
from megloc_kapture.stages.map_refinement import MapRefinementOptions
from megloc_kapture.stages.matches import SecondMatchingOptions, Verification
from megloc_kapture.stages.pose_refinement import PoseRefinementOptions
from megloc_kapture.stages.preprocessing import PreprocessingOptions
from megloc_kapture.stages.query_poses import LocalizationOptions
from megloc_kapture.stages.reranking import RerankingOptions
from megloc_kapture.values import Device, Options, Precision


def _first_twice(names: Sequence[str]) -> str | None:
    return min((name for name, count in Counter(names).items() if count > 1), default=None)


class LocalFeaturesChoice(PluginChoice):
    """A local feature extractor, its options, and the matcher of its features."""

    matching: PluginChoice | None = Field(
        default=None, description="matcher of these features; none: the one set by matching"
    )


class PipelineOptions(Options):
    """All options of a run. ``--set matching.options.max_ratio=0.9`` sets one of them."""

    device: Device = Field(
        default="auto",
        description="default device of networks: auto (a GPU if available), cpu, cuda, cuda:N",
    )
    precision: Precision = Field(
        default="full",
        description="default precision of networks; half: float16 on a GPU, bfloat16 on a CPU",
    )
    preprocessing: PreprocessingOptions = PreprocessingOptions()
    local_features: tuple[LocalFeaturesChoice, ...] = Field(
        default=(LocalFeaturesChoice(name="rootsift"),),
        min_length=1,
        description="types of local features, combined in one map; VLAD uses the first",
    )
    mask_margin_px: float = Field(
        default=4.0, ge=0, description="features closer than this to a masked pixel are removed"
    )
    global_features: tuple[GlobalFeaturesChoice, ...] = Field(
        default=(GlobalFeaturesChoice(),),
        min_length=1,
        description="global features for retrieval: vlad, or networks; several are fused",
    )
    fusion: FusionOptions = FusionOptions()
    mapping_pairs: MappingPairsOptions = MappingPairsOptions()
    query_pairs: QueryPairsOptions = QueryPairsOptions()
    reranking: RerankingOptions = RerankingOptions()
    matching: PluginChoice = Field(
        default=PluginChoice(name="nn"),
        description="matcher of local features, unless local_features sets another matcher",
    )
    verification: Literal["geometric", "mapping", "none"] = Field(
        default="geometric",
        description="verification of matches; geometric: by known poses within the map, by a "
        "two-view model for queries; mapping: only within the map",
    )
    mapping_verification: KnownPoseOptions = KnownPoseOptions()
    query_verification: TwoViewOptions = TwoViewOptions()
    second_matching: SecondMatchingOptions = SecondMatchingOptions()
    guided_pyramid: GuidedPyramidOptions = GuidedPyramidOptions()
    map: Literal["triangulate", "lift"] = Field(
        default="triangulate",
        description="source of map points; triangulate: matches; lift: keypoints that are "
        "backprojected with depth maps",
    )
    triangulation: TriangulationOptions = TriangulationOptions()
    refinement: MapRefinementOptions = MapRefinementOptions()
    mvs: DensifyOptions = DensifyOptions()
    localization: LocalizationOptions = LocalizationOptions()
    pose_refinement: PoseRefinementOptions = PoseRefinementOptions()
    stages: dict[str, dict[str, Any]] = Field(
        default_factory=dict,
        description="third-party stages by name, with their options",
    )

    @property
    def placement(self) -> NetworkOptions:
        return NetworkOptions(device=self.device, half_precision=self.precision == "half")

    def make_extractors(self) -> list[LocalFeatureExtractor]:
        return [
            load_chosen(LOCAL_FEATURES, chosen, self.placement) for chosen in self.local_features
        ]

    def preprocesses(self) -> bool:
        return self.preprocessing != PreprocessingOptions()

    def uses_pyramid(self) -> bool:
        """Return whether guided pyramid matching is enabled."""
        return self.guided_pyramid.mode != "off"

    def rematches_map(self) -> bool:
        """Return whether map pairs are matched again, by a second matcher or guided pyramids."""
        second = self.second_matcher(of_queries=False)
        return self.triangulates() and (self.uses_pyramid() or second is not None)

    def rematches_queries(self) -> bool:
        """Return whether pairs of queries are matched again."""
        return self.uses_pyramid() or self.second_matcher(of_queries=True) is not None

    def second_matcher(self, *, of_queries: bool) -> PluginChoice | None:
        """Return the matcher that matches pairs of queries, or of map images, again, if any."""
        second = self.second_matching
        return second.matcher if (second.queries if of_queries else self.triangulates()) else None

    def triangulates(self) -> bool:
        return self.map == "triangulate"

    def pairs_by_points(self) -> bool:
        return self.triangulates() and self.mapping_pairs.needs_points()

    def matched_types(self) -> list[str]:
        """Return keypoints types of the final matches, in the order of :meth:`local_types`."""
        types = self.local_types()
        return [pyramid_type(name) for name in types] if self.uses_pyramid() else types

    def local_types(self) -> list[str]:
        """Return the keypoints types used for localization, VLAD's type first."""
        types = [extractor.name for extractor in self.make_extractors()]
        if twice := _first_twice(types):
            raise OptionError(f"keypoints type {twice!r} is listed twice in local_features")
        return types

    def main_type(self) -> str:
        """Return the keypoints type used by VLAD."""
        return self.local_types()[0]

    def retrieval(self) -> Retrieval:
        """Return the global features to compare and their fusion weights."""
        main_type = self.main_type()
        types = [chosen.type_name(main_type) for chosen in self.global_features]
        if twice := _first_twice(types):
            raise OptionError(f"global features {twice!r} are listed twice")
        weights = tuple(chosen.weight for chosen in self.global_features)
        return Retrieval(tuple(types), weights, self.fusion)

    def matching_of(self, local_type: str) -> PluginChoice:
        for chosen, extractor in zip(self.local_features, self.make_extractors(), strict=True):
            if extractor.name == base_type(local_type) and chosen.matching is not None:
                return chosen.matching
        return self.matching

    def make_matcher(self, local_type: str) -> Matcher:
        matcher: Matcher = load_chosen(MATCHERS, self.matching_of(local_type), self.placement)
        return matcher

    def make_second_matcher(self, *, of_queries: bool) -> Matcher | None:
        """Create the second matcher of queries or of map images; None if there is none."""
        chosen = self.second_matcher(of_queries=of_queries)
        if chosen is None:
            return None
        matcher: Matcher = load_chosen(MATCHERS, chosen, self.placement)
        return matcher

    def verify_mapping(self) -> Verification:
        return None if self.verification == "none" else self.mapping_verification

    def verify_photographs(self) -> Verification:
        return None if self.verification == "none" else self.query_verification

    def verify_queries(self) -> Verification:
        return self.query_verification if self.verification == "geometric" else None
