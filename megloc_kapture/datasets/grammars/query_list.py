"""Lists of images with their cameras, as the challenges publish queries and database intrinsics.

One image per line, separated by blanks: ``name MODEL WIDTH HEIGHT PARAMS...``, with COLMAP's
camera models. Blank lines, CRLF and a missing end of the last line are accepted.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_csv import parse_float
from megloc_kapture.io.paths import check_relative
from megloc_kapture.io.text import read_text
from megloc_kapture.values import Camera

_BLANKS = re.compile(r"[ \t]+")
_SIZE = re.compile(r"[0-9]{1,9}")
_NUM_FIXED = 4  # name, model, width, height


def read_query_list(path: Path) -> dict[str, Camera]:
    """Read the images of a list and their cameras, in the list's order.

    Raises
    ------
    DataError : missing or not text, a line that is no image with a camera, a name that is no
        plain relative path or is given twice, or no image at all; names file and line.
    """
    cameras: dict[str, Camera] = {}
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        text = line.strip(" \t\r")
        if not text:
            continue
        name, camera = _parsed(_BLANKS.split(text), path, number)
        if name in cameras:
            raise DataError(f"image {name!r} is listed twice", path=path, line=number)
        cameras[name] = camera
    if not cameras:
        raise DataError("no image in the list; expected lines of 'name MODEL W H ...'", path=path)
    return cameras


def write_query_list(
    path: Path, cameras: Mapping[str, Camera], *, last_line_ends: bool = True
) -> None:
    """Write a list in the order of ``cameras``; numbers as short as they read back the same.

    Parameters
    ----------
    last_line_ends : False leaves the last line without its end, as in published lists.

    Raises
    ------
    DataError : a name with white space in it, or that is no plain relative path.
    OutputError : the file cannot be written.
    """
    lines = []
    for name, camera in cameras.items():
        if check_relative(name).split() != [name]:
            raise DataError(f"a list of images cannot hold the name {name!r}")
        size = (str(camera.width), str(camera.height))
        lines.append(" ".join((name, camera.model, *size, *map(_shortest, camera.params))))
    write_bytes(path, ("\n".join(lines) + "\n" * last_line_ends).encode())


def _parsed(fields: list[str], path: Path, line: int) -> tuple[str, Camera]:
    if len(fields) < _NUM_FIXED:
        raise DataError(
            f"expected 'name MODEL WIDTH HEIGHT PARAMS...', got {len(fields)} fields",
            path=path,
            line=line,
        )
    name, model, width, height, *texts = fields
    if not (_SIZE.fullmatch(width) and _SIZE.fullmatch(height)):
        raise DataError(
            f"{width} {height} is no image size; expected 'name MODEL WIDTH HEIGHT PARAMS...'",
            path=path,
            line=line,
        )
    params = tuple(parse_float(text, "camera parameter", path, line) for text in texts)
    try:
        return check_relative(name), Camera(model, int(width), int(height), params)
    except DataError as error:
        raise DataError(error.message, path=path, line=line) from error


def _shortest(value: float) -> str:
    """Shortest text that reads back as the same float64; whole numbers without a point."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
