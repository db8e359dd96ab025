"""Output folders: ours to write into, or refused."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from megloc_kapture.errors import OutputError
from megloc_kapture.io.atomic import output_error, write_bytes

MARKER = ".megloc"


def claim_folder(folder: Path, *, kind: str, force: bool = False) -> None:
    """Make a folder ours, or refuse it.

    A folder is ours when it is new, empty, or carries our mark with the same kind. With
    ``force`` any folder will do; what stands in it and is not written anew stays.

    Parameters
    ----------
    kind : what the folder is for, one word; written into the mark.

    Raises
    ------
    OutputError : the folder is somebody else's, or cannot be made.
    """
    folder = Path(folder)
    mark = folder / MARKER
    content = f"{kind}\n".encode()
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file, a folder is needed")
        if folder.exists() and any(folder.iterdir()):
            owned = mark.is_file() and mark.read_bytes() == content
            if not owned and not force:
                raise OutputError(
                    f"{folder}: is not empty and not a {kind} of megloc; give an empty folder, "
                    "or -f to write into it all the same"
                )
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(folder, error) from error
    if not mark.is_file() or mark.read_bytes() != content:
        write_bytes(mark, content)


def release_if_empty(folder: Path) -> None:
    """Take a claimed folder away again when nothing was written into it."""
    with contextlib.suppress(OSError):
        if [entry.name for entry in Path(folder).iterdir()] == [MARKER]:
            (Path(folder) / MARKER).unlink()
            Path(folder).rmdir()


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
    made = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    claim_folder(folder, kind=kind, force=force)
    staging = folder / f".partial-{secrets.token_hex(4)}"
    try:
        staging.mkdir()
        yield staging
        _merge(staging, folder)
    except OSError as error:
        if error.filename is not None and not str(error.filename).startswith(str(folder)):
            raise
        raise output_error(folder, error) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        release_if_empty(folder)
        if made and not folder.exists():
            for parent in made[1:]:
                with contextlib.suppress(OSError):
                    parent.rmdir()


def _merge(source: Path, target: Path) -> None:
    for entry in sorted(source.iterdir()):
        place = target / entry.name
        if entry.is_dir() and not entry.is_symlink() and place.is_dir() and not place.is_symlink():
            _merge(entry, place)
        else:
            if place.is_symlink():
                place.unlink()
            os.replace(entry, place)
