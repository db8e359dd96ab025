"""Matches and pairs of images.

The matches of a pair are stored as SMALLER.overlapping/LARGER.matches, ordered by name, in float64
rows (M, 3): index, index, score. kapture's own writers do not order the names, so both orders are
read. Pairs files are kapture-localization's: query image, map image, score.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import check_relative, safe_join, write_bytes, writing
from megloc_kapture.io.kapture.features import (
    SUFFIX,
    Blob,
    feature_folder,
    find_blob,
    list_blobs,
    open_folders,
)
from megloc_kapture.io.kapture.format import check_columns, format_table, read_rows
from megloc_kapture.io.text_lines import numbers_of

_BETWEEN = ".overlapping/"
_ROW_BYTES = 3 * 8
# kapture stores indices as float64, which is exact up to this value
_MAX_INDEX = 2**53
PAIRS_HEADER = "# query_image, map_image, score"


class MatchesReader:
    """Matches of one keypoints type from several folders; the first that has a pair is used."""

    def __init__(self, type_name: str, folders: Sequence[Path]) -> None:
        self.type_name = type_name
        self._folders = open_folders(folders, "matches")

    @cached_property
    def pairs(self) -> list[tuple[str, str]]:
        pairs = set()
        for name, path in list_blobs(self._folders, "matches").items():
            parts = name.removesuffix(SUFFIX["matches"]).split(_BETWEEN)
            if len(parts) != 2 or parts[0] == parts[1]:
                raise DataError("this is not the name of a pair of images", path=path)
            pairs.add((min(parts), max(parts)))
        return sorted(pairs)

    def __contains__(self, pair: tuple[str, str]) -> bool:
        return self._find(*pair) is not None

    def length(self, a: str, b: str) -> int:
        """Return the number of matches of a pair from its file size; 0 without a file."""
        blob = self._find(a, b)
        return 0 if blob is None else blob.size // _ROW_BYTES

    def read(self, a: str, b: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Read the indices int64 (M, 2) into ``a`` and ``b`` and scores float64 (M,) of a pair."""
        blob = self._find(a, b)
        if blob is None:
            raise DataError(f"no matches of type {self.type_name!r} for {a!r} and {b!r}")
        require(
            blob.size % _ROW_BYTES == 0,
            f"{blob.size} bytes are not whole rows of 3 x float64; truncated?",
            path=blob.where,
        )
        rows = np.frombuffer(blob.read(), dtype="<f8").reshape(-1, 3)
        columns = rows[:, :2]
        with np.errstate(invalid="ignore"):
            valid = (columns >= 0) & (columns < _MAX_INDEX) & (columns == np.floor(columns))
        if not valid.all():
            row = int(np.flatnonzero(~valid.all(axis=1))[0])
            raise DataError(
                f"row {row}: {columns[row].tolist()} are not keypoint indices", path=blob.where
            )
        if blob.name != _name(a, b):
            columns = columns[:, ::-1]
        return columns.astype(np.int64), rows[:, 2].copy()

    def _find(self, a: str, b: str) -> Blob | None:
        first, second = sorted((a, b))
        return find_blob(self._folders, _name(first, second), _name(second, first))


class MatchesWriter:
    """Writer for the matches of one keypoints type; each file is written atomically."""

    def __init__(self, root: Path, type_name: str, *, orphan: bool = False) -> None:
        self._folder = feature_folder(Path(root), "matches", type_name, orphan=orphan)
        with writing(self._folder):
            # kapture finds a type by its folder, so create it even if no pair is written
            self._folder.mkdir(parents=True, exist_ok=True)

    def __contains__(self, pair: tuple[str, str]) -> bool:
        return safe_join(self._folder, _name(min(pair), max(pair))).is_file()

    def write(self, a: str, b: str, indices: ArrayLike, scores: ArrayLike) -> None:
        """Write indices (M, 2) in the order ``a``, ``b`` and scores (M,)."""
        pairs = np.asarray(indices).reshape(-1, 2)
        rows = np.empty((len(pairs), 3), dtype="<f8")
        rows[:, :2] = pairs if a < b else pairs[:, ::-1]
        rows[:, 2] = scores
        write_bytes(safe_join(self._folder, _name(min(a, b), max(a, b))), rows.tobytes())


def _name(first: str, second: str) -> str:
    return f"{first}{_BETWEEN}{second}{SUFFIX['matches']}"


@dataclass(frozen=True, order=True, slots=True)
class ImagePair:
    """Two images to match; a higher score means a better candidate."""

    query: str
    map: str
    score: float


def read_pairs(path: Path | str) -> list[ImagePair]:
    """Read a pairs file in its order, without repeated pairs.

    Pairs without a score (hloc: two names separated by a blank) are ranked in the file's order.
    """
    pairs: list[ImagePair] = []
    seen: set[tuple[str, str]] = set()
    with read_rows(Path(path)) as rows:
        for fields in rows:
            if len(fields) == 1:
                fields = fields[0].split()
            if len(fields) == 2:
                fields = [*fields, str(-len(pairs))]
            check_columns(fields, 3)
            pair = check_relative(fields[0]), check_relative(fields[1])
            (score,) = numbers_of(fields[2:], "score")
            if pair not in seen:
                seen.add(pair)
                pairs.append(ImagePair(*pair, score))
    return pairs


def write_pairs(path: Path | str, pairs: Iterable[ImagePair]) -> None:
    rows = [[pair.query, pair.map, repr(float(pair.score))] for pair in pairs]
    write_bytes(path, format_table(PAIRS_HEADER, rows))
