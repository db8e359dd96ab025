"""COLMAP's databases (sqlite): images, keypoints and descriptors; never written to.

The file is opened as one that nobody changes (``immutable``): sqlite would otherwise put files of
its own beside a database in WAL mode, which is what COLMAP's are, or fail in a read-only folder.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.text_lines import check_plain, image_name
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import named

_SIZE_END = 2**31
# x y; x y scale orientation; x y and an affine shape
_KEYPOINT_COLUMNS = (2, 4, 6)


class FeatureType(NamedTuple):
    """A type of features in a database: what kapture calls it, and the numbers of descriptors."""

    name: str
    dtype: str


# COLMAP's feature/types.h; names are those of our extractors, of their weights where these differ.
# COLMAP keeps all descriptors as bytes, those of networks are float32 behind one another.
_SIFT, _UNDEFINED = 0, -1
_TYPES = {
    _UNDEFINED: FeatureType("colmap-undefined", "u1"),
    _SIFT: FeatureType("sift", "u1"),
    1: FeatureType("aliked-n16rot", "<f4"),
    2: FeatureType("aliked-n32", "<f4"),
    3: FeatureType("loma-b", "<f4"),
    4: FeatureType("loma-b128", "<f4"),
}
_SIFT_SIZE = 128


class ColmapDatabase(AbstractContextManager["ColmapDatabase"]):
    """An open database. Use as a context manager.

    Attributes
    ----------
    images : name (without ``./`` before it) -> id, sorted by name.

    Raises
    ------
    DataError : missing, no COLMAP database, broken, or not closed by who wrote it.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        check_plain(self.path)
        log = self.path.with_name(self.path.name + "-wal")
        if log.is_file() and log.stat().st_size:
            raise DataError(
                f"was not closed: what is in {log.name} is not part of it yet; "
                "open and close it once with COLMAP or sqlite3",
                path=path,
            )
        self._connection = self._connect()
        try:
            with self._reading():
                self._tables = {
                    name
                    for (name,) in self._connection.execute(
                        "SELECT name FROM sqlite_master WHERE type = 'table'"
                    )
                }
            self.images = self._read_images()
        except BaseException:
            self._connection.close()
            raise

    def keypoints(self, name: str) -> NDArray[np.float32]:
        """Keypoints of an image, float32 (N, 2), COLMAP pixels; none is no error.

        DataError where there is no such image, or a row does not fit its own sizes.
        """
        found = self._blob("keypoints", name)
        if found is None:
            return np.empty((0, 2), np.float32)
        rows, columns, content = found
        if columns not in _KEYPOINT_COLUMNS and rows:
            raise self._error(f"keypoints of {name!r} have {columns} columns, not 2, 4 or 6")
        what = f"keypoints of {name!r}"
        array = self._array(content, "<f4", (rows, columns if rows else 2), what)[:, :2]
        if not np.isfinite(array).all():
            raise self._error(f"{what} are not finite")
        return np.ascontiguousarray(array)

    def feature_type(self) -> FeatureType | None:
        """The type of all features; None where there are no descriptors to tell it.

        Types that we do not know have COLMAP's number in their name, and bytes. DataError where
        there are several types.
        """
        if "descriptors" not in self._tables:
            return None
        condition = "WHERE rows > 0"
        if self._has_types():
            kinds: set[Any] = set()
            for (kind,) in self._rows("descriptors", "DISTINCT type", condition):
                self._check_integer(kind, _UNDEFINED, _SIZE_END, "a type of descriptors")
                kinds.add(kind)
        else:  # before version 4; who brought features of his own could not say what they are
            sizes = {size for (size,) in self._rows("descriptors", "DISTINCT cols", condition)}
            kinds = {_SIFT if size == _SIFT_SIZE else _UNDEFINED for size in sizes}
        found = [_TYPES.get(kind) or FeatureType(f"colmap-{kind}", "u1") for kind in kinds]
        if len(found) > 1:
            told = ", ".join(sorted(kind.name for kind in found))
            raise self._error(f"has descriptors of several types: {told}")
        return found[0] if found else None

    def descriptors(self, name: str, expected: FeatureType = _TYPES[_SIFT]) -> NDArray[Any] | None:
        """Descriptors of an image, (N, D) of the type's numbers; None where it has none.

        DataError where image or type are others, or a row does not fit its own sizes.
        """
        found = self._blob("descriptors", name)
        if found is None or found[0] == 0:
            return None
        rows, columns, content = found
        if expected == _TYPES[_SIFT]:
            self._check_sift(name)
        size, rest = divmod(columns, np.dtype(expected.dtype).itemsize)
        if rest:
            raise self._error(f"descriptors of {name!r}: {columns} bytes are no whole numbers")
        array = self._array(content, expected.dtype, (rows, size), f"descriptors of {name!r}")
        if not np.isfinite(array).all():
            raise self._error(f"descriptors of {name!r} are not finite")
        return array

    def __exit__(self, *raised: object) -> None:
        self._connection.close()

    def _connect(self) -> sqlite3.Connection:
        path = quote(str(self.path.resolve()))
        with self._reading():
            connection = sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)
        # what a column computes could be of any length, what stands in the file could not
        longest = max(1_000_000, self.path.stat().st_size)
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(longest, 2**31 - 1))
        return connection

    def _read_images(self) -> dict[str, int]:
        images = {}
        for image_id, name, camera_id in self._rows("images", "image_id, name, camera_id"):
            if not isinstance(name, str) or not isinstance(camera_id, int):
                raise self._error(f"image {image_id!r} has no name or no camera")
            with named(self.path, about=f"image {image_id}"):
                known = image_name(name)
            if known in images:
                raise self._error(f"image {known!r} is listed twice")
            images[known] = int(image_id)
        return dict(sorted(images.items()))

    def _blob(self, table: str, name: str) -> tuple[int, int, Any] | None:
        """(rows, columns, content) of an image in a table; None where it is not there."""
        if name not in self.images:
            raise self._error(f"has no image {name!r}")
        if table not in self._tables:
            return None
        found = list(
            self._rows(table, "rows, cols, data", f"WHERE image_id = {self.images[name]:d}")
        )
        if not found:
            return None
        rows, columns, content = found[0]
        for value, what in ((rows, "rows"), (columns, "columns")):
            self._check_integer(value, 0, _SIZE_END, f"{table} of {name!r}: {what}")
        return rows, columns, content

    def _array(self, content: Any, dtype: str, shape: tuple[int, ...], what: str) -> NDArray[Any]:
        content = b"" if content is None else content
        expected = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if not isinstance(content, bytes) or len(content) != expected:
            size = f"{len(content)} bytes" if isinstance(content, bytes) else "no bytes"
            raise self._error(f"{what}: expected {expected} bytes of data, got {size}")
        return np.frombuffer(content, dtype).reshape(shape)

    def _check_sift(self, name: str) -> None:
        """Since version 4 there may be others, whose numbers are no bytes."""
        if self._has_types():
            condition = f"WHERE image_id = {self.images[name]:d}"
            kinds = [kind for (kind,) in self._rows("descriptors", "type", condition)]
            if kinds != [_SIFT]:
                raise self._error(f"descriptors of {name!r} are not SIFT (type {kinds[0]!r})")

    def _has_types(self) -> bool:
        with self._reading():
            columns = self._connection.execute("PRAGMA table_info(descriptors)")
            return any(column[1] == "type" for column in columns)

    def _check_integer(self, value: Any, first: int, end: int, what: str) -> None:
        if not isinstance(value, int) or not first <= value < end:
            raise self._error(f"{what} is {value!r}")

    def _rows(self, table: str, columns: str, condition: str = "") -> Iterator[tuple[Any, ...]]:
        # a view of that name could take forever, or say anything
        if table not in self._tables:
            raise self._error(f"no COLMAP database: it has no table {table!r}")
        with self._reading():
            yield from self._connection.execute(f"SELECT {columns} FROM {table} {condition}")

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
            raise self._error(f"no readable COLMAP database: {error}") from error

    def _error(self, message: str) -> DataError:
        return DataError(message, path=self.path)
