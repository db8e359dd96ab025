"""Manifests: what a stage did, and whether it must run again.

A stage's fingerprint is a hash of its name, its version, its options, the code of its plugins and
the fingerprints of what it reads: hashes of content, whether from outside the workspace or of what
another stage wrote. So a stage runs again exactly when something that could change its output has
changed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from stat import S_ISREG
from typing import Any

from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import read_json_model
from megloc_kapture.io.output_folders import FileState
from megloc_kapture.values import Options

_CHUNK_BYTES = 1 << 20


class Manifest(Options):
    """``stages/NAME.json``."""

    stage: str
    version: int
    options: dict[str, Any]
    inputs: dict[str, str] = Field(description="what was read: name to fingerprint")
    fingerprint: str
    content: str = Field(default="", description="hash of the outputs; none where they are links")
    outputs: tuple[str, ...]
    counts: dict[str, float] = Field(default_factory=dict)
    seconds: float
    started: str
    versions: dict[str, str]

    @property
    def output(self) -> str:
        """The fingerprint of the outputs, by which those that read them know them again."""
        return self.content or self.fingerprint


def fingerprint(
    stage: str, version: int, options: Mapping[str, Any], inputs: Mapping[str, str]
) -> str:
    """Hash of everything that determines a stage's output."""
    content = {
        "stage": stage,
        "version": version,
        "options": dict(options),
        "inputs": dict(inputs),
    }
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def read_manifest(path: Path) -> Manifest | None:
    """The manifest, None where there is none that can be read: then the stage has to run."""
    if not path.is_file():
        return None
    try:
        return read_json_model(path, Manifest)
    except DataError:
        return None


class FileHashes:
    """SHA-256 of files, remembered by size and modification time.

    Hashing a large dataset at each start would cost a minute; a file whose size and times are
    those of last time has last time's hash.
    """

    def __init__(self, path: Path, written: Mapping[str, FileState] | None = None) -> None:
        """``path`` is where they are remembered; ``written`` are files whose state is known."""
        self._written = written or {}
        self._known: dict[str, list[Any]] = {}
        self._seen: dict[str, list[Any]] = {}
        if path.is_file():
            try:
                content = json.loads(path.read_text(encoding="utf-8"))
                self._known = content if isinstance(content, dict) else {}
            except (OSError, ValueError):
                self._known = {}

    def of_file(self, path: Path) -> str:
        """Hash of one file's content; raises DataError when it cannot be read."""
        try:
            stat = os.stat(path)
            if not S_ISREG(stat.st_mode):
                raise DataError("not a plain file", path=path)
            key = str(path)
            written = self._written.get(key)
            if written is not None and written[:2] == (stat.st_size, stat.st_mtime_ns):
                return written.sha256
            state = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
            known = self._known.get(key)
            if isinstance(known, list) and known[:4] == state and len(known) == 5:
                self._seen[key] = known
                return str(known[4])
            digest = hashlib.sha256()
            with open(path, "rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    digest.update(chunk)
        except OSError as error:
            raise DataError(f"cannot be read: {error.strerror}", path=path) from error
        self._seen[key] = [*state, digest.hexdigest()]
        return digest.hexdigest()

    def of_files(self, root: Path, files: Iterable[Path]) -> str:
        """One hash of many files: their names relative to ``root`` and their contents."""
        digest = hashlib.sha256()
        for file in sorted(files):
            digest.update(f"{os.path.relpath(file, root)}\0{self.of_file(file)}\0".encode())
        return digest.hexdigest()

    def content(self) -> dict[str, list[Any]]:
        """What to remember: the files asked for this time."""
        return dict(sorted(self._seen.items()))
