"""Coloured points, and lines between them, as a binary PLY file, which every viewer opens."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from megloc_kapture.io.files import atomic_write

_TYPE_NAMES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}


def write_ply(
    path: Path,
    xyz: ArrayLike,
    colours: ArrayLike,
    edges: Sequence[tuple[int, int]] = (),
    **properties: ArrayLike,
) -> None:
    """Write points.

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
    header += [f"property {_TYPE_NAMES[kind]} {name}" for name, _, kind in columns]
    if edges:
        header += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2"]
    with atomic_write(path) as file:
        file.write("\n".join([*header, "end_header", ""]).encode())
        file.write(rows.tobytes())
        file.write(np.array(edges, dtype="<i4").tobytes())
