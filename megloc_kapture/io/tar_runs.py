"""Runs of alike members in a tar: one header size, one data size, so a constant stride.

The vectors of ten thousand images are such a run. Reading the headers of a run at once, and
checking them as arrays, is some twenty times as fast as to let ``tarfile`` meet them one by one.
Whatever is not exactly as expected ends the run, and is left to ``tarfile``.
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

_BLOCK = 512
_FIRST_BATCH, _LARGEST_BATCH = 16, 4096
_PLAIN, _EXTENDED = ord("0"), ord("x")
# keywords of an extended header that change neither size nor kind of the member (POSIX pax)
_HARMLESS = frozenset({b"mtime", b"atime", b"ctime", b"uid", b"gid", b"uname", b"gname", b"path"})


def stride_of(header_bytes: int, size: int) -> int:
    """Bytes from the start of a member to the start of the next."""
    return header_bytes + -(-size // _BLOCK) * _BLOCK


def names_of_run(
    descriptor: int, start: int, total: int, *, header_bytes: int, size: int
) -> list[str]:
    """Names of the whole plain files from ``start`` on, as long as they are alike.

    Parameters
    ----------
    descriptor : of the open tar; its position is neither used nor changed.
    start : where the first of them would begin.
    total : bytes of the tar.
    header_bytes : of all headers of a member: 512, or 1536 with an extended header (pax).
    size : bytes of a member's data.

    Returns
    -------
    names : member k begins at ``start + k * stride_of(header_bytes, size)``. As they stand in the
        tar: not checked to be harmless.
    """
    if header_bytes not in (_BLOCK, 3 * _BLOCK):
        return []
    stride = stride_of(header_bytes, size)
    most = max(0, (total - start - header_bytes - size) // stride + 1)
    names: list[str] = []
    batch = _FIRST_BATCH
    while len(names) < most:
        count = min(batch, most - len(names))
        first = start + len(names) * stride
        headers = _headers(descriptor, first, count, stride, header_bytes)
        if headers is None:
            break  # being cut while we read
        found = _names(headers, size)
        names += found
        if len(found) < count:
            break  # of a batch with a name that cannot be used, none is taken
        batch = min(2 * batch, _LARGEST_BATCH)
    return names


def _headers(
    descriptor: int, first: int, count: int, stride: int, header_bytes: int
) -> NDArray[np.uint8] | None:
    """Headers (N, header_bytes) at a constant stride; None where the file has not all of them."""
    places = range(first, first + count * stride, stride)
    content = b"".join([os.pread(descriptor, header_bytes, place) for place in places])
    if len(content) != count * header_bytes:
        return None
    return np.frombuffer(content, dtype=np.uint8).reshape(count, header_bytes)


def _names(headers: NDArray[np.uint8], size: int) -> list[str]:
    """Names of the members up to the first that is not as expected; headers (N, bytes)."""
    last = headers[:, -_BLOCK:]
    good = _whole(last, _PLAIN) & (_octal(last[:, 124:135]) == size)
    good &= (last[:, 135] == 0) | (last[:, 135] == ord(" "))
    if headers.shape[1] > _BLOCK:
        good &= _whole(headers[:, :_BLOCK], _EXTENDED)
    count = len(good) if good.all() else int(np.argmin(good))
    paths = _texts(last[:count, :100])
    if last[:count, 345].any():
        prefixes = _texts(last[:count, 345:500])
        joint = zip(prefixes, paths, strict=True)
        paths = [prefix + b"/" + path if prefix else path for prefix, path in joint]
    if headers.shape[1] > _BLOCK:
        paths = _extended_paths(headers[:count], paths)
    joined = b"\0".join(paths)
    if b"/\0" in joined or joined.endswith(b"/"):
        return []  # folders: tarfile meets them
    try:
        names = joined.decode("utf-8").split("\0")
    except UnicodeDecodeError:
        return []
    # a zero within a name would have made two
    return names if len(names) == len(paths) else []


def _extended_paths(headers: NDArray[np.uint8], paths: list[bytes]) -> list[bytes]:
    """Paths as the extended headers (N, 1536) have them, up to the first that has more."""
    lengths = _octal(headers[:, 124:135]).tolist()
    found: list[bytes] = []
    for header, path, length in zip(headers, paths, lengths, strict=True):
        if not 0 < length <= _BLOCK:
            break
        records = _records(header[_BLOCK : _BLOCK + length].tobytes())
        if records is None:
            break
        found.append(records.get(b"path", path))
    return found


def _whole(headers: NDArray[np.uint8], kind: int) -> NDArray[np.bool_]:
    """Whether headers (N, 512) are of one kind, in the ustar form, with a right checksum."""
    magic = (headers[:, 257:262] == np.frombuffer(b"ustar", dtype=np.uint8)).all(axis=1)
    sums = headers.sum(axis=1, dtype=np.int64)
    # the checksum's own field counts as eight spaces
    sums += 8 * ord(" ") - headers[:, 148:156].sum(axis=1, dtype=np.int64)
    good: NDArray[np.bool_] = magic & (headers[:, 156] == kind)
    return good & (_octal(headers[:, 148:154]) == sums)


def _octal(digits: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Numbers (N,) written as octal digits (N, W) without blanks; -1 where they are not."""
    values = digits.astype(np.int64) - ord("0")
    numbers = values @ 8 ** np.arange(digits.shape[1] - 1, -1, -1)
    numbers[((values < 0) | (values > 7)).any(axis=1)] = -1
    return numbers


def _texts(fields: NDArray[np.uint8]) -> list[bytes]:
    """Fields (N, W) without the zeros at their ends."""
    width = fields.shape[1]
    found: list[bytes] = np.ascontiguousarray(fields).view(f"S{width}").reshape(-1).tolist()
    return found


def _records(content: bytes) -> dict[bytes, bytes] | None:
    """The records of an extended header; None if one is broken or more than harmless."""
    records: dict[bytes, bytes] = {}
    while content:
        length, _, rest = content.partition(b" ")
        if not length.isdigit() or not len(length) < int(length) <= len(content):
            return None
        record, content = rest[: int(length) - len(length) - 1], content[int(length) :]
        key, equals, value = record.partition(b"=")
        if not equals or key not in _HARMLESS or not value.endswith(b"\n"):
            return None
        records[key] = value[:-1]
    return records
