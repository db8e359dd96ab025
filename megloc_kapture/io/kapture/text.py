"""kapture's text files: one grammar, read strictly, written so that it reads back the same.

Fields are separated by commas, spaces around a field do not count, a line that starts with ``#``
is a comment. Every complaint names file and line. Timestamps and ids are integers of any length,
never floats.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import has_control_characters, read_text

FORMAT_VERSION = "1.1"
FORMAT_LINE = f"# kapture format: {FORMAT_VERSION}"
BYTE_ORDER_MARK = b"\xef\xbb\xbf"

# Python's float() takes more ("1_0", "nan", digits of other scripts) than the format allows
FLOAT_PATTERN = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_VERSION_PATTERN = re.compile(r"# kapture format:\s*([0-9]+\.[0-9]+)")
_INTEGER_PATTERN = re.compile(r"[+-]?[0-9]{1,40}")

Row = tuple[int, list[str]]


@contextlib.contextmanager
def read_rows(path: Path, *, version_required: bool = False) -> Iterator[Iterator[Row]]:
    """Rows of a kapture CSV file as ``(line number, stripped fields)``; comments left out.

    A DataError of the block that names no file gets the path and the line of the row read last.

    Raises DataError: missing, not readable, not UTF-8 or with a NUL; the format version on line 1
    is another than 1.1, or absent although required; a line begins with blanks and "#": to kapture
    that is no comment, and a name that could not be written again.
    """
    lines = read_text(path).split("\n")
    check_version(path, lines[0], required=version_required)
    number = 0

    def rows() -> Iterator[Row]:
        nonlocal number
        for number, line in enumerate(lines, start=1):
            if line.startswith("#") or not line.strip():
                continue
            if line.lstrip().startswith("#"):
                raise DataError("a comment must begin in the first column")
            yield number, split_fields(line)

    try:
        yield rows()
    except DataError as error:
        if error.path is not None:
            raise
        raise DataError(error.message, path=path, line=number) from error.__cause__


def split_fields(line: str) -> list[str]:
    """Fields of a line: between commas, without the spaces around."""
    return [field.strip() for field in line.split(",")]


def check_version(path: Path, first_line: str, *, required: bool) -> None:
    """Refuse a file whose first line names another format version than 1.1."""
    found = _VERSION_PATTERN.search(first_line)
    if found is None:
        if required:
            raise DataError(f"the first line must be '{FORMAT_LINE}'", path=path, line=1)
    elif found[1] != FORMAT_VERSION:
        raise DataError(
            f"kapture format {found[1]} is not supported; upgrade it to {FORMAT_VERSION}",
            path=path,
            line=1,
        )


def check_columns(fields: Sequence[str], expected: int) -> None:
    """Raise DataError unless there are so many fields."""
    if len(fields) != expected:
        raise DataError(f"expected {expected} columns, got {len(fields)}")


def parse_integer(text: str, what: str) -> int:
    """A decimal integer, exactly; never through float."""
    if not _INTEGER_PATTERN.fullmatch(text):
        raise DataError(f"{what} {text!r} is not an integer")
    return int(text)


def parse_float(text: str, what: str) -> float:
    """A finite decimal number."""
    if FLOAT_PATTERN.fullmatch(text):
        if math.isfinite(value := float(text)):
            return value
    elif text.lower().lstrip("+-") not in ("nan", "inf", "infinity"):
        raise DataError(f"{what} {text!r} is not a number")
    raise DataError(f"{what} {text!r} is not finite")


def writable_name(name: str) -> str:
    """A name in which ``_`` stands for what :func:`format_table` refuses: a comma, a space at an
    end, and # at the beginning."""
    name = name.replace(",", "_")
    middle = name.strip()
    left = len(name) - len(name.lstrip())
    name = "_" * left + middle + "_" * (len(name) - left - len(middle))
    return f"_{name[1:]}" if name.startswith("#") else name


def format_table(header: str, rows: Iterable[Sequence[str]]) -> bytes:
    """A kapture CSV file: the version line, the column header, the rows.

    Raises DataError: a field that would not be read back as it is (comma, line break, outer
    spaces).
    """
    lines = [FORMAT_LINE, header]
    for row in rows:
        for text in row:
            if "," in text or text != text.strip() or has_control_characters(text):
                raise DataError(f"{text!r} cannot stand in a kapture text file")
        if row[0].startswith("#"):
            raise DataError(f"{row[0]!r} would be read as a comment")
        lines.append(", ".join(row))
    return ("\n".join(lines) + "\n").encode("utf-8")
