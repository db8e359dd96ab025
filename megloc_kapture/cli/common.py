"""Flags and messages shared by commands; flags are named as in kapture's tools."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import timedelta
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from megloc_kapture.errors import DataError, OptionError, require
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import staged_output
from megloc_kapture.io.text_lines import camera_of, fields_of, read_cameras
from megloc_kapture.pipeline.executors import (
    LOG_FORMAT,
    ExecutorKind,
    available_cores,
    open_executor,
    single_threaded,
)
from megloc_kapture.plugin_loading import AUTO, NetworkOptions
from megloc_kapture.stages.stage import count_label
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, PixelOriginChoice

if TYPE_CHECKING:
    from megloc_kapture.pipeline.kapture_map import KaptureMap
    from megloc_kapture.pipeline.plan import Workspace
    from megloc_kapture.stages.options import PipelineOptions

Input = Annotated[Path, tyro.conf.arg(aliases=["-i"])]
Inputs = Annotated[tuple[Path, ...], tyro.conf.arg(aliases=["-i"]), tyro.conf.UseAppendAction]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Force = Annotated[
    bool,
    tyro.conf.arg(aliases=["-f"], help="Write into a non-empty folder."),
]
Overwrite = Annotated[bool, tyro.conf.arg(aliases=["-f"])]
Folders = Annotated[tuple[Path, ...], tyro.conf.UseAppendAction]
AllowedLinks = Annotated[
    Folders,
    tyro.conf.arg(
        help="No effect; accepted for older scripts. Links in kapture folders are always followed."
    ),
]
Texts = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]

Item = TypeVar("Item")

_LINE_EVERY_S = 10.0


def kapture_map(path: Path) -> KaptureFolder:
    """Open the kapture folder of a map or workspace."""
    # importing the workspace is slow
    from megloc_kapture.pipeline.plan import map_of_workspace

    return KaptureFolder(map_of_workspace(path))


def print_counts(counts: Mapping[str, float]) -> None:
    for words, figure in starmap(count_label, counts.items()):
        print(f"{words:44s}{figure:>8}")


def camera_of_text(text: str) -> Camera:
    """Parse ``MODEL,WIDTH,HEIGHT,PARAMETERS``."""
    try:
        model, *numbers = fields_of(text)
        return camera_of(model, numbers)
    except (ValueError, DataError) as error:
        reason = error.message if isinstance(error, DataError) else "neither a file nor a camera"
        raise OptionError(
            f"--camera {text}: {reason}; give MODEL,WIDTH,HEIGHT,PARAMETERS, as in "
            "SIMPLE_RADIAL,4032,3024,3100,2016,1512,0.02"
        ) from error


def cameras_of_text(text: str | None) -> Camera | dict[str, Camera] | None:
    """Parse a camera as :func:`camera_of_text` does, or read a camera list file."""
    if text is None:
        return None
    # not Path.is_file, which raises an error for a text that is too long for a file name
    return read_cameras(Path(text)) if os.path.isfile(text) else camera_of_text(text)


@dataclass(frozen=True, kw_only=True)
class Common:
    """Flags of every command."""

    verbose: Annotated[
        Literal["debug", "info", "warning", "error"], tyro.conf.arg(aliases=["-v"])
    ] = "warning"
    """Level of log messages."""
    quiet: Annotated[bool, tyro.conf.arg(aliases=["-q"])] = False
    """Print results and errors only."""
    debug: bool = False
    """Show the traceback of an error."""

    def start_logging(self) -> None:
        level = "debug" if self.debug else self.verbose
        logging.basicConfig(level=getattr(logging, level.upper()), format=LOG_FORMAT)

    def say(self, text: str) -> None:
        """Print a progress message to standard error; results are printed to standard output."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def track(self, items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
        """Yield the items while showing a progress bar on a terminal, else plain lines."""
        if self.quiet:
            yield from items
        elif sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import MofNCompleteColumn, Progress

            columns = (*Progress.get_default_columns(), MofNCompleteColumn())
            with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
                yield from progress.track(items, total=total, description=f"  {label}")
        else:
            started = shown = time.monotonic()
            for number, item in enumerate(items, start=1):
                yield item
                now = time.monotonic()
                if now - shown > _LINE_EVERY_S and number < total:
                    shown = now
                    rate = number / (now - started)
                    left = timedelta(seconds=round((total - number) / rate))
                    self.say(f"  {label}: {number} of {total}, {rate:.2g}/s, {left} left")

    def opened_map(self, path: Path, *, force: bool = False) -> Path:
        """Return a map's kapture folder; a COLMAP model is imported into the user's cache."""
        # importing the stages is slow
        from megloc_kapture.datasets.colmap_map import is_colmap
        from megloc_kapture.pipeline.map_making import kapture_of

        if not is_colmap(path):
            return kapture_of(path)
        with open_executor("processes") as executor:
            folder = kapture_of(path, work=Work(executor, self.track, force=force))
        self.say(f"{path}: a COLMAP model, imported as kapture to {folder}")
        return folder


@dataclass(frozen=True, kw_only=True)
class Working(Common):
    """Flags of commands with per-image or per-pair work."""

    executor: ExecutorKind = "processes"
    """Run in this process, in local processes, or on a dask cluster."""
    workers: int | None = None
    """Number of processes; if omitted, all cores."""
    scheduler: str | None = None
    """Address of a running dask scheduler (tcp://HOST:8786); if omitted, a local cluster."""

    def placement(self) -> NetworkOptions:
        return AUTO

    @contextmanager
    def working(self, output: Path) -> Iterator[Work]:
        folder = output if output.is_dir() else output.absolute().parent
        with (
            single_threaded(),
            open_executor(self.executor, self.workers, self.scheduler, folder) as executor,
        ):
            yield Work(
                executor,
                self.track,
                self.workers or available_cores(),
                placement=self.placement(),
            )

    @contextmanager
    def staged(
        self, output: Path, kind: str, *, force: bool, adds: bool = False
    ) -> Iterator[tuple[Path, Work]]:
        """Yield a staging folder, whose content moves to ``output`` on success, and the Work."""
        read = () if adds else ("input", "query", "poses")
        inputs = [getattr(self, name, None) for name in read]
        with (
            staged_output(output, kind=kind, force=force, adds=adds, inputs=inputs) as out,
            self.working(out) as work,
        ):
            yield out, replace(work, force=force)

    @contextmanager
    def working_in(self, workspace: Workspace) -> Iterator[Work]:
        """Lock the workspace and yield the Work of a run in it."""
        with workspace.lock(), self.working(workspace.root) as work:
            yield work


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Flags of commands that read features of kapture folders."""

    allow_links_below: AllowedLinks = ()
    features_dir: Folders = ()
    """Folder with features outside the kapture folders; may be repeated."""

    def kapture(self, root: Path) -> KaptureFolder:
        for place in self.features_dir:
            require(place.is_dir(), "no such features folder", path=place)
        folder = KaptureFolder(root, features_dirs=self.features_dir)
        folder.read()  # rejects a COLMAP model or photographs before missing features are reported
        return folder

    def kapture_map(self, root: Path) -> KaptureFolder:
        """Open the kapture folder of a map or workspace."""
        return self.kapture(kapture_map(root).root)


@dataclass(frozen=True, kw_only=True)
class ReadingMap(Reading):
    """Flags of commands that localize in a kapture map."""

    keypoints_type: Texts = ()
    """Keypoints type to localize with; may be repeated; if omitted, all types with points."""
    pixel_origin: PixelOriginChoice = "auto"
    """Pixel origin of the map's intrinsics; auto detects it."""

    def open_map(self, path: Path) -> KaptureMap:
        from megloc_kapture.pipeline.kapture_map import KaptureMap

        return KaptureMap.open(
            path,
            keypoints_types=self.keypoints_type,
            features_dirs=self.features_dir,
            pixel_origin=self.pixel_origin,
        )


@dataclass(frozen=True, kw_only=True)
class Computing:
    """Flags for the device and the precision of networks."""

    device: str | None = None
    """Device of the networks: auto (a GPU if available), cpu, cuda, or cuda:N. If omitted, auto."""
    precision: Literal["full", "half"] | None = None
    """Precision of the networks; half: float16 on a GPU, bfloat16 on a CPU. If omitted, full."""

    def assignments(self) -> tuple[str, ...]:
        """Return the options that flags change, in ``--set`` syntax."""
        given = {"device": self.device, "precision": self.precision}
        return tuple(f"{name}={value}" for name, value in given.items() if value is not None)

    def placement(self) -> NetworkOptions:
        # slow imports
        from megloc_kapture.pipeline.presets import options_with, parse_assignments
        from megloc_kapture.stages.options import PipelineOptions

        chosen = parse_assignments(self.assignments()).items()
        placed = {key: value for key, value in chosen if key in ("device", "precision")}
        return options_with(PipelineOptions, placed).placement


@dataclass(frozen=True, kw_only=True)
class Choosing(Computing):
    """Flags that choose options."""

    preset: str | None = None
    """Preset: classic, modern, modern-large, megloc. If omitted, classic; for megloc eval, the
    benchmark file's."""
    set: Texts = ()
    """Change an option: key.key=value; may be repeated."""

    def assignments(self) -> tuple[str, ...]:
        return (*self.set, *super().assignments())

    def options(self, changes: dict[str, object] | None = None) -> PipelineOptions:
        """Return the preset's options with ``changes`` and then ``--set`` applied."""
        from megloc_kapture.pipeline.presets import DEFAULT_PRESET, options_of_preset

        preset = self.preset or DEFAULT_PRESET
        return options_of_preset(preset, changes=[changes or {}], assignments=self.assignments())


@dataclass(frozen=True, kw_only=True)
class Localizing(Choosing):
    """Flags of commands that localize."""

    min_confidence: float | None = None
    """Reject poses with a lower confidence (0 to 1); 0 keeps every pose, for challenges, where a
    wrong pose costs no more than a missing one. If omitted, 0.6, or 0 for megloc eval."""

    def assignments(self) -> tuple[str, ...]:
        if self.min_confidence is None:
            return super().assignments()
        return (*super().assignments(), f"localization.min_confidence={self.min_confidence:g}")
