"""The workspace: where a run keeps what it makes, and knows it again."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from megloc_kapture.errors import OutputError
from megloc_kapture.io.files import clear_leftovers, output_error, remove
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import claim_folder, replace_directory

PARTIAL = ".partial"
LOCK = ".lock"
HASHES = "stages/.hashes.json"
JOURNAL = ".items"  # of a stage's items that are done, in the folder that it writes into


class Workspace:
    """Paths of a workspace (docs/architecture.md); raises OutputError for a folder of others."""

    def __init__(self, root: Path, *, force: bool = False) -> None:
        self.root = Path(root).absolute()
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
