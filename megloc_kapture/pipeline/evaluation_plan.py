"""Plan of ``megloc eval``, from a dataset to a pose file and a recall table."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from megloc_kapture.errors import OptionError, check_option, require
from megloc_kapture.evaluation.evaluate import evaluate, results_without_truth
from megloc_kapture.evaluation.pose_files import package_versions
from megloc_kapture.evaluation.protocols import benchmark_of
from megloc_kapture.evaluation.report.reports import RECALL_JSON, write_report
from megloc_kapture.io.dataset_tables import SIDE_TABLES, Protocol, read_protocol, write_protocol
from megloc_kapture.pipeline.datasets import (
    KAPTURE,
    TWIN_PREFIX,
    BenchmarkFile,
    DatasetChoice,
    choose_dataset,
    find_benchmark,
    has_model,
    read_benchmark,
    with_model,
)
from megloc_kapture.pipeline.map_making import MAP_STAGES
from megloc_kapture.pipeline.presets import check_weights, options_of_preset, parse_assignments
from megloc_kapture.pipeline.submission import write_submission
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import STAGES, RenderedDataset
from megloc_kapture.stages import paths
from megloc_kapture.stages.guided_pyramid import RematchQueries
from megloc_kapture.stages.image_pairs import PairQueries
from megloc_kapture.stages.localized_folder import set_aside_unreadable
from megloc_kapture.stages.matches import MatchQueries
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.pose_refinement import RefinePoses
from megloc_kapture.stages.query_poses import LocalizeQueries
from megloc_kapture.stages.reranking import RerankQueries
from megloc_kapture.stages.stage import (
    PROTOCOL,
    ROOT,
    PipelineStage,
    Stage,
    StageWork,
    files_fingerprint,
    is_below,
    wanted_stages,
)

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """A dataset and its final options; ``usual`` are the options without the user's changes."""

    source: DatasetChoice
    preset: str
    options: PipelineOptions
    benchmark: BenchmarkFile = BenchmarkFile(dataset=KAPTURE)
    usual: PipelineOptions | None = None

    @property
    def dataset(self) -> str:
        return self.source.name

    @property
    def default_workspace(self) -> Path:
        source, folder = self.source, ""
        if source.root is not None and source.adapter is None:
            folder = Path(os.path.abspath(source.root)).name
        return Path("runs") / "-".join(filter(None, (self.dataset, folder, self.preset)))

    @property
    def label(self) -> str:
        """Title of the result: ``kapture, classic with local_features=aliked``."""
        changed = " and ".join(f"{key}={names}" for key, names in self._changed_features().items())
        return f"{self.dataset}, {self.preset}{' with ' if changed else ''}{changed}"

    def _changed_features(self) -> dict[str, str]:
        usual, changed = self.usual or options_of_preset(self.preset), {}
        for key in ("local_features", "global_features"):
            names = [choice.name for choice in getattr(self.options, key)]
            if names != [choice.name for choice in getattr(usual, key)]:
                changed[key] = "+".join(names)
        return changed

    def submission_below(self, folder: Path, tables: Path) -> Path:
        """Return the path of the pose file, or of the folder of several, below ``folder``.

        The name begins as the server requires, as in ``Aachen_v1_1_eval_METHOD.txt``; for twins and
        datasets without a server, with the dataset's name.
        """
        protocol = read_protocol(tables)
        stem = self.dataset
        if protocol.pose_file_stem and not stem.startswith(TWIN_PREFIX):
            stem = protocol.pose_file_stem
        end = "" if protocol.pose_file == "mlad" else ".txt"
        method = "-".join(("megloc", self.preset, *self._changed_features().values()))
        return folder / paths.SUBMISSIONS / f"{stem}_eval_{method}{end}"

    def provenance(self) -> dict[str, Any]:
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
    """Return the run of ``megloc eval`` for a dataset.

    Parameters
    ----------
    root : published dataset folder; by default, it is looked for below MEGLOC_DATA.
    assignments : the user's changes: ``key.key=value`` texts, or a mapping from ``key.key`` to
        values.
    import_options : dataset options, applied after those of the benchmark file.
    config : benchmark file that replaces the packaged one.
    find_root : if false, an official dataset may lack a root and then cannot be imported.
    """
    benchmark = read_benchmark(config) if config else find_benchmark(dataset)
    check_option(
        benchmark.dataset == dataset,
        f"{config} is for dataset {benchmark.dataset}, not {dataset}",
    )
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
    changes = benchmark.changes(
        preset, map_depth=source.has_map_depth(), query_depth=source.has_query_depth()
    )
    usual = options_of_preset(preset, changes=changes)
    options = options_of_preset(preset, changes=changes, assignments=assignments)
    is_asked = "by" in parse_assignments(assignments).get("mapping_pairs", {})
    others = tuple(method for method in options.mapping_pairs.by if method != "covisibility")
    if options.pairs_by_points() and others and not is_asked and not has_model(source):
        _log.warning("this data has no reference model: map images are not paired by co-visibility")
        pairs = options.mapping_pairs.model_copy(update={"by": others})
        options = options.model_copy(update={"mapping_pairs": pairs})
    return Run(source, preset, options, benchmark, usual)


WORLD = "world"

# in order, between import and pose file; options select the stages. The stages of the map are in
# map_making.py, as `megloc map` runs them too
PIPELINE: tuple[type[PipelineStage], ...] = (
    *MAP_STAGES,
    PairQueries,
    MatchQueries,
    RerankQueries,
    RematchQueries,
    LocalizeQueries,
    RefinePoses,
)


def plan_evaluation(run: Run) -> list[Stage]:
    """Return the stages of a run, in order, without writing anything."""
    options = run.options
    if options.pairs_by_points():
        source = with_model(run.source)
        if source is None:
            raise OptionError(
                f"dataset {run.dataset} comes with no model, but mapping_pairs.by covisibility "
                'needs one; --set \'mapping_pairs.by=["poses", "retrieval"]\' needs no model'
            )
        run = replace(run, source=source)
    run.source.check()
    check_weights(options)
    options.reranking.counted_types(options.local_types())
    options.retrieval()
    twin = run.source.twin
    stages: list[Stage] = [] if twin is None else [Render(twin)]
    stages.append(Import(run))
    stages += wanted_stages(PIPELINE, options)
    stages += [Submit(run), Evaluate(run)]
    for name, values in options.stages.items():
        _insert(stages, load_plugin(STAGES, name, dict(values)))
    return stages


def explain(options: PipelineOptions) -> list[dict[str, Any]]:
    """Return a row per stage with its ``name``, ``on`` (True if it runs) and ``why`` (options)."""
    rows: dict[str, dict[str, Any]] = {}
    for stage in (kind(options) for kind in PIPELINE):
        on = stage.is_wanted()
        # without reranking, PairQueries has the name of RerankQueries
        if on or stage.name not in rows:
            rows[stage.name] = {"name": stage.name, "on": on, "why": stage.explain()}
    return list(rows.values())


def explanation_table(rows: Sequence[Mapping[str, Any]]) -> str:
    width = max(len(row["name"]) for row in rows)
    return "\n".join(
        f"{row['name']:{width}s}  {'on' if row['on'] else 'off':3s}  {row['why']}" for row in rows
    )


def _insert(stages: list[Stage], stage: Stage) -> None:
    """Insert a plugin stage after the last stage that writes one of its inputs."""
    check_option(
        not any(stage.name == other.name for other in stages),
        f"stages.{stage.name}: this stage name is already used",
    )
    last = -1 if stage.reads else len(stages) - 1
    for path in stage.reads:
        writers = [at for at, other in enumerate(stages) if is_below(path, *other.writes)]
        check_option(writers, f"stages.{stage.name} reads {path}, which no stage of the run writes")
        last = max(last, *writers)
    stages.insert(last + 1, stage)


class Render(Stage):
    """Render a synthetic dataset."""

    name = "render"
    writes = (WORLD,)

    def __init__(self, twin: RenderedDataset) -> None:
        super().__init__(twin.options)
        self._twin = twin

    def settings(self) -> dict[str, Any]:
        return {"version": self._twin.version, "world": super().settings()}

    def run(self, work: StageWork) -> Mapping[str, float]:
        return self._twin.write(work.out / WORLD, work)


class _RunStage(Stage):
    """A stage that depends on the run: dataset, preset and all options."""

    def __init__(self, run: Run) -> None:
        super().__init__(run.options)
        self._run = run

    def _protocol(self) -> dict[str, Any]:
        return self._run.benchmark.change(Protocol()).model_dump(mode="json")


class Import(_RunStage):
    """Import the dataset as kapture."""

    name = "import"
    version = 4
    writes = (paths.MAPPING, paths.QUERY, paths.QUERY_GT, SIDE_TABLES, paths.REFERENCE)

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self.root = run.source.root

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (WORLD,) if self._run.source.twin is not None else ()

    def settings(self) -> dict[str, Any]:
        return {**self._run.source.settings(), PROTOCOL: self._protocol()}

    def plugins(self) -> Sequence[object]:
        return [adapter for adapter in (self._run.source.adapter,) if adapter is not None]

    def external(self) -> Mapping[str, str]:
        if self.root is None:
            return {}
        root = self.root.resolve()
        content = files_fingerprint(root, self._run.source.input_files(root))
        return {"dataset files": content, ROOT: str(root)}

    def check(self) -> None:
        self._run.source.rehearse()

    def run(self, work: StageWork) -> Mapping[str, float]:
        source = self._run.source
        root = work.path(WORLD) if source.root is None else source.root.resolve()
        counts = source.import_to(root, work.out)
        require(counts["queries"], "no query image is left to localize", path=root)
        unreadable = set_aside_unreadable(work.out / paths.QUERY, work.out / SIDE_TABLES, work)
        protocol = read_protocol(work.out / SIDE_TABLES)
        if protocol.dataset == Protocol().dataset:
            protocol = protocol.model_copy(update={"dataset": self._run.dataset})
        write_protocol(work.out / SIDE_TABLES, self._run.benchmark.change(protocol))
        return counts | ({"unreadable_queries": len(unreadable)} if unreadable else {})


class Submit(_RunStage):
    """Write the pose file and its provenance."""

    name = "submission"
    version = 4
    reads = (SIDE_TABLES, paths.LOCALIZED)
    writes = (paths.SUBMISSIONS,)

    def settings(self) -> dict[str, Any]:
        return {**self._run.provenance(), PROTOCOL: self._protocol()}

    def run(self, work: StageWork) -> Mapping[str, float]:
        return write_submission(
            work.path(paths.LOCALIZED),
            self._run.submission_below(work.out, work.path(SIDE_TABLES)),
            tables=work.path(SIDE_TABLES),
            provenance=self._run.provenance(),
        )


class Evaluate(_RunStage):
    """Measure recall if true poses are known, else compute statistics without them."""

    name = "evaluation"
    version = 4
    reads = (paths.MAPPING, paths.QUERY_GT, SIDE_TABLES, paths.LOCALIZED)
    writes = (paths.EVALUATION,)

    def settings(self) -> dict[str, Any]:
        steps = explain(self.options)
        return {**self._run.provenance(), "steps": steps, PROTOCOL: self._protocol()}

    def run(self, work: StageWork) -> Mapping[str, float]:
        localized, truth, tables = map(work.path, (paths.LOCALIZED, paths.QUERY_GT, SIDE_TABLES))
        provenance = self.settings() | {"versions": package_versions()}
        del provenance[PROTOCOL]  # the report shows the protocol as text
        output, label = work.out / paths.EVALUATION, self._run.label
        if not truth.is_dir():
            results = results_without_truth([localized], benchmark_of(tables), labels=[label])
            write_report(output, results, provenance=provenance)
            return {"queries_with_truth": 0}
        evaluation = evaluate(localized, truth, side_tables=tables, label=label)
        write_report(output, evaluation, provenance=provenance)
        row = evaluation.row()
        # the log shows the last word of a key as the unit
        recall = {
            f"recall within {at.threshold} percent".replace(",", " and"): round(100 * at.recall, 2)
            for at in row.recall
        }
        return {"queries_with_truth": len(evaluation.queries), **recall}


def recall_rows(workspace: Path) -> dict[str, Any]:
    """Return rows of the recall table by name; empty without true poses."""
    path = workspace / paths.EVALUATION / RECALL_JSON
    if not path.is_file():
        return {}
    return {row["name"]: row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}
