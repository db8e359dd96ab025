"""A run of ``megloc eval``: a dataset and options, and which steps of the paper they are.

Peng et al., MegLoc, arXiv 2111.13063; docs/paper.md has the same steps with their deviations.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from megloc_kapture.errors import OptionError
from megloc_kapture.io.dataset_tables import read_protocol
from megloc_kapture.pipeline.datasets import (
    EVERY_POSE,
    KAPTURE,
    TWIN_PREFIX,
    BenchmarkFile,
    DatasetChoice,
    choose_dataset,
    find_benchmark,
    has_model,
    read_benchmark,
)
from megloc_kapture.pipeline.presets import assigned, options_of_preset
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.stage import SUBMISSIONS

_log = logging.getLogger(__name__)

RETRIEVAL = frozenset({"netvlad", "delg", "apgem", "openibl"})


@dataclass(frozen=True)
class DatasetFacts:
    """What a dataset comes with, which decides which steps it permits."""

    map_depth: bool  # depth maps of the map images
    query_depth: bool
    model: bool  # points of its own


@dataclass(frozen=True)
class PaperStep:
    """A step of the paper in a run."""

    name: str
    on: bool
    why: str  # who turned it on or off, or what it needs that is not there


@dataclass(frozen=True)
class Run:
    """What is run: a dataset, with which options; nothing is written yet.

    Attributes
    ----------
    preset : its name.
    options : those of the run, with what the dataset's file and the user change.
    benchmark : the dataset's file, which changes the protocol too.
    facts : what the dataset comes with; None: nobody asks for the steps of the paper.
    """

    source: DatasetChoice
    preset: str
    options: PipelineOptions
    benchmark: BenchmarkFile = BenchmarkFile(dataset=KAPTURE)
    facts: DatasetFacts | None = None

    @property
    def dataset(self) -> str:
        """The dataset's name."""
        return self.source.name

    @property
    def default_workspace(self) -> Path:
        """``runs/DATASET-PRESET``; of kapture folders, ``runs/kapture-ROOT-PRESET``."""
        source, folder = self.source, ""
        if source.root is not None and source.adapter is None:
            folder = Path(os.path.abspath(source.root)).name
        return Path("runs") / "-".join(filter(None, (self.dataset, folder, self.preset)))

    @property
    def label(self) -> str:
        """What its result is called: ``kapture, classic with local_features=aliked``."""
        changed = " and ".join(f"{key}={names}" for key, names in self._changed_features().items())
        return f"{self.dataset}, {self.preset}{' with ' if changed else ''}{changed}"

    def _changed_features(self) -> dict[str, str]:
        """Types of features, by option, that the user has chosen instead of the usual ones."""
        usual, changed = self._options_of_file(), {}
        for key in ("local_features", "global_features"):
            names = [one.name for one in getattr(self.options, key)]
            if names != [one.name for one in getattr(usual, key)]:
                changed[key] = "+".join(names)
        return changed

    def _options_of_file(self) -> PipelineOptions:
        """The preset's options with what the dataset's file changes."""
        facts = self.facts or DatasetFacts(map_depth=False, query_depth=False, model=False)
        changes = self.benchmark.changes(
            self.preset, map_depth=facts.map_depth, query_depth=facts.query_depth
        )
        return options_of_preset(self.preset, changes=changes)

    def steps(self) -> list[PaperStep]:
        """The steps of the paper in its order, and whether the run does them; nothing is loaded."""
        if self.facts is None:
            return []
        of_preset = options_of_preset(self.preset, changes=[EVERY_POSE])
        usual = (self._options_of_file(), of_preset)
        wanted = (self.options, *(_permitted(one, self.facts) for one in usual))
        layers = (_steps_of(one, self.facts) for one in wanted)
        return [_explained(self.preset, *each) for each in zip(*layers, strict=True)]

    def submission_below(self, folder: Path, tables: Path) -> Path:
        """Where, below ``folder``, the pose file stands; a folder where it is several files.

        Its name is the server's, ``Aachen_v1_1_eval_METHOD.txt``; METHOD names the preset, and the
        features that were chosen instead of its own. That of a rendered twin begins with
        ``synthetic-``: there is no server for it. ``tables`` : the dataset's side tables.
        """
        protocol = read_protocol(tables)
        stem = self.dataset
        if protocol.pose_file_stem and not stem.startswith(TWIN_PREFIX):
            stem = protocol.pose_file_stem
        end = "" if protocol.pose_file == "mlad" else ".txt"
        method = "-".join(("megloc", self.preset, *self._changed_features().values()))
        return folder / SUBMISSIONS / f"{stem}_eval_{method}{end}"

    def provenance(self) -> dict[str, Any]:
        """What a result is of, as plain JSON values."""
        options = self.options.model_dump(mode="json")
        return {"dataset": self.dataset, "preset": self.preset, "options": options}


def choose_run(
    dataset: str,
    root: Path | None = None,
    *,
    preset: str | None = None,
    assignments: Sequence[str] | Mapping[str, Any] = (),
    import_options: Mapping[str, Any] | None = None,
    config: Path | None = None,
    query_prefix: str = "",
    allow_missing: bool = False,
    find_root: bool = True,
) -> Run:
    """Choose what ``megloc eval`` runs.

    Parameters
    ----------
    root : folder of the dataset as it is published; looked for below MEGLOC_DATA unless given.
    preset : that of the benchmark file unless given.
    assignments : what a user changes: ``key.key=value`` texts, or ``key.key`` to values.
    import_options : options of the dataset, after those of the benchmark file.
    config : a benchmark file instead of the one that we bring.
    find_root : false: an official dataset may be without a root; it cannot be imported then.

    Raises
    ------
    MeglocError : the dataset, its benchmark file or the options cannot be used.
    """
    benchmark = find_benchmark(dataset)
    if config:
        benchmark = read_benchmark(config)
        if benchmark.dataset != dataset:
            raise OptionError(f"{config} is for dataset {benchmark.dataset}, not {dataset}")
    preset = preset or benchmark.preset
    source = choose_dataset(
        dataset,
        root,
        import_options=benchmark.import_options_of(preset) | dict(import_options or {}),
        query_prefix=query_prefix,
        allow_missing=allow_missing,
        find_root=find_root,
    )
    source.check()
    facts = DatasetFacts(source.has_map_depth(), source.has_query_depth(), has_model(source))
    changes = benchmark.changes(preset, map_depth=facts.map_depth, query_depth=facts.query_depth)
    options = options_of_preset(preset, changes=changes, assignments=assignments)
    if "by" not in assigned(assignments).get("mapping_pairs", {}):
        permitted = _permitted(options, facts)
        if permitted != options:
            _log.warning("no reference model in this data: no map pairs by co-visibility")
        options = permitted
    return Run(source, preset, options, benchmark, facts)


def _permitted(options: PipelineOptions, facts: DatasetFacts) -> PipelineOptions:
    """Options without pairs by co-visibility where the data have no model to see it in."""
    others = tuple(method for method in options.mapping_pairs.by if method != "covisibility")
    if facts.model or not others or not options.pairs_by_points():
        return options
    pairs = options.mapping_pairs.model_copy(update={"by": others})
    return options.model_copy(update={"mapping_pairs": pairs})


def steps_text(steps: Sequence[PaperStep]) -> str:
    """The steps as lines of text."""
    width = max(len(step.name) for step in steps)
    return "\n".join(
        f"{step.name:{width}s}  {'on' if step.on else 'off':3s}  {step.why}" for step in steps
    )


@dataclass(frozen=True)
class _Step:
    """A step, the option that turns it on, and whether options ask for it.

    ``obstacle`` is why the data do not permit it, ``figures`` how it is done.
    """

    name: str
    option: str
    asked: bool
    obstacle: str = ""
    figures: str = ""


def _explained(preset: str, chosen: _Step, by_file: _Step, by_preset: _Step) -> PaperStep:
    """What becomes of a step that the run, the dataset's file and the preset may ask for."""
    if chosen.asked != by_file.asked:
        why = f"an option of this run ({chosen.option})"
    elif by_file.asked != by_preset.asked:
        why = f"the dataset's file ({chosen.option})"
    elif chosen.asked:
        why = f"preset {preset}"
    else:
        why = f"neither preset {preset} nor the dataset's file asks for it ({chosen.option})"
    # what nobody could turn on is said before who did not
    if chosen.obstacle and (chosen.asked or chosen.asked == by_file.asked):
        return PaperStep(chosen.name, on=False, why=chosen.obstacle)
    told = f"{why}; {chosen.figures}" if chosen.asked and chosen.figures else why
    return PaperStep(chosen.name, chosen.asked, told)


def _steps_of(options: PipelineOptions, facts: DatasetFacts) -> list[_Step]:
    """The steps of the paper in its order, as options and data have them."""
    preprocessing, masks = options.preprocessing, options.preprocessing.masks
    features = options.local_features
    matcher_of = {one.name: one.matching or options.matching for one in features}
    extracted = matcher_of if options.makes_points() else {}
    superpoint = next((one for one in features if one.name == "superpoint"), None)
    superglue = ""
    if superpoint is not None:
        radius = superpoint.options.get("nms_radius", 4)
        weights = matcher_of["superpoint"].options.get("weights", "superglue_outdoor")
        superglue = f"non-maximum suppression within {radius} px, {weights}"
    trained_anew = any(one.options.get("descriptor_weights") for one in features)
    refiners = {one.name for one in options.pose_refinement.by}
    rank = options.localization.rank
    pairs = options.mapping_pairs.by
    stereo = options.mvs.mode != "off"
    pyramid = options.guided_pyramid
    counted = "matches of the matcher" if pyramid.count == "matches" else "verified matches"
    reranking = options.reranking
    ranked_by = "coverage" if reranking.by == "coverage" else f"{reranking.by} matches"
    if reranking.local_type:
        ranked_by += f" of {reranking.local_type}"

    not_matched = no_uncertainty = ""
    if options.map == "lift":
        not_matched = (
            "the points are lifted from the map's depth: map images are not matched with each other"
        )
        no_uncertainty = (
            "a lifted point is seen by one image, which says nothing of its uncertainty"
        )
    elif not options.triangulates():
        not_matched = "the map is given: its images are not matched"
    no_model = not_matched
    if not facts.model and options.triangulates():
        no_model = "the dataset comes with no model whose points images could see in common"
    no_map_depth = "" if facts.map_depth else "the map images have no depth"
    no_depth_to_render = "" if stereo else no_map_depth

    def pairs_by(method: str, name: str, obstacle: str = not_matched) -> _Step:
        return _Step(f"map pairs by {name}", "mapping_pairs.by", method in pairs, obstacle)

    return [
        _Step(
            "larger side of 1600 px, sides multiples of 8",
            "preprocessing.max_size_px",
            preprocessing.max_size_px == 1600,
            figures="" if preprocessing.upscale else "smaller images are not enlarged",
        ),
        _Step(
            "lens distortion removed",
            "preprocessing.undistort",
            preprocessing.undistort,
            figures="cameras without distortion stay as they are",
        ),
        _Step(
            "people and vehicles masked",
            "preprocessing.masks.segmenter",
            masks.segmenter is not None,
            figures="" if masks.segmenter is None else masks.segmenter.name,
        ),
        _Step(
            "the own car masked",
            "preprocessing.masks.unchanging",
            masks.unchanging or bool(masks.fixed),
        ),
        _Step(
            "SuperPoint matched by SuperGlue",
            "local_features",
            "superpoint" in extracted and extracted["superpoint"].name == "superglue",
            figures=superglue,
        ),
        _Step("ASLFeat", "local_features", "aslfeat" in extracted),
        _Step(
            "descriptors and matcher trained anew",
            "local_features",
            trained_anew,
            ""
            if trained_anew
            else "the paper's weights are not public; megloc train descriptor makes such",
        ),
        _Step(
            "four global features fused",
            "global_features",
            {one.name for one in options.global_features} >= RETRIEVAL,
        ),
        pairs_by("poses", "poses"),
        pairs_by("covisibility", "co-visibility", no_model),
        pairs_by("retrieval", "retrieval"),
        pairs_by("sequence", "sequence"),
        _Step(
            "points triangulated with known poses",
            "map",
            options.triangulates(),
            "" if options.triangulates() else f"map = {options.map}",
        ),
        _Step(
            "points verified by depth",
            "refinement.depth.max_sigmas",
            options.refinement.depth.max_sigmas is not None,
            no_map_depth,
        ),
        _Step(
            "uncertain points rejected",
            "refinement.uncertainty",
            options.refinement.uncertainty.max_robust_sigmas is not None,
            no_uncertainty,
        ),
        _Step(
            "depth of map images by multi-view stereo",
            "mvs.mode",
            stereo,
            "the map images have depth" if facts.map_depth else "",
        ),
        _Step(
            "M images retrieved, N kept by local matches",
            "reranking.by",
            reranking.reranks(),
            figures=f"M = {options.query_pairs.top_k}, N = {reranking.keep}, by {ranked_by}",
        ),
        _Step(
            "guided pyramid matching",
            "guided_pyramid.mode",
            options.matches_again(),
            figures=f"pairs with fewer than {pyramid.min_matches} {counted}",
        ),
        _Step(
            "one pose per cluster of candidates",
            "localization.clusters.by",
            options.localization.clusters.by != "none",
            figures=f"by {options.localization.clusters.by}",
        ),
        _Step(
            "clusters ranked by the number of inliers",
            "localization.rank",
            rank.name == "inliers",
            figures="rank inliers",
        ),
        _Step(
            "clusters ranked by LPIPS of aligned views",
            "localization.rank",
            rank.name == "perceptual" and rank.options.get("distance", {}).get("name") == "lpips",
            "the paper's indoor strategy; the map images have no depth to make views of"
            if no_depth_to_render
            else "",
        ),
        _Step(
            "references of the top-1 cluster only",
            "pose_refinement.references",
            options.pose_refinement.references == "cluster",
            figures="" if refiners else "no pose is refined here",
        ),
        _Step(
            "poses refined by ICP",
            "pose_refinement.by",
            "icp" in refiners,
            "" if facts.query_depth else "the queries have no depth",
        ),
        _Step(
            "poses refined by rendering",
            "pose_refinement.by",
            "rendering" in refiners,
            no_depth_to_render,
        ),
        _Step(
            "a map as a neural field (NeRF-W)",
            "pose_refinement.by",
            "field" in refiners,
            "" if "field" in refiners else "it needs a field of the map (megloc train-field)",
        ),
        _Step(
            "every pose kept",
            "localization.min_confidence",
            options.localization.min_confidence == 0.0,
            figures="min_confidence 0; the confidence is reported next to the pose",
        ),
    ]
