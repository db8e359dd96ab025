"""``reconstruction/observations.txt``: the keypoints that observe each 3D point of a map.

kapture's reader takes half a minute for ten million observations; this one fills flat arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from heapq import merge
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import atomic_write, check_component, check_relative, reading
from megloc_kapture.io.kapture.format import FORMAT_LINE, check_field, check_version

OBSERVATIONS_HEADER = "# point3d_id, keypoints_type, [image_path, feature_id]*"
_MAX_KEYPOINT_ID = 2**31 - 1
_BLOCK_CHARACTERS = 1 << 22
_ROWS_AT_ONCE = 1 << 14


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of 3D points, sorted by point, in file order among equals.

    ``image_ids`` index the sorted ``image_names``; ``keypoint_ids`` are rows of their keypoints.
    """

    keypoints_type: str
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
            self.keypoints_type,
            self.image_names,
            self.point_ids[order],
            self.image_ids[order],
            self.keypoint_ids[order],
        )


# ------------------------------------------------------------------------------------ reading


class _Numbers(dict[str, int]):
    """Numbers names in order of appearance and checks each once."""

    def __init__(self, check: Callable[[str], str]) -> None:
        super().__init__()
        self._check = check
        self.names: dict[str, int] = {}

    def __missing__(self, text: str) -> int:
        name = self._check(text.strip())
        self[text] = number = self.names.setdefault(name, len(self.names))
        return number


class _Block(NamedTuple):
    point_ids: NDArray[np.int64]
    type_ids: NDArray[np.int32]
    image_ids: NDArray[np.int32]
    keypoint_ids: NDArray[np.int32]


def read_observations(path: Path) -> dict[str, Observations]:
    images, types = _Numbers(check_relative), _Numbers(check_component)
    blocks: list[_Block] = []
    number = 1
    with reading(path), open(path, encoding="utf-8-sig") as file:
        while lines := _read_lines(file.readlines, path):
            if number == 1:
                check_version(path, lines[0], required=False)
            try:
                blocks.append(_parse(lines, images, types))
            except (ValueError, OverflowError, DataError):
                _raise_for_line(path, lines, number, images, types)
                raise
            number += len(lines)
    if not blocks:
        return {}
    points, type_ids, image_ids, keypoints = (
        np.concatenate(ids) for ids in zip(*blocks, strict=True)
    )
    names = np.array(list(images.names))
    found = {}
    for keypoints_type, type_id in sorted(types.names.items()):
        rows = slice(None) if len(types.names) == 1 else type_ids == type_id
        used = np.flatnonzero(np.bincount(image_ids[rows], minlength=len(names)))
        used = used[np.argsort(names[used])]
        rank = np.empty(len(names), np.int32)
        rank[used] = np.arange(len(used))
        found[keypoints_type] = Observations(
            keypoints_type,
            tuple(names[used].tolist()),
            points[rows],
            rank[image_ids[rows]],
            keypoints[rows],
        ).sorted_by_point()
    return found


def _read_lines(readlines: Callable[[int], list[str]], path: Path) -> list[str]:
    try:
        return readlines(_BLOCK_CHARACTERS)
    except UnicodeDecodeError as error:
        raise DataError("not a text file in UTF-8", path=path) from error


def _parse(lines: Sequence[str], images: _Numbers, types: _Numbers) -> _Block:
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
        row_types.append(keypoints_type)
        counts.append(len(pairs))
        names += pairs[::2]
        keypoints += pairs[1::2]
    per_row = np.array(counts, dtype=np.int64)
    point_ids = _integers(points)
    type_ids = np.fromiter(map(types.__getitem__, row_types), np.int32, len(row_types))
    keypoint_ids = _integers(keypoints)
    if (per_row % 2).any() or (point_ids < 0).any():
        raise ValueError
    if len(keypoints) and not 0 <= keypoint_ids.min() <= keypoint_ids.max() <= _MAX_KEYPOINT_ID:
        raise ValueError
    image_ids = np.fromiter(map(images.__getitem__, names), np.int32, len(names))
    return _Block(
        np.repeat(point_ids, per_row // 2),
        np.repeat(type_ids, per_row // 2),
        image_ids,
        keypoint_ids.astype(np.int32),
    )


def _integers(texts: Sequence[str]) -> NDArray[np.int64]:
    """Parse int64 in a quarter of the time of ``int``; ValueError for other text."""
    if not texts:
        return np.zeros(0, np.int64)
    numbers = np.fromstring(",".join(texts), np.int64, sep=",")
    if len(numbers) != len(texts):
        raise ValueError("not an integer")
    return numbers


def _raise_for_line(
    path: Path, lines: Sequence[str], first: int, images: _Numbers, types: _Numbers
) -> None:
    for number, line in enumerate(lines, first):
        try:
            _parse([line], images, types)
        except (ValueError, OverflowError) as error:
            message = f"expected {OBSERVATIONS_HEADER.removeprefix('# ')}, ids from 0 on"
            raise DataError(message, path=path, line=number) from error
        except DataError as error:
            raise DataError(error.message, path=path, line=number) from error


# ------------------------------------------------------------------------------------ writing


def write_observations(root: Path, observations: Mapping[str, Observations]) -> None:
    """Write ``reconstruction/observations.txt``, sorted by point, then by type."""
    for keypoints_type, of_type in observations.items():
        check_component(keypoints_type)
        for name in of_type.image_names:
            check_field(name)
    # point and type of a row are unique
    rows = merge(*(_rows(name, of_type) for name, of_type in sorted(observations.items())))
    with atomic_write(Path(root) / "reconstruction" / "observations.txt") as file:
        file.write(f"{FORMAT_LINE}\n{OBSERVATIONS_HEADER}\n".encode())
        block: list[str] = []
        for point, keypoints_type, pairs in rows:
            block.append(f"{point}, {keypoints_type}{pairs}\n")
            if len(block) == _ROWS_AT_ONCE:
                file.write("".join(block).encode())
                block.clear()
        file.write("".join(block).encode())


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
