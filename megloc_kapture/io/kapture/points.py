"""3D points of a kapture map with their observations and covariances, and PLY files for viewers.

kapture's reader takes half a minute for ten million observations; this one is faster, because it
fills flat arrays.
"""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from heapq import merge
from itertools import count, islice, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import (
    atomic_write,
    check_component,
    check_relative,
    named,
    reading,
)
from megloc_kapture.io.kapture.format import FORMAT_LINE, check_version

POINTS_HEADERS = {3: "# X, Y, Z", 6: "# X, Y, Z, R, G, B"}
COVARIANCES_FILE = "reconstruction/point_covariances.npy"

OBSERVATIONS_HEADER = "# point3d_id, keypoints_type, [image_path, feature_id]*"
_MAX_KEYPOINT_ID = 2**31 - 1
_BLOCK_CHARACTERS = 1 << 22
_ROWS_AT_ONCE = 1 << 16
_PLY_TYPES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}


def read_points3d(path: Path) -> NDArray[np.float64]:
    """Read ``points3d.txt`` as float64 (N, 6): X Y Z R G B, colours 0 if missing."""
    what = "a table with 3 or 6 columns in every row"
    with reading(path, what), open(path, encoding="utf-8-sig", errors="replace") as file:
        check_version(path, file.readline(), required=False)
        file.seek(0)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            points = np.loadtxt(file, delimiter=",", comments="#", ndmin=2)
    if points.size == 0:
        return np.zeros((0, 6))
    if points.shape[1] not in POINTS_HEADERS:
        raise DataError(f"expected 3 or 6 columns, got {points.shape[1]}", path=path)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise DataError(f"point {bad[0]} is not finite", path=path)
    return points if points.shape[1] == 6 else np.pad(points, ((0, 0), (0, 3)))


def write_points3d(root: Path, points: ArrayLike) -> None:
    """Write ``reconstruction/points3d.txt``, (N, 3) or (N, 6) with colours, without loss."""
    rows = np.asarray(points, dtype=np.float64)
    pattern = ",".join(["%r"] * rows.shape[1]) + "\n"
    with atomic_write(Path(root) / "reconstruction" / "points3d.txt") as file:
        file.write(f"{FORMAT_LINE}\n{POINTS_HEADERS[rows.shape[1]]}\n".encode())
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            block = rows[start : start + _ROWS_AT_ONCE]
            file.write((pattern * len(block) % tuple(block.ravel().tolist())).encode())


# ---------------------------------------------------------------------------- observations


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of 3D points by keypoints of one type.

    They are sorted by point; those of one point are in file order. ``image_ids`` index the sorted
    ``image_names``; ``keypoint_ids`` are rows of the keypoints of these images.
    """

    image_names: tuple[str, ...]
    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int32]
    keypoint_ids: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.point_ids)

    def sorted_by_point(self) -> Observations:
        if not (np.diff(self.point_ids) < 0).any():
            return self
        order = np.argsort(self.point_ids, kind="stable")
        return Observations(
            self.image_names,
            self.point_ids[order],
            self.image_ids[order],
            self.keypoint_ids[order],
        )


def rows_by_id(ids: NDArray[np.integer], count: int) -> list[NDArray[np.int64]]:
    """Return, for each id from 0 to ``count`` - 1, its rows in ``ids`` (O,), ascending."""
    # numpy sorts 16-bit integers in linear time
    order = np.argsort(ids.astype(np.uint16) if count < 1 << 16 else ids, kind="stable")
    return np.split(order, np.cumsum(np.bincount(ids, minlength=count))[:-1])


def read_observations(path: Path) -> dict[str, Observations]:
    """Read ``observations.txt`` by keypoints type."""
    images, types = _numbers(), _numbers()
    blocks: list[tuple[NDArray[np.integer], ...]] = []
    with reading(path), named(path), open(path, encoding="utf-8-sig") as file:
        try:
            while lines := file.readlines(_BLOCK_CHARACTERS):
                if not blocks:
                    check_version(path, lines[0], required=False)
                blocks.append(_parse(lines, images, types))
        except UnicodeDecodeError as error:
            raise DataError("not a text file in UTF-8") from error
        except (ValueError, OverflowError) as error:
            message = f"expected {OBSERVATIONS_HEADER.removeprefix('# ')}, with ids of 0 or more"
            remedy = "files of kapture 1.0 have no type: run kapture_upgrade_1_0_to_1_1"
            raise DataError(f"{message}; {remedy}") from error
    if not blocks:
        return {}
    points, type_ids, image_ids, keypoints = (
        np.concatenate(ids) for ids in zip(*blocks, strict=True)
    )
    names = np.array(list(images))
    by_type = {}
    for keypoints_type, type_id in sorted(types.items()):
        rows = slice(None) if len(types) == 1 else type_ids == type_id
        used = np.flatnonzero(np.bincount(image_ids[rows], minlength=len(names)))
        used = used[np.argsort(names[used])]
        rank = np.empty(len(names), np.int32)
        rank[used] = np.arange(len(used))
        by_type[keypoints_type] = Observations(
            tuple(names[used].tolist()),
            points[rows],
            rank[image_ids[rows]],
            keypoints[rows],
        ).sorted_by_point()
    return by_type


def _numbers() -> defaultdict[str, int]:
    """Number names in the order of their first use."""
    return defaultdict(count().__next__)


def _parse(
    lines: Sequence[str], images: dict[str, int], types: dict[str, int]
) -> tuple[NDArray[np.integer], ...]:
    """Return the ids of point, type, image and keypoint of each observation, as arrays."""
    points: list[str] = []
    row_types: list[str] = []
    counts: list[int] = []
    names: list[str] = []
    keypoints: list[str] = []
    for line in lines:
        if line.startswith("#") or line.isspace():
            continue
        point, keypoints_type, *pairs = line.split(",")
        points.append(point)
        row_types.append(keypoints_type.strip())
        counts.append(len(pairs))
        names += map(str.strip, pairs[::2])
        keypoints += pairs[1::2]
    per_row = np.array(counts, dtype=np.int64)
    point_ids = _integers(points)
    keypoint_ids = _integers(keypoints)
    if (per_row % 2).any() or (point_ids < 0).any():
        raise ValueError
    if len(keypoints) and not 0 <= keypoint_ids.min() <= keypoint_ids.max() <= _MAX_KEYPOINT_ID:
        raise ValueError
    num_images, num_types = len(images), len(types)
    type_ids = np.fromiter(map(types.__getitem__, row_types), np.int32, len(row_types))
    image_ids = np.fromiter(map(images.__getitem__, names), np.int32, len(names))
    for name in islice(types, num_types, None):
        check_component(name)
    for name in islice(images, num_images, None):
        check_relative(name)
    return (
        np.repeat(point_ids, per_row // 2),
        np.repeat(type_ids, per_row // 2),
        image_ids,
        keypoint_ids.astype(np.int32),
    )


def _integers(texts: Sequence[str]) -> NDArray[np.int64]:
    """Parse int64 four times as fast as ``int``; ValueError for any other text."""
    if not texts:
        return np.zeros(0, np.int64)
    numbers = np.fromstring(",".join(texts), np.int64, sep=",")
    if len(numbers) != len(texts):
        raise ValueError("not an integer")
    return numbers


def write_observations(root: Path, observations: Mapping[str, Observations]) -> None:
    """Write ``reconstruction/observations.txt``, sorted by point, then by type."""
    # merge never compares the texts, because each pair of point and type has a single row
    rows = merge(*(_rows(name, of_type) for name, of_type in sorted(observations.items())))
    with atomic_write(Path(root) / "reconstruction" / "observations.txt") as file:
        file.write(f"{FORMAT_LINE}\n{OBSERVATIONS_HEADER}\n".encode())
        file.writelines(f"{point}, {name}{pairs}\n".encode() for point, name, pairs in rows)


def _rows(keypoints_type: str, observations: Observations) -> Iterator[tuple[int, str, str]]:
    """Yield point, type and text of the pairs of each row."""
    ordered = observations.sorted_by_point()
    points = np.asarray(ordered.point_ids)
    names = [f", {name}, " for name in ordered.image_names]
    starts = np.flatnonzero(np.diff(points, prepend=-1))
    for begin, end in pairwise([*starts.tolist(), len(points)]):
        images, keypoints = ordered.image_ids[begin:end], ordered.keypoint_ids[begin:end]
        pairs = zip(images.tolist(), keypoints.tolist(), strict=True)
        text = "".join([f"{names[image]}{keypoint}" for image, keypoint in pairs])
        yield int(points[begin]), keypoints_type, text


# ----------------------------------------------------------------------------- covariances


def write_point_covariances(root: Path, covariances: NDArray[np.float64]) -> None:
    """Write the covariances (N, 6) of points for keypoint noise of 1 px.

    The columns are xx, xy, xz, yy, yz, zz; NaN where unknown.
    """
    with atomic_write(root / COVARIANCES_FILE) as file:
        np.save(file, np.ascontiguousarray(covariances, dtype=np.float64), allow_pickle=False)


def read_point_covariances(root: Path, num_points: int) -> NDArray[np.float64] | None:
    """Return the covariances (N, 6) of a map's points, memory-mapped; None without the file."""
    path = root / COVARIANCES_FILE
    if not path.is_file():
        return None
    if num_points == 0:
        return np.zeros((0, 6))  # an empty file cannot be mapped
    with reading(path, "a NumPy array"):
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    require(
        array.dtype == np.float64 and array.shape == (num_points, 6),
        f"the array is {array.dtype} {array.shape}, not float64 ({num_points}, 6): a row per point",
        path=path,
    )
    return np.asarray(array)


# ------------------------------------------------------------------------------------ viewers


def write_ply(
    path: Path,
    xyz: ArrayLike,
    colours: ArrayLike,
    edges: Sequence[tuple[int, int]] = (),
    **properties: ArrayLike,
) -> None:
    """Write points, as float64, and ``edges`` between them (pairs of rows) as a binary PLY file.

    Colours are RGB; further ``properties`` (N,) are written as float32.
    """
    xyz, colours = np.asarray(xyz, dtype=np.float64), np.asarray(colours, dtype=np.uint8)
    columns = [
        *zip("xyz", xyz.T, ["<f8"] * 3, strict=True),
        *zip(("red", "green", "blue"), colours.T, ["|u1"] * 3, strict=True),
        *((name, np.asarray(values), "<f4") for name, values in properties.items()),
    ]
    rows = np.empty(len(xyz), dtype=[(name, kind) for name, _, kind in columns])
    for name, values, _ in columns:
        rows[name] = values
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {_PLY_TYPES[kind]} {name}" for name, _, kind in columns]
    if edges:
        header += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2"]
    with atomic_write(path) as file:
        file.write("\n".join([*header, "end_header", ""]).encode())
        file.write(rows.tobytes())
        file.write(np.array(edges, dtype="<i4").tobytes())
