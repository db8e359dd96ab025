"""Output folders: ours to write into, or refused."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.errors import OutputError
from megloc_kapture.io.atomic import output_error, write_bytes

MARKER = ".megloc"


@dataclass(frozen=True)
class Claim:
    """A folder that was made ours, and what it was before.

    Attributes
    ----------
    made : the folders that had to be made for it, innermost first.
    old_mark : content of the mark that stood there; None: there was none.
    """

    folder: Path
    made: tuple[Path, ...]
    old_mark: bytes | None

    def undo(self) -> None:
        """Take back the mark and the folders that were made; what has been written stays."""
        mark = self.folder / MARKER
        with contextlib.suppress(OSError, OutputError):
            if self.old_mark is None:
                mark.unlink(missing_ok=True)
            elif mark.read_bytes() != self.old_mark:
                write_bytes(mark, self.old_mark)
        for folder in self.made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def claim_folder(folder: Path, *, kind: str, force: bool = False) -> Claim:
    """Make a folder ours, or refuse it.

    A folder is ours when it is new, empty, or carries our mark with the same kind. With
    ``force`` any folder will do; what stands in it and is not written anew stays.

    Parameters
    ----------
    kind : what the folder is for, one word; written into the mark.

    Raises
    ------
    OutputError : the folder is somebody else's, or cannot be made; it is as it was.
    """
    folder = Path(folder)
    mark = folder / MARKER
    content = f"{kind}\n".encode()
    try:
        made = tuple(path for path in (folder, *folder.parents) if not path.exists())
        if not made and not folder.is_dir():
            raise OutputError(f"{folder}: is a file, a folder is needed")
        old_mark = mark.read_bytes() if mark.is_file() else None
        if not made and old_mark != content and not force and any(folder.iterdir()):
            raise OutputError(
                f"{folder}: is not empty and not a {kind} of megloc; give an empty folder, "
                "or -f to write into it all the same"
            )
    except OSError as error:
        raise output_error(folder, error) from error
    claim = Claim(folder, made, old_mark)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if old_mark != content:
            write_bytes(mark, content)
    except OSError as error:
        claim.undo()
        raise output_error(folder, error) from error
    except OutputError:
        claim.undo()
        raise
    return claim


@contextlib.contextmanager
def staged_output(folder: Path, *, kind: str, force: bool = False) -> Iterator[Path]:
    """A place to write a command's output; it gets to ``folder`` only when the block ends well.

    Files that are written anew take the place of old ones, one by one; others stay. When the
    block raises, ``folder`` is as it was, and gone if it was not there.

    Raises
    ------
    OutputError : see :func:`claim_folder`.
    """
    folder = Path(folder)
    claim = claim_folder(folder, kind=kind, force=force)
    staging = folder / f".partial-{secrets.token_hex(4)}"
    try:
        try:
            staging.mkdir()
            yield staging
            _merge(staging, folder)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    except OSError as error:
        claim.undo()
        # an error that names no file comes from writing: the disk is full, or a quota met
        if error.filename is not None and not _lies_in(error.filename, folder):
            raise
        raise output_error(folder, error) from error
    except BaseException:
        claim.undo()
        raise


def _lies_in(name: str | bytes | int, folder: Path) -> bool:
    if isinstance(name, int):
        return False
    return Path(os.path.abspath(os.fsdecode(name))).is_relative_to(os.path.abspath(folder))


def _merge(source: Path, target: Path) -> None:
    for entry in sorted(source.iterdir()):
        place = target / entry.name
        if entry.is_dir() and not entry.is_symlink() and place.is_dir() and not place.is_symlink():
            _merge(entry, place)
        else:
            if place.is_symlink():
                place.unlink()
            os.replace(entry, place)
