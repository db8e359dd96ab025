"""Compiled loops that read and write the rows of ``observations.txt``.

Imported only for large files: numba costs half a second to import (and some seconds to compile,
once per machine; the result is cached on disk). The reading loop accepts the plain form of the
grammar and stops at the first line that is anything else; what is wrong with that line, or whether
it is merely unusual, is for the Python parser in ``observations.py`` to say. Names are compared
byte by byte; the hash only finds the candidate.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from megloc_kapture.compiling import compiled_loop

if TYPE_CHECKING:
    from megloc_kapture.io.kapture.observations import Observations

PADDING = 16  # zeros after the end of a text: the loop looks some bytes ahead

_U = np.uint64
_ONES = _U(0x0101010101010101)
_HIGHS = _U(0x8080808080808080)
_COMMAS = _U(0x2C2C2C2C2C2C2C2C)
_NEWLINES = _U(0x0A0A0A0A0A0A0A0A)
_MULTIPLIER = _U(0x9E3779B97F4A7C15)
_COMMA, _NEWLINE, _HASH = 44, 10, 35
_OBSERVATIONS_AT_ONCE = 1 << 17
_MOST_DIGITS = 20


@compiled_loop
def _word(words, position):
    """The 8 bytes from any position, the first one lowest."""
    index = position >> 3
    shift = _U((position & 7) << 3)
    if shift == _U(0):
        return words[index]
    return (words[index] >> shift) | (words[index + 1] << (_U(64) - shift))


@compiled_loop
def _is_space(byte):
    """True for a byte of ASCII that str.strip() takes away; a line break is no space here."""
    return byte == 32 or (byte >= 9 and byte <= 13 and byte != 10) or (byte >= 28 and byte <= 31)


@compiled_loop
def _separator(words, position):
    """Position of the next comma or line break; the text must end with one."""
    while True:
        word = _word(words, position)
        commas = word ^ _COMMAS
        breaks = word ^ _NEWLINES
        found = (((commas - _ONES) & ~commas) | ((breaks - _ONES) & ~breaks)) & _HIGHS
        if found != _U(0):
            lowest = (found & (~found + _U(1))) >> _U(7)
            return position + np.int64((((lowest - _U(1)) & _ONES) * _ONES) >> _U(56))
        position += 8


@compiled_loop
def _field(text, words, position):
    """Begin and end of the field at a position, without the spaces around; its separator's."""
    begin = position
    while _is_space(text[begin]):
        begin += 1
    separator = _separator(words, begin)
    end = separator
    while end > begin and _is_space(text[end - 1]):
        end -= 1
    return begin, end, separator


@compiled_loop
def _integer(text, position, limit):
    """The digits at a position, spaces around them: (number below the limit or -1, their end)."""
    while _is_space(text[position]):
        position += 1
    first = position
    value = np.int64(0)
    while text[position] >= 48 and text[position] <= 57 and position - first < 19:
        value = value * 10 + (np.int64(text[position]) - 48)
        position += 1
    if position == first or position - first > 18 or value >= limit:
        return -1, position
    while _is_space(text[position]):
        position += 1
    return value, position


@compiled_loop
def _name_id(words, begin, end, slots, spans, count):
    """Id of a name: its rank among the names met so far, of which ``count[0]`` are in ``spans``."""
    length = end - begin
    full = length >> 3
    tail_mask = (_U(1) << _U((length & 7) << 3)) - _U(1)
    code = _U(length) * _MULTIPLIER
    for k in range(full):
        code = (code ^ _word(words, begin + 8 * k)) * _MULTIPLIER
        code ^= code >> _U(29)
    code = (code ^ (_word(words, begin + 8 * full) & tail_mask)) * _MULTIPLIER
    code ^= code >> _U(32)
    mask = len(slots) - 1
    slot = np.int64(code & _U(mask))
    while slots[slot] >= 0:
        other = spans[slots[slot], 0]
        if spans[slots[slot], 1] - other == length:
            same = True
            for k in range(full):
                if _word(words, other + 8 * k) != _word(words, begin + 8 * k):
                    same = False
                    break
            difference = _word(words, other + 8 * full) ^ _word(words, begin + 8 * full)
            if same and difference & tail_mask == _U(0):
                return slots[slot]
        slot = (slot + 1) & mask
    slots[slot] = count[0]
    spans[count[0], 0] = begin
    spans[count[0], 1] = end
    count[0] += 1
    return slots[slot]


@compiled_loop
def parse_observations(text, words, begin, end, images, types, out):
    """Read whole lines of observations from ``text[begin:end]``, which ends with a line break.

    Parameters
    ----------
    text, words : uint8 and the same memory as uint64; ``PADDING`` zeros follow the end.
    images, types : tables of names (slots, spans, count): ``slots`` of -1, a power of two at least
        twice as many as there are names; ``spans`` (N, 2) takes begin and end of each.
    out : arrays (points, images, keypoints, types) with room for half as many entries as the text
        has commas.

    Returns (offset of the line that is not plain, or ``end``; number of observations read).
    """
    slots, spans, count = images
    type_slots, type_spans, type_count = types
    points, image_ids, keypoints, type_ids = out
    position = begin
    read = 0
    while position < end:
        line = position
        if text[position] == _HASH:
            while text[position] != _NEWLINE:
                if text[position] >= 128 or text[position] == 0:
                    return line, read
                position += 1
            position += 1
            continue
        while _is_space(text[position]):
            position += 1
        if text[position] == _NEWLINE:
            position += 1
            continue
        point, position = _integer(text, position, np.int64(1) << 62)
        if point < 0 or text[position] != _COMMA:
            return line, read
        start, stop, separator = _field(text, words, position + 1)
        if stop == start:
            return line, read
        type_id = _name_id(words, start, stop, type_slots, type_spans, type_count)
        first = read
        position = separator
        while text[position] == _COMMA:
            start, stop, separator = _field(text, words, position + 1)
            if stop == start or text[separator] != _COMMA:
                return line, first
            image = _name_id(words, start, stop, slots, spans, count)
            keypoint, position = _integer(text, separator + 1, np.int64(1) << 31)
            if keypoint < 0:
                return line, first
            points[read] = point
            image_ids[read] = image
            keypoints[read] = keypoint
            type_ids[read] = type_id
            read += 1
        if text[position] != _NEWLINE:
            return line, first
        position += 1
    return end, read


# ------------------------------------------------------------------------------------ writing


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
    """Write the rows of observations sorted by point; the number of bytes.

    ``head`` is ", TYPE" in bytes, ``names[starts[i]:starts[i + 1]]`` ", IMAGE, " of image i.
    """
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


def written_rows(part: Observations) -> Iterator[bytes]:
    """The rows of observations sorted by point, in pieces of some megabytes."""
    head = np.frombuffer(f", {part.keypoints_type}".encode(), np.uint8)
    texts = [f", {name}, ".encode() for name in part.image_names]
    names = np.frombuffer(b"".join(texts), np.uint8)
    lengths = np.array([len(text) for text in texts], dtype=np.int64)
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
    begin = 0
    while begin < len(part):
        end = min(begin + _OBSERVATIONS_AT_ONCE, len(part))
        # a row is written whole
        end = int(np.searchsorted(part.point_ids, part.point_ids[end - 1], side="right"))
        points, images, keypoints = (
            ids[begin:end] for ids in (part.point_ids, part.image_ids, part.keypoint_ids)
        )
        room = int(lengths[images].sum()) + (end - begin) * (2 * _MOST_DIGITS + len(head) + 1)
        out = np.empty(room, np.uint8)
        yield out[: _put_rows(points, images, keypoints, head, names, starts, out)].tobytes()
        begin = end
