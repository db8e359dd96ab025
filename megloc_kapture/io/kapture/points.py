"""``reconstruction/points3d.txt``, the 3D points of a map, how uncertain they are, and PLY files.

pandas reads the plain form of the grammar, each number as Python's ``float`` does. It also takes
what the grammar does not know (missing fields, words, quotes): whatever might be such is read by
the strict parser, which says what is wrong, or that nothing is. Python's ``repr`` is the format
that is written.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import (
    atomic_write,
    check_no_escape,
    check_output,
    read_content,
    write_bytes,
)
from megloc_kapture.io.kapture.format import (
    BYTE_ORDER_MARK,
    FORMAT_LINE,
    check_version,
    parse_float,
    read_rows,
)

POINTS_HEADERS = {3: "# X, Y, Z", 6: "# X, Y, Z, R, G, B"}
COVARIANCES_FILE = "reconstruction/point_covariances.npy"

# below this the strict parser takes less time than importing pandas
LARGE_BYTES = 1 << 22
_ROWS_AT_ONCE = 1 << 16
_PLAIN, _ASCII = b"0123456789+-.eE, \t\r\n", bytes(range(1, 128))
_PLY_TYPES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
_NUMBER_CHARACTERS = re.compile(r"[0-9eE.+\-]+")


def read_points3d(path: Path, *, large_bytes: int = LARGE_BYTES) -> NDArray[np.float64]:
    """Read ``points3d.txt`` as float64 (N, 6): X Y Z R G B, colours 0 where there are none.

    Raises DataError: names file and line.
    """
    is_large = path.is_file() and path.stat().st_size >= large_bytes
    read = _read_plain(path) if is_large else None
    if read is None:
        read = read_points3d_strictly(path)
    return read if read.shape[1] == 6 else np.pad(read, ((0, 0), (0, 3)))


def _read_plain(path: Path) -> NDArray[np.float64] | None:
    """Read with pandas, (N, 3) or (N, 6); None where the strict parser might say otherwise."""
    import pandas as pd

    content = read_content(path).removeprefix(BYTE_ORDER_MARK)
    first_line = content[: content.find(b"\n") + 1].decode("utf-8", errors="replace")
    check_version(path, first_line, required=False)
    begin = 0
    while content[begin : begin + 1] == b"#":
        begin = content.find(b"\n", begin) + 1
        if not begin:
            return None
    # words are for the strict parser: pandas knows some, and quotes
    if content[begin:].translate(None, _PLAIN) or content[:begin].translate(None, _ASCII):
        return None
    try:
        table = pd.read_csv(
            io.BytesIO(content[begin:]),
            header=None,
            dtype=np.float64,
            lineterminator="\n",
            low_memory=False,
            **({} if _reads_exactly(pd.__version__) else {"float_precision": "round_trip"}),
        )
    except (ValueError, OverflowError, OSError):  # pandas' own errors are ValueErrors
        return None
    values = np.ascontiguousarray(table.to_numpy(dtype=np.float64))
    # NaN: fewer fields, or none
    return values if values.shape[1] in POINTS_HEADERS and np.isfinite(values).all() else None


def _reads_exactly(pandas_version: str) -> bool:
    """Whether pandas reads floats exactly by default, for which older versions need an option that
    this one deprecates."""
    major, minor = map(int, pandas_version.split(".")[:2])
    return (major, minor) >= (3, 1)


def read_points3d_strictly(path: Path) -> NDArray[np.float64]:
    """The grammar of ``points3d.txt`` in plain Python: slow, (N, 3) or (N, 6)."""
    values: list[float] = []
    columns = 0
    with read_rows(path) as rows:
        for _, fields in rows:
            columns = columns or len(fields)
            values += _coordinates(fields, columns)
    return np.array(values, dtype=np.float64).reshape(-1, columns or 6)


def _coordinates(fields: list[str], columns: int) -> list[float]:
    if columns not in POINTS_HEADERS or len(fields) != columns:
        expected = str(columns) if columns in POINTS_HEADERS else "3 or 6"
        raise DataError(f"expected {expected} columns, got {len(fields)}")
    # of these characters float() accepts exactly our grammar, and is faster than a pattern
    if _NUMBER_CHARACTERS.fullmatch("".join(fields)):
        with contextlib.suppress(ValueError):
            values = [float(text) for text in fields]
            if all(map(math.isfinite, values)):
                return values
    return [parse_float(text, "coordinate") for text in fields]


def write_points3d(root: Path, points: ArrayLike) -> None:
    """Write ``reconstruction/points3d.txt``: (N, 3) coordinates or (N, 6) with colours.

    Each number is the shortest that reads back as the same float64.

    Raises ValueError: another shape, or values that are not finite; OutputError: cannot be written.
    """
    rows = np.asarray(points, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] not in POINTS_HEADERS:
        raise ValueError(f"expected points of shape (N, 3) or (N, 6), got {rows.shape}")
    if not np.isfinite(rows).all():
        raise ValueError("points are not finite")
    pattern = ",".join(["%r"] * rows.shape[1]) + "\n"
    folder = check_output(Path(root), Path(root) / "reconstruction")
    with atomic_write(folder / "points3d.txt") as file:
        file.write(f"{FORMAT_LINE}\n{POINTS_HEADERS[rows.shape[1]]}\n".encode())
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            block = rows[start : start + _ROWS_AT_ONCE]
            file.write((pattern * len(block) % tuple(block.ravel().tolist())).encode())


# -------------------------------------------------------------------------------- covariances


def write_point_covariances(root: Path, covariances: NDArray[np.float64]) -> None:
    """Write ``reconstruction/point_covariances.npy``, which kapture does not know and ignores.

    Parameters
    ----------
    covariances : float64 (N, 6), row i of point i of ``points3d.txt``: xx, xy, xz, yy, yz, zz for a
        noise of 1 px, NaN: unknown.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    buffer = io.BytesIO()
    array = np.ascontiguousarray(covariances, dtype=np.float64)
    np.lib.format.write_array(buffer, array, allow_pickle=False)
    write_bytes(root / COVARIANCES_FILE, buffer.getvalue())


def read_point_covariances(root: Path, num_points: int) -> NDArray[np.float64] | None:
    """The covariances (N, 6) of a map with ``num_points`` points, memory-mapped; None without any.

    Raises DataError: not such an array, or not of so many points: another map's.
    """
    path = root / COVARIANCES_FILE
    if not path.is_file():
        return None
    if num_points == 0:
        return np.zeros((0, 6))  # nothing cannot be mapped
    try:
        array = np.lib.format.open_memmap(check_no_escape(root, path), mode="r")
    except Exception as error:  # numpy reads the header as Python's tokens and literals
        raise DataError(f"no array of numpy: {error}", path=path) from error
    if array.dtype != np.float64 or array.shape != (num_points, 6):
        raise DataError(
            f"{array.dtype} {array.shape}, expected float64 ({num_points}, 6): one row per point",
            path=path,
        )
    return np.asarray(array)


# ------------------------------------------------------------------------------------ viewers


def write_ply(
    path: Path,
    xyz: ArrayLike,
    colours: ArrayLike,
    edges: Sequence[tuple[int, int]] = (),
    **properties: ArrayLike,
) -> None:
    """Write coloured points, and lines between them, as a binary PLY file that every viewer opens.

    Coordinates are float64: a map in a world frame keeps its digits.

    Parameters
    ----------
    xyz : (N, 3).
    colours : uint8 (N, 3), red, green, blue.
    edges : pairs of rows that a line joins.
    properties : further values (N,), one float32 each, by name.

    Raises
    ------
    ValueError : arrays that differ in length.
    OutputError : cannot be written.
    """
    xyz, colours = np.asarray(xyz, dtype=np.float64), np.asarray(colours, dtype=np.uint8)
    columns = [
        *zip("xyz", xyz.T, ["<f8"] * 3, strict=True),
        *zip(("red", "green", "blue"), colours.T, ["|u1"] * 3, strict=True),
        *((name, np.asarray(values), "<f4") for name, values in properties.items()),
    ]
    if {len(values) for _, values, _ in columns} != {len(xyz)}:
        raise ValueError("coordinates, colours and properties differ in length")
    rows = np.empty(len(xyz), dtype=[(name, kind) for name, _, kind in columns])
    for name, values, _ in columns:
        rows[name] = values
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {_PLY_TYPES[kind]} {name}" for name, _, kind in columns]
    if edges:
        header += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2"]
    with atomic_write(path) as file:
        file.write("\n".join([*header, "end_header", ""]).encode())
        file.write(rows.tobytes())
        file.write(np.array(edges, dtype="<i4").tobytes())
