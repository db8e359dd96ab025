"""The workspace: where a run keeps its results, and recognizes them.

Each stage leaves a manifest there. Its fingerprint is a hash of the stage's name, version and
options, the code of its plugins, and the fingerprints of its inputs: of the stages that wrote
them, or of names, sizes and times of files outside the workspace. A stage runs again when its
fingerprint has changed or an output is gone.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import Field

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import clear_leftovers, output_error, read_json_model, remove
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import claim_folder, replace_directory
from megloc_kapture.stages.stage import PROTOCOL, ROOT
from megloc_kapture.stages.work import is_resumable
from megloc_kapture.values import Options

PARTIAL = ".partial"
LOCK = ".lock"
FINISHED = ".items"  # in a stage's unfinished folder: its finished items
_MAP = "map"


def map_of_workspace(path: Path) -> Path:
    """Return the kapture folder of a workspace's map; any other path as it is."""
    is_workspace = (path / LOCK).is_file() and (path / _MAP).is_dir()
    return path / _MAP if is_workspace else path


class Workspace:
    """Paths of a workspace (docs/architecture.md); a folder that is none is refused."""

    def __init__(self, root: Path, *, force: bool = False) -> None:
        self.root, self.force = Path(root).absolute(), force
        self._claim = claim_folder(self.root, kind="workspace", force=force)
        self._published = False

    def path(self, relative: str) -> Path:
        """Return a path below the workspace."""
        return self.root / relative

    def manifest_path(self, stage: str) -> Path:
        """Return where the manifest of a stage lies."""
        return self.root / "stages" / f"{stage}.json"

    def manifest(self, stage: str) -> Manifest | None:
        """Return the manifest of a stage; see :func:`read_manifest`."""
        return read_manifest(self.manifest_path(stage))

    def manifest_paths(self) -> list[Path]:
        """Return the paths of all manifests."""
        found = (self.root / "stages").glob("*.json")
        return sorted(path for path in found if path.name[0] != ".")

    def partial_path(self, stage: str) -> Path:
        """Return the folder that a stage writes into until it is finished."""
        return self.root / PARTIAL / stage

    def folder(self, name: str, *features: str) -> KaptureFolder:
        """Return a kapture folder of the workspace, with features folders of the workspace."""
        return KaptureFolder(self.path(name), features_dirs=[self.path(f) for f in features])

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the workspace against a second run; a dead process holds nothing.

        Leftovers of killed runs are removed, except finished items. A workspace that no stage
        has been run in by the end of the block is removed: a refused run, or a dry run,
        leaves nothing behind.
        """
        path = self.root / LOCK
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise output_error(path, error) from error
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise OutputError(
                    f"{self.root}: another run is using this workspace; wait for it or give "
                    "another --workspace"
                ) from error
            self._clear_partial()
            for folder in (self.root, self.root / "stages"):
                clear_leftovers(folder)
            try:
                yield
            finally:
                self._clear_partial()
                self._remove_if_unused()
        finally:
            os.close(handle)

    def _clear_partial(self) -> None:
        for folder in (self.root / PARTIAL).glob("*"):
            if not (folder / FINISHED).is_file():
                with contextlib.suppress(OSError):
                    remove(folder)

    def _remove_if_unused(self) -> None:
        stopped = any((self.root / PARTIAL).glob("*"))
        if self._published or stopped or (self.root / "stages").is_dir():
            return
        with contextlib.suppress(OSError):
            (self.root / LOCK).unlink(missing_ok=True)
            (self.root / PARTIAL).rmdir()
        self._claim.undo()

    @contextmanager
    def staging(self, stage: str, mark: str) -> Iterator[Path]:
        """Yield the folder to write a stage's output into; removed when the block ends well.

        A folder that a stopped run of the same fingerprint (``mark``) left is used again. When
        the block raises, a folder with finished items stays for the next run.
        """
        place = self.partial_path(stage)
        try:
            if not is_resumable(place / FINISHED, mark):
                remove(place)
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise output_error(place, error) from error
        done = False
        try:
            yield place
            done = True
        finally:
            if done or not (place / FINISHED).is_file():
                with contextlib.suppress(OSError):
                    remove(place)

    def publish(self, staging: Path, outputs: tuple[str, ...]) -> None:
        """Move a stage's outputs to their places; outputs it did not write are removed."""
        if not staging.is_dir():
            raise OutputError(f"{self.root}: was deleted or moved while a run was working in it")
        self._published = True
        for output in outputs:
            new, place = staging / output, self.root / output
            try:
                place.parent.mkdir(parents=True, exist_ok=True)
                if new.is_dir():
                    replace_directory(new, place)
                elif new.exists():
                    os.replace(new, place)
                else:
                    remove(place)
            except OSError as error:
                raise output_error(place, error) from error

    def remove(self, outputs: Iterable[str]) -> None:
        """Remove outputs."""
        for output in outputs:
            place = self.root / output
            try:
                remove(place)
            except OSError as error:
                raise output_error(place, error) from error


class Manifest(Options):
    """``stages/NAME.json``."""

    stage: str
    version: int
    options: dict[str, Any]
    inputs: dict[str, str] = Field(description="inputs: name to fingerprint")
    fingerprint: str
    output: str = Field(description="fingerprint for stages that read the outputs")
    outputs: tuple[str, ...]
    counts: dict[str, int | float] = Field(default_factory=dict)
    seconds: float
    started: str
    versions: dict[str, str]


def fingerprint(
    stage: str, version: int, options: Mapping[str, Any], inputs: Mapping[str, str]
) -> str:
    """Return a hash of everything that determines a stage's output."""
    content = {"stage": stage, "version": version, "options": dict(options), "inputs": dict(inputs)}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def output_fingerprint(
    stage: str, version: int, options: Mapping[str, Any], inputs: Mapping[str, str]
) -> str:
    """As :func:`fingerprint`, for stages that read the outputs.

    It is the same wherever the dataset lies, for it may be moved, and for any protocol: the
    submission and the evaluation, which depend on that, have it among their own options.
    """
    others = {name: value for name, value in options.items() if name != PROTOCOL}
    content = {name: mark for name, mark in inputs.items() if name != ROOT}
    return fingerprint(stage, version, others, content)


def read_manifest(path: Path) -> Manifest | None:
    """Read a manifest; None where it is missing or broken: then the stage has to run."""
    try:
        return read_json_model(path, Manifest)
    except DataError:
        return None
