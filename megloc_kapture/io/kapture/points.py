"""3D points of a kapture map, their covariances, and PLY files for viewers."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import atomic_write, reading, write_bytes
from megloc_kapture.io.kapture.format import FORMAT_LINE, check_version

POINTS_HEADERS = {3: "# X, Y, Z", 6: "# X, Y, Z, R, G, B"}
COVARIANCES_FILE = "reconstruction/point_covariances.npy"

_ROWS_AT_ONCE = 1 << 16
_PLY_TYPES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}


def read_points3d(path: Path) -> NDArray[np.float64]:
    """Read ``points3d.txt`` as float64 (N, 6): X Y Z R G B, colours 0 if missing."""
    with reading(path), open(path, encoding="utf-8-sig", errors="replace") as file:
        check_version(path, file.readline(), required=False)
        file.seek(0)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            try:
                points = np.loadtxt(file, delimiter=",", comments="#", ndmin=2)
            except ValueError as error:
                message = str(error).partition(";")[0]  # without numpy's advice to programmers
                line = _line_of_another_length(path)
                message = f"expected 3 or 6 columns in all rows: {message}"
                raise DataError(message, path=path, line=line) from error
    if points.size == 0:
        return np.zeros((0, 6))
    if points.shape[1] not in POINTS_HEADERS:
        raise DataError(f"expected 3 or 6 columns, got {points.shape[1]}", path=path)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise DataError(f"point {bad[0]} is not finite", path=path)
    return points if points.shape[1] == 6 else np.pad(points, ((0, 0), (0, 3)))


def _line_of_another_length(path: Path) -> int | None:
    """Return the first line whose number of columns differs from the first row's."""
    columns = None
    for number, text in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        if text.strip() and not text.startswith("#"):
            columns = columns or text.count(",")
            if text.count(",") != columns:
                return number
    return None


def write_points3d(root: Path, points: ArrayLike) -> None:
    """Write ``reconstruction/points3d.txt``, (N, 3) or (N, 6) with colours, without loss."""
    rows = np.asarray(points, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] not in POINTS_HEADERS:
        raise ValueError(f"expected points of shape (N, 3) or (N, 6), got {rows.shape}")
    if not np.isfinite(rows).all():
        raise ValueError("points are not finite")
    pattern = ",".join(["%r"] * rows.shape[1]) + "\n"
    with atomic_write(Path(root) / "reconstruction" / "points3d.txt") as file:
        file.write(f"{FORMAT_LINE}\n{POINTS_HEADERS[rows.shape[1]]}\n".encode())
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            block = rows[start : start + _ROWS_AT_ONCE]
            file.write((pattern * len(block) % tuple(block.ravel().tolist())).encode())


# -------------------------------------------------------------------------------- covariances


def write_point_covariances(root: Path, covariances: NDArray[np.float64]) -> None:
    """Write covariances (N, 6) for a noise of 1 px: xx, xy, xz, yy, yz, zz; NaN where unknown."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(covariances, dtype=np.float64), allow_pickle=False)
    write_bytes(root / COVARIANCES_FILE, buffer.getvalue())


def read_point_covariances(root: Path, num_points: int) -> NDArray[np.float64] | None:
    """Return the covariances (N, 6) of a map, memory-mapped; None without the file."""
    path = root / COVARIANCES_FILE
    if not path.is_file():
        return None
    if num_points == 0:
        return np.zeros((0, 6))  # an empty file cannot be mapped
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy parses the header as Python literals
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
    """Write points, float64, and lines between them (pairs of rows) as a binary PLY file.

    Colours are RGB; further ``properties`` (N,) are written as float32.
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
