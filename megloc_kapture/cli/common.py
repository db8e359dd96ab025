"""Flags that commands share, named as kapture's tools name theirs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from megloc_kapture.cli.console import Console, configure_logging
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.dataset_tables import PROTOCOL_FILE, SIDE_TABLES
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.executors import ExecutorKind, open_executor
from megloc_kapture.values import Camera

if TYPE_CHECKING:
    from megloc_kapture.pipeline.kapture_map import KaptureMap
    from megloc_kapture.pipeline.local_types import LocalType
    from megloc_kapture.stages.options import PipelineOptions

Input = Annotated[Path, tyro.conf.arg(aliases=["-i"])]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Force = Annotated[bool, tyro.conf.arg(aliases=["-f"])]


def existing(folders: Sequence[Path]) -> tuple[Path, ...]:
    """The folders; raises DataError when one is not there, which would be as if not given."""
    for folder in folders:
        if not folder.is_dir():
            raise DataError("no such folder", path=folder)
    return tuple(folders)


def opened_map(path: Path, console: Console) -> Path:
    """The kapture folder of a map, or of a workspace; a COLMAP model's is made in the user's cache,
    and said."""
    # commands that open no map do not wait for all stages
    from megloc_kapture.datasets.colmap_map import is_colmap
    from megloc_kapture.pipeline.colmap_maps import kapture_of
    from megloc_kapture.stages.work import Work

    if not is_colmap(path):
        return kapture_of(path)
    with open_executor("processes") as executor:
        folder = kapture_of(path, work=Work(executor, console.track))
    console.say(f"{path}: a COLMAP model, as kapture in {folder}")
    return folder


def camera_of_text(text: str) -> Camera:
    """The camera of ``MODEL,WIDTH,HEIGHT,PARAMETERS``; raises OptionError."""
    try:
        model, width, height, *params = text.split(",")
        return Camera(model.strip(), int(width), int(height), tuple(map(float, params)))
    except (ValueError, DataError) as error:
        reason = error.message if isinstance(error, DataError) else "not such a list"
        raise OptionError(
            f"--camera {text}: {reason}; give MODEL,WIDTH,HEIGHT,PARAMETERS, as in "
            "SIMPLE_RADIAL,4032,3024,3100,2016,1512,0.02"
        ) from error


def check_consistent(kapture_map: KaptureMap, path: Path, *, force: bool) -> None:
    """Raise DataError for a map that contradicts itself, unless it is to be used all the same."""
    if not force and (fault := kapture_map.fault()):
        raise DataError(
            f"{fault}; the poses would be wrong (--force localizes all the same)", path=path
        )


def idle_for_types(
    typed: Mapping[str, Any], types: Sequence[LocalType], options: PipelineOptions
) -> dict[str, str]:
    """Options that change nothing for a map of these keypoints types, and why.

    Parameters
    ----------
    typed : nested tables of ``--set``.
    """
    idle = {}
    if "guided_pyramid" in typed and options.matches_again():
        obstacles = [local.pyramid_obstacle for local in types]
        if all(obstacles):
            idle["guided_pyramid"] = obstacles[0]
    used = {local.choice.name for local in types if local.choice is not None}
    unused = [one.name for one in options.local_features if one.name not in used]
    if unused:
        brought = ", ".join(local.name for local in types)
        idle["local_features"] = f"the map is of {brought}; nothing in it is of {unused[0]}"
    return idle


def refuse_idle(typed: Mapping[str, Any], idle: Mapping[str, str]) -> None:
    """Raise OptionError where an option that was typed changes nothing."""
    for name in typed:
        if name in idle:
            raise OptionError(f"--set {name} changes nothing: {idle[name]}")


def side_tables_beside(result: Path) -> Path | None:
    """The workspace's side tables, where a result lies in a workspace."""
    place = result.resolve().parent / SIDE_TABLES
    return place if (place / PROTOCOL_FILE).is_file() else None


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

    def console(self) -> Console:
        """The console these flags ask for."""
        configure_logging("debug" if self.debug else self.verbose)
        return Console(quiet=self.quiet)


@dataclass(frozen=True, kw_only=True)
class Working:
    """Flags of commands with per-image or per-pair work."""

    executor: ExecutorKind = "processes"
    """Where the work runs: in this process, in local processes, or on a dask cluster."""
    workers: int | None = None
    """Number of processes; all cores unless given."""
    scheduler: str | None = None
    """Address of a running dask scheduler (tcp://HOST:8786); a local cluster unless given."""

    def open_executor(self, output: Path) -> AbstractContextManager[Executor | None]:
        """The executor that these flags ask for; a cluster must see the output's folder."""
        return open_executor(self.executor, self.workers, self.scheduler, output)


@dataclass(frozen=True, kw_only=True)
class Linked:
    """Flags of commands that read kapture folders, which may consist of links."""

    allow_links_below: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Folder that links in the kapture folders may lead to, as those of kapture-localization's
    proxy folders do; may be repeated."""

    def kapture(self, root: Path) -> KaptureFolder:
        """A kapture folder; raises DataError where a folder that links may lead to is not there."""
        return KaptureFolder(root, allow_links_below=existing(self.allow_links_below))


@dataclass(frozen=True, kw_only=True)
class Reading(Linked):
    """Flags of commands that read features of kapture folders."""

    features_dir: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Features folder beside the kapture folders; may be repeated."""

    def kapture(self, root: Path) -> KaptureFolder:
        """A kapture folder with the features beside it; raises DataError for one not there."""
        return KaptureFolder(
            root,
            features_dirs=existing(self.features_dir),
            allow_links_below=existing(self.allow_links_below),
        )


@dataclass(frozen=True, kw_only=True)
class Computing:
    """Flags that say where and how networks compute."""

    device: str | None = None
    """Where networks compute: auto (a GPU where there is one), cpu, cuda, or cuda:N."""
    precision: Literal["full", "half"] | None = None
    """Of networks; half: float16 on a GPU, bfloat16 on a processor. Full unless given."""

    def placement(self) -> list[str]:
        """As ``--set`` takes them."""
        given = {"device": self.device, "precision": self.precision}
        return [f"{name}={value}" for name, value in given.items() if value is not None]

    def check_computes(self, chosen: object) -> None:
        """Raise OptionError where no network, of options or a tuple of them, has what is given."""
        from megloc_kapture.stages.devices import unheeded

        if lacking := unheeded(chosen, self.device or "auto", self.precision or "full"):
            raise OptionError(f"--{lacking[0]} changes nothing: no network here has it")


@dataclass(frozen=True, kw_only=True)
class Choosing(Computing):
    """Flags that choose options."""

    preset: str | None = None
    """A set of options by name: classic, modern, modern-large, megloc."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """Change an option: key.key=value; may be repeated."""

    def assignments(self) -> tuple[str, ...]:
        """What is set by --set and by flags of its own."""
        return (*self.set, *self.placement())


@dataclass(frozen=True, kw_only=True)
class Deciding(Choosing):
    """Flags of commands that localize."""

    min_confidence: float | None = None
    """A pose that is less likely to be right (0 to 1) is a failure; 0: every pose is kept, for
    challenges, where a wrong answer costs nothing. 0.6 unless given."""

    def assignments(self) -> tuple[str, ...]:
        """What is set by --set and by flags of its own."""
        if self.min_confidence is None:
            return super().assignments()
        return (*super().assignments(), f"localization.min_confidence={self.min_confidence:g}")
