"""Output folders of commands: their ownership, and output that appears only on success.

A command may write to a folder that is new, empty, or marked as a folder of the command's kind. The
mark is a file that lists this kind and the files written by the last command; the next command
replaces these files.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import (
    check_relative,
    clear_temporary,
    output_error,
    temporary_name,
    write_bytes,
    writing,
)
from megloc_kapture.io.kapture import is_kapture

MARKER = ".megloc"
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z")


def claim_folder(folder: Path, *, kind: str, force: bool = False) -> bool:
    """Create and mark a folder that is new, empty or already marked with ``kind`` (one word).

    Raise OutputError for any other folder, unless forced. Return whether the mark is new;
    :func:`release_folder` may then remove it.
    """
    check_claim(folder, kind=kind, force=force)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        is_new = _read_mark(folder)[:1] != [kind]
        if is_new:
            _write_mark(folder, kind)
    return is_new


def check_claim(folder: Path, *, kind: str, force: bool = False) -> None:
    """Raise OutputError for a folder that :func:`claim_folder` rejects."""
    with writing(folder):
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file; give a folder")
        ours = force or not folder.exists() or _read_mark(folder)[:1] == [kind]
        if not ours and any(folder.iterdir()):
            raise OutputError(
                f"{folder}: is not empty and not an earlier output of this kind ({kind}); give an "
                "empty folder, or -f to write into it anyway"
            )


def check_new_file(path: Path, *, force: bool) -> None:
    """Raise OutputError if ``path`` is a folder or, unless forced, an existing file."""
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file")
    if path.exists() and not force:
        raise OutputError(f"{path}: exists; -f overwrites it")


def release_folder(folder: Path) -> None:
    """Remove the mark of a folder that got no results, and the folder if it is empty."""
    with contextlib.suppress(OSError):
        (folder / MARKER).unlink(missing_ok=True)
        folder.rmdir()


def _read_mark(folder: Path) -> list[str]:
    path = folder / MARKER
    return os.fsdecode(path.read_bytes()).splitlines() if path.is_file() else []


def _write_mark(folder: Path, kind: str, names: Iterable[str] = ()) -> None:
    write_bytes(folder / MARKER, os.fsencode("\n".join((kind, *sorted(names))) + "\n"))


@contextlib.contextmanager
def staged_output(
    folder: Path,
    *,
    kind: str,
    force: bool = False,
    adds: bool = False,
    inputs: Iterable[Path | str | None] = (),
) -> Iterator[Path]:
    """Yield a staging folder whose content moves to ``folder`` when the block succeeds.

    Files that the last command of this kind wrote are removed, unless ``adds`` is set. Other files
    in ``folder`` are kept unless overwritten. Raise OutputError if ``folder`` is or contains one of
    the ``inputs``.
    """
    folder = Path(folder)
    if any(Path(path).resolve().is_relative_to(folder.resolve()) for path in inputs if path):
        raise OutputError(
            f"{folder}: is or contains an input, which the output could overwrite; "
            "give another folder"
        )
    is_foreign = is_kapture(folder) and _read_mark(folder)[:1] != [kind]
    if is_foreign and not adds:
        raise OutputError(
            f"{folder}: holds other kapture data, which is never overwritten; give an empty folder"
        )
    check_claim(folder, kind=kind, force=force)
    existing = next(p for p in (folder, *folder.absolute().parents) if p.is_dir())
    staging = existing / temporary_name()
    try:
        with writing(folder):
            staging.mkdir()
        yield staging
        with writing(folder):
            clear_temporary(staging)
            claim_folder(folder, kind=kind, force=True)
            if not adds:
                new = _relative_names(staging)
                _remove_old_files(folder, set(_read_mark(folder)[1:]) - new)
                _write_mark(folder, kind, new)
            _merge(staging, folder)
    except OSError as error:
        # an error without a file name comes from writing: full disk or exceeded quota
        if error.filename is None or Path(error.filename).is_relative_to(staging):
            raise output_error(folder, error) from error
        raise
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _relative_names(folder: Path) -> set[str]:
    """Return the files and links below a folder, relative to it."""
    names = set()
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        names |= {os.path.relpath(os.path.join(place, name), folder) for name in files + links}
    return names


def _remove_old_files(folder: Path, names: Iterable[str]) -> None:
    """Remove the listed files and links, and folders that become empty, without following links."""
    for name in names:
        with contextlib.suppress(DataError, OSError):
            path = folder / check_relative(name)
            parents = list(path.parents)[: name.count("/")]
            if any(parent.is_symlink() for parent in parents):
                continue
            path.unlink()
            for parent in parents:
                parent.rmdir()


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
    """Yield the files below folders, except archives, hidden files and outputs of commands.

    Links are followed. Archives are omitted so that the files of a dataset stay the same when its
    archives are deleted after unpacking.
    """
    for root in folders:
        for place, names, files in os.walk(root, followlinks=True):
            here = Path(place)
            names[:] = [name for name in names if _is_data(here, name)]
            paths = (here / n for n in files if not (n.startswith(".") or n.endswith(ARCHIVES)))
            yield from (path for path in paths if path.is_file())


def _is_data(folder: Path, name: str) -> bool:
    path = folder / name
    if name.startswith(".") or (path / MARKER).is_file():
        return False
    # a link to a parent folder would be followed forever
    return not (path.is_symlink() and folder.resolve().is_relative_to(path.resolve()))
