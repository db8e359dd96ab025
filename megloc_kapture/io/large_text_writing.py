"""Writing ``points3d.txt`` and ``observations.txt`` of large maps with compiled loops.

Imported only when a large file is written, see ``text_kernels.py``. The bytes are those of the
plain writer in ``kapture_points.py``, about seven times as fast.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.io.float_text import MAX_FLOAT_CHARACTERS, put_float

_OBSERVATIONS_AT_ONCE = 1 << 17
_POINTS_AT_ONCE = 1 << 16
_MOST_DIGITS = 20


@compiled_loop
def _put_number(out, position, value):
    """Write digits; the position after them."""
    digits = 1
    left = value // 10
    while left > 0:
        digits += 1
        left //= 10
    for k in range(digits):
        out[position + digits - 1 - k] = 48 + value % 10
        value //= 10
    return position + digits


@compiled_loop
def _put_rows(point_ids, image_ids, keypoint_ids, head, names, starts, out):
    """Write the rows of observations sorted by point; the number of bytes."""
    position = 0
    for k in range(len(point_ids)):
        if k == 0 or point_ids[k] != point_ids[k - 1]:
            if k > 0:
                out[position] = 10
                position += 1
            position = _put_number(out, position, point_ids[k])
            for byte in head:
                out[position] = byte
                position += 1
        image = image_ids[k]
        for source in range(starts[image], starts[image + 1]):
            out[position] = names[source]
            position += 1
        position = _put_number(out, position, np.int64(keypoint_ids[k]))
    if len(point_ids) > 0:
        out[position] = 10
        position += 1
    return position


def observation_rows(
    keypoints_type: str,
    image_names: Sequence[str],
    point_ids: NDArray[np.int64],
    image_ids: NDArray[np.int32],
    keypoint_ids: NDArray[np.int32],
) -> Iterator[bytes]:
    """The rows of observations sorted by point, in pieces of some megabytes.

    Parameters
    ----------
    point_ids, image_ids, keypoint_ids : (O,), not negative; points ascending, images indices into
        ``image_names``.
    """
    head = np.frombuffer(f", {keypoints_type}".encode(), np.uint8)
    texts = [f", {name}, ".encode() for name in image_names]
    names = np.frombuffer(b"".join(texts), np.uint8)
    lengths = np.array([len(text) for text in texts], dtype=np.int64)
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
    begin = 0
    while begin < len(point_ids):
        end = min(begin + _OBSERVATIONS_AT_ONCE, len(point_ids))
        # a row is written whole
        end = int(np.searchsorted(point_ids, point_ids[end - 1], side="right"))
        rows = slice(begin, end)
        room = int(lengths[image_ids[rows]].sum()) + (end - begin) * (
            2 * _MOST_DIGITS + len(head) + 1
        )
        out = np.empty(room, np.uint8)
        size = _put_rows(
            point_ids[rows], image_ids[rows], keypoint_ids[rows], head, names, starts, out
        )
        yield out[:size].tobytes()
        begin = end


@compiled_loop
def _put_points(bits, columns, out):
    """Write rows of floats, separated by commas; the number of bytes."""
    position = 0
    for k in range(len(bits)):
        position = put_float(out, position, bits[k])
        out[position] = 10 if k % columns == columns - 1 else 44
        position += 1
    return position


def point_rows(points: NDArray[np.float64]) -> Iterator[bytes]:
    """The rows of finite points (N, C), in pieces of some megabytes."""
    columns = points.shape[1]
    out = np.empty(_POINTS_AT_ONCE * columns * (MAX_FLOAT_CHARACTERS + 1), np.uint8)
    for start in range(0, len(points), _POINTS_AT_ONCE):
        block = np.ascontiguousarray(points[start : start + _POINTS_AT_ONCE])
        size = _put_points(block.view(np.uint64).ravel(), columns, out)
        yield out[:size].tobytes()
