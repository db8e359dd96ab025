"""Compiled loops that read ``observations.txt`` and ``points3d.txt``: bytes in, numbers out.

Imported only when a large file is read: numba costs half a second to import (and some seconds to
compile, once per machine; the result is cached on disk). The loops accept the plain form of the
grammar and stop at the first line that is anything else; what is wrong with that line, or whether
it is merely unusual, is for the Python parser in ``kapture_points.py`` to say.

Everything is exact. Numbers are read by Lemire's method (Number parsing at a gigabyte per second,
2021): 128 bits of a power of five decide the rounding, and the few texts that they cannot decide
are handed back. Names are compared byte by byte; the hash only finds the candidate.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop

# how a loop ends: all read; a line is not plain; a table must grow and the line be read again
DONE, REFUSED, GROW = 0, 1, 2


_U = np.uint64
_ONES = _U(0x0101010101010101)
_HIGHS = _U(0x8080808080808080)
_COMMAS = _U(0x2C2C2C2C2C2C2C2C)
_NEWLINES = _U(0x0A0A0A0A0A0A0A0A)
_MASK32 = _U(0xFFFFFFFF)
_MULTIPLIER = _U(0x9E3779B97F4A7C15)
_COMMA, _NEWLINE, _HASH, _SPACE = 44, 10, 35, 32

_MIN_POWER, _MAX_POWER = -342, 308


def _powers_of_five() -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """The 128 leading bits of 5**q, rounded as Lemire's proof needs them; high and low halves."""
    high, low = [], []
    for q in range(_MIN_POWER, _MAX_POWER + 1):
        if q >= 0:
            value = 5**q
            value <<= max(0, 128 - value.bit_length())
        else:
            power = 5**-q
            bits = (power - 1).bit_length()
            value = (1 << (bits + 127 if q >= -27 else 2 * bits + 128)) // power + 1
        value >>= max(0, value.bit_length() - 128)
        high.append(value >> 64)
        low.append(value & (2**64 - 1))
    return np.array(high, dtype=np.uint64), np.array(low, dtype=np.uint64)


_POWER_HIGH, _POWER_LOW = _powers_of_five()


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
    """What str.strip() takes away, of ASCII; a line break is no space here."""
    return byte == 32 or (byte >= 9 and byte <= 13 and byte != 10) or (byte >= 28 and byte <= 31)


@compiled_loop
def _field_end(words, position):
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
def _lookup(words, begin, end, slots, store, starts, lengths, count):
    """Index of a name in a table, added where it is new; -1 where the table is full.

    ``count[0]`` names and ``count[1]`` words of text are stored; a name's text starts at a word
    of its own, filled up with zeros.
    """
    length = end - begin
    full = length >> 3
    tail = _U((length & 7) << 3)
    tail_mask = (_U(1) << tail) - _U(1)
    code = _U(length) * _MULTIPLIER
    for k in range(full):
        code = (code ^ _word(words, begin + 8 * k)) * _MULTIPLIER
        code ^= code >> _U(29)
    if tail != _U(0):
        code = (code ^ (_word(words, begin + 8 * full) & tail_mask)) * _MULTIPLIER
    code ^= code >> _U(32)
    mask = len(slots) - 1
    slot = np.int64(code & _U(mask))
    while True:
        name = slots[slot]
        if name < 0:
            break
        if lengths[name] == length:
            start = starts[name]
            same = True
            for k in range(full):
                if store[start + k] != _word(words, begin + 8 * k):
                    same = False
                    break
            if same and tail != _U(0):
                same = store[start + full] == (_word(words, begin + 8 * full) & tail_mask)
            if same:
                return name
        slot = (slot + 1) & mask
    name = count[0]
    start = count[1]
    needed = full + (1 if tail != _U(0) else 0)
    if name >= len(starts) or 2 * (name + 1) > len(slots) or start + needed > len(store):
        return -1
    for k in range(full):
        store[start + k] = _word(words, begin + 8 * k)
    if tail != _U(0):
        store[start + full] = _word(words, begin + 8 * full) & tail_mask
    slots[slot] = name
    starts[name] = start
    lengths[name] = length
    count[0] = name + 1
    count[1] = start + needed
    return name


@compiled_loop
def add_name(words, begin, end, table):
    """Put a name into a table; its index, or -1 where there is no room."""
    slots, store, starts, lengths, count = table
    return _lookup(words, begin, end, slots, store, starts, lengths, count)


@compiled_loop
def count_commas_and_lines(text):
    """How many commas and line breaks a text of bytes has: bounds for what it holds."""
    commas = 0
    lines = 0
    for k in range(len(text)):
        commas += text[k] == _COMMA
        lines += text[k] == _NEWLINE
    return commas, lines


@compiled_loop
def _integer(text, position, limit):
    """Read digits and the spaces around them: (value or -1, position after)."""
    while _is_space(text[position]):
        position += 1
    first = position
    value = np.int64(0)
    while text[position] >= 48 and text[position] <= 57:
        value = value * 10 + (np.int64(text[position]) - 48)
        position += 1
        if position - first > 18:
            return -1, position
    if position == first or value >= limit:
        return -1, position
    while _is_space(text[position]):
        position += 1
    return value, position


@compiled_loop
def parse_observations(
    text,
    words,
    begin,
    end,
    names,
    types,
    out,
):
    """Read whole lines of observations from ``text[begin:end]``, which ends with a line break.

    ``words`` is ``text`` seen as uint64. ``names`` and ``types`` are tables (slots, store, starts,
    lengths, count), ``out`` the arrays (points, images, keypoints, types) with room for half as
    many entries as there are commas.

    Returns (status, position of the line not read yet, number of observations read).
    """
    slots, store, starts, lengths, count = names
    type_slots, type_store, type_starts, type_lengths, type_count = types
    points, images, keypoints, type_ids = out
    position = begin
    read = 0
    while position < end:
        line = position
        first = read
        if text[position] == _HASH:
            while text[position] != _NEWLINE:
                if text[position] >= 128:
                    return REFUSED, line, first
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
            return REFUSED, line, first
        position += 1
        while _is_space(text[position]):
            position += 1
        field_end = _field_end(words, position)
        stop = field_end
        while stop > position and _is_space(text[stop - 1]):
            stop -= 1
        if stop == position:
            return REFUSED, line, first
        type_id = _lookup(
            words, position, stop, type_slots, type_store, type_starts, type_lengths, type_count
        )
        if type_id < 0 or type_id > 255:
            return REFUSED, line, first
        position = field_end
        while text[position] == _COMMA:
            position += 1
            while _is_space(text[position]):
                position += 1
            field_end = _field_end(words, position)
            if text[field_end] != _COMMA:
                return REFUSED, line, first
            stop = field_end
            while stop > position and _is_space(text[stop - 1]):
                stop -= 1
            if stop == position:
                return REFUSED, line, first
            image = _lookup(words, position, stop, slots, store, starts, lengths, count)
            if image < 0:
                return GROW, line, first
            keypoint, position = _integer(text, field_end + 1, np.int64(1) << 31)
            if keypoint < 0:
                return REFUSED, line, first
            points[read] = point
            images[read] = image
            keypoints[read] = keypoint
            type_ids[read] = type_id
            read += 1
        if text[position] != _NEWLINE:
            return REFUSED, line, first
        position += 1
    return DONE, position, read


# -------------------------------------------------------------------------------------- floats


@compiled_loop
def product(a, b):
    """128-bit product of two uint64: (high, low)."""
    a_low, a_high = a & _MASK32, a >> _U(32)
    b_low, b_high = b & _MASK32, b >> _U(32)
    low = a_low * b_low
    middle = a_high * b_low + (low >> _U(32))
    middle2 = a_low * b_high + (middle & _MASK32)
    high = a_high * b_high + (middle >> _U(32)) + (middle2 >> _U(32))
    return high, (middle2 << _U(32)) | (low & _MASK32)


@compiled_loop
def _nearest_float_bits(digits, power):
    """Bits of the float64 nearest to digits * 10**power, sign aside: (decided, bits)."""
    if digits == _U(0):
        return True, _U(0)
    if power < _MIN_POWER or power > _MAX_POWER:
        return False, _U(0)
    zeros = 0
    for step in (32, 16, 8, 4, 2, 1):
        if digits >> _U(64 - step) == _U(0):
            digits = digits << _U(step)
            zeros += step
    high, low = product(digits, _POWER_HIGH[power - _MIN_POWER])
    if high & _U(0x1FF) == _U(0x1FF):
        more, _ = product(digits, _POWER_LOW[power - _MIN_POWER])
        low = low + more
        if more > low:
            high = high + _U(1)
    if low == _U(0xFFFFFFFFFFFFFFFF) and (power < -27 or power > 55):
        return False, _U(0)
    upper = np.int64(high >> _U(63))
    shift = _U(upper + 64 - 52 - 3)
    mantissa = high >> shift
    exponent = ((217706 * power) >> 16) + 63 + upper - zeros + 1023
    if exponent <= 0:
        return False, _U(0)  # subnormal
    halfway = low <= _U(1) and power >= -4 and power <= 23 and (mantissa & _U(3)) == _U(1)
    if halfway and (mantissa << shift) == high:
        mantissa = mantissa & ~_U(1)
    mantissa = (mantissa + (mantissa & _U(1))) >> _U(1)
    if mantissa >= _U(1) << _U(53):
        mantissa = _U(1) << _U(52)
        exponent += 1
    if exponent >= 0x7FF:
        return False, _U(0)
    return True, (mantissa & ~(_U(1) << _U(52))) | (_U(exponent) << _U(52))


@compiled_loop
def _read_general_float(text, position):
    """As :func:`read_float`, with any number of digits, an exponent or a plus sign."""
    sign = _U(0)
    if text[position] == 45:  # -
        sign = _U(1) << _U(63)
        position += 1
    elif text[position] == 43:  # +
        position += 1
    digits = _U(0)
    significant = 0
    power = np.int64(0)
    truncated = False
    any_digit = False
    after_point = False
    while True:
        byte = text[position]
        if byte >= 48 and byte <= 57:
            any_digit = True
            if significant < 19:
                digits = digits * _U(10) + _U(byte - 48)
                if digits != _U(0):
                    significant += 1
                if after_point:
                    power -= 1
            else:
                truncated = truncated or byte != 48
                if not after_point:
                    power += 1
        elif byte == 46 and not after_point:  # .
            after_point = True
        else:
            break
        position += 1
    if not any_digit:
        return 1, _U(0), position
    if text[position] == 101 or text[position] == 69:  # e, E
        position += 1
        negative = text[position] == 45
        if text[position] == 45 or text[position] == 43:
            position += 1
        if text[position] < 48 or text[position] > 57:
            return 1, _U(0), position
        exponent = np.int64(0)
        while text[position] >= 48 and text[position] <= 57:
            if exponent < 100000:
                exponent = exponent * 10 + (np.int64(text[position]) - 48)
            position += 1
        power += -exponent if negative else exponent
    decided, bits = _nearest_float_bits(digits, power)
    if decided and truncated:
        # between these two lies the number; where they agree, so does it
        decided, above = _nearest_float_bits(digits + _U(1), power)
        decided = decided and above == bits
    return 0 if decided else 2, bits | sign, position


@compiled_loop
def read_float(text, position):
    """Read one decimal number: (status, bits, position after it).

    Status 0: read; 1: not a number; 2: a number whose nearest float is not decided here.
    """
    # nearly all numbers have at most 19 digits and no exponent: half the time of the general way
    begin = position
    sign = _U(0)
    if text[position] == 45:  # -
        sign = _U(1) << _U(63)
        position += 1
    first = position
    digits = _U(0)
    power = np.int64(0)
    digit = _U(text[position]) - _U(48)  # wraps around below "0"
    while digit <= _U(9):
        digits = digits * _U(10) + digit
        position += 1
        digit = _U(text[position]) - _U(48)
    length = position - first
    if text[position] == 46:  # .
        position += 1
        point = position
        digit = _U(text[position]) - _U(48)
        while digit <= _U(9):
            digits = digits * _U(10) + digit
            position += 1
            digit = _U(text[position]) - _U(48)
        power = point - position
        length -= power
    if length == 0 or length > 19 or text[position] == 101 or text[position] == 69:  # e, E
        return _read_general_float(text, begin)
    decided, bits = _nearest_float_bits(digits, power)
    return 0 if decided else 2, bits | sign, position


@compiled_loop
def parse_points(text, begin, end, columns, out, late):
    """Read whole lines of points from ``text[begin:end]``, which ends with a line break.

    ``out`` takes the bits of the floats, (rows, columns) flattened, uint64; ``late`` (L, 3) the
    numbers not decided here: index into ``out``, begin and end of the text.

    Returns (status, position of the line not read yet, rows read, entries of ``late``).
    """
    position = begin
    read = 0
    num_late = 0
    while position < end:
        line = position
        if text[position] == _HASH:
            while text[position] != _NEWLINE:
                if text[position] >= 128:
                    return REFUSED, line, read // columns, num_late
                position += 1
            position += 1
            continue
        while _is_space(text[position]):
            position += 1
        if text[position] == _NEWLINE:
            position += 1
            continue
        for column in range(columns):
            while _is_space(text[position]):
                position += 1
            start = position
            status, bits, position = read_float(text, position)
            if status == 1 or (status == 2 and num_late == len(late)):
                return REFUSED, line, read // columns, num_late
            if status == 2:
                late[num_late, 0] = read
                late[num_late, 1] = start
                late[num_late, 2] = position
                num_late += 1
            out[read] = bits
            read += 1
            while _is_space(text[position]):
                position += 1
            if text[position] != (_COMMA if column < columns - 1 else _NEWLINE):
                return REFUSED, line, (read - column - 1) // columns, num_late
            position += 1
    return DONE, position, read // columns, num_late
