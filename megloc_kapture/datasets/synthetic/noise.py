"""Smooth random fields, the stuff of dirt, clouds and stone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.portable import exp, resized

Field2D = NDArray[np.float32]


def smooth_noise(
    rng: np.random.Generator, height: int, width: int, *, cell: float, octaves: int = 4
) -> Field2D:
    """Multi-octave noise, zero mean and unit deviation; ``cell`` is the coarsest octave, texels."""
    total = np.zeros((height, width), np.float32)
    amplitude = 1.0
    for _ in range(octaves):
        rows, cols = int(np.ceil(height / cell)) + 2, int(np.ceil(width / cell)) + 2
        grid = rng.standard_normal((rows, cols), dtype=np.float32)
        fine_height, fine_width = int(round(rows * cell)), int(round(cols * cell))
        fine = resized(grid, fine_width, fine_height, cubic=True)
        top, left = (fine_height - height) // 2, (fine_width - width) // 2
        total += np.float32(amplitude) * fine[top : top + height, left : left + width]
        amplitude *= 0.65
        cell = cell / 2
        if cell < 1.5:
            break
    return (total - total.mean()) / max(float(total.std()), 1e-6)


def periodic_noise(
    rng: np.random.Generator, size: int, *, cell: float, octaves: int = 4
) -> Field2D:
    """Like :func:`smooth_noise`, square and seamless when tiled."""
    white = rng.standard_normal((size, size))
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    freq = np.sqrt(rows * rows + columns * columns) * cell
    upper = 2.0 ** (octaves - 1)
    gain = np.where(freq > 0, 1 / (0.3 + freq), 0) * exp(-((freq / upper) ** 2))
    out = np.fft.irfft2(np.fft.rfft2(white) * gain, (size, size)).astype(np.float32)
    return out / max(float(out.std()), 1e-6)
