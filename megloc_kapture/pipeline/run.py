"""A run of ``megloc eval``: its benchmark file, dataset, preset, options and workspace."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError, field_validator

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.dataset_tables import SIDE_TABLES, Protocol, read_protocol
from megloc_kapture.pipeline.datasets import TWIN_PREFIX, DatasetChoice, choose_dataset, with_model
from megloc_kapture.pipeline.paper_steps import DatasetFacts, LayeredOptions, PaperStep, paper_steps
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, PRESETS, options_of_preset
from megloc_kapture.pipeline.submission import place_of
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.stage import SUBMISSIONS
from megloc_kapture.values import Options

_PACKAGE = Path(__file__).resolve().parent.parent
# in a wheel the files lie inside the package, in a checkout beside it
_PLACES = (_PACKAGE / "benchmarks", _PACKAGE.parent / "benchmarks")


class PublishedResult(Options):
    """Figures of another method on the dataset, to be read beside ours.

    Parameters
    ----------
    method, source : what was measured, and where it is published.
    recall : condition -> percent at the dataset's thresholds, as papers print it.
    """

    method: str
    source: str
    recall: dict[str, str]


class PresetOptions(Options):
    """What a dataset wants different of one preset alone, after what it wants of all of them."""

    import_options: dict[str, Any] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)


class BenchmarkFile(Options):
    """``benchmarks/<dataset>.toml``: how one dataset is run.

    Parameters
    ----------
    import_options : the adapter's.
    options : changes to every preset.
    presets : further ones to the preset of a name.
    options_with_query_depth : further ones, where the queries come with depth maps of their own.
    thresholds, conditions, pools : instead of the dataset's own (see the side tables' Protocol).
    published : what others have reached.
    """

    dataset: str
    preset: str = DEFAULT_PRESET
    thresholds: tuple[tuple[float, float | None], ...] | None = None
    conditions: tuple[str, ...] | None = None
    pools: dict[str, tuple[str, ...]] | None = None
    import_options: dict[str, Any] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)
    presets: dict[str, PresetOptions] = Field(default_factory=dict)
    options_with_query_depth: dict[str, Any] = Field(default_factory=dict)
    published: tuple[PublishedResult, ...] = ()

    @field_validator("presets")
    @classmethod
    def _known_presets(cls, presets: dict[str, PresetOptions]) -> dict[str, PresetOptions]:
        unknown = sorted(set(presets) - set(PRESETS))
        if unknown:
            raise ValueError(f"unknown preset {unknown[0]!r}; known: {', '.join(PRESETS)}")
        return presets

    def changes(self, preset: str, *, query_depth: bool) -> list[dict[str, Any]]:
        """Changes to a preset, in order, for data whose queries have depth or not."""
        own = self.presets.get(preset, PresetOptions()).options
        return [self.options, own, *([self.options_with_query_depth] if query_depth else [])]

    def import_options_of(self, preset: str) -> dict[str, Any]:
        """The adapter's options, where this preset is run."""
        return self.import_options | self.presets.get(preset, PresetOptions()).import_options

    def change(self, protocol: Protocol) -> Protocol:
        """A dataset's protocol with what this file wants different."""
        wanted = {"thresholds": self.thresholds, "conditions": self.conditions, "pools": self.pools}
        return protocol.model_copy(update={k: v for k, v in wanted.items() if v is not None})


def find_benchmark(dataset: str) -> BenchmarkFile:
    """The benchmark file of a dataset that comes with the package; defaults where there is none.

    A rendered twin runs as its dataset does, but nobody has published figures on it.

    Raises
    ------
    DataError : the file is broken.
    """
    for name in (dataset, dataset.removeprefix(TWIN_PREFIX)):
        for place in _PLACES:
            path = place / f"{name}.toml"
            if path.is_file():
                found = read_benchmark(path)
                if name == dataset:
                    return found
                return found.model_copy(update={"dataset": dataset, "published": ()})
    return BenchmarkFile(dataset=dataset)


def read_benchmark(path: Path) -> BenchmarkFile:
    """Read a benchmark file.

    Raises
    ------
    DataError : absent, not TOML, or a key or value that is not of it; names the file.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        return BenchmarkFile.model_validate(content)
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror}", path=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"not TOML: {error}", path=path) from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DataError(f"{where}: {first['msg']}", path=path) from error


@dataclass(frozen=True)
class RunChoice:
    """A dataset, its benchmark file and the options, chosen together; nothing is written yet."""

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
    benchmark = find_benchmark(dataset)
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
    facts = DatasetFacts(
        source.has_map_depth(), source.has_query_depth(), with_model(source) is not None
    )
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
    """What a run is of; ``benchmark`` changes the protocol, ``steps`` are the paper's."""

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
