"""Presets: every option of the pipeline in one frozen model, with defaults and units."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Any, Literal

from pydantic import Field, ValidationError

from megloc_kapture.errors import OptionError
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.mapping.lifting import LiftingOptions
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS, Matcher, PluginChoice, load_plugin
from megloc_kapture.plugins import LocalFeatureExtractor as Extractor
from megloc_kapture.stages.image_pairs import MappingPairsOptions, QueryPairsOptions
from megloc_kapture.stages.map_refinement import MapRefinementOptions
from megloc_kapture.stages.matches import NoVerification, Verification
from megloc_kapture.stages.query_poses import LocalizationOptions
from megloc_kapture.values import Options


class PipelineOptions(Options):
    """All options of a run. ``--set matching.options.max_ratio=0.9`` sets one of them."""

    local_features: PluginChoice = PluginChoice(name="rootsift")
    vlad: VladOptions = VladOptions()
    mapping_pairs: MappingPairsOptions = MappingPairsOptions()
    query_pairs: QueryPairsOptions = QueryPairsOptions()
    matching: PluginChoice = PluginChoice(name="nn")
    verification: Literal["geometric", "none"] = Field(
        default="geometric", description="of matches, by known poses or a two-view model"
    )
    mapping_verification: KnownPoseOptions = KnownPoseOptions()
    query_verification: TwoViewOptions = TwoViewOptions()
    map: Literal["triangulate", "lift", "given", "given+triangulate"] = Field(
        default="triangulate",
        description="points of the map: triangulated from matches; keypoints lifted through the "
        "map images' depth maps; those of the model the dataset comes with; or the model's and "
        "triangulated ones, of two keypoints types",
    )
    given_features: PluginChoice = Field(
        default=PluginChoice(name="sift"), description="what a given model was made of"
    )
    triangulation: TriangulationOptions = TriangulationOptions()
    lifting: LiftingOptions = LiftingOptions()
    refinement: MapRefinementOptions = MapRefinementOptions()
    localization: LocalizationOptions = LocalizationOptions()

    def make_extractor(self) -> Extractor:
        """The local-feature extractor; raises PluginError."""
        extractor: Extractor = load_plugin(
            LOCAL_FEATURES, self.local_features.name, self.local_features.options
        )
        return extractor

    def make_given_extractor(self) -> Extractor:
        """The extractor of a given map's features; raises PluginError."""
        extractor: Extractor = load_plugin(
            LOCAL_FEATURES, self.given_features.name, self.given_features.options
        )
        return extractor

    def uses_given_map(self) -> bool:
        """Whether the model that the dataset comes with is localized in."""
        return self.map.startswith("given")

    def makes_points(self) -> bool:
        """Whether the map has points of features that are extracted here."""
        return self.map != "given"

    def local_types(self) -> list[str]:
        """Keypoints types that queries are localized with, the one retrieval uses first.

        Raises
        ------
        PluginError : an extractor cannot be made.
        OptionError : two types of one name.
        """
        types = [self.make_extractor().name] if self.makes_points() else []
        if self.uses_given_map():
            types.append(self.make_given_extractor().name)
        if len(set(types)) < len(types):
            raise OptionError(
                f"map = {self.map} needs local_features of another type than the given map's "
                f"{types[0]!r}"
            )
        return types

    def main_type(self) -> str:
        """The keypoints type that retrieval uses; see :meth:`local_types`."""
        return self.local_types()[0]

    def make_matcher(self) -> Matcher:
        """The matcher; raises PluginError."""
        matcher: Matcher = load_plugin(MATCHERS, self.matching.name, self.matching.options)
        return matcher

    def verify_mapping(self) -> Verification:
        """How mapping pairs are verified."""
        return NoVerification() if self.verification == "none" else self.mapping_verification

    def verify_queries(self) -> Verification:
        """How query pairs are verified."""
        return NoVerification() if self.verification == "none" else self.query_verification


PRESETS: dict[str, PipelineOptions] = {"classic": PipelineOptions()}
DEFAULT_PRESET = "classic"


def options_of_preset(
    preset: str = DEFAULT_PRESET,
    *,
    changes: dict[str, Any] | None = None,
    assignments: Sequence[str] = (),
) -> PipelineOptions:
    """A preset's options with changes: nested tables, then ``key.key=value`` assignments.

    Raises
    ------
    OptionError : unknown preset or option, or a value the option cannot have.
    """
    if preset not in PRESETS:
        raise OptionError(f"unknown preset {preset!r}; known: {', '.join(PRESETS)}")
    tree = PRESETS[preset].model_dump()
    _merge(tree, changes or {})
    _merge(tree, assigned(assignments))
    try:
        return PipelineOptions.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise OptionError(f"unknown option {where}; known here: {_known(where)}") from error
        raise OptionError(f"option {where}: {first['msg']}") from error


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Nested tables of ``key.key=value`` texts; raises OptionError for one that is not."""
    tree: dict[str, Any] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key:
            raise OptionError(f"--set takes key=value, got {assignment!r}")
        nested: dict[str, Any] = {}
        place = nested
        *parents, last = key.strip().split(".")
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = _value(text.strip())
        _merge(tree, nested)
    return tree


def _known(path: str) -> str:
    """The options beside one that does not exist."""
    model: Any = PipelineOptions
    for part in path.split(".")[:-1]:
        annotation = model.model_fields[part].annotation if part in model.model_fields else None
        if not (isinstance(annotation, type) and issubclass(annotation, Options)):
            break
        model = annotation
    return ", ".join(sorted(model.model_fields))


def _merge(tree: dict[str, Any], changes: dict[str, Any]) -> None:
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(tree.get(key), dict):
            _merge(tree[key], value)
        else:
            tree[key] = value


def _value(text: str) -> Any:
    """A TOML value, or the text itself where it is none (``--set verification=none``)."""
    if text.lower() in ("none", "null") and text != "none":
        return None
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
