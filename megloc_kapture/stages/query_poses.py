"""Stage: localize the queries from their matches with map images; kapture trajectories out."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.kapture_store import (
    ImagePair,
    KaptureData,
    KaptureFolder,
    write_sensors,
)
from megloc_kapture.io.links import link_images
from megloc_kapture.io.status_table import STATUS_FILE, Fallback, QueryStatus, write_status
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions, absolute_pose
from megloc_kapture.localization.correspondences import Correspondences, resolve
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.stages.matches import iterate_candidates
from megloc_kapture.stages.parallel import FolderSpec, Track, ordered_map, untracked
from megloc_kapture.stages.restrictions import UNRESTRICTED, Restrictions
from megloc_kapture.stages.rig_siblings import poses_through_rig
from megloc_kapture.values import Camera, Failure, Options, Pose, RigidTransform


class LocalizationOptions(Options):
    """How a query's pose is found from its matches."""

    pose: AbsolutePoseOptions = AbsolutePoseOptions()
    fallback: Fallback = "none"


@dataclass(frozen=True)
class _Job:
    map: FolderSpec
    query: FolderSpec
    matches: FolderSpec
    local_type: str
    image: str
    candidates: tuple[str, ...]
    frames: tuple[str, ...]  # of the candidates
    options: AbsolutePoseOptions


def index_map(folder: KaptureFolder, local_type: str) -> MapIndex:
    """Read the points and observations of one keypoints type into an index.

    Raises
    ------
    DataError : no observations of the type.
    """
    seen = folder.observations()
    if local_type not in seen:
        raise DataError(f"the map has no observations of type {local_type!r}", path=folder.root)
    observations = seen[local_type]
    return MapIndex.build(
        folder.points3d()[:, :3],
        observations.image_names,
        observations.image_ids,
        observations.keypoint_ids,
        observations.point_ids,
    )


def gather_correspondences(
    index: MapIndex,
    matches: Iterable[tuple[str, NDArray[np.int64], NDArray[np.floating]]],
) -> Correspondences:
    """2D-3D matches from (map image, matches (K, 2) query and map keypoints, scores (K,))."""
    keypoints, points, scores = [], [], []
    for image, pairs, similarity in matches:
        point_ids = index.points_of_keypoints(image, pairs[:, 1])
        observed = point_ids >= 0
        keypoints.append(pairs[observed, 0])
        points.append(point_ids[observed])
        scores.append(similarity[observed])
    if not keypoints:
        empty = np.zeros(0, dtype=np.int64)
        return resolve(empty, empty, np.zeros(0))
    return resolve(np.concatenate(keypoints), np.concatenate(points), np.concatenate(scores))


def pose_in_best_frame(
    index: MapIndex,
    keypoints_px: NDArray[np.float32],
    camera: Camera,
    matches: Sequence[tuple[str, NDArray[np.int64], NDArray[np.floating]]],
    frames: Sequence[str],
    options: AbsolutePoseOptions,
) -> Pose | Failure:
    """Localize one query in each coordinate frame its candidates stand in; keep the best.

    Points of different frames never meet in one solver: their coordinates say nothing about
    each other. The pose with the most inliers is kept, of equals that of the first candidate.

    Parameters
    ----------
    frames : of the map images of ``matches``, in their order.
    """
    results = [
        pose_from_matches(
            index,
            keypoints_px,
            camera,
            [match for match, own in zip(matches, frames, strict=True) if own == frame],
            options,
        )
        for frame in dict.fromkeys(frames)
    ]
    if not results:
        return pose_from_matches(index, keypoints_px, camera, [], options)
    return max(results, key=lambda result: (bool(result), result.num_inliers))


def pose_from_matches(
    index: MapIndex,
    keypoints_px: NDArray[np.float32],
    camera: Camera,
    matches: Sequence[tuple[str, NDArray[np.int64], NDArray[np.floating]]],
    options: AbsolutePoseOptions,
) -> Pose | Failure:
    """Localize one query from its verified matches with map images of one coordinate frame."""
    candidates = tuple(image for image, pairs, _ in matches if len(pairs))
    if not candidates:
        return Failure("no map image matches")
    found = gather_correspondences(index, matches)
    result = absolute_pose(
        keypoints_px[found.keypoint_ids, :2].astype(np.float64),
        index.xyz[found.point_ids],
        camera,
        options,
    )
    return replace(result, candidates=candidates)


_indices: dict[object, MapIndex] = {}


def _localize(job: _Job) -> tuple[Pose | Failure, float]:
    started = time.perf_counter()
    if job.map.key not in _indices:
        _indices.clear()
        _indices[job.map.key] = index_map(job.map.open(), job.local_type)
    index = _indices[job.map.key]
    query = job.query.open()
    reader = job.matches.open().matches(job.local_type)
    if not job.candidates:
        return Failure("no map image is a candidate"), time.perf_counter() - started
    matched = [
        (frame, (image, *reader.read(job.image, image)))
        for image, frame in zip(job.candidates, job.frames, strict=True)
        if (job.image, image) in reader
    ]
    result = pose_in_best_frame(
        index,
        query.keypoints(job.local_type).read(job.image),
        query.read().camera_of(job.image),
        [match for _, match in matched],
        [frame for frame, _ in matched],
        job.options,
    )
    if isinstance(result, Pose):
        # the mask is for who asked with arrays; the stage writes none of it
        result = replace(result, inliers=None)
    return result, time.perf_counter() - started


def localize_from_matches(
    map_folder: KaptureFolder,
    query: KaptureFolder,
    matches: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_type: str,
    options: LocalizationOptions,
    *,
    restrictions: Restrictions = UNRESTRICTED,
    executor: Executor | None = None,
    track: Track = untracked,
) -> Iterator[tuple[str, Pose | Failure, float]]:
    """Localize every query from stored matches: image, result, seconds; in order of names.

    Parameters
    ----------
    restrictions : the coordinate frames of the map's images, which are never mixed.
    """
    map_spec, query_spec, matches_spec = (
        FolderSpec(f.root, f.features_dirs) for f in (map_folder, query, matches)
    )
    candidates = dict(iterate_candidates(pairs))
    jobs = [
        _Job(
            map=map_spec,
            query=query_spec,
            matches=matches_spec,
            local_type=local_type,
            image=image,
            candidates=tuple(candidates.get(image, ())),
            frames=tuple(restrictions.frame(other) for other in candidates.get(image, ())),
            options=options.pose,
        )
        for image in query.read().image_names()
    ]
    results = ordered_map(_localize, jobs, executor)
    tracked = track(results, len(jobs), "localizing")
    for job, (result, seconds) in zip(jobs, tracked, strict=True):
        yield job.image, result, seconds


def write_localized(
    output: Path,
    query: KaptureFolder,
    results: Iterable[tuple[str, Pose | Failure, float]],
    *,
    fallback: Fallback = "none",
    first_candidates: dict[str, tuple[str, RigidTransform]] | None = None,
    timing: Path | None = None,
) -> dict[str, int]:
    """Write the localized queries as kapture, with ``status.csv`` beside it.

    Parameters
    ----------
    fallback : what a query that failed gets: nothing; the pose of its best retrieved image; or its
        pose through the rig, from another camera of its moment, where that was localized.
    first_candidates : query -> (best retrieved map image, its pose), needed for "retrieval".
    timing : where to write seconds per query and step.
    """
    data = query.read()
    named = list(results)
    guesses: Mapping[str, tuple[str, RigidTransform]] = {}
    if fallback == "retrieval":
        guesses = first_candidates or {}
    elif fallback == "rig":
        found = {image: result for image, result, _ in named if isinstance(result, Pose)}
        guesses = poses_through_rig(data, found)
    poses: dict[tuple[int, str], RigidTransform] = {}
    statuses = []
    for image, result, _ in named:
        guess = None if result else guesses.get(image)
        statuses.append(
            QueryStatus(
                image=image,
                status="localized" if result else "failed",
                reason="" if isinstance(result, Pose) else result.reason,
                num_matches=result.num_matches,
                num_inliers=result.num_inliers,
                fallback="none" if guess is None else fallback,
                candidates=result.candidates,
            )
        )
        if isinstance(result, Pose):
            poses[data.record_of(image)] = result.cam_from_world
        elif guess is not None:
            poses[data.record_of(image)] = guess[1]
    write_sensors(
        output,
        KaptureData(
            sensors=dict(data.sensors),
            rigs={},
            trajectories=poses,
            records_camera=dict(data.records_camera),
            records_depth={},
        ),
    )
    link_images(query.root, output)
    write_status(output / STATUS_FILE, statuses)
    if timing is not None:
        rows = ((image, "localization", f"{seconds:.4f}") for image, _, seconds in named)
        write_csv_table(timing, ("image", "step", "seconds"), rows)
    localized = sum(bool(result) for _, result, _ in named)
    return {
        "queries": len(named),
        "localized": localized,
        "failed": len(named) - localized,
        "fallbacks": len(poses) - localized,
    }
