"""Folders that a command writes: whose they are, and output that comes only when all went well.

A folder is ours when it is new, empty, or carries our mark; nothing that a user owns is written
over unasked. The mark names the kind of the folder, in its first line, and what we have written
into it, so that nothing of an earlier run is taken for the last one's. What replaces a folder does
so in one step.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.errors import OutputError
from megloc_kapture.io.files import (
    clear_leftovers,
    clear_temporary,
    output_error,
    temporary_name,
    write_bytes,
)

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
    try:
        made = tuple(path for path in (folder, *folder.parents) if not path.exists())
        if not made and not folder.is_dir():
            raise OutputError(f"{folder}: is a file, a folder is needed")
        old_mark = mark.read_bytes() if mark.is_file() else None
        ours = old_mark is not None and _kind(old_mark) == kind
        if not made and not ours and not force and any(folder.iterdir()):
            raise OutputError(
                f"{folder}: is not empty and not a {kind} of megloc; give an empty folder, "
                "or -f to write into it all the same"
            )
    except OSError as error:
        raise output_error(folder, error) from error
    claim = Claim(folder, made, old_mark)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not ours:
            write_bytes(mark, _mark_of(kind))
    except OSError as error:
        claim.undo()
        raise output_error(folder, error) from error
    except OutputError:
        claim.undo()
        raise
    return claim


def _kind(mark: bytes) -> str:
    return mark.partition(b"\n")[0].decode(errors="replace")


def _mark_of(kind: str, names: Iterable[str] = ()) -> bytes:
    # no tool's file has a line break in its name, and a name cut in two would be another's
    lines = (kind, *sorted(name for name in names if "\n" not in name))
    return b"".join(os.fsencode(line) + b"\n" for line in lines)


@contextlib.contextmanager
def staged_output(
    folder: Path, *, kind: str, force: bool = False, adds: bool = False
) -> Iterator[Path]:
    """A folder to write a command's output to; it gets to ``folder`` only when the block ends well.

    Files that are written anew replace old ones, one by one. Those of an earlier run with the same
    kind that are not written anew go, what else stands in the folder stays. When the
    block raises, ``folder`` is as it was, and gone if it was not there. What killed runs have left
    in it is cleared.

    Parameters
    ----------
    adds : runs add to each other; what earlier ones have written stays.

    Raises OutputError: see :func:`claim_folder`; or something of the user's is in the way.
    """
    folder = Path(folder)
    claim = claim_folder(folder, kind=kind, force=force)
    clear_leftovers(folder)
    staging = folder / temporary_name()
    try:
        try:
            staging.mkdir()
            yield staging
            clear_temporary(staging)
            new = _names_below(staging)
            before = set() if adds else _listed(claim.old_mark, kind)
            stale = {name for name in before - new if not _through_link(folder, name)}
            _check_ways(folder, new, stale)
            if not adds:
                write_bytes(folder / MARKER, _mark_of(kind, before | new))
            _remove_files(folder, stale)
            _merge(staging, folder)
            if before - new:
                write_bytes(folder / MARKER, _mark_of(kind, new))
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


def _names_below(folder: Path) -> set[str]:
    """Files and links below a folder, as paths from it."""
    found = set()
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        found |= {os.path.relpath(os.path.join(place, name), folder) for name in files + links}
    return found


def _listed(mark: bytes | None, kind: str) -> set[str]:
    """What a mark says was written; names that leave the folder are not ours."""
    if mark is None or _kind(mark) != kind:
        return set()
    names = {os.fsdecode(line) for line in mark.split(b"\n")[1:] if line}
    return {
        name
        for name in names
        if not os.path.isabs(name)
        and os.path.normpath(name) == name
        and ".." not in Path(name).parts
    } - {MARKER, "."}


def _through_link(folder: Path, name: str) -> bool:
    return any((folder / one).is_symlink() for one in _parents({name}))


def _check_ways(folder: Path, new: set[str], stale: set[str]) -> None:
    """Raises OutputError where a folder stands in a file's way or the reverse, and stays."""
    for name in sorted(new):
        path = folder / name
        if not path.is_dir() or path.is_symlink():
            continue
        if any(os.path.join(name, one) not in stale for one in _names_below(path)):
            raise OutputError(f"{path}: a folder stands where a file is to be written")
    for name in sorted(_parents(new) - stale):
        path = folder / name
        if path.is_file() and not path.is_symlink():
            raise OutputError(f"{path}: a file stands where a folder is to be written")


def _parents(names: set[str]) -> set[str]:
    return {str(one) for name in names for one in list(Path(name).parents)[:-1]}


def _remove_files(folder: Path, names: set[str]) -> None:
    """Remove files and links below a folder, and the folders that this leaves empty."""
    for name in names:
        path = folder / name
        if path.is_symlink() or not path.is_dir():
            path.unlink(missing_ok=True)
    for name in sorted(_parents(names), key=len, reverse=True):
        with contextlib.suppress(OSError):
            (folder / name).rmdir()


def _lies_in(name: str | bytes | int, folder: Path) -> bool:
    if isinstance(name, int):
        return False
    return Path(os.path.abspath(os.fsdecode(name))).is_relative_to(os.path.abspath(folder))


def _merge(source: Path, target: Path) -> None:
    for entry in sorted(source.iterdir()):
        path = target / entry.name
        if entry.is_dir() and not entry.is_symlink() and path.is_dir() and not path.is_symlink():
            _merge(entry, path)
        else:
            if path.is_symlink():
                path.unlink()
            os.replace(entry, path)


def replace_directory(new: Path, path: Path) -> None:
    """Replace folder ``path``, which need not exist, by folder ``new``.

    Both must be on one file system. On Linux the two are exchanged in one step, so that a run
    killed here leaves either the old or the new folder at ``path``; what was there before is
    then removed. A run killed during that removal leaves a rest at ``new``'s old name.

    Raises OutputError: ``path`` is a file or a link (a user's link is not ours to replace), or the
    file system refuses; names ``path``.
    """
    new, path = Path(new), Path(path)
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        raise OutputError(f"{path}: is a link or a file, not a folder; move it away first")
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            os.rename(new, path)
            return
        if _exchange(new, path):
            shutil.rmtree(new)
            return
        old = path.with_name(temporary_name())
        os.rename(path, old)
        os.rename(new, path)
        shutil.rmtree(old)
    except OSError as error:
        raise output_error(path, error) from error


def _exchange(first: Path, second: Path) -> bool:
    """Swap two paths in one step; False where the system has no such call."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    at_fdcwd, rename_exchange = -100, 2
    done = renameat2(
        at_fdcwd, os.fsencode(first), at_fdcwd, os.fsencode(second), ctypes.c_uint(rename_exchange)
    )
    if done == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code), os.fspath(second))
