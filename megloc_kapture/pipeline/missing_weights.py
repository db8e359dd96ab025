"""All weights that a run lacks, said at once."""

from __future__ import annotations

from collections.abc import Callable

from megloc_kapture.io.weights import MissingWeightsError, all_missing
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    POSE_RANKERS,
    POSE_REFINERS,
    SEGMENTERS,
    PluginChoice,
)
from megloc_kapture.stages.options import PipelineOptions


def check_weights(options: PipelineOptions) -> None:
    """Make every plugin that a run uses once.

    Raises
    ------
    MissingWeightsError : names each checkpoint that is not there, and how to get it.
    PluginError : a plugin is not there, or refuses its options.
    """
    missing = []
    for make in _makers(options):
        try:
            make()
        except MissingWeightsError as error:
            missing.append(error)
    if missing:
        raise all_missing(missing)


def _makers(options: PipelineOptions) -> list[Callable[[], object]]:
    chosen: list[tuple[str, PluginChoice]] = []
    segmenter = options.preprocessing.masks.segmenter
    if segmenter is not None:
        chosen.append((SEGMENTERS, segmenter))
    matchers = []
    if options.makes_points():
        for local in options.local_features:
            chosen.append((LOCAL_FEATURES, local))
            matchers.append(local.matching or options.matching)
    if options.uses_given_map():
        chosen.append((LOCAL_FEATURES, options.given_features))
        matchers.append(options.matching)
    chosen += [(MATCHERS, matcher) for matcher in matchers]
    chosen.append((POSE_RANKERS, options.localization.rank))
    chosen += [(POSE_REFINERS, one) for one in options.pose_refinement.by]
    makers: list[Callable[[], object]] = [
        lambda group=group, one=one: load_plugin(group, one.name, one.options)  # type: ignore[misc]
        for group, one in chosen
    ]
    makers += [one.make for one in options.global_features if not one.is_vlad]
    return makers
