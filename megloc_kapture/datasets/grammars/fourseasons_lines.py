"""Lines, fields, timestamps and poses, as all text files of 4Seasons have them.

Fields stand between commas or blanks, ``#`` begins a comment line. CRLF line ends, blank lines and
a missing end of the last line are accepted everywhere. Timestamps are integer nanoseconds and
never pass through a float, which would lose their last digits. Rotations are x y z w.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_csv import parse_float
from megloc_kapture.io.kapture_sensors import unit_quaternion
from megloc_kapture.io.text import read_text
from megloc_kapture.values import RigidTransform

# ECEF coordinates are below 1e7; larger numbers are broken and would overflow further on
MAX_DISTANCE_M = 1e9

_BLANKS = re.compile(r"[ \t]+")
_TIMESTAMP = re.compile(r"[1-9][0-9]{0,18}")
_SHOWN = 40


def text_lines(path: Path) -> list[str]:
    """All lines of a file without blanks around them, comments and empty ones included."""
    return [line.strip(" \t\r") for line in read_text(path).split("\n")]


def data_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """``(line number, fields)`` of every line that is neither empty nor a comment."""
    for number, text in enumerate(text_lines(path), start=1):
        if text and not text.startswith("#"):
            yield number, split_fields(text)


def split_fields(text: str) -> list[str]:
    """Fields between commas, where there are any, else between blanks; a comma may end the line."""
    if "," not in text:
        return _BLANKS.split(text)
    fields = [field.strip(" \t") for field in text.split(",")]
    return fields[:-1] if fields[-1] == "" else fields


def parse_timestamp(text: str, path: Path, line: int) -> int:
    """A time in nanoseconds, exactly."""
    if not _TIMESTAMP.fullmatch(text):
        raise DataError(
            f"{text[:_SHOWN]!r} is not a timestamp, a whole number of nanoseconds",
            path=path,
            line=line,
        )
    return int(text)


def timestamp_of_name(stem: str) -> int | None:
    """The time in nanoseconds that a file is called by; None where it is another name."""
    return int(stem) if _TIMESTAMP.fullmatch(stem) else None


def parse_transform(fields: Sequence[str], path: Path, line: int) -> RigidTransform:
    """The transform of seven fields ``tx ty tz qx qy qz qw``.

    Raises
    ------
    DataError : not seven numbers, no unit quaternion, or a translation beyond the earth.
    """
    if len(fields) != 7:
        raise DataError(
            f"expected 7 numbers, tx ty tz qx qy qz qw, got {len(fields)}", path=path, line=line
        )
    tx, ty, tz = (parse_float(text, "translation", path, line) for text in fields[:3])
    qx, qy, qz, qw = (parse_float(text, "rotation", path, line) for text in fields[3:])
    if max(abs(tx), abs(ty), abs(tz)) > MAX_DISTANCE_M:
        raise DataError(
            f"the translation {tx:g} {ty:g} {tz:g} leads nowhere on earth", path=path, line=line
        )
    try:
        return RigidTransform(unit_quaternion((qw, qx, qy, qz)), (tx, ty, tz))
    except DataError as error:
        raise DataError(error.message, path=path, line=line) from None
