"""Files of multi-view stereo depth in a map, and the point cloud fused from them.

Depth maps are kapture depth records of a sensor ``CAMERA_mvs`` with the camera's pose, float32, 0 =
unknown. Files outside the kapture format are ``sensors/mvs/IMAGE.sigma.npy`` (float32, standard
deviation of depth), ``IMAGE.normals.npy`` (int8 (H, W, 3), 127 times the unit normal in the camera
frame, towards the camera) and ``reconstruction/depth.csv``, a row per image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import require
from megloc_kapture.io.csv_table import read_records
from megloc_kapture.io.files import safe_join
from megloc_kapture.io.kapture import (
    KaptureData,
    KaptureFolder,
    Observations,
    Sensor,
    read_point_covariances,
    write_observations,
    write_point_covariances,
    write_points3d,
)
from megloc_kapture.io.kapture.points import write_ply
from megloc_kapture.io.tables import DepthRow
from megloc_kapture.mvs.views import (
    TOLERANCE_PX,
    agreeing_views,
    pinhole_matrix,
    stereo_camera,
    stereo_view,
)
from megloc_kapture.plugins import StereoView
from megloc_kapture.stages.local_features import read_stored_image
from megloc_kapture.stages.scene import depth_and_pose
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import RigidTransform

FOLDER = "mvs"  # folder of depth maps below records_data, and of side files below sensors
DEPTH_FILE = "reconstruction/depth.csv"

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LiftedPoints:
    """World points (N, 3) from keypoints and depth, covariances (N, 6), and keypoint ids (N,)."""

    xyz: Floats
    covariances: Floats
    keypoint_ids: NDArray[np.int64]


def depth_path(image: str) -> str:
    return f"{FOLDER}/{image}.depth"


def side_file(root: Path, image: str, kind: str) -> Path:
    """Return the path of a file outside the kapture format; see the module's docstring."""
    return safe_join(root / "sensors" / FOLDER, f"{image}.{kind}.npy")


def with_depth_sensors(data: KaptureData, images: Sequence[str], max_size_px: int) -> KaptureData:
    """Add a depth sensor to each camera whose images have depth; both are on one rig."""
    extended = replace(
        data,
        sensors=dict(data.sensors),
        rigs={rig: dict(members) for rig, members in data.rigs.items()},
        trajectories=dict(data.trajectories),
        records_depth=dict(data.records_depth),
    )
    for image in images:
        timestamp, camera = data.record_of(image)
        sensor = f"{camera}_mvs"
        if sensor not in extended.sensors:
            pinhole = stereo_camera(data.camera_of(image), max_size_px)
            extended.sensors[sensor] = Sensor.from_camera(pinhole, name=sensor, sensor_type="depth")
            carriers = [rig for rig, members in data.rigs.items() if camera in members]
            for rig in carriers:
                extended.rigs[rig][sensor] = extended.rigs[rig][camera]
            if not carriers:
                same = RigidTransform.identity()
                extended.rigs[f"{camera}_with_mvs"] = {camera: same, sensor: same}
        if (pose := data.trajectories.get((timestamp, camera))) is not None:
            extended.trajectories[timestamp, sensor] = pose
        extended.records_depth[timestamp, sensor] = depth_path(image)
    return extended


def write_points(
    source: KaptureFolder, output: Path, lifted: Mapping[str, Mapping[str, LiftedPoints]]
) -> int:
    """Write a map's points, followed by the lifted points; return the number of lifted points.

    ``lifted`` is keyed by keypoints type and image.
    """
    points = source.points3d()
    covariances = read_point_covariances(source.root, len(points))
    if covariances is None:
        uncertain = [np.full((len(points), 6), np.nan)]
    else:
        uncertain = [np.asarray(covariances)]
    xyz, observations, total = [points], {}, len(points)
    for local_type, seen in source.observations().items():
        new = sorted(lifted.get(local_type, {}).items())
        names = tuple(sorted({*seen.image_names, *(image for image, _ in new)}))
        row_of = {name: row for row, name in enumerate(names)}
        rows = np.array([row_of[name] for name in seen.image_names], np.int32)
        image_ids = [rows[seen.image_ids]]
        image_ids += [
            np.full(len(of_image.xyz), row_of[image], np.int32) for image, of_image in new
        ]
        for _, of_image in new:
            xyz.append(np.concatenate([of_image.xyz, np.zeros_like(of_image.xyz)], axis=1))
            uncertain.append(of_image.covariances)
        keypoint_ids = [of_image.keypoint_ids.astype(np.int32) for _, of_image in new]
        count = sum(map(len, keypoint_ids))
        observations[local_type] = Observations(
            names,
            np.concatenate([seen.point_ids, total + np.arange(count)]),
            np.concatenate(image_ids),
            np.concatenate([seen.keypoint_ids, *keypoint_ids]),
        )
        total += count
    write_points3d(output, np.concatenate(xyz))
    write_observations(output, observations)
    if covariances is not None or total > len(points):
        write_point_covariances(output, np.concatenate(uncertain))
    return total - len(points)


def fuse_depth(
    densified: KaptureFolder,
    cloud: Path,
    tolerance_px: float = TOLERANCE_PX,
    *,
    work: Work = HERE,
) -> int:
    """Write a PLY cloud with normals and deviations; return the number of points.

    A pixel is skipped if the depth map of a source image with an earlier name agrees with it.
    """
    path = densified.root / DEPTH_FILE
    require(path.is_file(), "no densified map: reconstruction/depth.csv is missing", path=path)
    rows = sorted(read_records(path, DepthRow), key=lambda row: row.image)
    images = {row.image: row.sources for row in rows if not row.reason}
    jobs = [
        (image, [other for other in others if other < image and other in images])
        for image, others in images.items()
    ]
    parts = work.map(partial(_points, densified, tolerance_px), jobs, "cloud")
    nothing = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    columns = zip(nothing, *parts, strict=True)
    xyz, colours, normals, sigma_m = (np.concatenate(column) for column in columns)
    nx, ny, nz = normals.T
    write_ply(cloud, xyz, colours, nx=nx, ny=ny, nz=nz, deviation=sigma_m)
    return len(xyz)


def _points(
    folder: KaptureFolder, tolerance_px: float, job: tuple[str, Sequence[str]]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return world points (N, 3), colours (N, 3), unit normals (N, 3) and deviations (N,)."""
    image, earlier = job
    view, depth = _view_with_depth(folder, image)
    others = [_view_with_depth(folder, other) for other in earlier]
    new = (depth > 0) & (agreeing_views(view, depth, others, tolerance_px) == 0)
    rows, columns = np.nonzero(new)
    pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1)
    in_camera = pixels @ np.linalg.inv(pinhole_matrix(view.camera)).T * depth[new][:, None]
    sigma, normals = (
        np.load(side_file(folder.root, image, kind))[new].astype(np.float64)
        for kind in ("sigma", "normals")
    )
    return (
        view.cam_from_world.inverse().apply(in_camera),
        view.image[new].astype(np.float64),
        normals / 127 @ view.cam_from_world.rotation_matrix(),
        sigma,
    )


def _view_with_depth(folder: KaptureFolder, image: str) -> tuple[StereoView, NDArray[np.float32]]:
    depth, pose = depth_and_pose(folder, image)
    pixels = read_stored_image(folder, image)
    longer = max(depth.camera.width, depth.camera.height)
    view = stereo_view(pixels, folder.read().camera_of(image), pose, None, longer)
    return view, depth.depth_m
