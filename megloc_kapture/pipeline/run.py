"""A run of ``megloc eval``: a dataset and options."""

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
            names = [one.name for one in getattr(self.options, key)]
            if names != [one.name for one in getattr(usual, key)]:
                changed[key] = "+".join(names)
        return changed

    def submission_below(self, folder: Path, tables: Path) -> Path:
        """Return the path of the pose file, or of the folder of several, below ``folder``.

        The name is the server's, ``Aachen_v1_1_eval_METHOD.txt``, or begins with ``synthetic-``.
        """
        protocol = read_protocol(tables)
        stem = self.dataset
        if protocol.pose_file_stem and not stem.startswith(TWIN_PREFIX):
            stem = protocol.pose_file_stem
        end = "" if protocol.pose_file == "mlad" else ".txt"
        method = "-".join(("megloc", self.preset, *self._changed_features().values()))
        return folder / SUBMISSIONS / f"{stem}_eval_{method}{end}"

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
    root : published dataset folder; searched below MEGLOC_DATA by default.
    assignments : the user's changes: ``key.key=value`` texts, or ``key.key`` to values.
    import_options : dataset options, applied after those of the benchmark file.
    config : benchmark file that replaces the packaged one.
    find_root : if false, an official dataset may lack a root and then cannot be imported.
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
    changes = benchmark.changes(
        preset, map_depth=source.has_map_depth(), query_depth=source.has_query_depth()
    )
    usual = options_of_preset(preset, changes=changes)
    options = options_of_preset(preset, changes=changes, assignments=assignments)
    if "by" not in assigned(assignments).get("mapping_pairs", {}) and not has_model(source):
        permitted = _without_covisibility(options)
        if permitted != options:
            _log.warning("no reference model in this data: no map pairs by co-visibility")
        options = permitted
    return Run(source, preset, options, benchmark, usual)


def _without_covisibility(options: PipelineOptions) -> PipelineOptions:
    """Drop pairs by co-visibility, which need a reference model, if other pairs remain."""
    others = tuple(method for method in options.mapping_pairs.by if method != "covisibility")
    if not others or not options.pairs_by_points():
        return options
    pairs = options.mapping_pairs.model_copy(update={"by": others})
    return options.model_copy(update={"mapping_pairs": pairs})
