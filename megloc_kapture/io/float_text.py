"""A compiled ``repr`` of float64: the shortest decimal that reads back as the same number.

Raffaello Giulietti's Schubfach (The Schubfach way to render doubles, 2020): of the decimals with
16 or 17 digits around a float, whose spacing is chosen so that one or two lie in its rounding
interval, three products with 128 bits of a power of ten tell which. No loop, no big integers.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.io.text_kernels import product

# of the longest text, "-2.2250738585072014e-308"
MAX_FLOAT_CHARACTERS = 24

_U = np.uint64
_MIN_POWER, _MAX_POWER = -292, 324
_HIDDEN_BIT = _U(1) << _U(52)


def _powers_of_ten() -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """The 128 leading bits of 10**k, rounded up; high and low halves."""
    high, low = [], []
    for k in range(_MIN_POWER, _MAX_POWER + 1):
        if k >= 0:
            bits = (10**k).bit_length()
            value = 10**k << (128 - bits) if bits <= 128 else (10**k >> (bits - 128)) + 1
        else:
            value = (1 << (127 + (10**-k).bit_length())) // 10**-k + 1
        high.append(value >> 64)
        low.append(value & (2**64 - 1))
    return np.array(high, dtype=np.uint64), np.array(low, dtype=np.uint64)


_TEN_HIGH, _TEN_LOW = _powers_of_ten()


@compiled_loop
def _round_to_odd(high, low, factor):
    """The upper 64 bits of a product of 192 bits; the last one set where others are cut off."""
    carried, _ = product(low, factor)
    upper, middle = product(high, factor)
    middle += carried
    if middle < carried:
        upper += _U(1)
    return upper | _U(1) if middle > _U(1) else upper


@compiled_loop
def _shortest_decimal(bits):
    """Digits and power of ten of a positive finite float64, given its bits without the sign."""
    fraction = bits & (_HIDDEN_BIT - _U(1))
    exponent = np.int64(bits >> _U(52))
    if exponent != 0:
        significand = fraction | _HIDDEN_BIT
        q = exponent - 1075
        if q <= 0 and q > -53 and significand & ((_U(1) << _U(-q)) - _U(1)) == _U(0):
            return significand >> _U(-q), 0  # a whole number
    else:
        significand = fraction
        q = np.int64(-1074)
    odd = significand & _U(1)
    # below a power of two the floats are twice as dense
    closer = fraction == _U(0) and exponent > 1
    k = (q * 1262611 - (524031 if closer else 0)) >> 22
    shift = _U(q + ((-k * 1741647) >> 19) + 1)
    high, low = _TEN_HIGH[-k - _MIN_POWER], _TEN_LOW[-k - _MIN_POWER]
    middle = _U(4) * significand
    # four times the float and the ends of its interval; an end counts where the float is even
    lower = _round_to_odd(high, low, (middle - (_U(1) if closer else _U(2))) << shift) + odd
    value = _round_to_odd(high, low, middle << shift)
    upper = _round_to_odd(high, low, (middle + _U(2)) << shift) - odd
    s = value >> _U(2)
    if s >= _U(10):
        tens = s // _U(10)
        below = lower <= _U(40) * tens
        above = _U(40) * tens + _U(40) <= upper
        if below != above:
            return tens + (_U(1) if above else _U(0)), k + 1
    below = lower <= _U(4) * s
    above = _U(4) * s + _U(4) <= upper
    if below != above:
        return s + (_U(1) if above else _U(0)), k
    half = _U(4) * s + _U(2)
    round_up = value > half or (value == half and s & _U(1) != _U(0))
    return s + (_U(1) if round_up else _U(0)), k


@compiled_loop
def put_float(out, position, bits):
    """Write a finite float64, given by its bits, as Python's repr does; the position after it."""
    if bits >> _U(63) != _U(0):
        out[position] = 45  # -
        position += 1
        bits &= ~(_U(1) << _U(63))
    digits, power = _U(0), np.int64(0)
    if bits != _U(0):
        digits, power = _shortest_decimal(bits)
        while digits % _U(10) == _U(0):
            digits //= _U(10)
            power += 1
    length = 1
    left = digits // _U(10)
    while left > _U(0):
        length += 1
        left //= _U(10)
    point = length + power  # digits before the decimal point
    if point <= -4 or point > 16:
        return _put_scientific(out, position, digits, length, point - 1)
    if point <= 0:
        out[position] = 48
        out[position + 1] = 46
        position += 2
        for _ in range(-point):
            out[position] = 48
            position += 1
        return _put_digits(out, position, digits, length)
    if point >= length:
        position = _put_digits(out, position, digits, length)
        for _ in range(point - length):
            out[position] = 48
            position += 1
        out[position] = 46
        out[position + 1] = 48
        return position + 2
    # one place to the right, then what belongs before the point back to the left
    _put_digits(out, position + 1, digits, length)
    for k in range(point):
        out[position + k] = out[position + k + 1]
    out[position + point] = 46
    return position + length + 1


@compiled_loop
def _put_digits(out, position, digits, length):
    for k in range(length):
        out[position + length - 1 - k] = np.uint8(_U(48) + digits % _U(10))
        digits //= _U(10)
    return position + length


@compiled_loop
def _put_scientific(out, position, digits, length, exponent):
    end = _put_digits(out, position + 1, digits, length)
    out[position] = out[position + 1]
    out[position + 1] = 46
    position = end if length > 1 else position + 1
    out[position] = 101  # e
    out[position + 1] = 45 if exponent < 0 else 43
    position += 2
    exponent = abs(exponent)
    return _put_digits(out, position, _U(exponent), 3 if exponent >= 100 else 2)
