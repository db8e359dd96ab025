"""A map's points and observations while filters take some of them out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from megloc_kapture.io.kapture import FeatureReader, KaptureData, KaptureFolder, Observations
from megloc_kapture.mapping.map_check import ObservedKeypoints, find_pixel_origin
from megloc_kapture.mapping.uncertainty import ObservedPoints, left_with_too_few, point_covariances

_SAMPLED_IMAGES = 50

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class FilterReport(BaseModel):
    """What one filter removed; ``checked`` is what it could judge, of observations or points."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    checked: int
    points: int
    observations: int


class MapSelection:
    """A map's points and observations, and which of them are still in."""

    def __init__(self, source: KaptureFolder, min_observations: int) -> None:
        self.source = source
        self.data: KaptureData = source.read()
        self.xyz = np.ascontiguousarray(source.points3d()[:, :3])
        self._of_type = source.observations()
        self._min_observations = min_observations
        types = list(self._of_type.values())
        self.images = sorted({image for seen in types for image in seen.image_names})
        poses = self.data.poses()
        posed = np.array([image in poses for image in self.images], dtype=bool)
        # images without a pose have one in the list, that no observation refers to
        self._poses = [poses.get(image) for image in self.images]
        row_of = {image: row for row, image in enumerate(self.images)}
        rows = [
            np.array([row_of[i] for i in seen.image_names], dtype=np.int32)[seen.image_ids]
            for seen in types
        ]
        self._sizes = [len(seen) for seen in types]
        point_ids = _joined([seen.point_ids for seen in types], np.int64)
        image_ids = _joined(rows, np.int32)
        # of several types, sorted by point as those of one are
        self._order = None if len(types) == 1 else np.argsort(point_ids, kind="stable")
        self.point_ids, self.image_ids = self._sorted(point_ids), self._sorted(image_ids)
        self.kept_points = np.ones(len(self.xyz), dtype=bool)
        self.kept = np.ones(len(self.point_ids), dtype=bool)
        self._placed = posed[self.image_ids] if len(posed) else self.kept.copy()
        self.reports: list[FilterReport] = []
        self._covariances: Floats | None = None

    def _sorted(self, values: NDArray[Any]) -> NDArray[Any]:
        return values if self._order is None else values[self._order]

    @cached_property
    def _views(self) -> tuple[list[Any], list[Any]]:
        posed = next((row for row, pose in enumerate(self._poses) if pose is not None), None)
        if posed is None:
            return [], []
        stand_in = self.data.camera_of(self.images[posed]), self._poses[posed]
        views = [
            stand_in if pose is None else (self.data.camera_of(image), pose)
            for image, pose in zip(self.images, self._poses, strict=True)
        ]
        cameras, poses = zip(*views, strict=True)
        return list(cameras), list(poses)

    def observed(self) -> tuple[ObservedPoints, NDArray[np.int64]]:
        """What is in and can be judged, and the rows of these observations."""
        rows = np.flatnonzero(self.kept & self._placed)
        point_ids, image_ids = self.point_ids, self.image_ids
        if len(rows) < len(point_ids):
            point_ids, image_ids = point_ids[rows], image_ids[rows]
        cameras, poses = self._views
        return ObservedPoints(self.xyz, point_ids, image_ids, cameras, poses), rows

    def covariances(self) -> Floats:
        """Covariances (N, 6) from the observations that are in; NaN where not determined."""
        if self._covariances is None:
            observed, _ = self.observed()
            self._covariances = point_covariances(
                observed.xyz,
                observed.point_ids,
                observed.image_ids,
                observed.cameras,
                observed.cams_from_world,
            )
        return self._covariances

    def drop_observations(self, name: str, dropped: Mask, checked: int) -> None:
        """Take observations (O,) out, and the points that are left with too few."""
        dropped = dropped & self.kept
        ids = self.point_ids[self.kept]
        gone = left_with_too_few(ids, dropped[self.kept], len(self.xyz), self._min_observations)
        self._take_out(name, dropped, gone, checked)

    def drop_points(self, name: str, dropped: Mask, checked: int) -> None:
        """Take points (N,) out, with their observations."""
        self._take_out(name, np.zeros(len(self.kept), dtype=bool), dropped, checked)

    def _take_out(self, name: str, observations: Mask, points: Mask, checked: int) -> None:
        gone = self.kept & (observations | points[self.point_ids])
        self.reports.append(
            FilterReport(
                name=name,
                checked=checked,
                points=int((points & self.kept_points).sum()),
                observations=int(gone.sum()),
            )
        )
        if self._covariances is not None and (gone & ~points[self.point_ids]).any():
            self._covariances = None  # a point that loses some but not all is less sure
        self.kept &= ~gone
        self.kept_points &= ~points

    def keypoints_px(self) -> NDArray[np.float32]:
        """Keypoint (O, 2) of every observation, as the cameras have the pixel origin.

        NaN where an image has no pose or no keypoints of the type.
        """
        found = []
        cameras, poses = self._views
        row_of = {image: row for row, image in enumerate(self.images)}
        for name, seen in self._of_type.items():
            rows = [row_of[image] for image in seen.image_names]
            in_type = ObservedPoints(
                self.xyz,
                seen.point_ids,
                seen.image_ids,
                [cameras[row] for row in rows] if cameras else [],
                [poses[row] for row in rows] if poses else [],
            )
            posed = [self._poses[row] is not None for row in rows]
            reader = self.source.keypoints(name) if name in self.source.types("keypoints") else None
            found.append(_keypoints_of(reader, seen, in_type, posed))
        return self._sorted(_joined(found, np.float32).reshape(-1, 2))

    def observations(self) -> dict[str, Observations]:
        """What is in, by type, points renumbered."""
        kept = self.kept
        if self._order is not None:
            kept = np.empty_like(self.kept)
            kept[self._order] = self.kept
        number = np.cumsum(self.kept_points) - 1
        parts = np.split(kept, np.cumsum(self._sizes)[:-1]) if self._sizes else []
        return {
            name: replace(
                seen,
                point_ids=number[seen.point_ids[part]],
                image_ids=seen.image_ids[part],
                keypoint_ids=seen.keypoint_ids[part],
            )
            for (name, seen), part in zip(self._of_type.items(), parts, strict=True)
            if part.any()
        }


def _joined(parts: Sequence[NDArray[Any]], dtype: type) -> NDArray[Any]:
    return np.concatenate([np.zeros(0, dtype), *(part.ravel() for part in parts)], dtype=dtype)


def _keypoints_of(
    reader: FeatureReader | None,
    seen: Observations,
    observed: ObservedPoints,
    posed: Sequence[bool],
) -> NDArray[np.float32]:
    """Keypoints (O, 2) of one type's observations; see :meth:`MapSelection.keypoints_px`."""
    keypoints = np.full((len(seen), 2), np.nan, dtype=np.float32)
    if reader is None or not observed.cameras:
        return keypoints
    usable = [i for i, image in enumerate(seen.image_names) if posed[i] and image in reader]
    sampled = set(usable[:: max(1, len(usable) // _SAMPLED_IMAGES)])
    sample = []
    for image, rows in observed.by_image():
        if not posed[image] or seen.image_names[image] not in reader:
            continue
        keypoints[rows] = reader.read(seen.image_names[image])[seen.keypoint_ids[rows], :2]
        if image in sampled:
            sample.append(
                ObservedKeypoints(
                    seen.image_names[image],
                    observed.cameras[image],
                    observed.cams_from_world[image],
                    keypoints[rows],
                    np.arange(len(rows)),
                    seen.point_ids[rows],
                )
            )
    origin = find_pixel_origin(
        sample, observed.xyz, cameras=[observed.cameras[image] for image in usable]
    )
    return keypoints + np.float32(origin.keypoints_shift_px - origin.intrinsics_shift_px)
