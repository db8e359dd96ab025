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
from megloc_kapture.io.files import claim_folder, output_error, replace_directory
from megloc_kapture.io.kapture import KaptureFolder

PARTIAL = ".partial"
LOCK = ".lock"
HASHES = "stages/.hashes.json"


class Workspace:
    """Paths of a workspace (docs/architecture.md, Contract 3).

    Raises
    ------
    OutputError : the folder has something in it that is not a workspace's.
    """

    def __init__(self, root: Path, *, force: bool = False) -> None:
        self.root = Path(root).absolute()
        self._claim = claim_folder(self.root, kind="workspace", force=force)
        self._published = False

    def path(self, relative: str) -> Path:
        """A path below the workspace."""
        return self.root / relative

    def manifest_path(self, stage: str) -> Path:
        """Where the manifest of a stage stands."""
        return self.root / "stages" / f"{stage}.json"

    def manifest_paths(self) -> list[Path]:
        """The manifests that there are."""
        folder = self.root / "stages"
        return sorted(path for path in folder.glob("*.json") if path.name[0] != ".")

    def folder(self, name: str, *features: str) -> KaptureFolder:
        """A kapture folder of the workspace, with features folders of the workspace."""
        return KaptureFolder(self.path(name), features_dirs=[self.path(f) for f in features])

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the workspace against a second run; the system lets go when the process dies.

        A workspace that no stage has been run in by the end of the block is taken away again: a
        run that is refused, or a dry run, leaves nothing behind.
        """
        path = self.root / LOCK
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise output_error(path, error) from error
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # a run that has just taken its unused workspace away holds nothing any more
                held = os.path.samestat(os.fstat(handle), os.stat(path))
            except OSError:
                held = False
            if not held:
                raise OutputError(
                    f"{self.root}: another run is using this workspace; wait for it or give "
                    "another --workspace"
                )
            try:
                yield
            finally:
                self._release_if_unused()
        finally:
            os.close(handle)

    def _release_if_unused(self) -> None:
        stages = self.root / "stages"
        with contextlib.suppress(OSError):
            if self._published or self.manifest_paths():
                return
            for path in (self.path(HASHES), self.root / LOCK):
                path.unlink(missing_ok=True)
            for folder in (stages, self.root / PARTIAL):
                with contextlib.suppress(OSError):
                    folder.rmdir()
            self._claim.undo()

    @contextmanager
    def staging(self, stage: str) -> Iterator[Path]:
        """A fresh folder to write a stage's output into; removed when the block ends."""
        place = self.root / PARTIAL / stage
        try:
            if place.exists():
                shutil.rmtree(place)
            place.mkdir(parents=True)
        except OSError as error:
            raise output_error(place, error) from error
        try:
            yield place
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def publish(self, staging: Path, outputs: tuple[str, ...]) -> None:
        """Move what a stage wrote to its places; outputs it did not write are taken away."""
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
                    _remove(place)
            except OSError as error:
                raise output_error(place, error) from error

    def remove(self, outputs: Iterable[str]) -> None:
        """Take outputs away; raises OutputError."""
        for output in outputs:
            place = self.root / output
            try:
                _remove(place)
            except OSError as error:
                raise output_error(place, error) from error


def _remove(place: Path) -> None:
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
