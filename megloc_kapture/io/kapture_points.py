"""3D points and their observations: the two large text files of a map.

The grammar is written here once, in plain Python, and is what reads small files. Files of some
megabytes go through the compiled loops of ``text_kernels.py`` (numba, which kapture needs anyway):
for a map of a million points and ten million observations they take about a second where kapture
takes half a minute. numpy alone was tried: finding the fields, converting the ids and hashing the
names of ten million observations, without checking any of it, took 1.8 s of processor time where
the loops, which check everything, take 1.0 s and share the work between two threads. The loops
accept only the plain form of the grammar and give every other line back to the parser here, so
both readers agree, and errors name file and line either way.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import atomic_write
from megloc_kapture.io.kapture_csv import (
    BYTE_ORDER_MARK,
    FORMAT_LINE,
    parse_float,
    parse_integer,
    read_rows,
    split_fields,
)
from megloc_kapture.io.kapture_features import check_field
from megloc_kapture.io.paths import check_component, check_output, check_relative

if TYPE_CHECKING:
    from megloc_kapture.io.large_text import ObservationArrays

POINTS_HEADERS = {3: "# X, Y, Z", 6: "# X, Y, Z, R, G, B"}
OBSERVATIONS_HEADER = "# point3d_id, keypoints_type, [image_path, feature_id]*"
MAX_KEYPOINT_ID = 2**31 - 1
MAX_POINT_ID = 2**62

# below this the plain readers take less time than importing numba
LARGE_BYTES = 1 << 22
LARGE_ROWS = 1 << 17

_ROWS_AT_ONCE = 1 << 16
_NUMBER_CHARACTERS = re.compile(r"[0-9eE.+\-]+")


@dataclass(frozen=True, eq=False)
class Observations:
    """Which keypoint of which image sees which 3D point, for one keypoints type.

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


def read_points3d(path: Path, *, large_bytes: int = LARGE_BYTES) -> NDArray[np.float64]:
    """Read ``points3d.txt`` as float64 (N, 6): X Y Z R G B, colours 0 where there are none.

    Raises
    ------
    DataError : names file and line.
    """
    read = None
    if _size(path) >= large_bytes:
        from megloc_kapture.io import large_text

        columns = _first_row_length(path)
        if columns in POINTS_HEADERS:

            def check(line: str, number: int) -> None:
                _coordinates(split_fields(line), columns, path, number)

            read = large_text.read_point_rows(path, columns, check)
    if read is None:
        read = read_points3d_strictly(path)
    if read.shape[1] == 6:
        return read
    return np.concatenate([read, np.zeros((len(read), 3))], axis=1)


def read_points3d_strictly(path: Path) -> NDArray[np.float64]:
    """The grammar of ``points3d.txt`` in plain Python: slow, (N, 3) or (N, 6)."""
    values: list[float] = []
    columns = 0
    for line, fields in read_rows(path):
        columns = columns or len(fields)
        values += _coordinates(fields, columns, path, line)
    return np.array(values, dtype=np.float64).reshape(-1, columns or 6)


def read_observations(path: Path, *, large_bytes: int = LARGE_BYTES) -> dict[str, Observations]:
    """Read ``observations.txt``, by keypoints type.

    Raises
    ------
    DataError : names file and line.
    """
    found = None
    if _size(path) >= large_bytes:
        from megloc_kapture.io import large_text

        def check(line: str, number: int) -> None:
            _row(split_fields(line), path, number)

        arrays = large_text.read_observation_arrays(path, check)
        found = None if arrays is None else _by_type(arrays)
    return read_observations_strictly(path) if found is None else found


def read_observations_strictly(path: Path) -> dict[str, Observations]:
    """The grammar of ``observations.txt`` in plain Python: slow."""
    lists: dict[str, tuple[list[int], list[str], list[int]]] = {}
    for line, fields in read_rows(path):
        point, keypoints_type, pairs = _row(fields, path, line)
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


def _size(path: Path) -> int:
    try:
        return path.stat().st_size if path.is_file() else -1
    except OSError:
        return -1  # the plain reader says what is wrong with it


def _first_row_length(path: Path) -> int:
    """Number of columns of the first row; 0 where it is not found soon."""
    with open(path, "rb") as file:
        for line in file.read(1 << 16).split(b"\n"):
            if line.strip() and not line.removeprefix(BYTE_ORDER_MARK).startswith(b"#"):
                return line.count(b",") + 1
    return 0


def _by_type(arrays: ObservationArrays) -> dict[str, Observations] | None:
    """Arrays of the compiled reader as observations; None where a name is not plain."""
    try:
        names = [name.decode("utf-8") for name in arrays.image_names]
        types = [check_component(name.decode("utf-8")) for name in arrays.type_names]
        if any(check_relative(name) != name.strip() for name in names):
            return None
    except (UnicodeDecodeError, DataError):
        return None  # the plain reader names the line
    found = {}
    for index, keypoints_type in enumerate(types):
        points, images, keypoints = arrays.point_ids, arrays.image_ids, arrays.keypoint_ids
        present = tuple(names)
        if len(types) > 1:
            rows = np.flatnonzero(arrays.type_ids == index)
            points, keypoints = points[rows], keypoints[rows]
            used, inverse = np.unique(images[rows], return_inverse=True)
            images = inverse.astype(np.int32)
            present = tuple(names[i] for i in used.tolist())
        found[keypoints_type] = sorted_observations(
            keypoints_type, present, points, images, keypoints
        )
    return dict(sorted(found.items()))


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
        point_ids, image_ids, keypoint_ids = (
            point_ids[order],
            image_ids[order],
            keypoint_ids[order],
        )
    return Observations(keypoints_type, image_names, point_ids, image_ids, keypoint_ids)


def _coordinates(fields: list[str], columns: int, path: Path, line: int) -> list[float]:
    if columns not in POINTS_HEADERS or len(fields) != columns:
        expected = str(columns) if columns in POINTS_HEADERS else "3 or 6"
        raise DataError(f"expected {expected} columns, got {len(fields)}", path=path, line=line)
    # of these characters float() accepts exactly our grammar, and is faster than a pattern
    if _NUMBER_CHARACTERS.fullmatch("".join(fields)):
        with contextlib.suppress(ValueError):
            values = [float(text) for text in fields]
            if all(map(math.isfinite, values)):
                return values
    return [parse_float(text, "coordinate", path, line) for text in fields]


def _row(fields: list[str], path: Path, line: int) -> tuple[int, str, list[tuple[str, int]]]:
    if len(fields) < 2 or len(fields) % 2:
        raise DataError(
            f"expected a point, a type and pairs of columns, got {len(fields)} columns",
            path=path,
            line=line,
        )
    point = parse_integer(fields[0], "point id", path, line)
    if not 0 <= point < MAX_POINT_ID:
        raise DataError(f"point id {point} is out of range", path=path, line=line)
    try:
        keypoints_type = check_component(fields[1])
        images = [check_relative(name) for name in fields[2::2]]
    except DataError as error:
        raise DataError(error.message, path=path, line=line) from None
    keypoints = [parse_integer(text, "keypoint id", path, line) for text in fields[3::2]]
    for keypoint in keypoints:
        if not 0 <= keypoint <= MAX_KEYPOINT_ID:
            raise DataError(f"keypoint id {keypoint} is out of range", path=path, line=line)
    return point, keypoints_type, list(zip(images, keypoints, strict=True))


def find_observation(
    path: Path, keypoints_type: str, point_id: int, image: str, keypoint_id: int
) -> int | None:
    """Line of ``observations.txt`` that holds an observation; slow, for error messages."""
    for line, fields in read_rows(path):
        point, found_type, pairs = _row(fields, path, line)
        if (point, found_type) == (point_id, keypoints_type) and (image, keypoint_id) in pairs:
            return line
    return None


# ------------------------------------------------------------------------------------ writing


def write_points3d(root: Path, points: ArrayLike, *, large_rows: int = LARGE_ROWS) -> None:
    """Write ``reconstruction/points3d.txt``: (N, 3) coordinates or (N, 6) with colours.

    Raises
    ------
    ValueError : another shape, or values that are not finite.
    OutputError : cannot be written.
    """
    rows = np.asarray(points, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] not in POINTS_HEADERS:
        raise ValueError(f"expected points of shape (N, 3) or (N, 6), got {rows.shape}")
    if not np.isfinite(rows).all():
        raise ValueError("points are not finite")
    with atomic_write(_output(root, "points3d.txt")) as file:
        file.write(f"{FORMAT_LINE}\n{POINTS_HEADERS[rows.shape[1]]}\n".encode())
        for text in _point_texts(rows, large_rows):
            file.write(text)


def _point_texts(rows: NDArray[np.float64], large: int) -> Iterator[bytes]:
    """Text of the rows; each number is the shortest that reads back as the same float64."""
    if len(rows) >= large:
        from megloc_kapture.io.large_text_writing import point_rows

        yield from point_rows(rows)
        return
    pattern = ",".join(["%r"] * rows.shape[1]) + "\n"
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        block = rows[start : start + _ROWS_AT_ONCE]
        yield (pattern * len(block) % tuple(block.ravel().tolist())).encode()


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
    with atomic_write(_output(root, "observations.txt")) as file:
        file.write(f"{FORMAT_LINE}\n{OBSERVATIONS_HEADER}\n".encode())
        for text in _observation_texts(observations, large_rows):
            file.write(text)


def _output(root: Path, name: str) -> Path:
    folder = Path(root) / "reconstruction"
    return check_output(Path(root), folder) / name


def _observation_texts(observations: Mapping[str, Observations], large: int) -> Iterator[bytes]:
    """Text of the rows; that of several types, which is rare, always by the plain writer."""
    parts = [_sorted_part(name, observations[name]) for name in sorted(observations)]
    if len(parts) == 1 and len(parts[0]) >= large:
        from megloc_kapture.io.large_text_writing import observation_rows

        part = parts[0]
        yield from observation_rows(
            part.keypoints_type,
            part.image_names,
            part.point_ids,
            part.image_ids,
            part.keypoint_ids,
        )
    elif parts:
        for text in _observation_lines(parts):
            yield text.encode()


def _sorted_part(keypoints_type: str, of_type: Observations) -> Observations:
    return sorted_observations(
        keypoints_type,
        of_type.image_names,
        np.asarray(of_type.point_ids, dtype=np.int64),
        np.asarray(of_type.image_ids, dtype=np.int32),
        np.asarray(of_type.keypoint_ids, dtype=np.int32),
    )


def _observation_lines(of_types: Sequence[Observations]) -> Iterator[str]:
    """Text of the rows, in blocks of some thousand points."""
    parts = [(ordered, [f", {name}, " for name in ordered.image_names]) for ordered in of_types]
    present = [ordered.point_ids for ordered, _ in parts]
    points = np.unique(np.concatenate(present))
    for start in range(0, len(points), _ROWS_AT_ONCE):
        block = points[start : start + _ROWS_AT_ONCE]
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
