"""The model a dataset ships, as a kapture map: what hloc and others localize in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.colmap_database import ColmapDatabase, FeatureType
from megloc_kapture.datasets.formats.sparse_models import SparsePoints, image_order
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import link_records
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)

# a database of another model has its features elsewhere; this one's differ by printed digits
_MAX_SHIFT_PX = 1.0


@dataclass(frozen=True)
class ReferenceModel:
    """The model a dataset ships: reads the names of its images and its points; its database."""

    read: Callable[[], tuple[Sequence[str], SparsePoints]]
    database: Path | None


def check_model_files(files: Iterable[Path]) -> None:
    """Raise DataError where a file of the model that a dataset comes with is missing."""
    for file in files:
        if not file.is_file():
            raise DataError("missing; the reference model is read from it", path=file)


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

    Row i of ``points3d.txt`` is point i of the model. Images of the model that ``data`` does not
    record are left out, with their observations. Without a database the keypoints of an image are
    those that see points, in the order of their ids in the model, numbered anew without gaps; of
    two positions for one feature the first counts. With one they are all keypoints of the database,
    under its numbers, beside their descriptors, and an image that has none there has empty ones,
    as if they had been extracted. An image that sees a point twice with the same
    feature does so once.

    Parameters
    ----------
    output : the kapture folder to write.
    data : sensors, records and poses of the images.
    links : folders of images, see :func:`~megloc_kapture.io.files.link_records`.
    image_names : name in ``data`` of each image of the model, in its order.
    points : of the model; ``image_ids`` count in ``image_names``.
    keypoints_type : the type name of keypoints and descriptors.
    database : COLMAP database with the features of the model; its images have the names of
        ``image_names``, or these with another suffix.
    database_names : of images that have quite another name there.
    scales : of images whose camera in ``data`` is another size than in the model, in x and y.

    Returns
    -------
    How many images, keypoints, points and observations were written, by these words.

    Raises
    ------
    DataError : the database is broken, or is not that of the model.
    ValueError : ``image_names`` are not unique, or ids out of range.
    OutputError : something cannot be written.
    """
    if len(set(image_names)) != len(image_names):
        raise ValueError("image_names are not unique")
    points.check_images(len(image_names))
    points = points.sorted_by_point()
    write_sensors(output, data)
    link_records(output, links)
    write_points3d(output, np.concatenate([points.xyz, points.rgb], axis=1))

    recorded = set(data.records_camera.values())
    names = tuple(sorted(recorded.intersection(image_names)))
    features: Features = partial(_seen_features, points)
    with ExitStack() as stack:
        if database is not None:
            opened = stack.enter_context(ColmapDatabase(database))
            of_database = _DatabaseFeatures(
                points, opened, output, keypoints_type, database_names or {}
            )
            stack.callback(of_database.close)
            features = of_database.of_image
        config = FeatureConfig(keypoints_type.upper(), np.dtype(np.float32), 2)
        writer = FeatureWriter(output, "keypoints", keypoints_type, config)
        stack.enter_context(writer)
        with_empty = database is not None
        observations, num_keypoints = _write_features(
            names, image_names, points, features, writer, scales or {}, with_empty=with_empty
        )
    write_observations(output, {keypoints_type: observations})
    return {
        "images": len(names),
        "keypoints": num_keypoints,
        "points": len(points),
        "observations": len(observations),
    }


# keypoints of an image (N, 2), and which of them each of its observations, given as rows, is
Features = Callable[[str, NDArray[np.int64]], tuple[NDArray[np.float32], NDArray[np.int64]]]


def _seen_features(
    points: SparsePoints, name: str, rows: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The features of an image that see points, numbered without gaps."""
    _, first, numbers = np.unique(points.feature_ids[rows], return_index=True, return_inverse=True)
    return points.xy_px[rows[first]], numbers


class _DatabaseFeatures:
    """All features of a database, under its numbers; writes the descriptors on the way."""

    def __init__(
        self,
        points: SparsePoints,
        database: ColmapDatabase,
        output: Path,
        keypoints_type: str,
        names: Mapping[str, str],
    ) -> None:
        self._database = database
        self._type = database.feature_type() or FeatureType(keypoints_type, "u1")
        if self._type.name != keypoints_type:
            raise self._error(f"has features of type {self._type.name}, not {keypoints_type}")
        self._names = names
        self._points = points
        self._output = output
        self._by_stem: dict[str, list[str]] = {}
        for name in database.images:
            self._by_stem.setdefault(_without_suffix(name), []).append(name)
        self._writer: FeatureWriter | None = None
        self._without: list[str] = []

    def of_image(
        self, name: str, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """See Features; DataError where the database does not have the features of the model."""
        name_there = self._name_there(name)
        if name_there is None:
            if len(rows):
                raise self._error(f"has no image {name!r}")
            self._without.append(name)
            return np.empty((0, 2), np.float32), np.empty(0, np.int64)
        keypoints = self._database.keypoints(name_there)
        numbers = self._points.feature_ids[rows].astype(np.int64)
        self._check(name_there, keypoints, numbers, self._points.xy_px[rows])
        descriptors = self._database.descriptors(name_there, self._type)
        if descriptors is not None:
            self._write_descriptors(name, name_there, descriptors, len(keypoints))
        elif len(keypoints) == 0:
            self._without.append(name)
        return keypoints, numbers

    def close(self) -> None:
        """Write empty descriptors where there are no keypoints."""
        if self._writer is not None:
            for name in self._without:
                empty = np.empty((0, self._writer.config.dsize), self._writer.config.dtype)
                self._writer.write(name, empty)

    def _name_there(self, name: str) -> str | None:
        name = self._names.get(name, name)
        if name in self._database.images:
            return name
        found = self._by_stem.get(_without_suffix(name), [])
        if len(found) > 1:
            raise self._error(f"has several images for {name!r}: {', '.join(found)}")
        return found[0] if found else None

    def _check(
        self,
        name: str,
        keypoints: NDArray[np.float32],
        numbers: NDArray[np.int64],
        xy_px: NDArray[np.float32],
    ) -> None:
        """Raise DataError where the database's features are not those of the model."""
        if not len(numbers):
            return
        last = int(numbers.max())
        if last >= len(keypoints):
            raise self._error(
                f"is not of this model: its image {name!r} has {len(keypoints)} keypoints, "
                f"the model names feature {last}"
            )
        shifts = np.abs(keypoints[numbers] - xy_px).max(axis=1)
        worst = int(np.argmax(shifts))
        if shifts[worst] > _MAX_SHIFT_PX:
            x, y = keypoints[numbers[worst]].tolist()
            there = xy_px[worst].tolist()
            raise self._error(
                f"is not of this model: feature {int(numbers[worst])} of {name!r} is at "
                f"({x:.1f}, {y:.1f}), in the model at ({there[0]:.1f}, {there[1]:.1f})"
            )

    def _write_descriptors(
        self, name: str, name_there: str, descriptors: NDArray[Any], num_keypoints: int
    ) -> None:
        kind = self._type.name
        if self._writer is None:
            size = descriptors.shape[1]
            config = FeatureConfig(kind.upper(), descriptors.dtype, size, kind, "L2")
            self._writer = FeatureWriter(self._output, "descriptors", kind, config)
        expected = (num_keypoints, self._writer.config.dsize)
        if descriptors.shape != expected:
            raise self._error(
                f"descriptors of {name_there!r} have the shape {descriptors.shape}, "
                f"expected {expected}"
            )
        self._writer.write(name, descriptors)

    def _error(self, message: str) -> DataError:
        return DataError(message, path=self._database.path)


def _write_features(
    names: Sequence[str],
    image_names: Sequence[str],
    points: SparsePoints,
    features: Features,
    writer: FeatureWriter,
    scales: Mapping[str, tuple[float, float]],
    *,
    with_empty: bool,
) -> tuple[Observations, int]:
    """Write the keypoints of images ``names``; returns the observations and how many they are."""
    positions = {name: position for position, name in enumerate(image_names)}
    order = image_order(points.image_ids)
    ends = np.cumsum([0, *np.bincount(points.image_ids, minlength=len(image_names)).tolist()])
    numbers = np.zeros(len(order), np.int32)
    kept = np.zeros(len(order), np.bool_)
    new_ids = np.zeros(len(image_names), np.int32)
    num_keypoints = 0
    for new_id, name in enumerate(names):
        position = positions[name]
        new_ids[position] = new_id
        # ascending, as the order among equals is kept
        rows = order[ends[position] : ends[position + 1]]
        keypoints, numbers_of_image = features(name, rows)
        if name in scales:
            keypoints = keypoints * np.array(scales[name], np.float32)
        num_keypoints += len(keypoints)
        if len(keypoints) or with_empty:
            writer.write(name, keypoints)
        numbers[rows] = numbers_of_image
        kept[rows] = _first_time(points.point_ids[rows], numbers_of_image)
    selected = slice(None) if kept.all() else np.flatnonzero(kept)
    observations = Observations(
        writer.type_name,
        tuple(names),
        points.point_ids[selected],
        new_ids[points.image_ids[selected]],
        numbers[selected],
    )
    return observations, num_keypoints


def _first_time(point_ids: NDArray[np.int64], numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask (O,) of the first observations of each pair of a point and a keypoint."""
    first = np.ones(len(point_ids), np.bool_)
    # points ascend: only where one repeats can a pair do so
    if len(point_ids) and (point_ids[1:] == point_ids[:-1]).any():
        order = np.lexsort((numbers, point_ids))
        same = np.diff(point_ids[order]) == 0
        first[order[1:][same & (np.diff(numbers[order]) == 0)]] = False
    return first


def _without_suffix(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
