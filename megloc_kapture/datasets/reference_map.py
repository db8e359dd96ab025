"""Conversion of a dataset's sparse model, which hloc localizes in, to a kapture map.

pycolmap opens COLMAP's databases for writing: it adds tables to the user's file and fails in
read-only folders. Here they are opened as ``immutable``, which creates no files even in WAL mode.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap_model import SparsePoints
from megloc_kapture.io.files import check_relative, link_records, named, reading
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.points import rows_by_id

# feature type of COLMAP's feature/types.h -> name of the extractor or weights in this package, and
# dtype; COLMAP stores all descriptors as bytes, but those of networks are float32
_SIFT, _UNDEFINED = 0, -1
UNDEFINED = "colmap-undefined"  # type of features of unknown origin
_TYPES = {
    _UNDEFINED: (UNDEFINED, "u1"),
    _SIFT: ("sift", "u1"),
    1: ("aliked-n16rot", "<f4"),
    2: ("aliked-n32", "<f4"),
    3: ("loma-b", "<f4"),
    4: ("loma-b128", "<f4"),
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
                f"the database was not closed, so it lacks the content of {log.name}; open and "
                "close it once with COLMAP or sqlite3",
                path=path,
            )
        uri = f"file:{quote(str(self.path.resolve()))}?mode=ro&immutable=1"
        self._connection = sqlite3.connect(uri, uri=True)
        try:
            self.images = {}
            with self._reading():
                for name, image_id in self._rows("SELECT name, image_id FROM images ORDER BY name"):
                    with named(path):
                        name = check_relative(str(name).replace("\\", "/").removeprefix("./"))
                    self.images[name] = int(image_id)
        except BaseException:
            self._connection.close()
            raise
        self._by_stem = {_without_suffix(name): name for name in self.images}

    def __exit__(self, *raised: object) -> None:
        self._connection.close()

    def name_of(self, image: str) -> str | None:
        """Return the image's name in the database, which may have a different suffix."""
        return image if image in self.images else self._by_stem.get(_without_suffix(image))

    def keypoints(self, name: str) -> NDArray[np.float32]:
        """Return the keypoints of an image, float32 (N, 2), COLMAP pixels."""
        rows = self._array("keypoints", name, "<f4")
        return np.empty((0, 2), np.float32) if rows is None else np.ascontiguousarray(rows[:, :2])

    def feature_type(self) -> tuple[str, str] | None:
        """Return type name and dtype of all features, or None if there are no descriptors.

        Tools with their own matcher store zeros instead of descriptors.
        """
        with self._reading():
            first = next(self._rows("SELECT data FROM descriptors WHERE rows > 0"), None)
            if first is not None and not any(first[0]):
                return None
            columns = self._rows("PRAGMA table_info(descriptors)")
            if any(column[1] == "type" for column in columns):
                rows = self._rows("SELECT DISTINCT type FROM descriptors WHERE rows > 0")
                kinds = {int(kind) for (kind,) in rows}
            else:  # older versions of COLMAP store no type: SIFT if 128 columns, else imported
                rows = self._rows("SELECT DISTINCT cols FROM descriptors WHERE rows > 0")
                kinds = {_SIFT if size == _SIFT_SIZE else _UNDEFINED for (size,) in rows}
        types = [_TYPES.get(kind) or (f"colmap-{kind}", "u1") for kind in kinds]
        if len(types) > 1:
            names = ", ".join(sorted(name for name, _ in types))
            raise self._error(f"the database has descriptors of several types: {names}")
        return types[0] if types else None

    def descriptors(self, name: str, dtype: str = "u1") -> NDArray[Any] | None:
        """Return the descriptors of an image, (N, D) of the type's dtype, or None."""
        return self._array("descriptors", name, dtype)

    def _array(self, table: str, name: str, dtype: str) -> NDArray[Any] | None:
        if name not in self.images:
            raise self._error(f"the database has no image {name!r}")
        query = f"SELECT rows, cols, data FROM {table} WHERE image_id = {self.images[name]:d}"
        with self._reading():
            rows, columns, content = next(self._rows(query), (0, 0, b""))
            if not rows:
                return None
            # for descriptors, the number of columns is in bytes
            size = columns // np.dtype(dtype).itemsize if table == "descriptors" else columns
            array = np.frombuffer(content, dtype).reshape(rows, size)
        if not np.isfinite(array).all():
            raise self._error(f"{table} of {name!r} are not finite")
        return array

    def _rows(self, query: str) -> Iterator[tuple[Any, ...]]:
        return self._connection.execute(query)

    def _reading(self) -> AbstractContextManager[None]:
        return reading(self.path, "a COLMAP database")

    def _error(self, message: str) -> DataError:
        return DataError(message, path=self.path)


# keypoints of a model and of its database differ only by rounding
_MAX_SHIFT_PX = 1.0


def published_database(path: Path | None, remarks: list[str]) -> Path | None:
    """Return the feature database of a published model, or add a remark and return None."""
    if path is not None and path.is_file():
        return path
    remarks.append(
        "The reference model comes without descriptors: its database is missing. "
        "`megloc localize` extracts them again from the images."
    )
    return None


def write_reference_map(
    output: Path,
    data: KaptureData,
    links: Mapping[str, Path],
    image_names: Sequence[str],
    points: SparsePoints,
    *,
    keypoints_type: str = "sift",
    database: Path | None = None,
    database_names: Mapping[str, str] | None = None,
    scales: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, int]:
    """Write a sparse model as a kapture map: sensors, poses, keypoints, points, observations.

    Row i of ``points3d.txt`` is point i of the model; images without a record are omitted. With a
    database, all of its keypoints and descriptors are written. Without a database, only observed
    keypoints are written, renumbered in the order of their ids.

    Parameters
    ----------
    image_names : name in ``data`` of each image of the model, in model order.
    database : COLMAP database with the names of ``image_names``, up to their suffixes.
    database_names : names in the database, by image, that differ from ``image_names``.
    scales : (x, y) scale of images whose camera in ``data`` differs in size from the model's.
    """
    write_sensors(output, data)
    link_records(output, links)
    write_points3d(output, np.concatenate([points.xyz, points.rgb], axis=1))
    names = tuple(sorted(set(data.records_camera.values()).intersection(image_names)))
    config = FeatureConfig(keypoints_type.upper(), np.dtype(np.float32), 2)
    writer = FeatureWriter(output, "keypoints", keypoints_type, config)
    positions = {name: position for position, name in enumerate(image_names)}
    rows_of = rows_by_id(points.image_ids, len(image_names))
    keypoint_ids = np.full(len(points.image_ids), -1, np.int32)  # -1: omitted observation
    new_ids = np.zeros(len(image_names), np.int32)
    # number of keypoints, and name in the database, by image
    lengths, sources = dict[str, int](), dict[str, str]()
    with ExitStack() as stack:
        source = None
        if database is not None:
            source = stack.enter_context(ColmapDatabase(database))
            feature_type = source.feature_type() or (keypoints_type, "u1")
            require(
                feature_type[0] == keypoints_type,
                f"the database has features of type {feature_type[0]}, not {keypoints_type}",
                path=database,
            )
            stored = {
                name: source.name_of((database_names or {}).get(name, name)) for name in names
            }
            sources = {image: name for image, name in stored.items() if name is not None}
        for new_id, name in enumerate(names):
            position = positions[name]
            new_ids[position] = new_id
            rows = rows_of[position]
            features, xy_px = points.feature_ids[rows].astype(np.int64), points.xy_px[rows]
            keypoints, numbers = _keypoints_of(source, name, sources.get(name), features, xy_px)
            if scales and name in scales:
                keypoints = keypoints * np.array(scales[name], np.float32)
            lengths[name] = len(keypoints)
            # with a database, images without features get empty files
            if len(keypoints) or source is not None:
                writer.write(name, keypoints)
            pairs = np.stack([points.point_ids[rows], numbers], axis=1)
            _, first = np.unique(pairs, axis=0, return_index=True)  # each pair once
            keypoint_ids[rows[first]] = numbers[first]
        if source is not None:
            _write_descriptors(source, output, feature_type, lengths, sources)
    kept = np.flatnonzero(keypoint_ids >= 0)
    observations = Observations(
        names,
        points.point_ids[kept],
        new_ids[points.image_ids[kept]],
        keypoint_ids[kept],
    )
    write_observations(output, {keypoints_type: observations})
    return {
        "images": len(names),
        "keypoints": sum(lengths.values()),
        "points": len(points),
        "observations": len(observations),
    }


def _keypoints_of(
    database: ColmapDatabase | None,
    name: str,
    stored: str | None,
    features: NDArray[np.int64],
    xy_px: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the keypoints of an image, and the keypoint row of each feature of the model.

    ``stored`` is the image's name in the database, whose keypoints must agree with the model's.
    """
    if database is None:
        _, first, rows = np.unique(features, return_index=True, return_inverse=True)
        return xy_px[first], rows
    if stored is None:
        require(not len(features), f"the database has no image {name!r}", path=database.path)
        return np.empty((0, 2), np.float32), features
    keypoints = database.keypoints(stored)
    fits = features.max(initial=-1) < len(keypoints)
    if fits:
        shifts = np.abs(keypoints[features] - xy_px)
        fits = shifts.max(initial=0.0) <= _MAX_SHIFT_PX
    require(
        fits,
        f"the database does not fit this model: the keypoints of {stored!r} differ",
        path=database.path,
    )
    return keypoints, features


def _write_descriptors(
    database: ColmapDatabase,
    output: Path,
    feature_type: tuple[str, str],
    lengths: Mapping[str, int],
    sources: Mapping[str, str],
) -> None:
    """Write descriptors; by image, ``lengths`` counts keypoints, ``sources`` has stored names."""
    (kind, dtype), size = feature_type, 0
    writer: FeatureWriter | None = None
    # images without keypoints come last: their empty files need the descriptor size of the others
    for name in sorted(lengths, key=lambda name: lengths[name] == 0):
        rows = database.descriptors(sources[name], dtype) if name in sources else None
        if rows is not None:
            size = size or rows.shape[1]
            require(
                rows.shape == (lengths[name], size),
                f"descriptors of {name!r} have the shape {rows.shape}, expected "
                f"{(lengths[name], size)}",
                path=database.path,
            )
        elif lengths[name] == 0 and size:
            rows = np.empty((0, size), dtype)
        else:
            continue
        if writer is None:
            config = FeatureConfig(kind.upper(), np.dtype(dtype), size, kind, "L2")
            writer = FeatureWriter(output, "descriptors", kind, config)
        writer.write(name, rows)


def _without_suffix(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
