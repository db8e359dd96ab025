"""Presets: named options, and changes to them from files and the command line."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from typing import Any, TypeVar

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from megloc_kapture.errors import OptionError, check_option, suggestion
from megloc_kapture.io.weights import MissingWeightsError, all_missing, lookup
from megloc_kapture.mapping.pairs import PairsByPosesOptions
from megloc_kapture.mapping.uncertainty import UncertaintyOptions
from megloc_kapture.matching.guided_pyramid import GuidedPyramidOptions
from megloc_kapture.plugin_loading import load_chosen, option_fault
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    POSE_RANKERS,
    POSE_REFINERS,
    SEGMENTERS,
    PluginChoice,
)
from megloc_kapture.stages.global_features import GlobalFeaturesChoice
from megloc_kapture.stages.image_pairs import MappingPairsOptions, QueryPairsOptions
from megloc_kapture.stages.map_refinement import MapRefinementOptions
from megloc_kapture.stages.matches import SecondMatchingOptions
from megloc_kapture.stages.options import LocalFeaturesChoice, PipelineOptions
from megloc_kapture.stages.preprocessing import PreprocessingOptions
from megloc_kapture.stages.query_poses import LocalizationOptions
from megloc_kapture.stages.reranking import RerankingOptions
from megloc_kapture.values import Options, listed

OptionsT = TypeVar("OptionsT", bound=Options)

# the paper as published; benchmarks/*.toml add its dataset-dependent steps (masks,
# co-visibility, sequences, indoor weights), see docs/paper.md
_MEGLOC = PipelineOptions(
    # undistortion changes only distorted cameras; upscaling: docs/experiments/preprocessing.md
    preprocessing=PreprocessingOptions(max_size_px=1600, upscale=True, undistort=True),
    local_features=(
        LocalFeaturesChoice(name="superpoint", matching=PluginChoice(name="superglue")),
        LocalFeaturesChoice(
            name="aslfeat",
            # matcher of ASLFeat's authors; the paper does not specify one
            matching=PluginChoice(name="nn", options={"max_ratio": 0.8}),
        ),
    ),
    global_features=tuple(
        GlobalFeaturesChoice(name=name) for name in ("netvlad", "delg", "apgem", "openibl")
    ),
    mapping_pairs=MappingPairsOptions(
        by=("poses", "retrieval"), poses=PairsByPosesOptions(max_angle_deg=180.0)
    ),
    query_pairs=QueryPairsOptions(top_k=50),
    reranking=RerankingOptions(by="verified", local_type="superpoint"),
    guided_pyramid=GuidedPyramidOptions(mode="all", count="matches"),
    refinement=MapRefinementOptions(uncertainty=UncertaintyOptions(max_robust_sigmas=2.5)),
    localization=LocalizationOptions(rank=PluginChoice(name="inliers")),
)
# all weights of the modern presets permit commercial use: docs/experiments/presets.md
_ALIKED = LocalFeaturesChoice(name="aliked", options={"max_keypoints": 2048, "threshold": 0.05})
_LIGHTGLUE = PluginChoice(name="lightglue", options={"weights": "aliked_lightglue"})
_MODERN = PipelineOptions(
    preprocessing=PreprocessingOptions(max_size_px=1600),
    local_features=(_ALIKED,),
    # rematches only map pairs with few matches; queries take no longer
    second_matching=SecondMatchingOptions(matcher=_LIGHTGLUE, min_matches=100, queries=False),
)
# needs 1 GB of weights, most of it MegaLoc
_MODERN_LARGE = PipelineOptions(
    preprocessing=PreprocessingOptions(max_size_px=1600),
    local_features=(_ALIKED.model_copy(update={"matching": _LIGHTGLUE}),),
    global_features=(GlobalFeaturesChoice(name="megaloc"),),
    reranking=RerankingOptions(by="coverage"),
)

PRESETS: dict[str, PipelineOptions] = {
    "classic": PipelineOptions(),
    "megloc": _MEGLOC,
    "modern": _MODERN,
    "modern-large": _MODERN_LARGE,
}
DEFAULT_PRESET = "classic"

# the most commonly changed options
BASIC_OPTIONS = (
    "device",
    "preprocessing.max_size_px",
    "local_features",
    "matching",
    "global_features",
    "mapping_pairs.by",
    "query_pairs.top_k",
    "guided_pyramid.mode",
    "localization.min_confidence",
    "pose_refinement.by",
)


def options_of_preset(
    preset: str = DEFAULT_PRESET,
    *,
    changes: Sequence[dict[str, Any]] = (),
    assignments: Sequence[str] | Mapping[str, Any] = (),
) -> PipelineOptions:
    """Return a preset's options, modified by ``changes`` (nested tables) and ``assignments``.

    Assignments are ``key.key=value`` strings or map ``key.key`` to values; they are applied last.
    """
    if preset not in PRESETS:
        raise OptionError(f"unknown preset {preset!r}; {suggestion(preset, PRESETS)}")
    return _apply_changes(PRESETS[preset], *changes, parse_assignments(assignments))


def options_with(
    model: type[OptionsT],
    assignments: Sequence[str] | Mapping[str, Any],
    changes: Mapping[str, Any] | None = None,
) -> OptionsT:
    return _apply_changes(model(), parse_assignments(changes or {}), parse_assignments(assignments))


def _apply_changes(options: OptionsT, *changes: dict[str, Any]) -> OptionsT:
    model, tree = type(options), options.model_dump()
    for change in changes:
        _merge(tree, change)
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise OptionError(f"unknown option {where}; {_suggestion(where, model)}") from error
        raise OptionError(f"option {option_fault(error, model)}") from error


def parse_assignments(
    assignments: Sequence[str] | Mapping[str, Any], *, flag: str = "--set"
) -> dict[str, Any]:
    """Convert ``key.key=value`` strings, or a mapping from ``key.key``, to nested tables."""
    tree: dict[str, Any] = {}
    parse = partial(_parse_assignment, flag=flag)
    pairs = assignments.items() if isinstance(assignments, Mapping) else map(parse, assignments)
    for key, value in pairs:
        nested: Any = value
        for part in reversed(key.split(".")):
            nested = {part: nested}
        _merge(tree, nested)
    return tree


def _parse_assignment(assignment: str, flag: str) -> tuple[str, Any]:
    key, equals, text = assignment.partition("=")
    check_option(equals and key, f"{flag} takes key=value, got {assignment!r}")
    key, text = key.strip(), text.strip()
    if text in ("None", "null"):  # "none" stays text, as it is a choice of some options
        return key, None
    try:
        return key, tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return key, text


def _suggestion(path: str, root: type[Options]) -> str:
    keys = [key for key, _, _ in options_of(root())]
    elsewhere = [key for key in keys if key.endswith(f".{path.rpartition('.')[2]}")]
    steps = {key.rpartition(".")[0] for key in keys} - {""}
    similar = elsewhere or get_close_matches(path, [*keys, *steps], n=1)
    return f"did you mean {' or '.join(similar)}?" if similar else f"known: {', '.join(keys)}"


def options_of(options: Options, prefix: str = "") -> Iterator[tuple[str, Any, FieldInfo]]:
    """Yield key, value and field of all options, including nested ones."""
    for name, field in type(options).model_fields.items():
        value = getattr(options, name)
        if isinstance(value, Options) and not isinstance(value, PluginChoice):
            yield from options_of(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value, field


def _merge(tree: dict[str, Any], changes: dict[str, Any]) -> None:
    for key, value in changes.items():
        present = tree.get(key)
        if isinstance(value, dict) and isinstance(present, dict):
            _merge(present, value)
        elif isinstance(value, dict) and isinstance(present, list | tuple | str):
            tree[key] = _merge_choices(key, listed(present), value)
        else:
            tree[key] = value


def _merge_choices(
    key: str, choices: Sequence[Any], changes: dict[str, Any]
) -> list[dict[str, Any]]:
    """Apply changes to the only plugin in a list, or to the plugins that the keys name, as in
    ``local_features.aliked.options.max_keypoints``.
    """
    merged = [
        {"name": choice} if isinstance(choice, str) else dict(choice)
        for choice in choices
        if isinstance(choice, str | dict)
    ]
    named = {choice.get("name"): choice for choice in merged}
    if set(changes) <= set(named):
        for name, change in changes.items():
            check_option(
                isinstance(change, dict),
                f"option {key}.{name}: expected a table, got {change!r}",
            )
            _merge(named[name], change)
    elif len(merged) == 1:
        _merge(merged[0], changes)
    else:
        raise OptionError(
            f"option {key}.{min(changes)}: {key} has several plugins; choose one of: "
            f"{', '.join(f'{key}.{name}' for name in named)}"
        )
    return merged


def check_weights(options: PipelineOptions) -> None:
    """Raise MissingWeightsError, with the download command, if a plugin lacks its weights."""
    if (error := _missing_weights(options)) is None:
        return
    missing_of = {name: _missing_weights(preset) for name, preset in PRESETS.items()}
    # presets whose missing weights are all needed
    weights_of = {
        name: missing.names
        for name, missing in missing_of.items()
        if missing is not None and set(missing.names) <= set(error.names)
    }
    if weights_of and len(error.names) > 1:
        preset = max(weights_of, key=lambda name: len(weights_of[name]))
        free = all(lookup(name).commercial for name in weights_of[preset])
        command = f"megloc weights fetch --preset {preset}{'' if free else ' --accept-licence'}"
        message = f"{error}\nfetch all weights of preset {preset} with: {command}"
        error = MissingWeightsError(message, names=error.names)
    raise error


def _missing_weights(options: PipelineOptions) -> MissingWeightsError | None:
    features = options.local_features
    matchers = [choice.matching or options.matching for choice in features]
    second = [options.second_matcher(of_queries=of_queries) for of_queries in (False, True)]
    chosen: list[tuple[str, PluginChoice | None]] = [
        (SEGMENTERS, options.preprocessing.masks.segmenter),
        *((LOCAL_FEATURES, plugin) for plugin in features),
        *((MATCHERS, plugin) for plugin in (*matchers, *second)),
        (POSE_RANKERS, options.localization.rank),
        *((POSE_REFINERS, plugin) for plugin in options.pose_refinement.by),
    ]
    makers: list[Callable[[], object]] = [
        partial(load_chosen, group, plugin) for group, plugin in chosen if plugin
    ]
    makers += [plugin.make for plugin in options.global_features if not plugin.is_vlad]
    missing = []
    for make in makers:
        try:
            make()
        except MissingWeightsError as error:
            missing.append(error)
    return all_missing(missing) if missing else None
