"""Whole text files, read with errors that name the file and the line."""

from __future__ import annotations

from pathlib import Path

from megloc_kapture.errors import DataError


def read_text(path: Path | str) -> str:
    """Return the text of a UTF-8 file (ASCII included); a byte order mark is dropped.

    Line ends are left as they are.

    Raises
    ------
    DataError : the file is absent, cannot be read, is not UTF-8 or holds a NUL; names the file,
        and the line where the text breaks.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=path) from error
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise DataError("not a text file in UTF-8", path=path, line=line) from error
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise DataError("a NUL character in a text file", path=path, line=line)
    return text
