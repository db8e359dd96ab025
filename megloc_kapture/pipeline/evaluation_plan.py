"""The plan of ``megloc eval``: from a dataset to a pose file and a recall table.

An ablation is the same run, each time without one of the paper's steps: what each of them adds.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.evaluate import evaluate, results_without_truth
from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.pose_files import package_versions
from megloc_kapture.evaluation.protocols import benchmark_of
from megloc_kapture.evaluation.report.reports import RECALL_JSON, write_report
from megloc_kapture.evaluation.results import context_of
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.dataset_tables import SIDE_TABLES, Protocol
from megloc_kapture.io.files import hard_link, output_error
from megloc_kapture.pipeline.datasets import DatasetChoice, with_model
from megloc_kapture.pipeline.map_making import MAP_STAGES
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.presets import check_weights
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.submission import write_submission
from megloc_kapture.pipeline.workspace import LOCK, PARTIAL, Workspace
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import STAGES
from megloc_kapture.stages.image_pairs import PairQueries, RerankQueries
from megloc_kapture.stages.localized_folder import set_aside_unreadable
from megloc_kapture.stages.matches import MatchQueries
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.pose_refinement import RefinePoses
from megloc_kapture.stages.pyramid_mapping import PyramidQueries
from megloc_kapture.stages.query_poses import LocalizeQueries
from megloc_kapture.stages.stage import (
    EVALUATION,
    LOCALIZED,
    MAPPING,
    QUERY,
    QUERY_GT,
    REFERENCE,
    ROOT,
    SUBMISSIONS,
    Hashes,
    PipelineStage,
    Stage,
    StageWork,
    is_below,
    wanted_stages,
)
from megloc_kapture.stages.work import Work

WORLD = "world"

# between import and pose file, in this order; each is there where the options ask for it
PIPELINE: tuple[type[PipelineStage], ...] = (
    *MAP_STAGES,
    PairQueries,
    MatchQueries,
    RerankQueries,
    PyramidQueries,
    LocalizeQueries,
    RefinePoses,
)


def plan_evaluation(run: Run) -> list[Stage]:
    """The stages of a run, in order.

    Raises
    ------
    MeglocError : the dataset or the options cannot be used; nothing has been written by then.
    """
    options = run.options
    given = options.uses_given_map()
    if given or options.pairs_by_points():
        run = replace(run, source=_with_model(run, given))
    run.source.check()
    check_weights(options)
    options.reranking.counted_types(options.local_types())
    options.retrieval()
    if given and options.changes_frames():
        raise OptionError(
            f"map = {options.map}: the given map's keypoints are in the original images; "
            "pre-processing may mask them, but not resize or undistort"
        )
    stages: list[Stage] = [Render(run)] if run.source.twin is not None else []
    stages.append(Import(run))
    stages += wanted_stages(PIPELINE, options)
    stages += [Submit(run), Evaluate(run)]
    for name, values in options.stages.items():
        _insert(stages, load_plugin(STAGES, name, dict(values)))
    return stages


def _insert(stages: list[Stage], stage: Stage) -> None:
    """Put a stage of another package behind the last one that writes what it reads."""
    if any(stage.name == one.name for one in stages):
        raise OptionError(f"stages.{stage.name}: there is a stage of this name")
    for path in stage.reads:
        if not any(is_below(path, written) for one in stages for written in one.writes):
            raise OptionError(f"stages.{stage.name} reads {path}, which no stage of the run writes")
    places = [
        number
        for number, one in enumerate(stages)
        if any(is_below(path, written) for path in stage.reads for written in one.writes)
    ]
    stages.insert(max(places, default=len(stages) - 1) + 1, stage)


def _with_model(run: Run, given: bool) -> DatasetChoice:
    found = with_model(run.source, features=given)
    if found is None:
        wanted = (
            f"map = {run.options.map} localizes in that model (megloc localize takes any kapture "
            "map)"
            if given
            else "mapping_pairs by covisibility or overlap need its points; "
            '--set \'mapping_pairs.by=["poses", "retrieval"]\' does without them'
        )
        raise OptionError(f"dataset {run.dataset} comes with no model: {wanted}")
    return found


class _RunStage(Stage):
    """A stage that needs to know of the run: its dataset, its preset, all of its options."""

    def __init__(self, run: Run) -> None:
        super().__init__(run.options)
        self._run = run


class Render(_RunStage):
    """Render a dataset that is made rather than given."""

    name = "render"
    writes = (WORLD,)

    def settings(self) -> dict[str, Any]:
        return self._run.source.render_options()

    def run(self, work: StageWork) -> Mapping[str, float]:
        twin = self._run.source.twin
        if twin is None:
            raise ValueError(f"dataset {self._run.dataset} is given, not rendered")
        return twin.write(work.out / WORLD, work)


class Import(_RunStage):
    """Import the dataset as kapture."""

    name = "import"
    version = 4
    writes = (MAPPING, QUERY, QUERY_GT, SIDE_TABLES, REFERENCE)

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self.root = run.source.root

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (WORLD,) if self._run.source.twin is not None else ()

    def settings(self) -> dict[str, Any]:
        protocol = self._run.benchmark.change(Protocol())
        return {**self._run.source.settings(), "protocol": protocol.model_dump(mode="json")}

    def plugins(self) -> Sequence[object]:
        return [one for one in (self._run.source.adapter,) if one is not None]

    def external(self, hashes: Hashes) -> Mapping[str, str]:
        if self.root is None:
            return {}
        root = self.root.resolve()
        content = hashes.of_files(root, self._run.source.input_files(root))
        return {"dataset files": content, ROOT: str(root)}

    def check(self) -> None:
        self._run.source.rehearse()

    def run(self, work: StageWork) -> Mapping[str, float]:
        source = self._run.source
        root = work.path(WORLD) if source.root is None else source.root.resolve()
        counts = source.import_to(root, work.out, self._change)
        if not counts["queries"]:
            raise DataError("no query image is left to localize", path=root)
        unreadable = set_aside_unreadable(work.out / QUERY, work.out / SIDE_TABLES, work)
        return counts | ({"unreadable_queries": len(unreadable)} if unreadable else {})

    def _change(self, given: Protocol) -> Protocol:
        if given.dataset == Protocol().dataset:
            given = given.model_copy(update={"dataset": self._run.dataset})
        return self._run.benchmark.change(given)


class Submit(_RunStage):
    """Write the pose file, with its provenance beside it."""

    name = "submission"
    version = 4
    reads = (SIDE_TABLES, LOCALIZED)
    writes = (SUBMISSIONS,)

    def settings(self) -> dict[str, Any]:
        return self._run.provenance()

    def run(self, work: StageWork) -> Mapping[str, float]:
        return write_submission(
            work.path(LOCALIZED),
            self._run.submission_below(work.out, work.path(SIDE_TABLES)),
            tables=work.path(SIDE_TABLES),
            provenance=self._run.provenance(),
        )


class Evaluate(_RunStage):
    """Measure recall where the true poses are known, else what can be known without them."""

    name = "evaluation"
    version = 4
    reads = (MAPPING, QUERY_GT, SIDE_TABLES, LOCALIZED)
    writes = (EVALUATION,)

    def settings(self) -> dict[str, Any]:
        return self._run.provenance() | {"steps": [asdict(step) for step in self._run.steps()]}

    def run(self, work: StageWork) -> Mapping[str, float]:
        localized, truth, tables = map(work.path, (LOCALIZED, QUERY_GT, SIDE_TABLES))
        map_poses = work.folder(MAPPING).read().poses()
        provenance = self.settings() | {"versions": package_versions()}
        output = work.out / EVALUATION
        context = context_of(localized)
        if not truth.is_dir():
            found = results_without_truth(
                [localized], benchmark_of(tables), labels=[self._run.label]
            )
            found = replace(found, results=(replace(found.results[0], context=context),))
            write_report(output, found, map_poses=map_poses, provenance=provenance)
            return {"queries_with_truth": 0}
        evaluation = evaluate(
            localized, truth, side_tables=tables, label=self._run.label, mapping=work.path(MAPPING)
        )
        evaluation = replace(evaluation, context=context)
        write_report(output, evaluation, map_poses=map_poses, provenance=provenance)
        row = evaluation.row()
        recall = {
            f"recall within {at.threshold} percent".replace(",", " and"): round(100 * at.recall, 2)
            for at in row.recall
        }
        return {"queries_with_truth": len(evaluation.queries), **recall}


ABLATION, TABLE = "ablation", "ablation/ablation.csv"

# of a run's stages, those that take time whatever the steps
_BESIDE = frozenset({"import", "submission", "evaluation"})


@dataclass(frozen=True)
class Outcome:
    """What a run came to."""

    name: str
    recall: dict[str, float]  # 0 to 1, by the text of the threshold
    median_position_m: float
    median_angle_deg: float
    seconds: float  # of all its stages, from import and evaluation apart


def variants(options: PipelineOptions) -> dict[str, PipelineOptions]:
    """Options without one of the steps that these have, by the step's name, in their order."""
    no_masks = type(options.preprocessing.masks)()
    depth = options.refinement.depth.model_copy(update={"max_sigmas": None})
    nothing_rejected = type(options.refinement)(depth=depth)
    # as many images, the first that retrieval finds
    unranked = _changed(options, "query_pairs", top_k=options.reranking.keep)
    unranked = _changed(unranked, "reranking", by="none")
    steps: dict[str, PipelineOptions] = {
        "masks": _changed(options, "preprocessing", masks=no_masks),
        "second local features": _changed(options, local_features=options.local_features[:1]),
        "fusion": _changed(options, global_features=options.global_features[:1]),
        "map refinement": _changed(options, refinement=nothing_rejected),
        "reranking": unranked if options.reranking.reranks() else options,
        "guided pyramid": _changed(options, "guided_pyramid", mode="off"),
        "clusters": _changed(options, "localization.clusters", by="none"),
        "pose ranking": _changed(options, "localization.rank", name="inliers", options={}),
    }
    refiners = options.pose_refinement.by
    for at, chosen in enumerate(refiners):
        others = refiners[:at] + refiners[at + 1 :]
        steps[chosen.name] = _changed(options, "pose_refinement", by=others)
    return {name: without for name, without in steps.items() if without != options}


def _changed(model: Any, path: str = "", **values: object) -> Any:
    """A model with other values in the model at a path in it."""
    if path:
        name, _, below = path.partition(".")
        values = {name: _changed(getattr(model, name), below, **values)}
    return model.model_copy(update=values)


def ablate(
    run: Run,
    whole: Workspace,
    stages: Sequence[Stage],
    work: Work,
    say: Callable[[str], None] = lambda text: None,
) -> list[Outcome]:
    """Run again without each of the steps in turn; what the whole run and these came to."""
    outcomes = [outcome("all steps", whole, stages)]
    for name, options in variants(run.options).items():
        say(f"ablation: without {name}")
        workspace = fresh_copy(whole, f"without_{name.replace(' ', '_')}")
        with workspace.lock():
            planned = plan_evaluation(replace(run, options=options))
            run_plan(planned, workspace, work, say=say)
        outcomes.append(outcome(f"without {name}", workspace, planned))
    return outcomes


def fresh_copy(source: Workspace, slug: str) -> Workspace:
    """A workspace below another with all that is in it: files are linked, none is copied.

    Stages replace what they write, so the files of the one are never changed by the other.

    Raises
    ------
    OutputError : cannot be written.
    """
    place = source.path(ABLATION) / slug
    try:
        if place.exists():
            shutil.rmtree(place)
        for folder, names, files in os.walk(source.root):
            inside = Path(folder).relative_to(source.root)
            if inside == Path():
                names[:] = sorted(set(names) - {ABLATION, PARTIAL})
                files = sorted(set(files) - {LOCK})
            for name in sorted([*files, *(n for n in names if (Path(folder) / n).is_symlink())]):
                old, new = Path(folder) / name, place / inside / name
                if old.is_symlink():
                    new.parent.mkdir(parents=True, exist_ok=True)
                    new.symlink_to(os.readlink(old))
                else:
                    hard_link(old, new)
    except OSError as error:
        raise output_error(place, error) from error
    return Workspace(place, force=True)


def recall_rows(workspace: Path) -> dict[str, Any]:
    """Rows of the recall table by name; none where no truth is known."""
    path = workspace / EVALUATION / RECALL_JSON
    if not path.is_file():
        return {}
    return {row["name"]: row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}


def outcome(name: str, workspace: Workspace, stages: Sequence[Stage]) -> Outcome:
    """Read what a run with true poses came to."""
    row = recall_rows(workspace.root)["all"]
    # JSON knows no infinity: a median over queries without a pose is written as null
    medians = (row["median_position_m"], row["median_angle_deg"])
    position_m, angle_deg = (float("inf" if value is None else value) for value in medians)
    manifests = [workspace.manifest(s.name) for s in stages]
    return Outcome(
        name=name,
        recall={str(Threshold(**at["threshold"])): float(at["recall"]) for at in row["recall"]},
        median_position_m=position_m,
        median_angle_deg=angle_deg,
        seconds=sum(m.seconds for m in manifests if m is not None and m.stage not in _BESIDE),
    )


def write_outcomes(workspace: Workspace, outcomes: Sequence[Outcome]) -> Path:
    """Write the table ``ablation/ablation.csv``; raises OutputError."""
    path = workspace.path(TABLE)
    thresholds = (threshold.replace(", ", " ") for threshold in outcomes[0].recall)
    columns = ("run", *thresholds, "median_m", "median_deg", "seconds")
    rows = (
        (
            one.name,
            *(f"{recall:.6f}" for recall in one.recall.values()),
            f"{one.median_position_m:.6f}",
            f"{one.median_angle_deg:.6f}",
            f"{one.seconds:.1f}",
        )
        for one in outcomes
    )
    write_csv_table(path, columns, rows)
    return path


def outcomes_text(outcomes: Sequence[Outcome]) -> str:
    """The table as text: recall in percent, medians over all queries, seconds of the stages."""
    thresholds = list(outcomes[0].recall)
    width = max(len(one.name) for one in outcomes)
    lines = [f"recall (%) at {' / '.join(thresholds)}; median error; seconds of all stages", ""]
    for one in outcomes:
        recall = " / ".join(f"{100 * value:5.1f}" for value in one.recall.values())
        lines.append(
            f"{one.name:{width}s}  {recall}  {one.median_position_m:8.4f} m "
            f"{one.median_angle_deg:7.3f} deg  {one.seconds:7.1f} s"
        )
    return "\n".join(lines) + "\n"
