"""Base class of stages; ``docs/plugins.md`` has an example.

A stage runs again if its options, inputs, version, plugin code or output names change.
``PIPELINE`` in ``pipeline/evaluation_plan.py`` defines the order of the stages. A third-party
stage runs after the stages that write its inputs.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugin_loading import (
    AUTO,
    NetworkOptions,
    code_of,
    has_precision,
    is_ours,
    weights_of,
)
from megloc_kapture.stages import paths
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Options

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions


_UNITS = {"px": "px", "m": "m", "percent": "%"}


def count_label(name: str, value: float) -> tuple[str, str]:
    """Return the label and the formatted value of a count: ``keypoints``, ``33,485,000``."""
    words, _, last = name.replace("_", " ").rpartition(" ")
    unit = f" {_UNITS[last]}" if words and last in _UNITS else ""
    words = words if unit else f"{words} {last}".lstrip()
    if isinstance(value, int):
        if value == 1 and not unit:  # singular
            words = re.sub(
                r"(ie|(?<=ch)e|)s\b", lambda end: "y" if end[1] == "ie" else "", words, count=1
            )
        return words, f"{value:,}{unit}"
    figure = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return words, f"{figure}{unit}"


def counts_text(counts: Mapping[str, float]) -> str:
    """Format a stage's counts: ``12 images, mean reprojection error: 0.74 px``."""
    texts = []
    for name, value in counts.items():
        words, figure = count_label(name, value)
        is_number = isinstance(value, int) and figure[-1].isdigit()
        texts.append(f"{figure} {words}" if is_number else f"{words}: {figure}")
    return ", ".join(texts)


def files_fingerprint(root: Path, files: Iterable[Path]) -> str:
    """Return a hash of the files' sizes, modification times and names relative to ``root``."""
    digest = hashlib.sha256()
    for file in sorted(files):
        try:
            state = os.stat(file)
        except OSError as error:
            raise DataError(f"cannot be read: {error.strerror}", path=file) from error
        name = os.path.relpath(file, root)
        digest.update(f"{name}\0{state.st_size}\0{state.st_mtime_ns}\0".encode())
    return digest.hexdigest()


@dataclass(frozen=True, kw_only=True)
class StageWork(Work):
    """Execution context with the workspace ``root`` (read-only) and the output folder ``out``."""

    root: Path
    out: Path

    def path(self, name: str) -> Path:
        return self.root / name

    def folder(self, name: str, *features: str) -> KaptureFolder:
        return KaptureFolder(self.path(name), features_dirs=[self.path(part) for part in features])

    def folders(self, names: Sequence[str], *features: str) -> list[KaptureFolder]:
        """Open the kapture folders of these names; skip missing folders."""
        return [self.folder(name, *features) for name in names if self.path(name).is_dir()]


CODE_OF = "code of "
ROOT = "root"  # key of the dataset's folder in the inputs of an import stage
PROTOCOL = "protocol"


def is_below(path: str, *folders: str) -> bool:
    """Return whether a path is one of the folders, or below one."""
    return any(path == folder or path.startswith(f"{folder}/") for folder in folders)


class Stage(ABC):
    """One step of a run. Subclasses describe it by attributes or properties.

    Attributes
    ----------
    version : increase it when the output changes for the same options and inputs.
    resumes : the output of an interrupted run is kept, and the items in it are skipped.
    reads, writes : paths in the workspace; a written folder includes its contents.
    root : folder of user data that the stage imports, or None; a workspace has one root.
    placement : device and precision of the stage's networks; ``run`` gets it in ``work``.
    """

    root: Path | None = None
    placement: NetworkOptions = AUTO
    name: str
    version: ClassVar[int] = 1
    resumes: ClassVar[bool] = False
    reads: Sequence[str] = ()
    writes: Sequence[str] = ()

    def __init__(self, options: Options | None = None) -> None:
        self.options: Any = options or Options()

    def settings(self) -> dict[str, Any]:
        """Return settings that determine the output, as plain JSON values."""
        chosen: dict[str, Any] = self.options.model_dump(mode="json")
        return chosen

    def external(self) -> Mapping[str, str]:
        """Return fingerprints of inputs outside the workspace; see :func:`files_fingerprint`."""
        return {}

    def plugins(self) -> Sequence[object]:
        """Return the plugins whose code and weights determine the output."""
        return ()

    def code(self) -> dict[str, str]:
        """Return the code versions of the plugins, and of the stage if it is third-party."""
        plugins = [*self.plugins(), *(() if is_ours(type(self)) else (self,))]
        for plugin in self.plugins():
            plugins += getattr(plugin, "plugins", tuple)()
        kinds = {type(plugin) for plugin in plugins}
        names = {f"{CODE_OF}{kind.__module__}.{kind.__qualname__}": kind for kind in kinds}
        # mypy does not consider classes hashable
        return {name: code_of(kind) for name, kind in names.items()}  # type: ignore[arg-type]

    def check(self) -> None:  # noqa: B027  # most stages read only outputs of other stages
        """Raise the errors of :meth:`run` that can be found quickly; for dry runs."""

    @abstractmethod
    def run(self, work: StageWork) -> Mapping[str, float]:
        """Write the outputs; return counts for the log, see :func:`counts_text`."""


# options that determine the local feature types
LOCAL_TYPES = ("local_features.name", "local_features.options")


class PipelineStage(Stage):
    """A stage of the pipeline.

    Attributes
    ----------
    uses : option keys that determine the output; ``local_features.name`` means the names of all
        local features.
    explained_by : option keys that best explain whether and how the stage runs.
    inputs, outputs : workspace paths, or methods of this class that return them.
    posed : the poses of the map images are estimated by an earlier stage.
    """

    uses: ClassVar[tuple[str, ...]] = ()
    explained_by: ClassVar[tuple[str, ...]] = ()
    inputs: ClassVar[tuple[WorkspacePath, ...]] = ()
    outputs: ClassVar[tuple[WorkspacePath, ...]] = ()
    posed = False

    def __init__(self, options: PipelineOptions) -> None:
        self.options: PipelineOptions = options
        self.placement = options.placement

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return self._paths(self.inputs)

    @property
    def writes(self) -> Sequence[str]:  # type: ignore[override]
        return self._paths(self.outputs)

    def is_wanted(self) -> bool:
        return True

    def explain(self) -> str:
        return ", ".join(f"{key} = {_option_text(self.options, key)}" for key in self.explained_by)

    def settings(self) -> dict[str, Any]:
        # exclude the device, so that finished stages stay valid on another machine
        dump = json.loads(
            json.dumps(self.options.model_dump(mode="json")),
            object_hook=lambda table: {k: v for k, v in table.items() if k != "device"},
        )
        chosen: dict[str, Any] = _selected(dump, [key.split(".") for key in self.uses])
        plugins = self.plugins()
        weights = {file: sha for plugin in plugins for file, sha in weights_of(plugin).items()}
        if weights:
            chosen["weights"] = weights
        if self.placement.half_precision and any(map(has_precision, plugins)):
            chosen["precision"] = "half"
        return chosen

    # ---------------------------------------------------------- workspace paths by option

    def _paths(self, parts: Sequence[WorkspacePath]) -> list[str]:
        names: list[str] = []
        for part in parts:
            part_names = part if isinstance(part, str) else part(self)
            names += [part_names] if isinstance(part_names, str) else part_names
        return names

    def mapping(self) -> str:
        """Return the folder of the map images: with estimated poses, pre-processed, or imported."""
        if self.posed:
            return paths.POSED
        return (
            f"{paths.PREPROCESSED}/{paths.MAPPING}"
            if self.options.preprocesses()
            else paths.MAPPING
        )

    def query(self) -> str:
        return f"{paths.PREPROCESSED}/{paths.QUERY}" if self.options.preprocesses() else paths.QUERY

    def pairing_points(self) -> tuple[str, ...]:
        """Return the dataset's prebuilt model, if its points are used to pair map images."""
        return (paths.REFERENCE,) if self.options.pairs_by_points() else ()

    def mapping_matches(self) -> tuple[str, ...]:
        if not self.options.triangulates():
            return ()
        # a pair is read from the first folder that contains it
        again = self.options.rematches_map()
        return (paths.MAPPING_PYRAMID, paths.MAPPING_MATCHES) if again else (paths.MAPPING_MATCHES,)

    def query_matches(self) -> tuple[str, ...]:
        again = self.options.rematches_queries()
        return (paths.QUERY_PYRAMID, paths.QUERY_MATCHES) if again else (paths.QUERY_MATCHES,)

    def sparse_map(self) -> str:
        return paths.MAP if self.options.mvs.mode == "off" else paths.SPARSE

    def candidates(self) -> str:
        return paths.QUERY_CANDIDATES if self.options.reranking.reranks() else paths.QUERY_PAIRS

    def poses(self) -> str:
        return paths.UNREFINED_POSES if self.options.pose_refinement.refines() else paths.LOCALIZED


WorkspacePath = str | Callable[[PipelineStage], str | tuple[str, ...]]


def wanted_stages(
    kinds: Iterable[type[PipelineStage]], options: PipelineOptions
) -> list[PipelineStage]:
    return [stage for kind in kinds if (stage := kind(options)).is_wanted()]


def _option_text(options: Any, key: str) -> str:
    value = options
    for name in key.split("."):
        value = getattr(value, name)
    if isinstance(value, bool):
        return str(value).lower()
    several = value if isinstance(value, tuple) else () if value is None else (value,)
    return " + ".join(str(getattr(item, "name", item)) for item in several) or "none"


def _selected(dump: Any, keys: Sequence[Sequence[str]]) -> Any:
    if not all(keys):
        return dump
    if isinstance(dump, list):
        return [_selected(item, keys) for item in dump]
    names = dict.fromkeys(key[0] for key in keys)
    return {name: _selected(dump[name], [k[1:] for k in keys if k[0] == name]) for name in names}
