"""kapture's text format.

Fields are separated by commas, with optional spaces; lines that start with ``#`` are comments.
Timestamps are integers of any length, never floats. kapture's own reader takes most of a second to
import and 100 MB per worker; this module takes 20 ms, and its errors name the file and the line.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import has_control_characters
from megloc_kapture.io.text_lines import reading_lines

FORMAT_VERSION = "1.1"
FORMAT_LINE = f"# kapture format: {FORMAT_VERSION}"
_READ_VERSIONS = ("1.0", FORMAT_VERSION)  # the tables are the same in both

# stricter than float(), which accepts "1_0", "nan" and digits of other scripts
FLOAT_PATTERN = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_VERSION_PATTERN = re.compile(r"# kapture format:\s*([0-9]+\.[0-9]+)")


@contextlib.contextmanager
def read_rows(path: Path, *, version_required: bool = False) -> Iterator[Iterator[list[str]]]:
    """Read rows of stripped fields, without comments; errors in the block name file and line."""
    with reading_lines(path) as lines:
        first = next(lines, "")
        check_version(path, first, required=version_required)
        rows = (line for line in chain([first], lines) if line and not line.startswith("#"))
        yield ([text.strip() for text in row.split(",")] for row in rows)


def check_version(path: Path, first_line: str, *, required: bool) -> None:
    match = _VERSION_PATTERN.search(first_line)
    if match is None:
        require(not required, f"the first line must be '{FORMAT_LINE}'", path=path, line=1)
    elif match[1] not in _READ_VERSIONS:
        message = f"kapture format {match[1]} is not supported; convert it to {FORMAT_VERSION}"
        raise DataError(message, path=path, line=1)


def check_columns(fields: Sequence[str], expected: int) -> None:
    if len(fields) != expected:
        raise DataError(f"expected {expected} columns, got {len(fields)}")


def writable_name(name: str) -> str:
    """Replace commas, outer spaces and a leading #, which kapture files cannot hold, by ``_``."""
    return re.sub(r",|^#|^\s+|\s+$", lambda match: "_" * len(match[0]), name)


def format_table(header: str, rows: Iterable[Sequence[str]]) -> bytes:
    """Format a kapture CSV file: version line, column header, rows."""
    lines = [FORMAT_LINE, header]
    for row in rows:
        for text in row:
            if "," in text or text != text.strip() or has_control_characters(text):
                raise DataError(
                    f"{text!r}: a kapture text file cannot hold a comma, a leading or trailing "
                    "space, or a control character"
                )
        if row[0].startswith("#"):
            raise DataError(f"{row[0]!r}: a leading # would make this row a comment")
        lines.append(", ".join(row))
    return ("\n".join(lines) + "\n").encode("utf-8")
