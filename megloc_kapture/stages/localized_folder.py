"""The localized queries as a kapture folder with status tables.

Unreadable query images are set aside at import and reported as failures.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.dataset_tables import read_unreadable, write_unreadable
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import (
    CLUSTERS_FILE,
    COVARIANCE_FILE,
    POSES_FILE,
    REFINEMENT_FILE,
    STATUS_FILE,
    Fallback,
    QueryStatus,
    refinement_text,
    write_clusters,
    write_covariances,
    write_refinement,
    write_status,
)
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.stages.scene import poses_through_rig
from megloc_kapture.stages.work import FolderSpec, Work
from megloc_kapture.values import Failure, Pose, RigidTransform


def write_localized(
    output: Path,
    query: KaptureFolder | KaptureData,
    results: Iterable[tuple[str, Pose | Failure]],
    *,
    fallback: Fallback = "none",
    first_candidates: dict[str, tuple[str, RigidTransform]] | None = None,
    timing: Path | None = None,
) -> dict[str, int]:
    """Write localized queries as kapture with tables of status, poses, clusters and covariances.

    A query with an estimated focal length gets a separate camera.

    Parameters
    ----------
    fallback : pose of a failed query: none, that of its best retrieved image, or the one derived
        from a localized camera of the same rig and timestamp.
    first_candidates : best retrieved map image and its pose by query, for "retrieval".
    timing : optional file for seconds per query and step.
    """
    data = query.read() if isinstance(query, KaptureFolder) else query
    named = sorted(results, key=lambda result: result[0])
    found = {image: result for image, result in named if isinstance(result, Pose)}
    guesses: Mapping[str, tuple[str, RigidTransform]] = {}
    if fallback == "retrieval":
        guesses = first_candidates or {}
    elif fallback == "rig":
        guesses = poses_through_rig(data, found)
    poses: dict[tuple[int, str], RigidTransform] = {}
    sensors, records = dict(data.sensors), dict(data.records_camera)
    statuses = []
    for image, result in named:
        guess = None if result else guesses.get(image)
        statuses.append(query_status(image, result, "none" if guess is None else fallback))
        if isinstance(result, Pose):
            record = data.record_of(image)
            if result.camera is not None:
                del records[record]
                given = sensors[record[1]]
                record = (record[0], f"{record[1]}-{record[0]}")
                records[record] = image
                sensors[record[1]] = Sensor.from_camera(result.camera, name=given.name)
            poses[record] = result.cam_from_world
        elif guess is not None:
            poses[data.record_of(image)] = guess[1]
    localized = KaptureData(sensors=sensors, trajectories=poses, records_camera=records)
    write_sensors(output, localized)
    write_poses(output / POSES_FILE, localized.poses())
    if isinstance(query, KaptureFolder):
        link_images(query.root, output)
    write_status(output / STATUS_FILE, statuses)
    write_covariances(output / COVARIANCE_FILE, found)
    write_clusters(
        output / CLUSTERS_FILE,
        (
            (image, result.clusters, found[image].cluster if result else None)
            for image, result in named
        ),
    )
    refinements = [row for pose in found.values() for row in pose.refinements]
    if refinements:
        write_refinement(output / REFINEMENT_FILE, refinements)
    if timing is not None:
        write_timing(timing, named)
    return {
        "queries": len(named),
        "localized": len(found),
        "failed": len(named) - len(found),
        "fallbacks": len(poses) - len(found),
    }


def write_poses(path: Path, poses: Mapping[str, RigidTransform]) -> None:
    """Write ``poses.csv``: ``cam_from_world`` and camera centre in the world by image."""
    columns = ("image", "qw", "qx", "qy", "qz", "tx", "ty", "tz")
    rows = (
        (image, *map(repr, (*pose.quat_wxyz, *pose.translation, *pose.center().tolist())))
        for image, pose in sorted(poses.items())
    )
    write_csv_table(path, (*columns, "center_x", "center_y", "center_z"), rows)


def write_timing(path: Path, results: Iterable[tuple[str, Pose | Failure]]) -> None:
    rows = (
        (image, step, f"{seconds:.5f}")
        for image, result in results
        for step, seconds in result.seconds.items()
    )
    write_csv_table(path, ("image", "step", "seconds"), rows)


def query_status(image: str, result: Pose | Failure, fallback: Fallback = "none") -> QueryStatus:
    return QueryStatus(
        image=image,
        status="localized" if result else "failed",
        reason="" if isinstance(result, Pose) else result.reason,
        num_matches=result.num_matches,
        num_inliers=result.num_inliers,
        confidence=result.confidence,
        cluster=result.cluster if isinstance(result, Pose) else None,
        refinement=refinement_text(result.refinements) if isinstance(result, Pose) else "",
        fallback=fallback,
        candidates=result.candidates,
        remarks="; ".join(result.remarks),
    )


def set_aside_unreadable(query: Path, tables: Path, work: Work) -> Mapping[str, str]:
    """Remove unreadable images from a workspace's queries; write the reasons to ``tables``."""
    folder = KaptureFolder(query)
    data = folder.read()
    names = data.image_names()
    faults = work.map(partial(_fault, FolderSpec(folder)), names, "reading queries")
    reasons = {name: fault for name, fault in zip(names, faults, strict=True) if fault}
    if not reasons:
        return {}
    if len(reasons) == len(names):
        # report the target, as the link may be temporary
        raise DataError(reasons[names[0]], path=Path(os.path.realpath(folder.image_path(names[0]))))
    records = {key: name for key, name in data.records_camera.items() if name not in reasons}
    write_sensors(query, replace(data, records_camera=records))
    write_unreadable(tables, reasons)
    return reasons


def unreadable_queries(tables: Path) -> Iterator[tuple[str, Failure]]:
    for name, reason in read_unreadable(tables).items():
        yield name, unreadable_image(name, reason)


def unreadable_image(name: str, reason: str) -> Failure:
    return Failure(f"the image cannot be used: {reason}", name=name)


def _fault(spec: FolderSpec, name: str) -> str:
    folder = spec.open()
    try:
        read_image_of(folder.image_path(name), folder.read().camera_of(name))
    except DataError as error:
        return error.message
    return ""
