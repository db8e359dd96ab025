"""Lists of images with their cameras, as the challenges publish queries and database intrinsics.

One image per line, separated by blanks: ``name MODEL WIDTH HEIGHT PARAMS...``, with COLMAP's
camera models.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from megloc_kapture.datasets.formats.text_lines import Line, read_lines
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import check_relative, write_bytes
from megloc_kapture.values import Camera

_SIZE_END = 10**9


def read_query_list(path: Path) -> dict[str, Camera]:
    """Read the images of a list and their cameras, in the list's order.

    Raises
    ------
    DataError : missing or not text, a line that is no image with a camera, a name that is no
        plain relative path or is given twice, or no image at all; names file and line.
    """
    cameras: dict[str, Camera] = {}
    for line in read_lines(path):
        name, camera = _parse(line)
        if name in cameras:
            raise line.error(f"image {name!r} is listed twice")
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


def _parse(line: Line) -> tuple[str, Camera]:
    if len(line.fields) < 4:
        raise line.error(
            f"expected 'name MODEL WIDTH HEIGHT PARAMS...', got {len(line.fields)} fields"
        )
    name, model, *texts = line.fields
    width, height = (line.count_of(text, "image size", _SIZE_END) for text in texts[:2])
    params = tuple(line.numbers_of(texts[2:], "camera parameter"))
    try:
        return check_relative(name), Camera(model, width, height, params)
    except DataError as error:
        raise line.error(error.message) from error


def _shortest(value: float) -> str:
    """Shortest text that reads back as the same float64; whole numbers without a point."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
