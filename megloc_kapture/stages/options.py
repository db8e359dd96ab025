"""Every option of the pipeline in one frozen model, with defaults and units."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal

from pydantic import Field, model_validator

from megloc_kapture.errors import OptionError
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.mapping.depth import LiftingOptions
from megloc_kapture.matching.guided_pyramid import GuidedPyramidOptions, base_type, pyramid_type
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    LocalFeatureExtractor,
    Matcher,
    PluginChoice,
)
from megloc_kapture.retrieval.fusion import FusionOptions
from megloc_kapture.stages.candidates import QueryPairsOptions, Retrieval
from megloc_kapture.stages.densifying import DensifyOptions
from megloc_kapture.stages.devices import Precision, with_device
from megloc_kapture.stages.global_features import GlobalFeaturesChoice
from megloc_kapture.stages.image_pairs import MappingPairsOptions, RerankingOptions
from megloc_kapture.stages.map_refinement import MapRefinementOptions
from megloc_kapture.stages.matches import NoVerification, Verification
from megloc_kapture.stages.pose_refinement import PoseRefinementOptions
from megloc_kapture.stages.preprocessing import PreprocessingOptions
from megloc_kapture.stages.query_poses import LocalizationOptions
from megloc_kapture.values import Device, Options


def _first_twice(names: Sequence[str]) -> str | None:
    """The first name, by the alphabet, that stands in a list more than once."""
    return min((name for name, count in Counter(names).items() if count > 1), default=None)


class LocalFeaturesChoice(PluginChoice):
    """An extractor of local features, its options, and how its features are matched."""

    matching: PluginChoice | None = Field(
        default=None, description="matcher of this type; none: that of the run"
    )


class PipelineOptions(Options):
    """All options of a run. ``--set matching.options.max_ratio=0.9`` sets one of them."""

    device: Device = Field(
        default="auto",
        description="of networks that name none: auto (a GPU if there is one), cpu, cuda, cuda:N",
    )
    precision: Precision = Field(
        default="full",
        description="of networks that do not say; half: float16 on a GPU, bfloat16 on a processor",
    )
    preprocessing: PreprocessingOptions = PreprocessingOptions()
    local_features: tuple[LocalFeaturesChoice, ...] = Field(
        default=(LocalFeaturesChoice(name="rootsift"),),
        min_length=1,
        description="types of local features, all in one map; VLAD uses the first",
    )
    mask_margin_px: float = Field(
        default=4.0, ge=0, description="features nearer than this to a masked pixel go too"
    )
    global_features: tuple[GlobalFeaturesChoice, ...] = Field(
        default=(GlobalFeaturesChoice(),),
        min_length=1,
        description="what retrieval compares: vlad, or image networks; several are fused",
    )
    fusion: FusionOptions = FusionOptions()
    mapping_pairs: MappingPairsOptions = MappingPairsOptions()
    query_pairs: QueryPairsOptions = QueryPairsOptions()
    reranking: RerankingOptions = RerankingOptions()
    matching: PluginChoice = Field(
        default=PluginChoice(name="nn"), description="of types that name no matcher of their own"
    )
    verification: Literal["geometric", "mapping", "none"] = Field(
        default="geometric",
        description="of matches: within the map by known poses, of queries by a two-view model; "
        "mapping: within the map only",
    )
    mapping_verification: KnownPoseOptions = KnownPoseOptions()
    query_verification: TwoViewOptions = TwoViewOptions()
    guided_pyramid: GuidedPyramidOptions = GuidedPyramidOptions()
    map: Literal["triangulate", "lift", "given"] = Field(
        default="triangulate",
        description="points of the map: triangulated from matches; keypoints lifted through the "
        "map images' depth maps; or those of the model the dataset comes with",
    )
    given_features: PluginChoice = Field(
        default=PluginChoice(name="sift"), description="what a given model was made of"
    )
    triangulation: TriangulationOptions = TriangulationOptions()
    lifting: LiftingOptions = LiftingOptions()
    refinement: MapRefinementOptions = MapRefinementOptions()
    mvs: DensifyOptions = DensifyOptions()
    localization: LocalizationOptions = LocalizationOptions()
    pose_refinement: PoseRefinementOptions = PoseRefinementOptions()
    stages: dict[str, dict[str, Any]] = Field(
        default_factory=dict,
        description="stages of other packages that run as well, by name, with their options",
    )

    @model_validator(mode="after")
    def _placed(self) -> PipelineOptions:
        """Put device and precision into the options of the networks that name none."""
        for name in type(self).model_fields:
            self.__dict__[name] = with_device(getattr(self, name), self.device, self.precision)
        return self

    def make_extractors(self) -> list[LocalFeatureExtractor]:
        """The extractors of local features, in order; raises PluginError, MissingWeightsError."""
        return [
            load_plugin(LOCAL_FEATURES, chosen.name, chosen.options)
            for chosen in self.local_features
        ]

    def make_given_extractor(self) -> LocalFeatureExtractor:
        """The extractor of a given map's features."""
        extractor: LocalFeatureExtractor = load_plugin(
            LOCAL_FEATURES, self.given_features.name, self.given_features.options
        )
        return extractor

    def preprocesses(self) -> bool:
        """Whether anything is done to the images before features are extracted."""
        return self.preprocessing != PreprocessingOptions()

    def changes_frames(self) -> bool:
        """Whether the images become others in size or projection."""
        masked = PreprocessingOptions(masks=self.preprocessing.masks)
        return self.preprocessing != masked

    def uses_given_map(self) -> bool:
        """Whether the model that the dataset comes with is localized in."""
        return self.map == "given"

    def makes_points(self) -> bool:
        """Whether the map has points of features that are extracted here."""
        return self.map != "given"

    def matches_again(self) -> bool:
        """Whether pairs with few matches are tried again by guided pyramid matching."""
        return self.guided_pyramid.mode != "off"

    def triangulates(self) -> bool:
        """Whether map images are matched with each other."""
        return self.map == "triangulate"

    def pairs_by_points(self) -> bool:
        """Whether map images are paired by the points of the model that the dataset comes with."""
        return self.triangulates() and self.mapping_pairs.needs_points()

    def point_types(self) -> list[str]:
        """Keypoints types of our own in the map: the pyramids' where map images were retried."""
        types = self.own_types()
        if self.matches_again() and self.triangulates():
            return [pyramid_type(local_type) for local_type in types]
        return types

    def query_types(self) -> list[str]:
        """Keypoints types of the queries' matches; in the order of :meth:`local_types`."""
        types = self.local_types()
        return [pyramid_type(name) for name in types] if self.matches_again() else types

    def own_extractors(self) -> list[LocalFeatureExtractor]:
        """Extractors of the types that get points of our own; none for a given map alone."""
        return self.make_extractors() if self.makes_points() else []

    def query_extractors(self) -> list[LocalFeatureExtractor]:
        """Extractors of all types that queries are localized with, ours first."""
        given = [self.make_given_extractor()] if self.uses_given_map() else []
        return [*self.own_extractors(), *given]

    def own_types(self) -> list[str]:
        """Keypoints types that are extracted here and get points."""
        return [extractor.name for extractor in self.own_extractors()]

    def local_types(self) -> list[str]:
        """Keypoints types that queries are localized with, the one VLAD uses first."""
        types = [extractor.name for extractor in self.query_extractors()]
        if twice := _first_twice(types):
            raise OptionError(
                f"keypoints type {twice!r} is asked for twice, in local_features or of the given "
                f"map (map = {self.map})"
            )
        return types

    def main_type(self) -> str:
        """The keypoints type that VLAD uses; see :meth:`local_types`."""
        return self.local_types()[0]

    def retrieval(self) -> Retrieval:
        """The global features that are compared, and how they are fused.

        Raises OptionError: two of one type, or options that VLAD cannot have; PluginError,
        MissingWeightsError: an extractor cannot be made.
        """
        main_type = self.main_type()
        types = [chosen.type_name(main_type) for chosen in self.global_features]
        if twice := _first_twice(types):
            raise OptionError(f"global features {twice!r} are asked for twice")
        weights = tuple(chosen.weight for chosen in self.global_features)
        return Retrieval(tuple(types), weights, self.fusion)

    def matching_of(self, local_type: str) -> PluginChoice:
        """How features of a type are matched."""
        if self.makes_points():
            for chosen, extractor in zip(self.local_features, self.make_extractors(), strict=True):
                if extractor.name == base_type(local_type) and chosen.matching is not None:
                    return chosen.matching
        return self.matching

    def make_matcher(self, local_type: str) -> Matcher:
        """The matcher of a type."""
        chosen = self.matching_of(local_type)
        matcher: Matcher = load_plugin(MATCHERS, chosen.name, chosen.options)
        return matcher

    def verify_mapping(self) -> Verification:
        """How mapping pairs are verified."""
        return NoVerification() if self.verification == "none" else self.mapping_verification

    def verify_photographs(self) -> Verification:
        """How pairs of photographs without poses are verified."""
        return NoVerification() if self.verification == "none" else self.query_verification

    def verify_queries(self) -> Verification:
        """How query pairs are verified."""
        return self.query_verification if self.verification == "geometric" else NoVerification()
