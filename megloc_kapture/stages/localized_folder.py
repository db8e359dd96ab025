"""Localized queries as a kapture folder with tables, and queries with unreadable images."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.dataset_tables import write_unreadable
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import (
    CLUSTERS_FILE,
    COVARIANCE_FILE,
    POSES_FILE,
    REFINEMENT_FILE,
    STATUS_FILE,
    write_clusters,
    write_covariances,
    write_refinement,
    write_status,
)
from megloc_kapture.stages.local_features import read_stored_image
from megloc_kapture.stages.scene import poses_through_rig
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Failure, Fallback, LocalizationResult, Pose, RigidTransform


def write_localized(
    output: Path,
    query: KaptureFolder | KaptureData,
    results: Iterable[Pose | Failure],
    *,
    fallback: Fallback = "none",
    first_candidates: dict[str, tuple[str, RigidTransform]] | None = None,
    timing: Path | None = None,
) -> dict[str, int]:
    """Write a kapture of localized queries with tables of status, poses, clusters and covariances.

    A query with an estimated focal length gets a separate camera.

    Parameters
    ----------
    fallback : pose of a failed query: "none"; "retrieval", the pose of its best retrieved image;
        "rig", derived from a localized camera of the same rig and timestamp.
    first_candidates : best retrieved map image and its pose by query, for "retrieval".
    timing : optional file for seconds per query and step.
    """
    data = query.read() if isinstance(query, KaptureFolder) else query
    ordered = sorted(results, key=lambda result: result.name)
    localized_poses = {result.name: result for result in ordered if isinstance(result, Pose)}
    guesses: Mapping[str, tuple[str, RigidTransform]] = {}
    if fallback == "retrieval":
        guesses = first_candidates or {}
    elif fallback == "rig":
        guesses = poses_through_rig(data, localized_poses)
    poses: dict[tuple[int, str], RigidTransform] = {}
    sensors, records = dict(data.sensors), dict(data.records_camera)
    written: list[LocalizationResult] = []
    for result in ordered:
        image = result.name
        if isinstance(result, Pose):
            record = data.record_of(image)
            if result.camera is not None:
                del records[record]
                given = sensors[record[1]]
                record = (record[0], f"{record[1]}-{record[0]}")
                records[record] = image
                sensors[record[1]] = Sensor.from_camera(result.camera, name=given.name)
            poses[record] = result.cam_from_world
        elif image in guesses:
            poses[data.record_of(image)] = guesses[image][1]
            result = replace(result, fallback=fallback)
        written.append(result)
    localized = KaptureData(sensors=sensors, trajectories=poses, records_camera=records)
    write_sensors(output, localized)
    if isinstance(query, KaptureFolder):
        link_images(query.root, output)
    write_result_tables(output, localized.poses(), written)
    write_clusters(output / CLUSTERS_FILE, written)
    if timing is not None:
        write_timing(timing, written)
    return {
        "queries": len(written),
        "localized": len(localized_poses),
        "failed": len(written) - len(localized_poses),
        "fallbacks": len(poses) - len(localized_poses),
    }


def write_result_tables(
    output: Path, poses: Mapping[str, RigidTransform], results: Sequence[LocalizationResult]
) -> None:
    """Write tables of poses, status and covariances; if a pose was refined, also of refinement."""
    write_poses(output / POSES_FILE, poses)
    write_status(output / STATUS_FILE, results)
    write_covariances(output / COVARIANCE_FILE, results)
    if any(result.refinements for result in results):
        write_refinement(output / REFINEMENT_FILE, results)


def write_poses(path: Path, poses: Mapping[str, RigidTransform]) -> None:
    """Write ``poses.csv``: ``cam_from_world`` and camera centre in the world by image."""
    columns = ("image", "qw", "qx", "qy", "qz", "tx", "ty", "tz")
    rows = (
        (image, *map(repr, (*pose.quat_wxyz, *pose.translation, *pose.center().tolist())))
        for image, pose in sorted(poses.items())
    )
    write_csv_table(path, (*columns, "center_x", "center_y", "center_z"), rows)


def write_timing(path: Path, results: Iterable[LocalizationResult]) -> None:
    rows = (
        (result.name, step, f"{seconds:.5f}")
        for result in results
        for step, seconds in result.seconds.items()
    )
    write_csv_table(path, ("image", "step", "seconds"), rows)


def set_aside_unreadable(query: Path, tables: Path, work: Work) -> Mapping[str, str]:
    """Remove unreadable images from a workspace's queries; write the reasons to ``tables``."""
    folder = KaptureFolder(query)
    data = folder.read()
    names = data.image_names()
    faults = work.map(partial(_fault, folder), names, "reading queries")
    reasons = {name: fault for name, fault in zip(names, faults, strict=True) if fault}
    if not reasons:
        return {}
    if len(reasons) == len(names):
        # report the target of the link, as the link may be temporary
        raise DataError(reasons[names[0]], path=Path(os.path.realpath(folder.image_path(names[0]))))
    records = {key: name for key, name in data.records_camera.items() if name not in reasons}
    write_sensors(query, replace(data, records_camera=records))
    write_unreadable(tables, reasons)
    return reasons


def unreadable_image(name: str, reason: str) -> Failure:
    return Failure(f"the image cannot be used: {reason}", name=name)


def _fault(folder: KaptureFolder, name: str) -> str:
    try:
        read_stored_image(folder, name)
    except DataError as error:
        return error.message
    return ""
