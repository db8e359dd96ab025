"""Images, keypoints and descriptors of COLMAP's databases, read with sqlite.

pycolmap opens databases for writing: it adds tables to the user's file and fails in read-only
folders. Here they are opened as ``immutable``, which creates no files even in WAL mode.
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

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import check_relative


class FeatureType(NamedTuple):
    """A feature type: kapture name, and dtype of the descriptors."""

    name: str
    dtype: str


# ids of COLMAP's feature/types.h with the names of our extractors or weights; COLMAP stores all
# descriptors as bytes, those of networks are float32
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
    """An open database; ``images`` maps names (without ``./``) to ids. Use as a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        require(self.path.is_file(), "file is missing", path=path)
        log = self.path.with_name(self.path.name + "-wal")
        if log.is_file() and log.stat().st_size:
            raise DataError(
                f"was not closed: the content of {log.name} is not in it yet; open and close it "
                "once with COLMAP or sqlite3",
                path=path,
            )
        uri = f"file:{quote(str(self.path.resolve()))}?mode=ro&immutable=1"
        self._connection = sqlite3.connect(uri, uri=True)
        try:
            self.images = {}
            with self._reading():
                for name, image_id in self._rows("SELECT name, image_id FROM images ORDER BY name"):
                    self.images[check_relative(str(name).removeprefix("./"))] = int(image_id)
        except BaseException:
            self._connection.close()
            raise

    def __exit__(self, *raised: object) -> None:
        self._connection.close()

    def keypoints(self, name: str) -> NDArray[np.float32]:
        """Return the keypoints of an image, float32 (N, 2), COLMAP pixels."""
        found = self._array("keypoints", name, "<f4")
        return np.empty((0, 2), np.float32) if found is None else np.ascontiguousarray(found[:, :2])

    def feature_type(self) -> FeatureType | None:
        """Return the type of all features, or None without descriptors."""
        with self._reading():
            if self._has_types():
                rows = self._rows("SELECT DISTINCT type FROM descriptors WHERE rows > 0")
                kinds = {int(kind) for (kind,) in rows}
            else:  # before version 4: SIFT, or imported features
                rows = self._rows("SELECT DISTINCT cols FROM descriptors WHERE rows > 0")
                kinds = {_SIFT if size == _SIFT_SIZE else _UNDEFINED for (size,) in rows}
        found = [_TYPES.get(kind) or FeatureType(f"colmap-{kind}", "u1") for kind in kinds]
        if len(found) > 1:
            names = ", ".join(sorted(kind.name for kind in found))
            raise self._error(f"has descriptors of several types: {names}")
        return found[0] if found else None

    def descriptors(self, name: str, expected: FeatureType = _TYPES[_SIFT]) -> NDArray[Any] | None:
        """Return the descriptors of an image, (N, D) of the type's dtype, or None."""
        return self._array("descriptors", name, expected.dtype)

    def _array(self, table: str, name: str, dtype: str) -> NDArray[Any] | None:
        if name not in self.images:
            raise self._error(f"has no image {name!r}")
        query = f"SELECT rows, cols, data FROM {table} WHERE image_id = {self.images[name]:d}"
        with self._reading():
            rows, columns, content = next(self._rows(query), (0, 0, b""))
            if not rows:
                return None
            # descriptor columns count bytes
            size = columns // np.dtype(dtype).itemsize if table == "descriptors" else columns
            array = np.frombuffer(content, dtype).reshape(rows, size)
        if not np.isfinite(array).all():
            raise self._error(f"{table} of {name!r} are not finite")
        return array

    def _has_types(self) -> bool:
        return any(row[1] == "type" for row in self._rows("PRAGMA table_info(descriptors)"))

    def _rows(self, query: str) -> Iterator[tuple[Any, ...]]:
        return self._connection.execute(query)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except DataError as error:
            raise self._error(error.message) from error
        except (sqlite3.Error, UnicodeDecodeError, OverflowError, ValueError, TypeError) as error:
            raise self._error(f"not a readable COLMAP database: {error}") from error

    def _error(self, message: str) -> DataError:
        return DataError(message, path=self.path)
