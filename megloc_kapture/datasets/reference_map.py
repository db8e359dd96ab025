"""The model a dataset ships, as a kapture map: what hloc and others localize in."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.colmap_database import ColmapDatabase, FeatureType
from megloc_kapture.datasets.formats.sparse_points import SparsePoints, image_order
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
    """The model a dataset ships.

    Parameters
    ----------
    read : returns the names of its images, in its order, and its points.
    database : COLMAP database with its features; None where there is none.
    """

    read: Callable[[], tuple[Sequence[str], SparsePoints]]
    database: Path | None


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
    with ExitStack() as stack:
        features: _SeenFeatures | _DatabaseFeatures = _SeenFeatures(points)
        if database is not None:
            opened = stack.enter_context(ColmapDatabase(database))
            features = _DatabaseFeatures(
                points, opened, output, keypoints_type, database_names or {}
            )
            stack.callback(features.close)
        config = FeatureConfig(keypoints_type.upper(), np.dtype(np.float32), 2)
        writer = FeatureWriter(output, "keypoints", keypoints_type, config)
        stack.enter_context(writer)
        observations = _write_features(names, image_names, points, features, writer)
    write_observations(output, {keypoints_type: observations})
    return {
        "images": len(names),
        "keypoints": features.num_keypoints,
        "points": len(points),
        "observations": len(observations),
    }


class _SeenFeatures:
    """The features that see points, numbered without gaps."""

    complete = False

    def __init__(self, points: SparsePoints) -> None:
        self._points = points
        self.num_keypoints = 0

    def of_image(
        self, name: str, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Keypoints of an image (N, 2), and which of them each of its observations is."""
        _, first, numbers = np.unique(
            self._points.feature_ids[rows], return_index=True, return_inverse=True
        )
        self.num_keypoints += len(first)
        return self._points.xy_px[rows[first]], numbers


class _DatabaseFeatures:
    """All features of a database, under its numbers; writes the descriptors on the way."""

    complete = True

    def __init__(
        self,
        points: SparsePoints,
        database: ColmapDatabase,
        output: Path,
        keypoints_type: str,
        names: Mapping[str, str],
    ) -> None:
        self._type = database.feature_type() or FeatureType(keypoints_type, "u1")
        if self._type.name != keypoints_type:
            raise DataError(
                f"has features of type {self._type.name}, not {keypoints_type}", path=database.path
            )
        self._names = names
        self._points = points
        self._database = database
        self._output = output
        self._keypoints_type = keypoints_type
        self._by_stem: dict[str, list[str]] = {}
        for name in database.images:
            self._by_stem.setdefault(_without_suffix(name), []).append(name)
        self._writer: FeatureWriter | None = None
        self._without: list[str] = []
        self.num_keypoints = 0

    def of_image(
        self, name: str, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """See :meth:`_SeenFeatures.of_image`.

        Raises
        ------
        DataError : the database does not have the features of the model.
        """
        name_there = self._name_there(name)
        if name_there is None:
            if len(rows):
                raise DataError(f"has no image {name!r}", path=self._database.path)
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
        self.num_keypoints += len(keypoints)
        return keypoints, numbers

    def close(self) -> None:
        """Write empty descriptors where there are no keypoints, and close what was opened."""
        if self._writer is not None:
            for name in self._without:
                empty = np.empty((0, self._writer.config.dsize), self._writer.config.dtype)
                self._writer.write(name, empty)
            self._writer.close()

    def _name_there(self, name: str) -> str | None:
        name = self._names.get(name, name)
        if name in self._database.images:
            return name
        found = self._by_stem.get(_without_suffix(name), [])
        if len(found) > 1:
            raise DataError(
                f"has several images for {name!r}: {', '.join(found)}", path=self._database.path
            )
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
            raise DataError(
                f"is not of this model: its image {name!r} has {len(keypoints)} keypoints, "
                f"the model names feature {last}",
                path=self._database.path,
            )
        shifts = np.abs(keypoints[numbers] - xy_px).max(axis=1)
        worst = int(np.argmax(shifts))
        if shifts[worst] > _MAX_SHIFT_PX:
            x, y = keypoints[numbers[worst]].tolist()
            there = xy_px[worst].tolist()
            raise DataError(
                f"is not of this model: feature {int(numbers[worst])} of {name!r} is at "
                f"({x:.1f}, {y:.1f}), in the model at ({there[0]:.1f}, {there[1]:.1f})",
                path=self._database.path,
            )

    def _write_descriptors(
        self, name: str, name_there: str, descriptors: NDArray[Any], num_keypoints: int
    ) -> None:
        if self._writer is None:
            config = FeatureConfig(
                self._type.name.upper(),
                descriptors.dtype,
                descriptors.shape[1],
                self._keypoints_type,
                "L2",
            )
            self._writer = FeatureWriter(self._output, "descriptors", self._keypoints_type, config)
        expected = (num_keypoints, self._writer.config.dsize)
        if descriptors.shape != expected:
            raise DataError(
                f"descriptors of {name_there!r} have the shape {descriptors.shape}, "
                f"expected {expected}",
                path=self._database.path,
            )
        self._writer.write(name, descriptors)


def _write_features(
    names: Sequence[str],
    image_names: Sequence[str],
    points: SparsePoints,
    features: _SeenFeatures | _DatabaseFeatures,
    writer: FeatureWriter,
) -> Observations:
    """Write the keypoints of images ``names``, and return the observations with their numbers."""
    positions = {name: position for position, name in enumerate(image_names)}
    order = image_order(points.image_ids)
    ends = np.cumsum([0, *np.bincount(points.image_ids, minlength=len(image_names)).tolist()])
    numbers = np.zeros(len(order), np.int32)
    kept = np.zeros(len(order), np.bool_)
    new_ids = np.zeros(len(image_names), np.int32)
    for new_id, name in enumerate(names):
        position = positions[name]
        new_ids[position] = new_id
        # ascending, as the order among equals is kept
        rows = order[ends[position] : ends[position + 1]]
        keypoints, numbers_of_image = features.of_image(name, rows)
        if len(keypoints) or features.complete:
            writer.write(name, keypoints)
        numbers[rows] = numbers_of_image
        kept[rows] = _first_time(points.point_ids[rows], numbers_of_image)
    selected = slice(None) if kept.all() else np.flatnonzero(kept)
    return Observations(
        writer.type_name,
        tuple(names),
        points.point_ids[selected],
        new_ids[points.image_ids[selected]],
        numbers[selected],
    )


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
