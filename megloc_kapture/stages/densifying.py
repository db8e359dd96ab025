"""Stage: multi-view stereo depth of map images without a depth sensor.

The output is the input map with the files of ``stereo_depth.py`` added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import MeglocError, PluginError, require
from megloc_kapture.geometry.cameras import focal_px
from megloc_kapture.io.csv_table import write_records
from megloc_kapture.io.dataset_tables import (
    NO_TABLES,
    SIDE_TABLES,
    ImageGroup,
    SideTables,
    read_side_tables,
)
from megloc_kapture.io.files import link_images, link_records, remove, safe_join
from megloc_kapture.io.images import write_depth_map
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.io.tables import DepthRow
from megloc_kapture.mapping.depth import lift_with_covariances
from megloc_kapture.mvs.views import (
    TOLERANCE_PX,
    agreeing_views,
    choose_sources,
    confirmed,
    depth_range,
    stereo_view,
    with_pose_errors,
)
from megloc_kapture.plugin_loading import load_chosen
from megloc_kapture.plugins import (
    DEPTH_ESTIMATORS,
    DepthEstimate,
    DepthEstimator,
    PluginChoice,
    StereoView,
)
from megloc_kapture.stages import paths
from megloc_kapture.stages.local_features import read_frame
from megloc_kapture.stages.map_features import copy_features
from megloc_kapture.stages.scene import (
    check_points,
    depth_records,
    indices_of,
    points_seen,
    with_noise,
    write_array,
)
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.stereo_depth import (
    DEPTH_FILE,
    FOLDER,
    LiftedPoints,
    depth_path,
    side_file,
    with_depth_sensors,
    write_points,
)
from megloc_kapture.stages.work import HERE, Work, is_out_of_memory
from megloc_kapture.values import Camera, Options

_ANCHOR_VIEWS = 2  # views that must agree with a keypoint's depth before it is lifted
# median reprojection error with exact poses, in image pixels; the excess is attributed to the poses
_KEYPOINT_ERROR_PX = 0.3
# largest median pose error in pixels of a depth map, and tolerated difference between views in
# multiples of the pose error
_ERROR_PX, _DIFFERENCE = 0.5, 5.0
# standard deviation between two views per median error: the median distance in a plane is 1.1774
# standard deviations; a factor of sqrt(2) is for the difference of two views, another because
# points triangulated from three views have absorbed half of the variance
_DEVIATION = 2 / 1.1774

# number of source images per image, and largest number if the poses are not exact
_NUM_SOURCES, _MAX_SOURCES = 4, 16


class DensifyOptions(Options):
    """Multi-view stereo options; defaults: docs/experiments/mvs.md."""

    mode: Literal["off", "depth", "points"] = Field(
        default="off",
        description="depth: estimate depth of map images without depth; points: also make map "
        "points from keypoints without a point",
    )
    estimator: PluginChoice = Field(
        default=PluginChoice(name="sweep"), description="sweep, colmap or a plugin"
    )
    max_size_px: int = Field(default=800, ge=64, description="longer side of the depth maps")


@dataclass(frozen=True)
class StereoFit:
    """Resolution and tolerance of stereo, given the accuracy of the poses.

    Attributes
    ----------
    max_size_px : longer side of the depth maps.
    num_sources : number of map images that an image is compared with.
    tolerance_px : see :func:`~megloc_kapture.mvs.views.agreeing_views`.
    error_px : median error of the poses in pixels of the depth maps; 0 if unknown.
    """

    max_size_px: int
    num_sources: int
    tolerance_px: float
    error_px: float


def densify_map(
    source: KaptureFolder,
    output: Path,
    options: DensifyOptions,
    *,
    tables: SideTables = NO_TABLES,
    link_features: bool = False,
    work: Work = HERE,
) -> dict[str, float]:
    """Write a map with stereo depth of its images; return counts for the log.

    Images are only compared within a frame, location and condition. ``link_features`` is as in
    :func:`~megloc_kapture.stages.map_refinement.refine_map`.
    """
    estimator: DepthEstimator = load_chosen(DEPTH_ESTIMATORS, options.estimator, work.placement)
    check_points(source, "densify")
    records = source.root / "sensors" / "records_data"
    require(records.is_dir(), "the images of the map are missing", path=records)
    require(
        not (records / FOLDER).exists(),
        f"has images or depth maps in records_data/{FOLDER}: densified already?",
        path=source.root,
    )
    data = source.read()
    fit = fitted_to_poses(source, options.max_size_px)
    rows = {row.image: row for row in _plan(source, fit, tables)}
    scratch = output / f".{FOLDER}"
    planned = [row for row in rows.values() if not row.reason]
    estimate = partial(_estimate, source, scratch, fit, estimator)
    estimated = work.map(estimate, planned, "depth", plugins=(estimator,))
    rows |= {row.image: row for row in estimated}
    lifts = indices_of(source) if options.mode == "points" else ()
    jobs = [
        (row, {index.local_type: index.observed(row.image)[0] for index in lifts})
        for row in rows.values()
        if not row.reason
    ]
    lifted: dict[str, dict[str, LiftedPoints]] = {}
    results = work.map(partial(_confirm, source, scratch, output, fit), jobs, "agreement")
    for row, points_of_type in results:
        rows[row.image] = row
        for local_type, points in points_of_type.items():
            lifted.setdefault(local_type, {})[row.image] = points
    remove(scratch)
    fills = {row.image: rows[row.image].fill for row, _ in jobs}
    write_sensors(output, with_depth_sensors(data, list(fills), fit.max_size_px))
    link_records(output, {entry.name: entry for entry in sorted(records.iterdir())})
    link_images(source.root, output, ("masks",))
    copy_features(source, output, link_own=link_features)
    num_lifted = write_points(source, output, lifted)
    write_records(output / DEPTH_FILE, DepthRow, rows.values())
    return {
        "images": len(rows),
        "images_with_depth": len(fills),
        "share_with_depth": round(float(np.mean(list(fills.values()))), 4) if fills else 0.0,
        "points_lifted": num_lifted,
        "max_size_px": fit.max_size_px,
        "map_error_px": round(fit.error_px, 4),
    }


# ------------------------------------------------------------------------------------ planning


def fitted_to_poses(source: KaptureFolder, max_size_px: int) -> StereoFit:
    """Fit stereo to the pose error: the median reprojection error in excess of keypoint noise.

    Images are reduced until the pose error is at most half a pixel, as other views could not
    confirm finer detail. A reduced image is compared with proportionally more sources. Two views
    agree up to five times the pose error, or up to the default tolerance if that is larger.
    """
    angles = [with_noise(source, index).noise_rad for index in indices_of(source)]
    error_rad = min((angle for angle in angles if np.isfinite(angle)), default=0.0)
    data = source.read()
    cameras = [data.camera_of(image) for image in data.poses()]
    side = int(np.median([max(camera.width, camera.height) for camera in cameras]))
    error_px = error_rad * float(np.median([focal_px(camera) for camera in cameras]))
    share = float(np.sqrt(max(error_px**2 - _KEYPOINT_ERROR_PX**2, 0.0))) / side
    size = min(max_size_px, side)
    reduced = max(64, int(min(size, _ERROR_PX / share))) if share else size
    error_px = share * reduced
    return StereoFit(
        max_size_px=reduced if reduced < size else max_size_px,
        num_sources=min(_MAX_SOURCES, round(_NUM_SOURCES * size / reduced)),
        tolerance_px=max(TOLERANCE_PX, _DIFFERENCE * error_px),
        error_px=error_px,
    )


def _plan(source: KaptureFolder, fit: StereoFit, tables: SideTables) -> list[DepthRow]:
    """Return a row per image, with sources and depth range, or the reason why it has no depth."""
    data, xyz = source.read(), source.points3d()[:, :3]
    poses = data.poses()
    images = list(poses)
    points_of = [points_seen(source, image) for image in images]
    counts = [len(points) for points in points_of]
    point_ids = np.concatenate(points_of)
    order = np.argsort(point_ids, kind="stable")
    starts = np.append(0, np.cumsum(np.bincount(point_ids, minlength=len(xyz))))
    images_of = starts, np.repeat(np.arange(len(images)), counts)[order]
    centers = np.array([pose.center() for pose in poses.values()]).reshape(-1, 3)
    session = attrgetter("frame", "location", "condition")
    sessions = [session(tables.groups.get(image, ImageGroup())) for image in images]
    session_ids = np.unique(sessions, axis=0, return_inverse=True)[1].ravel()
    has_depth = depth_records(data)

    def planned(row: int, image: str) -> DepthRow:
        blank = DepthRow(image, (), 0.0, 0.0, 0.0, "")
        if image in has_depth:
            return replace(blank, reason="already has depth")
        if not source.image_path(image).is_file():
            return replace(blank, reason="no image file")
        limits = depth_range(poses[image].apply(xyz[points_of[row]])[:, 2])
        if limits is None:
            return replace(blank, reason="too few visible points")
        members = session_ids == session_ids[row]
        chosen = choose_sources(row, members, xyz, points_of, images_of, centers, fit.num_sources)
        found = [images[other] for other in chosen if source.image_path(images[other]).is_file()]
        if not found:
            return replace(blank, reason="no image shares points")
        return replace(blank, sources=tuple(found), near_m=limits[0], far_m=limits[1])

    return [planned(row, image) for row, image in enumerate(images)]


# ------------------------------------------------------------------------------------- images


@lru_cache(maxsize=12)
def _view(folder: KaptureFolder, image: str, max_size_px: int) -> StereoView:
    data = folder.read()
    pixels, mask = read_frame(folder, image)
    pose = data.cam_from_world(image)
    assert pose is not None
    return stereo_view(pixels, data.camera_of(image), pose, mask, max_size_px)


def _estimate(
    folder: KaptureFolder, scratch: Path, fit: StereoFit, estimator: DepthEstimator, row: DepthRow
) -> DepthRow:
    """Estimate an image's depth into the scratch folder; add the reason to its row if it fails."""
    try:
        views = [_view(folder, image, fit.max_size_px) for image in (row.image, *row.sources)]
        estimate = estimator.estimate(views[0], views[1:], (row.near_m, row.far_m))
    except MeglocError as error:
        return replace(row, reason=str(error))
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        return replace(row, reason="out of memory; make mvs.max_size_px smaller")
    if not isinstance(estimate, DepthEstimate):
        what = f"returned {type(estimate).__name__}, not DepthEstimate"
        raise PluginError(f"estimator {type(estimator).__name__} on image {row.image}: {what}")
    file = _scratch_file(scratch, row.image)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(file, **vars(estimate))
    return row


def _confirm(
    folder: KaptureFolder,
    scratch: Path,
    out: Path,
    fit: StereoFit,
    job: tuple[DepthRow, Mapping[str, NDArray[np.int32]]],
) -> tuple[DepthRow, dict[str, LiftedPoints]]:
    """Write the depth that sources confirm; return the row with its ``fill``, and lifted points.

    A job has an image's row and, by type, ids of keypoints that observe a point and are not lifted.
    """
    row, seen_of_type = job
    image, size = row.image, fit.max_size_px
    view = _view(folder, image, size)
    estimate = DepthEstimate(**np.load(_scratch_file(scratch, image)))
    sources = [_view(folder, other, size) for other in row.sources]
    others = [
        (source, np.load(path)["depth_m"])
        for other, source in zip(row.sources, sources, strict=True)
        if (path := _scratch_file(scratch, other)).is_file()
    ]
    kept = confirmed(view, estimate, others, fit.tolerance_px)
    limits = row.near_m, row.far_m
    kept = with_pose_errors(view, sources, kept, limits, _DEVIATION * fit.error_px)
    records = out / "sensors" / "records_data"
    write_depth_map(safe_join(records, depth_path(image)), kept.depth_m)
    write_array(side_file(out, image, "sigma"), kept.sigma_m)
    normals = np.rint(127 * kept.normals).astype(np.int8)
    write_array(side_file(out, image, "normals"), normals)
    lifted = {}
    if seen_of_type:
        views = agreeing_views(view, kept.depth_m, others, fit.tolerance_px)
        sure = np.where(views >= _ANCHOR_VIEWS, kept.depth_m, np.float32(0))
        camera = folder.read().camera_of(image)
        for local_type, seen in seen_of_type.items():
            reader = folder.keypoints(local_type)
            if image in reader:
                keypoints = np.asarray(reader.read(image))
                unseen = np.setdiff1d(np.arange(len(keypoints)), seen)
                lifted[local_type] = _lift(keypoints, unseen, camera, view, sure, kept.sigma_m)
    return replace(row, fill=float((kept.depth_m > 0).mean())), lifted


def _lift(
    keypoints_px: NDArray[np.floating[Any]],
    ids: NDArray[np.int64],
    camera: Camera,
    view: StereoView,
    depth_m: NDArray[np.float32],
    sigma_m: NDArray[np.float32],
) -> LiftedPoints:
    points, covariances, valid = lift_with_covariances(
        keypoints_px[ids], depth_m, sigma_m, camera, view.camera
    )
    turned = view.cam_from_world.rotation_matrix()
    world = np.einsum("ji,njk,kl->nil", turned, covariances[valid], turned)
    packed = world[:, *np.triu_indices(3)]
    return LiftedPoints(view.cam_from_world.inverse().apply(points[valid]), packed, ids[valid])


def _scratch_file(scratch: Path, image: str) -> Path:
    return safe_join(scratch, f"{image}.npz")


class Densify(PipelineStage):
    """Estimate depth of map images without depth."""

    name = "densify"
    version = 4
    uses = ("mvs",)
    explained_by = ("mvs.mode",)
    inputs = (PipelineStage.sparse_map, SIDE_TABLES)
    outputs = (paths.MAP,)

    def is_wanted(self) -> bool:
        return self.options.mvs.mode != "off"

    def plugins(self) -> Sequence[object]:
        return (load_chosen(DEPTH_ESTIMATORS, self.options.mvs.estimator),)

    def run(self, work: StageWork) -> Mapping[str, float]:
        return densify_map(
            work.folder(self.sparse_map()),
            work.out / paths.MAP,
            self.options.mvs,
            tables=read_side_tables(work.path(SIDE_TABLES)),
            link_features=True,
            work=work,
        )
