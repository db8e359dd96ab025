"""Stage: depth of map images without a depth sensor, by multi-view stereo.

The map that is written is the one that is read, with depth beside its images: ordinary kapture
depth records of a sensor ``CAMERA_mvs`` that shares the camera's centre, float32 in the map's unit,
0 where nothing is known. Beside them, which kapture does not know and ignores:
``sensors/mvs/IMAGE.sigma.npy`` (float32, the standard deviation of depth), ``IMAGE.normals.npy``
(int8 (H, W, 3), 127 times the unit normal in the camera's frame, towards it) and
``reconstruction/depth.csv``, a row per image. Images that have depth keep theirs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError, MeglocError
from megloc_kapture.io.dataset_tables import SIDE_TABLES
from megloc_kapture.io.files import link_images, link_records, remove
from megloc_kapture.io.images import write_depth_map
from megloc_kapture.io.kapture import (
    KaptureData,
    KaptureFolder,
    Observations,
    Sensor,
    read_point_covariances,
    write_observations,
    write_point_covariances,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.paths import safe_join
from megloc_kapture.io.tables import DepthRow, write_depth_rows
from megloc_kapture.mapping.depth import LiftingOptions, lift_with_covariances
from megloc_kapture.mvs.consistency import AgreementOptions, agreeing_views, confirmed
from megloc_kapture.mvs.views import choose_sources, depth_range, stereo_camera, stereo_view
from megloc_kapture.plugins import (
    DEPTH_ESTIMATORS,
    DepthEstimate,
    DepthEstimator,
    PluginChoice,
    StereoView,
    load_plugin,
)
from megloc_kapture.stages.layout import MAP
from megloc_kapture.stages.local_features import read_frame
from megloc_kapture.stages.restrictions import UNRESTRICTED, Restrictions
from megloc_kapture.stages.rigs import depth_records
from megloc_kapture.stages.shared_index import index_map, write_array
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.triangulation import copy_features
from megloc_kapture.stages.work import HERE, FolderSpec, Work
from megloc_kapture.values import Camera, Options, RigidTransform

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions

FOLDER = "mvs"  # of depth maps below records_data, and of what is beside them below sensors
DEPTH_FILE = "reconstruction/depth.csv"
_NO_POINTS = np.zeros(0, np.int64)
_ANCHOR_VIEWS = 2  # that agree with a keypoint's depth, for it to be lifted

Floats = NDArray[np.float64]


class DensifyOptions(Options):
    """Depth by multi-view stereo; defaults: docs/experiments/mvs.md."""

    mode: Literal["off", "depth", "points"] = Field(
        default="off",
        description="depth: depth maps beside map images that have none; points: keypoints without "
        "a point get one of it as well",
    )
    estimator: PluginChoice = Field(
        default=PluginChoice(name="sweep"), description="sweep, patchmatchnet, colmap or a plugin"
    )
    num_sources: int = Field(
        default=4, ge=1, le=16, description="other map images that an image is compared with"
    )
    max_size_px: int = Field(default=800, ge=64, description="longer side of the depth maps")
    agreement: AgreementOptions = AgreementOptions()

    def idle(self) -> dict[str, str]:
        if self.mode == "off":
            return dict.fromkeys(self.all_but("mode"), "mvs.mode is off")
        return {}

    def make_estimator(self) -> DepthEstimator:
        """The estimator; raises PluginError, MissingWeightsError."""
        found: DepthEstimator = load_plugin(
            DEPTH_ESTIMATORS, self.estimator.name, self.estimator.options
        )
        return found


@dataclass(frozen=True)
class _Job:
    """One image, those it is compared with, and where their depth lies meanwhile."""

    folder: FolderSpec
    scratch: Path
    out: Path
    image: str
    sources: tuple[str, ...]
    range_m: tuple[float, float]
    options: DensifyOptions
    estimator: DepthEstimator
    # keypoints that have a point, by type; empty where none is lifted
    seen: Mapping[str, NDArray[np.int32]]


@dataclass(frozen=True, eq=False)
class _Lifted:
    """Points (N, 3) and covariances (N, 6) in the world, of keypoints (N,)."""

    xyz: Floats
    covariances: Floats
    keypoint_ids: NDArray[np.int64]


def densify_map(
    source: KaptureFolder,
    output: Path,
    options: DensifyOptions,
    *,
    estimator: DepthEstimator | None = None,
    restrictions: Restrictions = UNRESTRICTED,
    link_features: bool = False,
    work: Work = HERE,
) -> dict[str, float]:
    """Write a map with depth of its images.

    Parameters
    ----------
    estimator : that of the options unless given.
    restrictions : images are compared within a frame, location and condition only.
    link_features : as of :func:`~megloc_kapture.stages.map_refinement.refine_map`.

    Returns
    -------
    Counts for the log.

    Raises
    ------
    DataError : no map, or one that cannot be densified; names the file.
    PluginError, MissingWeightsError : the estimator cannot be made.
    """
    estimator = estimator or options.make_estimator()
    data = source.read()
    _check(source, data)
    jobs, rows = _plan(source, output, options, estimator, restrictions)
    reasons = work.map(_estimate, jobs, "depth")
    failed = {job.image: reason for job, reason in zip(jobs, list(reasons), strict=True) if reason}
    done = [job for job in jobs if job.image not in failed]
    rows = [replace(row, reason=failed.get(row.image, row.reason)) for row in rows]
    lifted: dict[str, dict[str, _Lifted]] = {}
    fills = {}
    for job, (fill, found) in zip(done, work.map(_confirm, done, "agreement"), strict=True):
        fills[job.image] = fill
        for local_type, points in found.items():
            lifted.setdefault(local_type, {})[job.image] = points
    if jobs:
        remove(jobs[0].scratch)
    rows = [replace(row, fill=fills.get(row.image, 0.0)) for row in rows]
    write_sensors(output, _with_depth(data, [job.image for job in done], options.max_size_px))
    _link(source, output)
    for type_name in sorted({*source.types("keypoints"), *source.types("descriptors")}):
        copy_features(source, output, type_name, link_own=link_features)
    num_lifted = _write_points(source, output, lifted)
    write_depth_rows(output / DEPTH_FILE, rows)
    return {
        "images": len(rows),
        "images_with_depth": len(done),
        "fill": round(float(np.mean(list(fills.values()))), 4) if fills else 0.0,
        "points_lifted": num_lifted,
    }


def _check(source: KaptureFolder, data: KaptureData) -> None:
    if not source.has_points():
        raise DataError(
            "no map to densify: depth is looked for around its points (reconstruction/points3d.txt "
            "and observations.txt); triangulate first",
            path=source.root,
        )
    if (source.root / "sensors" / "records_data" / FOLDER).exists():
        raise DataError(f"has images or depth maps in records_data/{FOLDER}", path=source.root)
    if any(f"{sensor}_mvs" in data.sensors for sensor in data.sensors):
        raise DataError("has a sensor CAMERA_mvs: densified already?", path=source.root)


# ------------------------------------------------------------------------------------ planning


def _plan(
    source: KaptureFolder,
    output: Path,
    options: DensifyOptions,
    estimator: DepthEstimator,
    restrictions: Restrictions,
) -> tuple[list[_Job], list[DepthRow]]:
    """What is worked on, and a row for every image with a pose; reasons of those left out."""
    data, xyz = source.read(), source.points3d()[:, :3]
    poses = data.poses()
    images = list(poses)
    indices = [index_map(source, local_type) for local_type in source.observations()]
    points_of = [
        np.unique(np.concatenate([_NO_POINTS, *(index.observed(image)[1] for index in indices)]))
        for image in images
    ]
    counts = [len(points) for points in points_of]
    point_ids = np.concatenate([_NO_POINTS, *points_of])
    order = np.argsort(point_ids, kind="stable")
    starts = np.zeros(len(xyz) + 1, np.int64)
    np.cumsum(np.bincount(point_ids, minlength=len(xyz)), out=starts[1:])
    images_of = starts, np.repeat(np.arange(len(images)), counts)[order]
    centers = np.array([pose.center() for pose in poses.values()]).reshape(-1, 3)
    members: dict[tuple[str, str, str], NDArray[np.bool_]] = {}
    keys = [_session(restrictions, image) for image in images]
    for row, key in enumerate(keys):
        members.setdefault(key, np.zeros(len(images), bool))[row] = True
    has_depth = depth_records(data)
    spec, scratch = FolderSpec(source), output / f".{FOLDER}"
    jobs, rows = [], []
    for row, image in enumerate(images):
        blank = DepthRow(image, (), 0.0, 0.0, 0.0, "")
        if image in has_depth:
            rows.append(replace(blank, reason="has depth of its own"))
            continue
        if not source.image_path(image).is_file():
            rows.append(replace(blank, reason="there is no image file"))
            continue
        found = depth_range(poses[image].apply(xyz[points_of[row]])[:, 2])
        chosen = choose_sources(
            row, members[keys[row]], xyz, points_of, images_of, centers, options.num_sources
        )
        sources = tuple(
            images[other] for other in chosen if source.image_path(images[other]).is_file()
        )
        if found is None or not sources:
            reason = "too few points in sight" if found is None else "no image shares points"
            rows.append(replace(blank, reason=reason))
            continue
        lifts = indices if options.mode == "points" else ()
        seen = {index.local_type: index.observed(image)[0] for index in lifts}
        jobs.append(_Job(spec, scratch, output, image, sources, found, options, estimator, seen))
        rows.append(replace(blank, sources=sources, near_m=found[0], far_m=found[1]))
    return jobs, rows


def _session(restrictions: Restrictions, image: str) -> tuple[str, str, str]:
    group = restrictions.groups.get(image)
    return ("", "", "") if group is None else (group.frame, group.location, group.condition)


# ------------------------------------------------------------------------------------- images


@lru_cache(maxsize=12)
def _view(folder: KaptureFolder, image: str, max_size_px: int) -> StereoView:
    """An image and its neighbours are looked at one after another: each is read once or twice."""
    data = folder.read()
    pixels, mask = read_frame(folder, image)
    pose = data.cam_from_world(image)
    assert pose is not None  # who has none is not looked at
    return stereo_view(pixels, data.camera_of(image), pose, mask, max_size_px)


def _estimate(job: _Job) -> str:
    """Estimate one image's depth into the scratch folder; why there is none, else empty."""
    folder, size = job.folder.open(), job.options.max_size_px
    try:
        views = [_view(folder, image, size) for image in (job.image, *job.sources)]
        found = job.estimator.estimate(views[0], views[1:], job.range_m)
    except MeglocError as error:
        return str(error)
    write_array(_scratch(job, job.image, "depth"), found.depth_m)
    write_array(_scratch(job, job.image, "sigma"), found.sigma_m)
    write_array(_scratch(job, job.image, "normals"), found.normals)
    return ""


def _confirm(job: _Job) -> tuple[float, dict[str, _Lifted]]:
    """Write what the sources confirm of an image's depth; the share of it, and lifted points."""
    folder, size = job.folder.open(), job.options.max_size_px
    view = _view(folder, job.image, size)
    names = ("depth", "sigma", "normals")
    estimate = DepthEstimate(*(np.load(_scratch(job, job.image, name)) for name in names))
    others = [
        (_view(folder, other, size), np.load(path))
        for other in job.sources
        if (path := _scratch(job, other, "depth")).is_file()
    ]
    agreement = job.options.agreement
    kept = confirmed(view, estimate, others, agreement)
    write_depth_map(
        safe_join(job.out / "sensors" / "records_data", depth_path(job.image)), kept.depth_m
    )
    beside = side_file(job.out, job.image, "sigma")
    write_array(beside, kept.sigma_m)
    normals = np.rint(127 * kept.normals).astype(np.int8)
    write_array(side_file(job.out, job.image, "normals"), normals)
    lifted = {}
    if job.seen:
        views = agreeing_views(view, kept.depth_m, others, agreement)
        sure = np.where(views >= _ANCHOR_VIEWS, kept.depth_m, np.float32(0))
        camera = folder.read().camera_of(job.image)
        for local_type, seen in job.seen.items():
            reader = folder.keypoints(local_type)
            if job.image in reader:
                keypoints = np.asarray(reader.read(job.image))
                unseen = np.setdiff1d(np.arange(len(keypoints)), seen)
                lifted[local_type] = _lift(keypoints, unseen, camera, view, sure, kept.sigma_m)
    return float((kept.depth_m > 0).mean()), lifted


def _lift(
    keypoints_px: NDArray[np.floating[Any]],
    ids: NDArray[np.int64],
    camera: Camera,
    view: StereoView,
    depth_m: NDArray[np.float32],
    sigma_m: NDArray[np.float32],
) -> _Lifted:
    points, covariances, valid = lift_with_covariances(
        keypoints_px[ids],
        depth_m,
        sigma_m,
        camera,
        view.camera,
        LiftingOptions(),
    )
    turned = view.cam_from_world.rotation_matrix()
    world = np.einsum("ji,njk,kl->nil", turned, covariances[valid], turned)
    packed = world[:, *np.triu_indices(3)]
    return _Lifted(view.cam_from_world.inverse().apply(points[valid]), packed, ids[valid])


def _scratch(job: _Job, image: str, kind: str) -> Path:
    return safe_join(job.scratch, f"{image}.{kind}.npy")


# -------------------------------------------------------------------------------------- output


def depth_path(image: str) -> str:
    """The depth map of an image, below ``records_data``."""
    return f"{FOLDER}/{image}.depth"


def side_file(root: Path, image: str, kind: Literal["sigma", "normals"]) -> Path:
    """What lies beside the depth map of an image in the kapture at ``root``; see the module."""
    return safe_join(root / "sensors" / FOLDER, f"{image}.{kind}.npy")


def read_beside(
    root: Path, image: str, kind: Literal["sigma", "normals"]
) -> NDArray[np.float32] | None:
    """Standard deviations (H, W) or normals (H, W, 3) of an image's depth by stereo, float32, 0
    where nothing is known; None without; raises DataError."""
    path = side_file(root, image, kind)
    if not path.is_file():
        return None
    try:
        found = np.load(path, allow_pickle=False).astype(np.float32)
    except (OSError, ValueError) as error:
        raise DataError(f"no array of numpy: {error}", path=path) from error
    return np.asarray(found / np.float32(127) if kind == "normals" else found)


def _with_depth(data: KaptureData, images: Sequence[str], max_size_px: int) -> KaptureData:
    """The sensors with a depth sensor on one rig with each camera whose images have depth."""
    found = replace(
        data,
        sensors=dict(data.sensors),
        rigs={rig: dict(members) for rig, members in data.rigs.items()},
        trajectories=dict(data.trajectories),
        records_depth=dict(data.records_depth),
    )
    for image in images:
        timestamp, camera = data.record_of(image)
        sensor = f"{camera}_mvs"
        if sensor not in found.sensors:
            pinhole = stereo_camera(data.camera_of(image), max_size_px)
            found.sensors[sensor] = Sensor.from_camera(pinhole, name=sensor, sensor_type="depth")
            carriers = [rig for rig, members in data.rigs.items() if camera in members]
            for rig in carriers:
                found.rigs[rig][sensor] = found.rigs[rig][camera]
            if not carriers:
                same = RigidTransform.identity()
                found.rigs[f"{camera}_with_mvs"] = {camera: same, sensor: same}
        if (own := data.trajectories.get((timestamp, camera))) is not None:
            found.trajectories[timestamp, sensor] = own
        found.records_depth[timestamp, sensor] = depth_path(image)
    return found


def _link(source: KaptureFolder, output: Path) -> None:
    """Link the images, beside which there are depth maps now, and the masks."""
    records = source.root / "sensors" / "records_data"
    link_records(output, {entry.name: entry for entry in sorted(records.iterdir())})
    link_images(source.root, output, ("masks",))


def _write_points(
    source: KaptureFolder, output: Path, lifted: Mapping[str, Mapping[str, _Lifted]]
) -> int:
    """Write the map's points, unchanged, and those of lifted keypoints behind them."""
    points = source.points3d()
    covariances = read_point_covariances(source.root, len(points))
    parts, uncertain = [points], [np.full((len(points), 6), np.nan)]
    if covariances is not None:
        uncertain = [np.asarray(covariances)]
    observations = {}
    total = len(points)
    for local_type, seen in source.observations().items():
        new = lifted.get(local_type, {})
        names = tuple(sorted({*seen.image_names, *new}))
        row_of = {name: row for row, name in enumerate(names)}
        rows = np.array([row_of[name] for name in seen.image_names], np.int32)
        point_ids, image_ids, keypoint_ids = (
            [seen.point_ids],
            [rows[seen.image_ids] if len(rows) else seen.image_ids],
            [seen.keypoint_ids],
        )
        for image, own in sorted(new.items()):
            count = len(own.xyz)
            parts.append(np.concatenate([own.xyz, np.zeros_like(own.xyz)], axis=1))
            uncertain.append(own.covariances)
            point_ids.append(total + np.arange(count))
            image_ids.append(np.full(count, row_of[image], np.int32))
            keypoint_ids.append(own.keypoint_ids.astype(np.int32))
            total += count
        observations[local_type] = Observations(
            local_type,
            names,
            np.concatenate(point_ids),
            np.concatenate(image_ids),
            np.concatenate(keypoint_ids),
        )
    write_points3d(output, np.concatenate(parts))
    write_observations(output, observations)
    if covariances is not None or total > len(points):
        write_point_covariances(output, np.concatenate(uncertain))
    return total - len(points)


class Densify(PipelineStage):
    """Estimate depth of the map's images that have none."""

    name = "densify"
    uses = ("mvs",)
    writes = (MAP,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (self.layout.sparse_map, SIDE_TABLES)

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.mvs.mode != "off"

    def plugins(self) -> Sequence[object]:
        return (self.options.mvs.make_estimator(),)

    def run(self, work: StageWork) -> Mapping[str, float]:
        return densify_map(
            work.folder(self.layout.sparse_map),
            work.out / MAP,
            self.options.mvs,
            restrictions=work.restrictions(),
            link_features=True,
            work=work,
        )
