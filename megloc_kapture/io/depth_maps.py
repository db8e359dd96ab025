"""Depth maps as kapture stores them: raw float32, metres, 0 or less where there is no depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_csv import read_content


def read_depth_map(path: Path | str, *, width: int, height: int) -> NDArray[np.float32]:
    """Read a depth map as float32 (H, W) in metres; the size is its depth sensor's.

    Raises
    ------
    DataError : missing, or of another size (truncated).
    """
    path = Path(path)
    content = read_content(path, text=False)
    expected = 4 * width * height
    if len(content) != expected:
        raise DataError(
            f"{len(content)} bytes, but {width}x{height} float32 take {expected}", path=path
        )
    return np.frombuffer(content, dtype="<f4").astype(np.float32).reshape(height, width)


def write_depth_map(path: Path | str, depth_m: ArrayLike) -> None:
    """Write a depth map (H, W) in metres, atomically.

    Raises
    ------
    ValueError : not a two-dimensional array.
    OutputError : cannot be written.
    """
    pixels = np.asarray(depth_m, dtype="<f4")
    if pixels.ndim != 2:
        raise ValueError(f"expected a depth map of shape (H, W), got {pixels.shape}")
    write_bytes(path, np.ascontiguousarray(pixels).tobytes())
