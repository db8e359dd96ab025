"""``reconstruction/point_covariances.npy``: how uncertain the points of a kapture map are.

kapture has no place for it, and ignores the file. Row i belongs to point i of ``points3d.txt``.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.paths import check_no_escape

COVARIANCES_FILE = "reconstruction/point_covariances.npy"


def write_point_covariances(root: Path, covariances: NDArray[np.float64]) -> None:
    """Write covariances float64 (N, 6): xx, xy, xz, yy, yz, zz for a noise of 1 px, NaN: unknown.

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

    Raises
    ------
    DataError : not such an array, or not of so many points: another map's.
    """
    path = root / COVARIANCES_FILE
    if not path.is_file():
        return None
    if num_points == 0:
        return np.zeros((0, 6))  # nothing cannot be mapped
    try:
        array = np.lib.format.open_memmap(check_no_escape(root, path), mode="r")
    except (OSError, ValueError) as error:
        raise DataError(f"no array of numpy: {error}", path=path) from error
    if array.dtype != np.float64 or array.shape != (num_points, 6):
        raise DataError(
            f"{array.dtype} {array.shape}, expected float64 ({num_points}, 6): one row per point",
            path=path,
        )
    return np.asarray(array)
