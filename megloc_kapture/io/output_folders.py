"""Output folders of commands: ownership, and output that appears only on success.

A command may write to a folder that is new, empty, or marked. The mark file names the kind of the
folder, then the files of the last command, which the next command replaces.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import (
    check_relative,
    clear_leftovers,
    clear_temporary,
    output_error,
    temporary_name,
    write_bytes,
)

MARKER = ".megloc"
_ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z")


def claim_folder(folder: Path, *, kind: str, force: bool = False) -> Callable[[], None]:
    """Claim a folder that is new, empty or of the same ``kind`` (one word), or any by ``force``.

    Others raise OutputError. Returns a function that undoes the claim: it restores the former mark
    and removes the folders that the claim created; written files stay.
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

    def undo() -> None:
        with contextlib.suppress(OSError, OutputError):
            if old_mark is None:
                mark.unlink(missing_ok=True)
            elif mark.read_bytes() != old_mark:
                write_bytes(mark, old_mark)
        for created in made:
            with contextlib.suppress(OSError):
                created.rmdir()

    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not ours:
            write_bytes(mark, _mark_of(kind))
    except (OSError, OutputError) as error:
        undo()
        raise error if isinstance(error, OutputError) else output_error(folder, error) from error
    return undo


def _kind(mark: bytes) -> str:
    return mark.partition(b"\n")[0].decode(errors="replace")


def _mark_of(kind: str, names: Iterable[str] = ()) -> bytes:
    return b"".join(os.fsencode(line) + b"\n" for line in (kind, *sorted(names)))


@contextlib.contextmanager
def staged_output(
    folder: Path, *, kind: str, force: bool = False, adds: bool = False
) -> Iterator[Path]:
    """Yield a staging folder whose content moves to ``folder`` when the block succeeds.

    Files of the last command of the same kind are removed, unless ``adds`` is set; others stay.
    """
    folder = Path(folder)
    old_names = _listed(folder / MARKER, kind)
    undo_claim = claim_folder(folder, kind=kind, force=force)
    clear_leftovers(folder)
    staging = folder / temporary_name()
    try:
        try:
            staging.mkdir()
            yield staging
            clear_temporary(staging)
            if not adds:
                new = _files_below(staging)
                _remove_old_files(folder, old_names - new)
                write_bytes(folder / MARKER, _mark_of(kind, new))
            _merge(staging, folder)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    except OSError as error:
        undo_claim()
        # an error without a file name comes from writing: full disk or exceeded quota
        if error.filename is not None and not _lies_in(error.filename, folder):
            raise
        raise output_error(folder, error) from error
    except BaseException:
        undo_claim()
        raise


def _files_below(folder: Path) -> set[str]:
    found = set()
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        found |= {os.path.relpath(os.path.join(place, name), folder) for name in files + links}
    return found


def _listed(path: Path, kind: str) -> set[str]:
    mark = path.read_bytes() if path.is_file() else b""
    if _kind(mark) != kind:
        return set()
    return {os.fsdecode(line) for line in mark.split(b"\n")[1:] if line}


def _remove_old_files(folder: Path, names: Iterable[str]) -> None:
    """Remove listed files and links and emptied folders, without following links."""
    for name in names:
        with contextlib.suppress(DataError, OSError):
            path = folder / check_relative(name)
            parents = list(path.parents)[: name.count("/")]
            if any(parent.is_symlink() for parent in parents):
                continue
            path.unlink()
            for parent in parents:
                parent.rmdir()


def _lies_in(name: str, folder: Path) -> bool:
    return Path(os.path.abspath(name)).is_relative_to(os.path.abspath(folder))


def _merge(source: Path, target: Path) -> None:
    for entry in sorted(source.iterdir()):
        path = target / entry.name
        if entry.is_dir() and not entry.is_symlink() and path.is_dir() and not path.is_symlink():
            _merge(entry, path)
        else:
            if path.is_symlink():
                path.unlink()
            os.replace(entry, path)


def files_below(*folders: Path) -> Iterator[Path]:
    """Yield the files below folders, without archives, hidden files and outputs of commands.

    Links are followed. A download that is unpacked has the same files before and after its
    archive is deleted.
    """
    for root in folders:
        for place, names, files in os.walk(root, followlinks=True):
            here = Path(place)
            names[:] = [name for name in names if _is_data(here, name)]
            shown = (here / n for n in files if not (n.startswith(".") or n.endswith(_ARCHIVES)))
            yield from (path for path in shown if path.is_file())


def _is_data(folder: Path, name: str) -> bool:
    path = folder / name
    if name.startswith(".") or (path / MARKER).is_file():
        return False
    # a link to a folder around it never ends
    return not (path.is_symlink() and folder.resolve().is_relative_to(path.resolve()))


def replace_directory(new: Path, path: Path) -> None:
    """Replace folder ``path``, which need not exist, by folder ``new`` on the same file system.

    A run killed in between leaves the old folder under a temporary name.
    """
    new, path = Path(new), Path(path)
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        raise OutputError(f"{path}: is a link or a file, not a folder; move it away first")
    old = path.with_name(temporary_name())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            os.rename(path, old)
        os.rename(new, path)
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise output_error(path, error) from error
