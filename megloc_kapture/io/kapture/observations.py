"""``reconstruction/observations.txt``: the keypoints that observe each 3D point of a map.

The grammar is written here once, in plain Python, and is what reads small files. Files of some
megabytes go through the compiled loops of ``observation_kernels.py`` (numba, which kapture needs
anyway), in chunks of whole lines on two threads: ten million observations take about a second where
kapture takes half a minute, and the fastest libraries for tables two. The loops accept only the
plain form of the grammar and give every other line back to the parser here, so both readers agree,
and errors name file and line either way.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import (
    atomic_write,
    check_component,
    check_output,
    check_relative,
    named,
    reading,
)
from megloc_kapture.io.kapture.features import check_field
from megloc_kapture.io.kapture.format import (
    BYTE_ORDER_MARK,
    FORMAT_LINE,
    check_version,
    parse_integer,
    read_rows,
    split_fields,
)

OBSERVATIONS_HEADER = "# point3d_id, keypoints_type, [image_path, feature_id]*"
MAX_KEYPOINT_ID = 2**31 - 1
MAX_POINT_ID = 2**62

# below this the plain reader and writer take less time than importing numba
LARGE_BYTES = 1 << 22
LARGE_ROWS = 1 << 17

_CHUNK_BYTES = 1 << 23
_MAX_LINE_BYTES = 1 << 28  # a file without line breaks shall not fill the memory
_THREADS = 2  # the loops run at half a gigabyte per second and thread: that keeps up with disks
_POINTS_AT_ONCE = 1 << 16


@dataclass(frozen=True, eq=False)
class Observations:
    """Keypoints that observe 3D points, of one keypoints type.

    Parameters
    ----------
    keypoints_type : type name of the keypoints.
    image_names : sorted.
    point_ids : int64 (O,), rows of the points; sorted, in file order among equals.
    image_ids : int32 (O,), indices into ``image_names``.
    keypoint_ids : int32 (O,), rows of the image's keypoints.
    """

    keypoints_type: str
    image_names: tuple[str, ...]
    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int32]
    keypoint_ids: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.point_ids)


def read_observations(
    path: Path, *, large_bytes: int = LARGE_BYTES, chunk_bytes: int = _CHUNK_BYTES
) -> dict[str, Observations]:
    """Read ``observations.txt``, by keypoints type. Raises DataError: names file and line."""
    is_large = path.is_file() and path.stat().st_size >= large_bytes
    found = _read_compiled(path, chunk_bytes) if is_large else None
    return read_observations_strictly(path) if found is None else found


def read_observations_strictly(path: Path) -> dict[str, Observations]:
    """The grammar of ``observations.txt`` in plain Python: slow."""
    lists: dict[str, tuple[list[int], list[str], list[int]]] = {}
    with read_rows(path) as rows:
        for _, fields in rows:
            point, keypoints_type, pairs = _row(fields)
            points, images, keypoints = lists.setdefault(keypoints_type, ([], [], []))
            for image, keypoint in pairs:
                points.append(point)
                images.append(image)
                keypoints.append(keypoint)
    found = {}
    for keypoints_type, (points, images, keypoints) in sorted(lists.items()):
        names = tuple(sorted(set(images)))
        ids = {name: i for i, name in enumerate(names)}
        found[keypoints_type] = sorted_observations(
            keypoints_type,
            names,
            np.array(points, dtype=np.int64),
            np.array([ids[name] for name in images], dtype=np.int32),
            np.array(keypoints, dtype=np.int32),
        )
    return found


def _row(fields: list[str]) -> tuple[int, str, list[tuple[str, int]]]:
    if len(fields) < 2 or len(fields) % 2:
        raise DataError(f"expected a point, a type and pairs of columns, got {len(fields)} columns")
    point = parse_integer(fields[0], "point id")
    if not 0 <= point < MAX_POINT_ID:
        raise DataError(f"point id {point} is out of range")
    keypoints_type = check_component(fields[1])
    images = [check_relative(name) for name in fields[2::2]]
    keypoints = [parse_integer(text, "keypoint id") for text in fields[3::2]]
    for keypoint in keypoints:
        if not 0 <= keypoint <= MAX_KEYPOINT_ID:
            raise DataError(f"keypoint id {keypoint} is out of range")
    return point, keypoints_type, list(zip(images, keypoints, strict=True))


def find_observation(
    path: Path, keypoints_type: str, point_id: int, image: str, keypoint_id: int
) -> int | None:
    """Line of ``observations.txt`` that holds an observation; slow, for error messages."""
    with read_rows(path) as rows:
        for line, fields in rows:
            point, found_type, pairs = _row(fields)
            if (point, found_type) == (point_id, keypoints_type) and (image, keypoint_id) in pairs:
                return line
    return None


def sorted_observations(
    keypoints_type: str,
    image_names: tuple[str, ...],
    point_ids: NDArray[np.int64],
    image_ids: NDArray[np.int32],
    keypoint_ids: NDArray[np.int32],
) -> Observations:
    """Observations sorted by point, in the given order among equals."""
    if (point_ids[1:] < point_ids[:-1]).any():
        order = np.argsort(point_ids, kind="stable")
        point_ids, image_ids = point_ids[order], image_ids[order]
        keypoint_ids = keypoint_ids[order]
    return Observations(keypoints_type, image_names, point_ids, image_ids, keypoint_ids)


# ------------------------------------------------------------------- the compiled reader


class _Chunk(NamedTuple):
    """Whole lines ``content[begin:end]`` of a file, which zeros follow."""

    content: bytearray
    begin: int
    end: int
    first_line: int
    num_lines: int


class _Parsed(NamedTuple):
    """The observations of a chunk, ids by the chunk's own names; ``refused``: a line not plain."""

    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int32]
    keypoint_ids: NDArray[np.int32]
    type_ids: NDArray[np.int32]
    images: list[bytes]
    types: list[bytes]
    refused: int | None


def _read_compiled(path: Path, chunk_bytes: int) -> dict[str, Observations] | None:
    """Read with the compiled loops; None where a line or a name is unusual.

    Raises DataError: a line is wrong, or the file cannot be read.
    """
    parts = []
    for chunk, parsed in _parsed_chunks(path, chunk_bytes):
        if parsed.refused is not None:
            _check_refused(path, chunk, parsed.refused)
            return None
        parts.append(parsed)
    try:
        images, image_ids = _common_names([part.images for part in parts])
        types, type_ids = _common_names([part.types for part in parts])
        for name in types:
            check_component(name)
        if any(check_relative(name) != name.strip() for name in images):
            return None
    except (UnicodeDecodeError, DataError):
        return None  # the plain reader names the line
    found = {}
    for index, keypoints_type in enumerate(types):
        rows = [
            np.flatnonzero(ids[part.type_ids] == index)
            if len(part.types) > 1
            else slice(None if index in ids else 0)
            for part, ids in zip(parts, type_ids, strict=True)
        ]
        chosen = [
            ids[part.image_ids[r]] for part, ids, r in zip(parts, image_ids, rows, strict=True)
        ]
        of_type, names = np.concatenate(chosen), tuple(images)
        if len(types) > 1:
            used, inverse = np.unique(of_type, return_inverse=True)
            of_type, names = inverse.astype(np.int32), tuple(images[i] for i in used.tolist())
        found[keypoints_type] = sorted_observations(
            keypoints_type,
            names,
            np.concatenate([part.point_ids[r] for part, r in zip(parts, rows, strict=True)]),
            of_type,
            np.concatenate([part.keypoint_ids[r] for part, r in zip(parts, rows, strict=True)]),
        )
    return found


def _parsed_chunks(path: Path, chunk_bytes: int) -> Iterator[tuple[_Chunk, _Parsed]]:
    """Every chunk with its observations, in order; few chunks are in memory at a time."""
    threads = max(1, min(_THREADS, os.cpu_count() or 1))
    pending: deque[tuple[_Chunk, Future[_Parsed]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for chunk in _chunks(path, chunk_bytes):
            pending.append((chunk, pool.submit(_parse, chunk)))
            if len(pending) > threads:
                first, future = pending.popleft()
                yield first, future.result()
        for first, future in pending:
            yield first, future.result()


def _chunks(path: Path, chunk_bytes: int) -> Iterator[_Chunk]:
    """Chunks of whole lines; a missing last line break is added, the version is checked."""
    from megloc_kapture.io.kapture.observation_kernels import PADDING

    line, rest = 1, b""
    with reading(path), open(path, "rb", buffering=0) as file:
        while True:
            content = bytearray((len(rest) + chunk_bytes + PADDING + 7) // 8 * 8)
            content[: len(rest)] = rest
            read = file.readinto(memoryview(content)[len(rest) : len(rest) + chunk_bytes])
            filled = len(rest) + read
            if not filled:
                return
            if not read:
                content[filled] = 10  # the last line lacks its break
                filled += 1
            end = content.rfind(b"\n", 0, filled) + 1
            rest = bytes(content[end:filled])
            if len(rest) > _MAX_LINE_BYTES:
                line += _count(content, b"\n", 0, end)
                text = f"a line of more than {_MAX_LINE_BYTES} bytes"
                raise DataError(text, path=path, line=line)
            if not end:
                continue  # a line longer than a chunk
            content[end:filled] = bytes(filled - end)
            begin = 0
            if line == 1:
                begin = len(BYTE_ORDER_MARK) if content.startswith(BYTE_ORDER_MARK) else 0
                head = content[begin : content.index(b"\n")].decode(errors="replace")
                check_version(path, head, required=False)
            num_lines = _count(content, b"\n", begin, end)
            yield _Chunk(content, begin, end, line, num_lines)
            line += num_lines


def _count(content: bytearray, byte: bytes, begin: int, end: int) -> int:
    # of many, several times as fast as bytearray.count
    return int(np.count_nonzero(np.frombuffer(content, np.uint8)[begin:end] == ord(byte)))


def _parse(chunk: _Chunk) -> _Parsed:
    from megloc_kapture.io.kapture.observation_kernels import parse_observations

    content, begin, end = chunk.content, chunk.begin, chunk.end
    text, words = np.frombuffer(content, np.uint8), np.frombuffer(content, np.uint64)
    room = _count(content, b",", begin, end) // 2 + 1
    images, types = _name_table(room), _name_table(chunk.num_lines)
    points, image_ids = np.empty(room, np.int64), np.empty(room, np.int32)
    keypoints, type_ids = np.empty(room, np.int32), np.empty(room, np.int32)
    out = (points, image_ids, keypoints, type_ids)
    stopped, read = parse_observations(text, words, begin, end, images, types, out)
    names = [
        [bytes(content[first:last]) for first, last in spans[: count[0]].tolist()]
        for _, spans, count in (images, types)
    ]
    return _Parsed(
        points[:read],
        image_ids[:read],
        keypoints[:read],
        type_ids[:read],
        images=names[0],
        types=names[1],
        refused=None if stopped == end else int(stopped),
    )


def _name_table(room: int) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int64]]:
    """A hash table of the compiled loop for so many names: it need not grow."""
    slots = np.full(1 << (2 * room + 1).bit_length(), -1, np.int32)
    return slots, np.empty((room, 2), np.int64), np.zeros(1, np.int64)


def _common_names(of_parts: Sequence[list[bytes]]) -> tuple[list[str], list[NDArray[np.int32]]]:
    """Sorted names of all parts, and for each part its ids' indices into them."""
    merged = sorted({name for names in of_parts for name in names})
    index = {name: i for i, name in enumerate(merged)}
    ids = [np.array([index[name] for name in names], dtype=np.int32) for names in of_parts]
    return [name.decode("utf-8") for name in merged], ids


def _check_refused(path: Path, chunk: _Chunk, begin: int) -> None:
    """Raise where the line that the loop refused is wrong, and not merely unusual."""
    number = chunk.first_line + _count(chunk.content, b"\n", 0, begin)
    try:
        line = chunk.content[begin : chunk.content.index(b"\n", begin)].decode("utf-8")
    except UnicodeDecodeError:
        raise DataError("not a text file in UTF-8", path=path, line=number) from None
    # a comment in another script, or a line blank but for its spaces, is no row
    if line.strip() and not line.startswith("#"):
        with named(path, number):
            _row(split_fields(line))


# ------------------------------------------------------------------------------------ writing


def write_observations(
    root: Path,
    observations: Mapping[str, Observations],
    *,
    large_rows: int = LARGE_ROWS,
) -> None:
    """Write ``reconstruction/observations.txt``: sorted by point, then by type.

    Raises
    ------
    ValueError : arrays of different length, or ids out of range.
    DataError : a name that cannot stand in the file.
    OutputError : cannot be written.
    """
    for keypoints_type, of_type in observations.items():
        _check_writable(keypoints_type, of_type)
    folder = check_output(Path(root), Path(root) / "reconstruction")
    with atomic_write(folder / "observations.txt") as file:
        file.write(f"{FORMAT_LINE}\n{OBSERVATIONS_HEADER}\n".encode())
        for text in _texts(observations, large_rows):
            file.write(text)


def _texts(observations: Mapping[str, Observations], large: int) -> Iterator[bytes]:
    """Text of the rows; that of several types, which is rare, always by the plain writer."""
    parts = [
        sorted_observations(
            name,
            of_type.image_names,
            np.asarray(of_type.point_ids, dtype=np.int64),
            np.asarray(of_type.image_ids, dtype=np.int32),
            np.asarray(of_type.keypoint_ids, dtype=np.int32),
        )
        for name, of_type in sorted(observations.items())
    ]
    if len(parts) == 1 and len(parts[0]) >= large:
        from megloc_kapture.io.kapture.observation_kernels import written_rows

        yield from written_rows(parts[0])
    elif parts:
        for text in _plain_texts(parts):
            yield text.encode()


def _plain_texts(of_types: Sequence[Observations]) -> Iterator[str]:
    """Text of the rows, in blocks of some thousand points."""
    parts = [(ordered, [f", {name}, " for name in ordered.image_names]) for ordered in of_types]
    present = [ordered.point_ids for ordered, _ in parts]
    points = np.unique(np.concatenate(present))
    for start in range(0, len(points), _POINTS_AT_ONCE):
        block = points[start : start + _POINTS_AT_ONCE]
        rows: list[tuple[int, str]] = []
        for ordered, texts in parts:
            first, last = np.searchsorted(ordered.point_ids, [block[0], block[-1] + 1])
            if first == last:  # this type sees no point of the block
                continue
            ids = ordered.point_ids[first:last]
            tokens = [
                texts[image] + str(keypoint)
                for image, keypoint in zip(
                    ordered.image_ids[first:last].tolist(),
                    ordered.keypoint_ids[first:last].tolist(),
                    strict=True,
                )
            ]
            starts = np.flatnonzero(np.diff(ids, prepend=-1)).tolist()
            for point, begin, end in zip(
                ids[starts].tolist(), starts, [*starts[1:], len(tokens)], strict=True
            ):
                row = f"{point}, {ordered.keypoints_type}{''.join(tokens[begin:end])}\n"
                rows.append((point, row))
        if len(parts) > 1:
            rows.sort(key=lambda row: row[0])  # stable: types stay sorted within a point
        yield "".join(row for _, row in rows)


def _check_writable(keypoints_type: str, observations: Observations) -> None:
    check_component(keypoints_type)
    for name in observations.image_names:
        check_field(name)
    count = len(observations.point_ids)
    if len(observations.image_ids) != count or len(observations.keypoint_ids) != count:
        raise ValueError("point_ids, image_ids and keypoint_ids differ in length")
    if count == 0:
        return
    limits = (
        ("point_ids", observations.point_ids, MAX_POINT_ID),
        ("image_ids", observations.image_ids, len(observations.image_names)),
        ("keypoint_ids", observations.keypoint_ids, MAX_KEYPOINT_ID + 1),
    )
    for what, ids, limit in limits:
        if not np.issubdtype(np.asarray(ids).dtype, np.integer):
            raise ValueError(f"{what} are not integers")
        if int(np.min(ids)) < 0 or int(np.max(ids)) >= limit:
            raise ValueError(f"{what} are out of range")
