"""Workspace: stage outputs of a run, with manifests.

A stage runs again if an output is missing or its fingerprint changes: a hash of its name, version,
options, plugin code, and inputs (fingerprints of stages, or sizes and times of external files).
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
FINISHED = ".items"  # finished items in a stage's unfinished folder
_MAP = "map"


def map_of_workspace(path: Path) -> Path:
    """Return the kapture map in a workspace; any other path unchanged."""
    is_workspace = (path / LOCK).is_file() and (path / _MAP).is_dir()
    return path / _MAP if is_workspace else path


class Workspace:
    """Paths of a workspace (docs/architecture.md)."""

    def __init__(self, root: Path, *, force: bool = False) -> None:
        self.root, self.force = Path(root).absolute(), force
        self._undo_claim = claim_folder(self.root, kind="workspace", force=force)
        self._published = False

    def path(self, relative: str) -> Path:
        return self.root / relative

    def manifest_path(self, stage: str) -> Path:
        return self.root / "stages" / f"{stage}.json"

    def manifest(self, stage: str) -> Manifest | None:
        return read_manifest(self.manifest_path(stage))

    def manifest_paths(self) -> list[Path]:
        found = (self.root / "stages").glob("*.json")
        return sorted(path for path in found if path.name[0] != ".")

    def partial_path(self, stage: str) -> Path:
        """Return the folder of a stage's unfinished output."""
        return self.root / PARTIAL / stage

    def folder(self, name: str, *features: str) -> KaptureFolder:
        return KaptureFolder(self.path(name), features_dirs=[self.path(f) for f in features])

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the workspace for this process.

        Removes leftovers of killed runs, except finished items; at the end, removes a workspace
        that has no stage.
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
        self._undo_claim()

    @contextmanager
    def staging(self, stage: str, mark: str) -> Iterator[Path]:
        """Yield the folder to write a stage's output into; removed on success.

        Reuses the finished items of an interrupted run with the same fingerprint (``mark``).
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
        """Move a stage's outputs into place and remove old ones that were not written."""
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
        for output in outputs:
            place = self.root / output
            try:
                remove(place)
            except OSError as error:
                raise output_error(place, error) from error


class Manifest(Options):
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
    content = {"stage": stage, "version": version, "options": dict(options), "inputs": dict(inputs)}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def output_fingerprint(
    stage: str, version: int, options: Mapping[str, Any], inputs: Mapping[str, str]
) -> str:
    """Return a fingerprint that ignores the dataset's location and the protocol, for dependents."""
    others = {name: value for name, value in options.items() if name != PROTOCOL}
    content = {name: mark for name, mark in inputs.items() if name != ROOT}
    return fingerprint(stage, version, others, content)


def read_manifest(path: Path) -> Manifest | None:
    """Read a manifest; None if missing or broken, so that the stage runs again."""
    try:
        return read_json_model(path, Manifest)
    except DataError:
        return None
