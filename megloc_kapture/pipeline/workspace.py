"""The workspace: where a run keeps what it makes, and knows it again.

Each stage leaves a manifest there, which says what it did and whether it must run again. A stage's
fingerprint is a hash of its name, its version, its options, the code of its plugins and the
fingerprints of what it reads: hashes of content, whether from outside the workspace or of what
another stage wrote. So a stage runs again exactly when something that could change its output has
changed.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISREG
from typing import Any

from pydantic import Field

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import (
    clear_leftovers,
    output_error,
    read_content,
    read_json_model,
    remove,
    write_bytes,
)
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import (
    FileState,
    claim_folder,
    replace_directory,
    state_if_unchanged,
    state_of,
)
from megloc_kapture.values import Options

PARTIAL = ".partial"
LOCK = ".lock"
_MAP = "map"
HASHES = "stages/.hashes.json"
JOURNAL = ".items"  # of a stage's items that are done, in the folder that it writes into


def map_of_workspace(path: Path) -> Path:
    """The kapture folder of a workspace's map; any other path as it is."""
    there = (path / LOCK).is_file() and (path / _MAP).is_dir()
    return path / _MAP if there else path


class Workspace:
    """Paths of a workspace (docs/architecture.md); raises OutputError for a folder of others."""

    def __init__(self, root: Path, *, force: bool = False) -> None:
        self.root, self.force = Path(root).absolute(), force
        self._claim = claim_folder(self.root, kind="workspace", force=force)
        self._published = False
        # open files, so that no other file gets their numbers
        self._lock: int | None = None
        self._staged: int | None = None

    def path(self, relative: str) -> Path:
        """A path below the workspace."""
        return self.root / relative

    def manifest_path(self, stage: str) -> Path:
        """Where the manifest of a stage stands."""
        return self.root / "stages" / f"{stage}.json"

    def files_path(self, stage: str) -> Path:
        """Where the files that a stage wrote are listed."""
        return self.root / "stages" / f"{stage}.files"

    def items_path(self, stage: str) -> Path:
        """Where the items that a stage's output consists of are listed."""
        return self.root / "stages" / f"{stage}.items"

    def item_sources(self, stage: str) -> list[tuple[Path, Path]]:
        """Folders that have items of a stage, stopped runs' before its output; their journals."""
        left = sorted(self._stopped(stage), reverse=True)
        return [*((path, path / JOURNAL) for path in left), (self.root, self.items_path(stage))]

    def forget_items(self, stage: str) -> None:
        """Let nothing be taken over that a stage did before."""
        for path in (*self._stopped(stage), self.root / PARTIAL / stage, self.items_path(stage)):
            with contextlib.suppress(OSError):
                remove(path)

    def _stopped(self, stage: str) -> Iterator[Path]:
        """What runs of a stage left that were stopped: a number stands behind its name."""
        return (self.root / PARTIAL).glob(f"{stage}~*")

    def manifest(self, stage: str) -> Manifest | None:
        """The manifest of a stage; see :func:`read_manifest`."""
        return read_manifest(self.manifest_path(stage))

    def manifest_paths(self) -> list[Path]:
        """The manifests that there are."""
        found = (self.root / "stages").glob("*.json")
        return sorted(path for path in found if path.name[0] != ".")

    def folder(self, name: str, *features: str) -> KaptureFolder:
        """A kapture folder of the workspace, with features folders of the workspace."""
        return KaptureFolder(self.path(name), features_dirs=[self.path(f) for f in features])

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the workspace against a second run; the system lets go when the process dies.

        What killed runs have left is cleared, but for items that are done. A workspace that no
        stage has been run in by the end of the block is taken away again: a refused run, or a dry
        run, leaves nothing behind.
        """
        path = self.root / LOCK
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise output_error(path, error) from error
        try:
            held = False
            with contextlib.suppress(OSError):
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # a run that has just taken its unused workspace away holds nothing any more
                held = _is_still(handle, path)
            if not held:
                raise OutputError(
                    f"{self.root}: another run is using this workspace; wait for it or give "
                    "another --workspace"
                )
            self._lock = handle
            self._clear_partial()
            for folder in (self.root, self.root / "stages"):
                clear_leftovers(folder)
            try:
                yield
            finally:
                self._lock = None
                self._clear_partial()  # workers that were ended after the stage's own clearing
                self._release_if_unused()
        finally:
            os.close(handle)

    def _clear_partial(self) -> None:
        for left in (self.root / PARTIAL).glob("*"):
            if not (left / JOURNAL).is_file():
                with contextlib.suppress(OSError):
                    remove(left)

    def _release_if_unused(self) -> None:
        with contextlib.suppress(OSError):
            gone = not (self.root / LOCK).exists()  # what is there has come after the deletion
            kept = self._published or self.manifest_paths() or any((self.root / PARTIAL).glob("*"))
            if not gone and kept:
                return
            for path in (self.path(HASHES), self.root / LOCK):
                path.unlink(missing_ok=True)
            for folder in (self.root / "stages", self.root / PARTIAL):
                with contextlib.suppress(OSError):
                    folder.rmdir()
            self._claim.undo()

    @contextmanager
    def staging(self, stage: str) -> Iterator[Path]:
        """A fresh folder to write a stage's output into; removed when the block ends.

        One that has items stays when the block raises, for the next run to take over.

        Raises
        ------
        OutputError : it cannot be made.
        """
        place = self.root / PARTIAL / stage
        try:
            if (place / JOURNAL).is_file():
                numbers = [int(path.name.rpartition("~")[2]) for path in self._stopped(stage)]
                place.rename(f"{place}~{max(numbers, default=0) + 1}")
            elif place.exists():
                shutil.rmtree(place)
            place.mkdir(parents=True)
            self._staged = os.open(place, os.O_RDONLY)
        except OSError as error:
            raise output_error(place, error) from error
        done = False
        try:
            yield place
            done = True
        finally:
            os.close(self._staged)
            self._staged = None
            if done or not (place / JOURNAL).is_file():
                for path in (place, *(self._stopped(stage) if done else ())):
                    shutil.rmtree(path, ignore_errors=True)

    def publish(self, staging: Path, outputs: tuple[str, ...]) -> None:
        """Move what a stage wrote to its places; outputs it did not write are taken away.

        Raises
        ------
        OutputError : cannot be written; or somebody has taken the workspace away meanwhile.
        """
        for opened, path in ((self._staged, staging), (self._lock, self.root / LOCK)):
            if opened is not None and not _is_still(opened, path):
                raise OutputError(
                    f"{self.root}: was deleted or moved while a run was working in it; what the "
                    "last stage made is lost"
                )
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
        """Take outputs away; raises OutputError."""
        for output in outputs:
            place = self.root / output
            try:
                remove(place)
            except OSError as error:
                raise output_error(place, error) from error


def _is_still(opened: int, path: Path) -> bool:
    """Whether a path leads to the file or folder that is open."""
    try:
        return os.path.samestat(os.fstat(opened), os.stat(path))
    except OSError:
        return False


class Manifest(Options):
    """``stages/NAME.json``."""

    stage: str
    version: int
    options: dict[str, Any]
    inputs: dict[str, str] = Field(description="what was read: name to fingerprint")
    fingerprint: str
    content: str = Field(default="", description="hash of the outputs; none where they are links")
    outputs: tuple[str, ...]
    counts: dict[str, int | float] = Field(default_factory=dict)
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
    content = {"stage": stage, "version": version, "options": dict(options), "inputs": dict(inputs)}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def read_manifest(path: Path) -> Manifest | None:
    """The manifest, None where there is none that can be read: then the stage has to run."""
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
        self._seen: dict[str, list[Any]] = {}
        content = None
        with contextlib.suppress(OSError, ValueError):
            content = json.loads(path.read_text(encoding="utf-8"))
        self._known: dict[str, list[Any]] = content if isinstance(content, dict) else {}

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
            with open(path, "rb") as file:
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise DataError(f"cannot be read: {error.strerror}", path=path) from error
        self._seen[key] = [*state, sha256]
        return sha256

    def of_files(self, root: Path, files: Iterable[Path]) -> str:
        """One hash of many files: their names relative to ``root`` and their contents."""
        digest = hashlib.sha256()
        for file in sorted(files):
            digest.update(f"{os.path.relpath(file, root)}\0{self.of_file(file)}\0".encode())
        return digest.hexdigest()

    def content(self) -> dict[str, list[Any]]:
        """What to remember: the files asked for this time."""
        return dict(sorted(self._seen.items()))


Files = dict[str, FileState]  # by path in the workspace


def remember_files(
    record: Path, root: Path, outputs: Iterable[str], known: Mapping[str, FileState]
) -> str:
    """Write down the files below a stage's outputs, with their hashes.

    Parameters
    ----------
    known : states of files that were hashed when they were written.

    Returns
    -------
    One hash of their names and contents; none where there are links, which do not say what is at
    their ends.

    Raises
    ------
    OutputError : cannot be written, or one of them is gone already.
    """
    files: Files = {}
    digest, has_links = hashlib.sha256(), False
    try:
        for path in sorted(_below(root, outputs)):
            before, place = known.get(path), root / path
            state = None if before is None else state_if_unchanged(place, before)
            files[path] = state = state or state_of(place)
            digest.update(f"{path}\0{state.sha256}\0".encode())
            has_links = has_links or place.is_symlink()
    except OSError as error:
        raise output_error(root, error) from error
    _write(record, files)
    return "" if has_links else digest.hexdigest()


def changed_file(record: Path, root: Path, *, verify: bool = False) -> str:
    """The first file that is not as it was written, and what became of it; empty if all are.

    Parameters
    ----------
    verify : hash all of them, see :func:`~megloc_kapture.io.output_folders.state_if_unchanged`.
    """
    files = written_files(record)
    touched = False
    for path, known in files.items():
        state = state_if_unchanged(root / path, known, verify=verify)
        if state is None:
            there = os.path.lexists(root / path)
            return f"{path} {'was changed since it was written' if there else 'is gone'}"
        files[path], touched = state, touched or state != known
    if touched:
        _write(record, files)
    return ""


def written_files(record: Path) -> Files:
    """The files that a record lists; none where it is of another time, or spoilt."""
    try:
        content = json.loads(read_content(record))
        return {path: FileState(*state) for path, state in content.items()}
    except (DataError, ValueError, TypeError, AttributeError):
        return {}


def _write(record: Path, files: Files) -> None:
    write_bytes(record, (json.dumps(files) + "\n").encode())


def _below(root: Path, outputs: Iterable[str]) -> Iterator[str]:
    """Files and links at and below paths; links are not followed."""
    for output in outputs:
        place = root / output
        if place.is_symlink() or not place.is_dir():
            yield output
            continue
        for folder, names, files in os.walk(place):
            here = os.path.relpath(folder, root)
            links = (name for name in names if os.path.islink(os.path.join(folder, name)))
            yield from (f"{here}/{name}" for name in (*files, *links))
