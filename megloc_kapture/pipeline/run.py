"""A run of ``megloc eval``: its dataset, preset, options and workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from megloc_kapture.errors import OptionError
from megloc_kapture.io.dataset_tables import SIDE_TABLES, read_protocol
from megloc_kapture.pipeline.benchmarks import BenchmarkFile, find_benchmark, read_benchmark
from megloc_kapture.pipeline.datasets import TWIN_PREFIX, DatasetChoice, choose_dataset, has_model
from megloc_kapture.pipeline.paper_steps import (
    DatasetFacts,
    LayeredOptions,
    PaperStep,
    paper_steps,
)
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.submission import place_of
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.stage import SUBMISSIONS


@dataclass(frozen=True)
class RunChoice:
    """A dataset, its benchmark file and the options, chosen together; nothing is written yet.

    Attributes
    ----------
    layers : the options by who chose them: preset, benchmark file, user.
    facts : what of the dataset decides which steps of the paper it permits.
    """

    source: DatasetChoice
    benchmark: BenchmarkFile
    layers: LayeredOptions
    facts: DatasetFacts

    @property
    def preset(self) -> str:
        """The preset's name."""
        return self.layers.preset

    @property
    def options(self) -> PipelineOptions:
        """The options of the run."""
        return self.layers.chosen

    def steps(self) -> list[PaperStep]:
        """The steps of the paper, and which of them the run does."""
        return paper_steps(self.layers, self.facts)

    def with_options(self, options: PipelineOptions) -> RunChoice:
        """The same run with other options."""
        return replace(self, layers=replace(self.layers, chosen=options))

    def run_in(self, workspace: Workspace) -> Run:
        """The run, in a workspace."""
        return Run(
            self.source, self.preset, self.options, workspace, self.benchmark, tuple(self.steps())
        )


def choose_run(
    dataset: str,
    root: Path | None = None,
    *,
    preset: str | None = None,
    assignments: Sequence[str] | Mapping[str, Any] = (),
    config: Path | None = None,
    query_prefix: str = "",
    allow_missing: bool = False,
    find_root: bool = True,
) -> RunChoice:
    """Choose what ``megloc eval`` runs.

    Parameters
    ----------
    root : folder of the dataset as it is published; looked for below MEGLOC_DATA unless given.
    preset : that of the benchmark file unless given.
    assignments : what a user changes: ``key.key=value`` texts, or ``key.key`` to values.
    config : a benchmark file instead of the one that we bring.
    find_root : false: an official dataset may be without a root; it cannot be imported then.

    Raises
    ------
    MeglocError : the dataset, its benchmark file or the options cannot be used.
    """
    benchmark = find_benchmark(dataset, TWIN_PREFIX)
    if config:
        benchmark = read_benchmark(config)
        if benchmark.dataset != dataset:
            raise OptionError(f"{config} is for dataset {benchmark.dataset}, not {dataset}")
    preset = preset or benchmark.preset
    source = choose_dataset(
        dataset,
        root,
        import_options=benchmark.import_options_of(preset),
        query_prefix=query_prefix,
        allow_missing=allow_missing,
        find_root=find_root,
    )
    source.check()
    facts = DatasetFacts(source.has_map_depth(), source.has_query_depth(), has_model(source))
    of_file = benchmark.changes(preset, query_depth=facts.query_depth)
    layers = LayeredOptions(
        preset,
        options_of_preset(preset),
        options_of_preset(preset, changes=of_file),
        options_of_preset(preset, changes=of_file, assignments=assignments),
    )
    return RunChoice(source, benchmark, layers, facts)


@dataclass(frozen=True)
class Run:
    """What a run is of.

    Attributes
    ----------
    benchmark : what it wants different in the dataset's protocol.
    steps : of the paper, for the report.
    """

    source: DatasetChoice
    preset: str
    options: PipelineOptions
    workspace: Workspace
    benchmark: BenchmarkFile | None = None
    steps: tuple[PaperStep, ...] = ()

    @property
    def dataset(self) -> str:
        """The dataset's name."""
        return self.source.name

    def submission_below(self, folder: Path) -> Path:
        """Where, below ``folder``, the pose file stands; a folder where it is several files.

        Its name is the server's, ``Aachen_v1_1_eval_METHOD.txt``. That of a rendered twin begins
        with ``synthetic-``: there is no server for it.
        """
        protocol = read_protocol(self.workspace.path(SIDE_TABLES))
        stem = self.dataset
        if protocol.pose_file_stem and not stem.startswith(TWIN_PREFIX):
            stem = protocol.pose_file_stem
        return place_of(folder / SUBMISSIONS, f"{stem}_eval_megloc-{self.preset}", protocol)

    def provenance(self) -> dict[str, Any]:
        """What a result is of, as plain JSON values."""
        options = self.options.model_dump(mode="json")
        return {"dataset": self.dataset, "preset": self.preset, "options": options}
