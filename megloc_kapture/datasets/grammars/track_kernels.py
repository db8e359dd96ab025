"""Compiled loops that read the points of large models: bytes in, numbers out.

Imported only for large files, see ``megloc_kapture.io.text_kernels``. The loops over text accept
the plain form of a grammar and stop at the first line that is anything else; what is wrong with
it, or that it is merely unusual, is for the Python parser to say.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import numpy as np

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.io.text_kernels import DONE, REFUSED, read_float

_U = np.uint64
_NEWLINE, _HASH, _MINUS, _ONE = 10, 35, 45, 49
_INT32_END = np.int64(2**31)
# float32 ends below 2**128; the exponent's bits of a float64 say so at once
_EXPONENT_BITS, _FLOAT32_EXPONENT = _U(0x7FF), _U(1023 + 127)


@compiled_loop
def _is_blank(byte):
    """What bytes.split() takes for a space; a line break is none here."""
    return byte == 32 or (byte >= 9 and byte <= 13 and byte != 10)


@compiled_loop
def _skip_blanks(text, position):
    while _is_blank(text[position]):
        position += 1
    return position


@compiled_loop
def _count(text, position, limit):
    """Read a number in digits, below ``limit``: (value or -1, position of the next field)."""
    first = position
    value = np.int64(0)
    while text[position] >= 48 and text[position] <= 57:
        value = value * 10 + (np.int64(text[position]) - 48)
        position += 1
        if position - first > 18:
            return -1, position
    if position == first or value >= limit:
        return -1, position
    if text[position] != _NEWLINE and not _is_blank(text[position]):
        return -1, position
    return value, _skip_blanks(text, position)


@compiled_loop
def _number(text, position):
    """Read a decimal number: (read, bits of the float64, position of the next field)."""
    status, bits, position = read_float(text, position)
    if status != 0 or (text[position] != _NEWLINE and not _is_blank(text[position])):
        return False, bits, position
    return True, bits, _skip_blanks(text, position)


@compiled_loop
def _pixel(text, position):
    """As ``_number``, for what a float32 can hold."""
    good, bits, position = _number(text, position)
    return good and (bits >> _U(52)) & _EXPONENT_BITS < _FLOAT32_EXPONENT, bits, position


@compiled_loop
def _coordinates_and_colour(text, position, row, xyz, rgb):
    """Read X Y Z R G B into a row: (read, position of the next field)."""
    for k in range(3):
        good, bits, position = _number(text, position)
        if not good:
            return False, position
        xyz[3 * row + k] = bits
    for k in range(3):
        value, position = _count(text, position, 256)
        if value < 0:
            return False, position
        rgb[row, k] = value
    return True, position


@compiled_loop
def parse_nvm_points(text, begin, end, max_rows, num_images, out):
    """Read at most ``max_rows`` points of an NVM from ``text[begin:end]``, which ends a line.

    ``out`` are the arrays xyz (the bits of the floats, flattened), rgb (rows, 3), lengths of the
    tracks, and per observation image, feature and xy (bits); all large enough.

    Returns (status, position of the line not read yet, rows read, observations read).
    """
    xyz, rgb, lengths, images, features, xy = out
    position = begin
    row = 0
    read = 0
    while position < end and row < max_rows:
        line = position
        position = _skip_blanks(text, position)
        if text[position] == _NEWLINE:
            position += 1
            continue
        first = read
        good, position = _coordinates_and_colour(text, position, row, xyz, rgb)
        if not good:
            return REFUSED, line, row, first
        length, position = _count(text, position, _INT32_END)
        if length < 0:
            return REFUSED, line, row, first
        for _ in range(length):
            image, position = _count(text, position, num_images)
            if image < 0:
                return REFUSED, line, row, first
            feature, position = _count(text, position, _INT32_END)
            if feature < 0:
                return REFUSED, line, row, first
            good_x, x, position = _pixel(text, position)
            if not good_x:
                return REFUSED, line, row, first
            good_y, y, position = _pixel(text, position)
            if not good_y:
                return REFUSED, line, row, first
            images[read] = image
            features[read] = feature
            xy[2 * read] = x
            xy[2 * read + 1] = y
            read += 1
        if text[position] != _NEWLINE:
            return REFUSED, line, row, first
        position += 1
        lengths[row] = length
        row += 1
    return DONE, position, row, read


@compiled_loop
def parse_colmap_points(text, begin, end, max_rows, num_images, out):
    """Read points of a ``points3D.txt``; see :func:`parse_nvm_points`. There is no xy."""
    xyz, rgb, lengths, images, features, _ = out
    position = begin
    row = 0
    read = 0
    while position < end and row < max_rows:
        line = position
        position = _skip_blanks(text, position)
        if text[position] == _HASH:
            while text[position] != _NEWLINE:
                position += 1
        if text[position] == _NEWLINE:
            position += 1
            continue
        first = read
        point, position = _count(text, position, np.int64(1) << 62)
        if point < 0:
            return REFUSED, line, row, first
        good, position = _coordinates_and_colour(text, position, row, xyz, rgb)
        if not good:
            return REFUSED, line, row, first
        good, _, position = _number(text, position)
        if not good:
            return REFUSED, line, row, first
        while text[position] != _NEWLINE:
            image, position = _count(text, position, num_images)
            if image < 0:
                return REFUSED, line, row, first
            feature, position = _count(text, position, _INT32_END)
            if feature < 0:
                return REFUSED, line, row, first
            images[read] = image
            features[read] = feature
            read += 1
        position += 1
        lengths[row] = read - first
        row += 1
    return DONE, position, row, read


@compiled_loop
def skip_rows(text, begin, end, max_rows):
    """Pass over lines that are not blank: (position after them, their number)."""
    position = begin
    rows = 0
    while position < end and rows < max_rows:
        position = _skip_blanks(text, position)
        rows += text[position] != _NEWLINE
        while text[position] != _NEWLINE:
            position += 1
        position += 1
    return position, rows


@compiled_loop
def parse_model_features(text, begin, xy):
    """Read a line of X Y POINT3D_ID from an ``images.txt``, up to its line break.

    ``xy`` takes the bits of the floats, flattened. Returns the number of features, -1 where the
    line is not plain.
    """
    position = _skip_blanks(text, begin)
    read = 0
    while text[position] != _NEWLINE:
        good_x, x, position = _pixel(text, position)
        if not good_x:
            return -1
        good_y, y, position = _pixel(text, position)
        if not good_y:
            return -1
        limit = np.int64(1) << 62
        if text[position] == _MINUS:  # only -1: there is no point
            limit = np.int64(2)
            position += 1
            if text[position] != _ONE:
                return -1
        point, position = _count(text, position, limit)
        if point < 0:
            return -1
        xy[2 * read] = x
        xy[2 * read + 1] = y
        read += 1
    return read


@compiled_loop
def _uint64(content, position):
    value = _U(0)
    for k in range(8):
        value |= _U(content[position + k]) << _U(8 * k)
    return value


@compiled_loop
def measure_binary_points(content, begin, count):
    """Walk through the records of a ``points3D.bin``: (done, position after, observations).

    Where the records do not end within the content, ``done`` is False and the position that of
    the record that does not fit.
    """
    head, per_observation = 51, 8
    position = begin
    observations = np.int64(0)
    for _ in range(count):
        if len(content) - position < head:
            return False, position, observations
        length = _uint64(content, position + head - 8)
        room = (len(content) - position - head) // per_observation
        if length > _U(room):
            return False, position, observations
        observations += np.int64(length)
        position += head + per_observation * np.int64(length)
    return True, position, observations


@compiled_loop
def copy_binary_points(content, begin, xyz, rgb, lengths, tracks):
    """Copy measured records apart: xyz and tracks are the bytes of the arrays, in rows."""
    position = begin
    read = 0
    for row in range(len(xyz)):
        for k in range(24):
            xyz[row, k] = content[position + 8 + k]
        for k in range(3):
            rgb[row, k] = content[position + 32 + k]
        length = np.int64(_uint64(content, position + 43))
        position += 51
        for _ in range(length):
            for k in range(8):
                tracks[read, k] = content[position + k]
            read += 1
            position += 8
        lengths[row] = length
