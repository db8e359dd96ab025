"""Stage: a dense map without triangulation, from map images with depth.

Every keypoint with depth becomes a 3D point of its own, seen by its own image. Where a dataset has
depth (laser scans, RGB-D) such a map knows a point for nearly every keypoint, also where images
share their centre and nothing could be triangulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import link_images
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import (
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.mapping.depth import LiftingOptions, lift_keypoints
from megloc_kapture.stages.rigs import DepthRecord, depth_records
from megloc_kapture.stages.triangulation import copy_features
from megloc_kapture.stages.work import HERE, FolderSpec, Work


@dataclass(frozen=True)
class _Job:
    folder: FolderSpec
    local_type: str
    image: str
    depth: DepthRecord
    options: LiftingOptions


def lift_map(
    mapping: KaptureFolder,
    local_types: Sequence[str],
    output: Path,
    options: LiftingOptions,
    *,
    work: Work = HERE,
) -> dict[str, float]:
    """Lift the keypoints of the map's images through their depth maps, and write the map.

    Parameters
    ----------
    local_types : keypoints types that get points, each its own.

    Returns
    -------
    Counts for the log.

    Raises
    ------
    DataError : no image has a pose, or none has depth; a depth map is missing or broken.
    """
    data = mapping.read()
    poses = data.poses()
    records = depth_records(data)
    images = sorted(poses)
    with_depth = [image for image in images if image in records]
    if not with_depth:
        raise DataError(
            "no mapping image has a pose and a depth map of its moment (records_depth.txt, a "
            "rig with camera and depth sensor)",
            path=mapping.root,
        )
    spec = FolderSpec(mapping)
    row_of = {image: row for row, image in enumerate(images)}
    points: list[NDArray[np.float64]] = []
    seen: dict[str, Observations] = {}
    total = 0
    for local_type in local_types:
        jobs = [_Job(spec, local_type, image, records[image], options) for image in with_depth]
        image_ids: list[NDArray[np.int32]] = []
        keypoint_ids: list[NDArray[np.int32]] = []
        results = work.map(_lift, jobs, f"lifting {local_type}")
        for image, (lifted, ids) in zip(with_depth, results, strict=True):
            points.append(poses[image].inverse().apply(lifted))
            image_ids.append(np.full(len(ids), row_of[image], np.int32))
            keypoint_ids.append(ids)
        seen[local_type] = _observations(local_type, images, image_ids, keypoint_ids, total)
        total += len(seen[local_type])
    xyz = np.concatenate(points)
    write_sensors(output, data)
    link_images(mapping.root, output)
    for local_type in local_types:
        copy_features(mapping, output, local_type)
    write_points3d(output, np.concatenate([xyz, np.zeros_like(xyz)], axis=1))
    write_observations(output, seen)
    return {
        "images": len(images),
        "images_with_depth": len(with_depth),
        "points": len(xyz),
    }


def _observations(
    local_type: str,
    images: Sequence[str],
    image_ids: Sequence[NDArray[np.int32]],
    keypoint_ids: Sequence[NDArray[np.int32]],
    first_point: int,
) -> Observations:
    keypoints = np.concatenate(keypoint_ids)
    return Observations(
        keypoints_type=local_type,
        image_names=tuple(images),
        point_ids=first_point + np.arange(len(keypoints)),
        image_ids=np.concatenate(image_ids),
        keypoint_ids=keypoints,
    )


def _lift(job: _Job) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points in the image's camera frame (N, 3), and the keypoints they belong to (N,)."""
    folder = job.folder.open()
    depth_m = read_depth_map(
        folder.image_path(job.depth.path),
        width=job.depth.camera.width,
        height=job.depth.camera.height,
    )
    points, valid = lift_keypoints(
        folder.keypoints(job.local_type).read(job.image),
        depth_m,
        folder.read().camera_of(job.image),
        job.depth.camera,
        job.depth.image_from_depth,
        job.options,
    )
    return points[valid], np.flatnonzero(valid).astype(np.int32)
