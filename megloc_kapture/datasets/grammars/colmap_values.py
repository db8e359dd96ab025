"""A COLMAP model in memory, and what its two grammars have in common."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.grammars.sparse_points import SparsePoints, image_order
from megloc_kapture.datasets.grammars.track_rows import TrackArrays
from megloc_kapture.errors import DataError
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

# the ids of camera models, as binary models and databases have them
CAMERA_MODELS: tuple[str, ...] = tuple(CAMERA_MODEL_NUM_PARAMS)
# COLMAP's own limit; its databases pack two ids into one number
MAX_IMAGE_ID = 2**31 - 2
NO_POINT = -1
UNKNOWN_ERROR_PX = -1.0


@dataclass(frozen=True, slots=True)
class ColmapImage:
    """One registered image of a model."""

    image_id: int
    name: str
    camera_id: int
    cam_from_world: RigidTransform


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """Cameras, images and points of one reconstruction.

    Parameters
    ----------
    cameras : by camera id; images may share one.
    images : those a reader returns are sorted by ``image_id``, and their names differ.
    points : ``image_ids`` are positions in ``images``, not COLMAP's ids.
    """

    cameras: dict[int, Camera]
    images: tuple[ColmapImage, ...]
    points: SparsePoints


class ImageTable:
    """Images as a reader meets them, checked against each other."""

    def __init__(self, cameras: Mapping[int, Camera]) -> None:
        self._cameras = cameras
        self._images: dict[int, ColmapImage] = {}
        self._names: set[str] = set()

    def add(self, image: ColmapImage) -> None:
        """Take one more image.

        Raises
        ------
        DataError : its id or name is taken, or its camera unknown; does not name the place.
        """
        if image.image_id in self._images:
            raise DataError(f"image id {image.image_id} is listed twice")
        if image.name in self._names:
            raise DataError(f"image {image.name!r} is listed twice")
        if image.camera_id not in self._cameras:
            raise DataError(
                f"image {image.name!r} was taken by the unknown camera {image.camera_id}"
            )
        self._images[image.image_id] = image
        self._names.add(image.name)

    def sorted(self) -> tuple[ColmapImage, ...]:
        """All images by their ids."""
        return tuple(self._images[image_id] for image_id in sorted(self._images))


class TrackedFeatures:
    """Where the features of tracks lie: the points name images and features, the images where.

    Parameters
    ----------
    tracks : as a points' file has them, with COLMAP's ids of the images.
    """

    def __init__(self, tracks: TrackArrays) -> None:
        self._tracks = tracks
        image_ids = tracks.image_ids
        self._order = image_order(image_ids)
        ids, starts = np.unique(image_ids[self._order], return_index=True)
        bounds = [*starts.tolist(), len(image_ids)]
        self._rows = {
            image_id: slice(start, end)
            for image_id, start, end in zip(ids.tolist(), bounds[:-1], bounds[1:], strict=True)
        }
        self._xy_px = np.zeros((len(image_ids), 2), np.float32)
        self._positions = np.zeros(len(image_ids), np.int32)

    def place(self, image_id: int, features_px: NDArray[np.floating[Any]]) -> None:
        """Take what is needed of all features (M, 2) of an image.

        Raises
        ------
        DataError : a track names a feature that the image does not have, or that is not finite;
            does not name the place.
        """
        if image_id not in self._rows:
            return
        rows = self._order[self._rows[image_id]]
        ids = self._tracks.feature_ids[rows]
        last = int(ids.max())
        if last >= len(features_px):
            raise DataError(
                f"a track names feature {last} of image {image_id}, which has {len(features_px)}"
            )
        with np.errstate(over="ignore"):
            found = features_px[ids].astype(np.float32)
        if not np.isfinite(found).all():
            raise DataError(f"a feature of image {image_id} is not finite")
        self._xy_px[rows] = found

    def resolve(self, images: Sequence[ColmapImage], path: Path) -> None:
        """Turn COLMAP's ids into positions in ``images``.

        Raises
        ------
        DataError : a track names an image that there is not; names ``path``.
        """
        known = {image.image_id: position for position, image in enumerate(images)}
        for image_id, rows in self._rows.items():
            if image_id not in known:
                raise DataError(f"a track names image {image_id}, which is not there", path=path)
            self._positions[self._order[rows]] = known[image_id]

    def points(self) -> SparsePoints:
        """The points, after all images are placed and resolved."""
        tracks = self._tracks
        return SparsePoints(
            tracks.xyz,
            tracks.rgb,
            tracks.point_ids(),
            self._positions,
            tracks.feature_ids,
            self._xy_px,
        )


def features_for_writing(
    model: ColmapModel,
) -> Iterator[tuple[ColmapImage, NDArray[np.float32], NDArray[np.int64]]]:
    """Each image with the features a file lists: where (M, 2), and the row of the point or -1.

    Features that the model does not know, because no point needs them, stand at (0, 0): their
    places keep the others' indices.

    Raises
    ------
    ValueError : a feature sees two points, which no COLMAP model can say.
    """
    points = model.points
    points.check_images(len(model.images))
    order = image_order(points.image_ids)
    ends = np.searchsorted(points.image_ids[order], np.arange(len(model.images) + 1)).tolist()
    for position, image in enumerate(model.images):
        rows = order[ends[position] : ends[position + 1]]
        ids = points.feature_ids[rows]
        if len(np.unique(ids)) != len(ids) or (len(ids) and ids.min() < 0):
            raise ValueError(f"a feature of image {image.name!r} is negative or in two tracks")
        size = int(ids.max()) + 1 if len(ids) else 0
        xy_px = np.zeros((size, 2), np.float32)
        seen = np.full(size, NO_POINT, np.int64)
        xy_px[ids] = points.xy_px[rows]
        seen[ids] = points.point_ids[rows]
        yield image, xy_px, seen


def check_writable(model: ColmapModel) -> None:
    """Raise ValueError where ids or names are not fit for a model's files."""
    ids = [image.image_id for image in model.images]
    if len(set(ids)) != len(ids) or not all(0 <= i <= MAX_IMAGE_ID for i in ids):
        raise ValueError("image ids are out of range or not unique")
    for image in model.images:
        if image.camera_id not in model.cameras:
            raise ValueError(f"image {image.name!r} has the unknown camera {image.camera_id}")
        if not image.name or image.name.split() != [image.name] or "\0" in image.name:
            raise ValueError(f"image name {image.name!r} has blanks, as COLMAP cannot read it")
