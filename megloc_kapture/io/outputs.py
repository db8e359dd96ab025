"""Output folders: ours to write into, or refused."""

from __future__ import annotations

import contextlib
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
