"""The plan of ``megloc eval``: from a dataset to a pose file and a recall table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from megloc_kapture.datasets.kapture_folders import import_mapping, mapping_files
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.evaluate import evaluate, results_without_truth
from megloc_kapture.evaluation.pose_files import package_versions
from megloc_kapture.evaluation.protocols import benchmark_of
from megloc_kapture.evaluation.report.reports import write_report
from megloc_kapture.evaluation.results import context_of
from megloc_kapture.io.dataset_tables import SIDE_TABLES, Protocol
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.datasets import DatasetChoice, with_model
from megloc_kapture.pipeline.presets import check_weights
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.submission import write_submission
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import STAGES
from megloc_kapture.stages.densifying import Densify
from megloc_kapture.stages.global_features import ExtractGlobalFeatures
from megloc_kapture.stages.image_pairs import PairMapping, PairQueries, RerankQueries
from megloc_kapture.stages.local_features import ExtractLocalFeatures
from megloc_kapture.stages.localized_folder import set_aside_unreadable
from megloc_kapture.stages.map_points import GivenMap, LiftPoints, TriangulatePoints
from megloc_kapture.stages.map_refinement import RefineMap
from megloc_kapture.stages.matches import MatchMapping, MatchQueries
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.pose_refinement import RefinePoses
from megloc_kapture.stages.preprocessing import Preprocess
from megloc_kapture.stages.pyramid_mapping import PyramidMapping, PyramidQueries
from megloc_kapture.stages.query_poses import LocalizeQueries
from megloc_kapture.stages.stage import (
    EVALUATION,
    LOCALIZED,
    MAPPING,
    QUERY,
    QUERY_GT,
    REFERENCE,
    SUBMISSIONS,
    Hashes,
    PipelineStage,
    Stage,
    StageWork,
    is_below,
    wanted_stages,
)
from megloc_kapture.values import Options

WORLD = "world"

# between import and pose file, in this order; each is there where the options ask for it
PIPELINE: tuple[type[PipelineStage], ...] = (
    Preprocess,
    ExtractLocalFeatures,
    ExtractGlobalFeatures,
    PairMapping,
    MatchMapping,
    PyramidMapping,
    TriangulatePoints,
    LiftPoints,
    GivenMap,
    RefineMap,
    Densify,
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
    check_weights(options)
    options.local_types()
    options.retrieval()
    given = options.uses_given_map()
    if given and options.changes_frames():
        raise OptionError(
            f"map = {options.map}: the given map's keypoints are in the original images; "
            "pre-processing may mask them, but not resize or undistort"
        )
    options.check()
    if given or options.pairs_by_points():
        run = replace(run, source=_with_model(run, given))
    run.source.check()
    stages: list[Stage] = [Render(run)] if run.source.twin is not None else []
    stages.append(Import(run))
    stages += wanted_stages(PIPELINE, options)
    stages += [Submit(run), Evaluate(run)]
    for name, values in options.stages.items():
        _insert(stages, load_plugin(STAGES, name, dict(values)))
    return stages


def plan_map(mapping: KaptureFolder, options: PipelineOptions) -> list[Stage]:
    """The stages that make a map of images with poses, without queries.

    Raises
    ------
    OptionError : the options need a model that a dataset comes with.
    """
    check_weights(options)
    options.retrieval()
    if options.uses_given_map() or options.pairs_by_points():
        raise OptionError("images with poses come with no model: map, mapping_pairs.by")
    behind = PIPELINE.index(Densify) + 1
    return [ImportMapping(mapping), *wanted_stages(PIPELINE[:behind], options)]


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

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (WORLD,) if self._run.source.twin is not None else ()

    def settings(self) -> dict[str, Any]:
        benchmark = self._run.benchmark
        wanted = None if benchmark is None else benchmark.change(Protocol())
        protocol = wanted and wanted.model_dump(mode="json")
        return {**self._run.source.settings(), "protocol": protocol}

    def plugins(self) -> Sequence[object]:
        return [one for one in (self._run.source.adapter,) if one is not None]

    def external(self, hashes: Hashes) -> Mapping[str, str]:
        source = self._run.source
        if source.root is None:
            return {}
        root = source.root.resolve()
        content = hashes.of_files(root, source.input_files(root))
        return {"dataset files": content, "dataset root": str(root)}

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
        return given if self._run.benchmark is None else self._run.benchmark.change(given)


class ImportMapping(Stage):
    """Import images with poses alone, with the coordinate frames that tables beside them name."""

    name = "import"
    version = 3
    writes = (MAPPING, QUERY, SIDE_TABLES)  # no queries: what stages read of them is nothing

    def __init__(self, mapping: KaptureFolder) -> None:
        super().__init__(Options())
        self._mapping = mapping

    def external(self, hashes: Hashes) -> Mapping[str, str]:
        root = self._mapping.root.resolve()
        return {"images": hashes.of_files(root, mapping_files(self._mapping)), "root": str(root)}

    def run(self, work: StageWork) -> Mapping[str, float]:
        return import_mapping(self._mapping, work.out)


class Submit(_RunStage):
    """Write the pose file, with its provenance beside it."""

    name = "submission"
    version = 3
    reads = (SIDE_TABLES, LOCALIZED)
    writes = (SUBMISSIONS,)

    def settings(self) -> dict[str, Any]:
        return self._run.provenance()

    def run(self, work: StageWork) -> Mapping[str, float]:
        return write_submission(
            work.path(LOCALIZED),
            self._run.submission_below(work.out),
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
        return self._run.provenance() | {"steps": [asdict(step) for step in self._run.steps]}

    def run(self, work: StageWork) -> Mapping[str, float]:
        localized, truth, tables = map(work.path, (LOCALIZED, QUERY_GT, SIDE_TABLES))
        label = f"{self._run.dataset}, {self._run.preset}"
        map_poses = work.folder(MAPPING).read().poses()
        provenance = self.settings() | {"versions": package_versions()}
        output = work.out / EVALUATION
        # two runs give the same bytes, so seconds stand in manifests and timing.csv alone
        context = replace(context_of(localized), seconds={})
        if not truth.is_dir():
            found = results_without_truth(
                [localized], benchmark_of(tables), map_poses=map_poses, labels=[label]
            )
            found = replace(found, results=(replace(found.results[0], context=context),))
            write_report(output, found, map_poses=map_poses, provenance=provenance)
            return {"queries_with_truth": 0}
        evaluation = evaluate(
            localized, truth, side_tables=tables, label=label, mapping=work.path(MAPPING)
        )
        evaluation = replace(evaluation, context=context)
        write_report(output, evaluation, map_poses=map_poses, provenance=provenance)
        row = evaluation.row()
        recall = {f"recall at {at.threshold}": round(at.recall, 4) for at in row.recall}
        return {"queries_with_truth": len(evaluation.queries), **recall}
