"""Datasets of ``megloc eval`` and ``megloc import`` by name, and their benchmark files.

``kapture`` is any pair of kapture folders; an adapter (group ``megloc_kapture.datasets``) reads an
official layout; ``synthetic`` and ``synthetic-X`` (group ``megloc_kapture.rendered_datasets``) are
rendered, the latter in the layout of X. A benchmark file holds the options of a dataset.
"""

from __future__ import annotations

import logging
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError, field_validator

from megloc_kapture.datasets.kapture_folders import (
    check_root,
    checked_folders,
    import_kapture_folders,
    input_files,
)
from megloc_kapture.datasets.official import OfficialDataset, check_official, write_official
from megloc_kapture.errors import (
    DataError,
    MeglocError,
    OptionError,
    PluginError,
    check_option,
    require,
    suggestion,
)
from megloc_kapture.evaluation.protocols import TWIN_PREFIX as TWIN_PREFIX
from megloc_kapture.io.dataset_tables import PROTOCOL_FILE, SIDE_TABLES, Protocol
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.kapture import KaptureFolder, is_kapture
from megloc_kapture.io.output_folders import files_below
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, PRESETS
from megloc_kapture.plugin_loading import load_plugin, option_fault, plugin_names
from megloc_kapture.plugins import DATASETS, RENDERED_DATASETS, DatasetAdapter, RenderedDataset
from megloc_kapture.stages.paths import MAPPING, QUERY, QUERY_GT
from megloc_kapture.values import Options

_log = logging.getLogger(__name__)

KAPTURE, SYNTHETIC = "kapture", "synthetic"
DATA_VARIABLE = "MEGLOC_DATA"
SUMMARY_FILE = f"{SIDE_TABLES}/summary.txt"
# evaluation servers count a missing pose as wrong, so benchmarks keep every pose
EVERY_POSE = {"localization": {"min_confidence": 0.0}}

_PACKAGE = Path(__file__).resolve().parent.parent
# inside the package in a wheel, next to it in a checkout
_PLACES = (_PACKAGE / "benchmarks", _PACKAGE.parent / "benchmarks")


@dataclass(frozen=True)
class DatasetChoice:
    """A dataset and its source: an adapter, a renderer (``twin``), or kapture folders (neither)."""

    name: str
    root: Path | None
    adapter: DatasetAdapter | None = None
    import_options: Mapping[str, Any] = field(default_factory=dict)
    twin: RenderedDataset | None = None
    query_prefix: str = ""
    allow_missing: bool = False

    def check(self) -> None:
        """Raise DataError if the folder cannot hold the dataset."""
        if self.root is not None:
            require(self.root.exists(), "no such folder", path=self.root)
            (check_root if self.adapter is None else self.adapter.check)(self.root)

    def has_truth(self) -> bool:
        """Return whether there are true poses; assumed for all datasets but kapture folders."""
        return self.root is None or self.adapter is not None or is_kapture(self.root / QUERY_GT)

    def has_query_depth(self) -> bool:
        """Return whether kapture folders have a rig that links depth maps to the queries."""
        return self.root is not None and self.adapter is None and _has_depth(self.root / QUERY)

    def has_map_depth(self) -> bool:
        made_by = self.adapter or self.twin
        if made_by is not None:
            return bool(getattr(getattr(made_by, "options", None), "depth", False))
        return self.root is not None and _has_depth(self.root / MAPPING)

    def settings(self) -> dict[str, Any]:
        settings: dict[str, Any] = {"dataset": self.name, "query_prefix": self.query_prefix}
        if self.adapter is not None:
            settings["adapter"] = self.adapter.name
            settings["options"] = dict(self.import_options)
            settings["allow_missing"] = self.allow_missing
        return settings

    def input_files(self, root: Path) -> Iterator[Path]:
        """Yield the files that an import depends on; for official datasets, all below the root."""
        return input_files(root) if self.adapter is None else files_below(root)

    def rehearse(self) -> None:
        """Raise the errors that an import would raise, without writing anything."""
        if self.root is None:
            return
        root = self.root.resolve()
        if self.adapter is None:
            checked_folders(root, self.query_prefix)
        else:
            check_official(self._read(self.adapter, root), allow_missing=self.allow_missing)

    def _read(self, adapter: DatasetAdapter, root: Path) -> OfficialDataset:
        dataset = adapter.read(root, allow_missing=self.allow_missing)
        if not isinstance(dataset, OfficialDataset):
            what = f"returned {type(dataset).__name__}, not OfficialDataset"
            raise PluginError(f"dataset plugin {self.name!r}: read {what}")
        return dataset

    def import_to(self, root: Path, output: Path) -> dict[str, float]:
        """Import ``root`` into ``output`` and return counts for the log.

        Official datasets get ``megloc/summary.txt``, which compares actual and published counts.
        """
        if self.adapter is None:
            return import_kapture_folders(root, output, query_prefix=self.query_prefix)
        dataset = self._read(self.adapter, root)
        write_official(dataset, output, allow_missing=self.allow_missing)
        if self.name.startswith(TWIN_PREFIX):
            bare = [replace(count, published=None) for count in dataset.summary]
            dataset = replace(dataset, summary=bare)
        others = [count for count in dataset.summary if count.published not in (None, count.found)]
        if others:
            shown = ", ".join(f"{c.found} {c.what.strip()} ({c.published})" for c in others[:3])
            message = "%d counts differ from the published ones: %s; %s has all"
            _log.warning(message, len(others), shown, SUMMARY_FILE)
        write_bytes(output / SUMMARY_FILE, summary_text(dataset).encode())
        truth = dataset.query_gt
        return {
            "map_images": len(dataset.mapping.records_camera),
            "queries": len(dataset.query.records_camera),
            "queries_with_truth": 0 if truth is None else len(truth.poses()),
        }


def summary_text(dataset: OfficialDataset) -> str:
    lines = [str(count) for count in dataset.summary]
    if dataset.missing is not None and dataset.missing.files:
        lines += ["", f"{len(dataset.missing.files)} files are missing (--allow-missing):"]
        lines += [f"  {text}" for text in dataset.missing.by_folder()]
    for remark in dataset.remarks:
        lines += ["", remark]
    return "\n".join(lines) + "\n"


def dataset_names() -> list[str]:
    official = plugin_names(DATASETS)
    return [KAPTURE, *official, SYNTHETIC, *(f"{TWIN_PREFIX}{name}" for name in official)]


def check_known(dataset: str) -> None:
    if dataset not in dataset_names():
        raise OptionError(f"unknown dataset {dataset!r}; {suggestion(dataset, dataset_names())}")


def check_dataset(dataset: str, protocol: Protocol, *, tables: Path | None) -> None:
    """Raise OptionError if the side tables are of another dataset, or are required but missing."""
    check_known(dataset)
    plain = (KAPTURE, SYNTHETIC)
    wanted, given = (name.removeprefix(TWIN_PREFIX) for name in (dataset, protocol.dataset))
    if tables is None and wanted not in plain:
        raise OptionError(
            f"the protocol of {dataset} is missing; give the imported dataset (`megloc check "
            "--data`) or its megloc/ folder (`megloc submit --side-tables`)"
        )
    official = {name for name in dataset_names() if name not in plain}
    check_option(
        wanted == given or wanted in plain and given not in official,
        f"dataset {dataset} was requested, but {(tables or Path()) / PROTOCOL_FILE} is for "
        f"dataset {protocol.dataset}",
    )


def choose_dataset(
    name: str,
    root: Path | None,
    *,
    import_options: Mapping[str, Any] | None = None,
    query_prefix: str = "",
    allow_missing: bool = False,
    find_root: bool = True,
) -> DatasetChoice:
    """Return a dataset by name; without ``root``, look for its folder below MEGLOC_DATA.

    If ``find_root`` is false, an official dataset may lack a root and then cannot be imported.
    """
    check_known(name)
    layout, options = name.removeprefix(TWIN_PREFIX), dict(import_options or {})
    adapter: DatasetAdapter | None = None
    if layout not in (KAPTURE, SYNTHETIC):
        adapter = load_plugin(DATASETS, layout, options)
        check_option(not query_prefix, "--query-prefix is for datasets of kapture folders")
    elif options:
        raise OptionError(f"dataset {name} has no import options, but got {', '.join(options)}")
    twin = None
    if root is None and (name == SYNTHETIC or name.startswith(TWIN_PREFIX)):
        twin = twin_of(layout)
    elif root is None and (find_root or adapter is None):
        root = _root_in_environment(name, adapter)
    return DatasetChoice(name, root, adapter, options, twin, query_prefix, allow_missing)


def with_model(choice: DatasetChoice) -> DatasetChoice | None:
    """Return the dataset with the import of its point model enabled; None if it has no model."""
    if choice.adapter is None:
        return None
    layout = choice.name.removeprefix(TWIN_PREFIX)
    options = {**choice.import_options, "reference_model": True}
    try:
        adapter: DatasetAdapter = load_plugin(DATASETS, layout, options)
    except PluginError:
        return None
    return replace(choice, adapter=adapter, import_options=options)


def has_model(choice: DatasetChoice) -> bool:
    reference = with_model(choice)
    try:
        if reference is not None:
            reference.check()
    except (
        MeglocError
    ):  # the model's files are missing, since without the model the check has passed
        return False
    return reference is not None


def _root_in_environment(name: str, adapter: DatasetAdapter | None) -> Path:
    folder = os.environ.get(DATA_VARIABLE)
    names: Sequence[str] = (name,) if adapter is None else (name, *adapter.card.folders)
    tried = [Path(folder) / part for part in names] if folder else []
    for place in tried:
        if place.is_dir():
            return place
    looked = (
        f"; {DATA_VARIABLE} contains none of {', '.join(p.name for p in tried)}" if tried else ""
    )
    if adapter is None:
        raise OptionError(
            f"dataset {name} needs --root, a folder with mapping/, query/ and optionally query_gt/"
            + looked
        )
    card = adapter.card
    twin = f"; without the data, `megloc eval {TWIN_PREFIX}{name}` runs a rendered twin"
    raise OptionError(
        f"dataset {name} needs --root or {DATA_VARIABLE}{looked}: {card.title} is published at "
        f"{card.published_at} ({card.size}); the root must contain {card.layout}"
        + (twin if name in plugin_names(RENDERED_DATASETS) else "")
    )


def twin_of(layout: str, **options: Any) -> RenderedDataset:
    known = plugin_names(RENDERED_DATASETS)
    check_option(
        known,
        "rendered datasets (synthetic, synthetic-aachen ...) need a separate package: "
        "pip install megloc-twins",
    )
    if layout not in known:
        raise OptionError(f"no renderer for {layout!r}; known: {', '.join(known)}")
    twin: RenderedDataset = load_plugin(RENDERED_DATASETS, layout, options)
    return twin


class PresetOptions(Options):
    """Options that a dataset changes in a preset; some only if its data have depth maps."""

    import_options: dict[str, Any] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)
    options_with_map_depth: dict[str, Any] = Field(default_factory=dict)
    options_with_query_depth: dict[str, Any] = Field(default_factory=dict)
    options_with_both_depths: dict[str, Any] = Field(default_factory=dict)

    def _changes(self, *, map_depth: bool, query_depth: bool) -> list[dict[str, Any]]:
        return [
            self.options,
            self.options_with_map_depth if map_depth else {},
            self.options_with_query_depth if query_depth else {},
            self.options_with_both_depths if map_depth and query_depth else {},
        ]


class BenchmarkFile(PresetOptions):
    """Options of one dataset, ``benchmarks/<dataset>.toml``, with changes to every preset.

    ``presets`` holds further changes by preset name; ``thresholds``, ``conditions`` and ``pools``
    replace those of the dataset's Protocol; ``published`` are lines about other methods' results.
    """

    dataset: str
    preset: str = DEFAULT_PRESET
    thresholds: tuple[tuple[float, float | None], ...] | None = None
    conditions: tuple[str, ...] | None = None
    pools: dict[str, tuple[str, ...]] | None = None
    presets: dict[str, PresetOptions] = Field(default_factory=dict)
    published: tuple[str, ...] = ()

    @field_validator("presets")
    @classmethod
    def _known_presets(cls, presets: dict[str, PresetOptions]) -> dict[str, PresetOptions]:
        unknown = sorted(set(presets) - set(PRESETS))
        if unknown:
            raise ValueError(f"unknown preset {unknown[0]!r}; known: {', '.join(PRESETS)}")
        return presets

    def changes(self, preset: str, *, map_depth: bool, query_depth: bool) -> list[dict[str, Any]]:
        """Return changes to a preset, in order, for data with or without depth maps."""
        layers = self, self.presets.get(preset, PresetOptions())
        changed = [layer._changes(map_depth=map_depth, query_depth=query_depth) for layer in layers]
        return [EVERY_POSE, *chain.from_iterable(changed)]

    def import_options_of(self, preset: str) -> dict[str, Any]:
        return self.import_options | self.presets.get(preset, PresetOptions()).import_options

    def change(self, protocol: Protocol) -> Protocol:
        wanted = {"thresholds": self.thresholds, "conditions": self.conditions, "pools": self.pools}
        return protocol.model_copy(update={k: v for k, v in wanted.items() if v is not None})


def find_benchmark(dataset: str) -> BenchmarkFile:
    """Return the packaged benchmark file of a dataset or of a twin's original, or defaults."""
    original = dataset.removeprefix(TWIN_PREFIX)
    path = next(filter(Path.is_file, (place / f"{original}.toml" for place in _PLACES)), None)
    if path is None:
        return BenchmarkFile(dataset=dataset)
    benchmark = read_benchmark(path)
    if original == dataset:
        return benchmark
    return benchmark.model_copy(update={"dataset": dataset, "published": ()})


def read_benchmark(path: Path) -> BenchmarkFile:
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return BenchmarkFile.model_validate(content)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"not TOML: {error}", path=path) from error
    except ValidationError as error:
        raise DataError(option_fault(error, BenchmarkFile), path=path) from error


def _has_depth(root: Path) -> bool:
    # imported here so that choosing a dataset does not import the stages
    from megloc_kapture.stages.scene import depth_records

    data = KaptureFolder(root).read()
    has_depth = bool(depth_records(data))
    if data.records_depth and not has_depth:
        message = (
            "%s: no rig links depth sensors to cameras at the same timestamps; depth is not used"
        )
        _log.warning(message, root)
    return has_depth
