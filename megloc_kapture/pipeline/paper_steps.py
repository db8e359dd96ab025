"""The steps of the paper, each on or off in a run, and why.

Peng et al., MegLoc, arXiv 2111.13063; docs/paper.md has the same steps with their deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from megloc_kapture.stages.image_pairs import PairingMethod
from megloc_kapture.stages.options import PipelineOptions

RETRIEVAL = frozenset({"netvlad", "delg", "apgem", "openibl"})

_LIFTED = "the points are lifted from the map's depth: map images are not matched with each other"


@dataclass(frozen=True)
class PaperStep:
    """A step of the paper in a run."""

    name: str
    on: bool
    why: str  # who turned it on or off, or what it needs that is not there


@dataclass(frozen=True)
class DatasetFacts:
    """What a dataset comes with, which decides which steps it permits."""

    map_depth: bool  # depth maps of the map images
    query_depth: bool
    model: bool  # points of its own


@dataclass(frozen=True)
class LayeredOptions:
    """A run's options as they came about."""

    preset: str  # its name
    of_preset: PipelineOptions  # of it alone
    of_dataset: PipelineOptions  # with what the dataset's file changes
    chosen: PipelineOptions  # with what the user typed: those of the run


@dataclass(frozen=True)
class _Step:
    """A step: its option, when it is on, why data may not permit it, and its figures."""

    name: str
    option: str
    is_on: Callable[[PipelineOptions], bool]
    obstacle: Callable[[PipelineOptions, DatasetFacts], str] = lambda options, facts: ""
    figures: Callable[[PipelineOptions], str] = lambda options: ""


def paper_steps(options: LayeredOptions, facts: DatasetFacts) -> list[PaperStep]:
    """The steps of the paper in its order, and whether a run does them; nothing is loaded."""
    return [_explained(step, options, facts) for step in _STEPS]


def steps_text(steps: Sequence[PaperStep]) -> str:
    """The steps as lines of text."""
    width = max(len(step.name) for step in steps)
    return "\n".join(
        f"{step.name:{width}s}  {'on' if step.on else 'off':3s}  {step.why}" for step in steps
    )


def _explained(step: _Step, options: LayeredOptions, facts: DatasetFacts) -> PaperStep:
    chosen = step.is_on(options.chosen)
    by_file = step.is_on(options.of_dataset)
    by_preset = step.is_on(options.of_preset)
    if chosen != by_file:
        why = f"an option of this run ({step.option})"
    elif by_file != by_preset:
        why = f"the dataset's file ({step.option})"
    elif chosen:
        why = f"preset {options.preset}"
    else:
        why = f"neither preset {options.preset} nor the dataset's file asks for it ({step.option})"
    obstacle = step.obstacle(options.chosen, facts)
    # what nobody could turn on is said before who did not
    if obstacle and (chosen or chosen == by_file):
        return PaperStep(step.name, on=False, why=obstacle)
    figures = step.figures(options.chosen) if chosen else ""
    return PaperStep(step.name, on=chosen, why=f"{why}; {figures}" if figures else why)


def _uses(extractor: str, matcher: str | None = None) -> Callable[[PipelineOptions], bool]:
    def uses(options: PipelineOptions) -> bool:
        return options.makes_points() and any(
            one.name == extractor
            and (matcher is None or (one.matching or options.matching).name == matcher)
            for one in options.local_features
        )

    return uses


def _superglue(options: PipelineOptions) -> str:
    (first,) = (one for one in options.local_features if one.name == "superpoint")
    matching = first.matching or options.matching
    radius = first.options.get("nms_radius", 4)
    weights = matching.options.get("weights", "superglue_outdoor")
    return f"non-maximum suppression within {radius} px, {weights}"


def _trained_anew(options: PipelineOptions) -> bool:
    return any(one.options.get("descriptor_weights") for one in options.local_features)


def _not_public(options: PipelineOptions, facts: DatasetFacts) -> str:
    if _trained_anew(options):
        return ""
    return "the paper's weights are not public; megloc train descriptor makes such"


def _no_map_depth(options: PipelineOptions, facts: DatasetFacts) -> str:
    known = facts.map_depth or options.mvs.mode != "off"
    return "" if known else "the map images have no depth"


def _pairs_by(method: PairingMethod) -> Callable[[PipelineOptions], bool]:
    return lambda options: method in options.mapping_pairs.by


def _not_matched(options: PipelineOptions, facts: DatasetFacts) -> str:
    if options.map == "lift":
        return _LIFTED
    return "" if options.triangulates() else "the map is given: its images are not matched"


def _no_model(options: PipelineOptions, facts: DatasetFacts) -> str:
    if not facts.model and options.triangulates():
        return "the dataset comes with no model whose points images could see in common"
    return _not_matched(options, facts)


def _no_uncertainty(options: PipelineOptions, facts: DatasetFacts) -> str:
    if options.map == "lift":
        return "a lifted point is seen by one image, which says nothing of its uncertainty"
    return ""


def _not_triangulated(options: PipelineOptions, facts: DatasetFacts) -> str:
    return "" if options.triangulates() else f"map = {options.map}"


def _no_lpips_depth(options: PipelineOptions, facts: DatasetFacts) -> str:
    if not _no_map_depth(options, facts):
        return ""
    return "the paper's indoor strategy; the map images have no depth to make views of"


def _ranks_by_lpips(options: PipelineOptions) -> bool:
    rank = options.localization.rank
    distance = rank.options.get("distance", {})
    return rank.name == "perceptual" and distance.get("name") == "lpips"


def _masks_car(options: PipelineOptions) -> bool:
    return options.preprocessing.masks.unchanging or bool(options.preprocessing.masks.fixed)


def _refines_by(name: str) -> Callable[[PipelineOptions], bool]:
    return lambda options: any(one.name == name for one in options.pose_refinement.by)


_STEPS = (
    _Step(
        "larger side of 1600 px, sides multiples of 8",
        "preprocessing.max_size_px",
        lambda o: o.preprocessing.max_size_px == 1600,
        figures=lambda o: "" if o.preprocessing.upscale else "smaller images are not enlarged",
    ),
    _Step(
        "lens distortion removed",
        "preprocessing.undistort",
        lambda o: o.preprocessing.undistort,
        figures=lambda o: "cameras without distortion stay as they are",
    ),
    _Step(
        "people and vehicles masked",
        "preprocessing.masks.segmenter",
        lambda o: o.preprocessing.masks.segmenter is not None,
        figures=lambda o: str(getattr(o.preprocessing.masks.segmenter, "name", "")),
    ),
    _Step("the own car masked", "preprocessing.masks.unchanging", _masks_car),
    _Step(
        "SuperPoint matched by SuperGlue",
        "local_features",
        _uses("superpoint", "superglue"),
        figures=_superglue,
    ),
    _Step("ASLFeat", "local_features", _uses("aslfeat")),
    _Step("descriptors and matcher trained anew", "local_features", _trained_anew, _not_public),
    _Step(
        "four global features fused",
        "global_features",
        lambda o: {one.name for one in o.global_features} >= RETRIEVAL,
    ),
    _Step("map pairs by poses", "mapping_pairs.by", _pairs_by("poses"), _not_matched),
    _Step("map pairs by co-visibility", "mapping_pairs.by", _pairs_by("covisibility"), _no_model),
    _Step("map pairs by retrieval", "mapping_pairs.by", _pairs_by("retrieval"), _not_matched),
    _Step("map pairs by sequence", "mapping_pairs.by", _pairs_by("sequence"), _not_matched),
    _Step(
        "points triangulated with known poses", "map", lambda o: o.triangulates(), _not_triangulated
    ),
    _Step(
        "points verified by depth",
        "refinement.depth.max_sigmas",
        lambda o: o.refinement.depth.max_sigmas is not None,
        lambda o, facts: "" if facts.map_depth else "the map images have no depth",
    ),
    _Step(
        "uncertain points rejected",
        "refinement.uncertainty",
        lambda o: o.refinement.uncertainty.needs_deviations(),
        _no_uncertainty,
    ),
    _Step(
        "depth of map images by multi-view stereo",
        "mvs.mode",
        lambda o: o.mvs.mode != "off",
        lambda o, facts: "the map images have depth" if facts.map_depth else "",
    ),
    _Step(
        "M images retrieved, N kept by local matches",
        "reranking.by",
        lambda o: o.reranking.reranks(),
        figures=lambda o: f"M = {o.query_pairs.top_k}, N = {o.reranking.keep}",
    ),
    _Step(
        "guided pyramid matching",
        "guided_pyramid.mode",
        lambda o: o.matches_again(),
        figures=lambda o: f"pairs with fewer than {o.guided_pyramid.min_matches} verified matches",
    ),
    _Step(
        "one pose per cluster of candidates",
        "localization.clusters.by",
        lambda o: o.localization.clusters.by != "none",
        figures=lambda o: f"by {o.localization.clusters.by}",
    ),
    _Step(
        "clusters ranked by LPIPS of aligned views",
        "localization.rank",
        _ranks_by_lpips,
        _no_lpips_depth,
    ),
    _Step(
        "poses refined by ICP",
        "pose_refinement.by",
        _refines_by("icp"),
        lambda o, facts: "" if facts.query_depth else "the queries have no depth",
    ),
    _Step(
        "poses refined by rendering", "pose_refinement.by", _refines_by("rendering"), _no_map_depth
    ),
    _Step(
        "rendering by a neural field (NeRF-W)",
        "pose_refinement.by",
        _refines_by("field"),
        lambda o, facts: (
            "" if _refines_by("field")(o) else "it needs a field of the map (megloc train-field)"
        ),
    ),
)
