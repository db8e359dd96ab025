"""Stage: map points, triangulated from matches, or lifted (backprojected with depth maps)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap import MapImage, TriangulationOptions, triangulate
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, Observations
from megloc_kapture.io.kapture.matches import MatchesReader
from megloc_kapture.mapping.depth import lift_keypoints
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.stages import paths
from megloc_kapture.stages.local_features import warn_of_other_size
from megloc_kapture.stages.map_features import copy_features, write_map
from megloc_kapture.stages.scene import depth_and_pose, depth_records
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, Work


def triangulate_map(
    mapping: KaptureFolder,
    local_types: Sequence[str],
    output: Path,
    options: TriangulationOptions,
    *,
    pairs: Sequence[ImagePair] | None = None,
    num_threads: int = 1,
) -> dict[str, float]:
    """Triangulate with fixed poses and intrinsics, write the map, and return counts for the log.

    Each keypoints type has separate points; those of the first type come first. If ``pairs`` are
    given, only their matches are used.
    """
    types = tuple(dict.fromkeys(local_types))
    data = mapping.read()
    poses = data.poses()
    images = sorted(poses)
    require(images, "no mapping image has a pose (sensors/trajectories.txt)", path=mapping.root)
    require(len(images) > 1, "points need two or more images with poses", path=mapping.root)
    asked = None if pairs is None else {tuple(sorted((pair.query, pair.map))) for pair in pairs}
    of_type = {name: matched_pairs(mapping.matches(name), images, asked) for name in types}
    keypoints_of = {name: mapping.keypoints(name) for name in types}
    xyz, errors_px = np.zeros((0, 3)), np.zeros(0)
    observations = {}
    by_type: dict[str, float] = {}
    for name, matched in of_type.items():
        read = keypoints_of[name].read
        views = [
            MapImage(image, data.camera_of(image), poses[image], read(image)[:, :2])
            for image in images
        ]
        spans = [(view.keypoints_px, (view.camera.width, view.camera.height)) for view in views]
        warn_of_other_size(spans, name, mapping.root)
        verified = matches_of(mapping.matches(name), images, matched)
        type_xyz, type_errors_px, seen = triangulate(
            views, verified, options, num_threads=num_threads, scratch=output.absolute()
        )
        point_ids, image_ids, keypoint_ids = seen.T
        observations[name] = Observations(
            image_names=tuple(images),
            point_ids=point_ids + len(xyz),
            image_ids=image_ids.astype(np.int32),
            keypoint_ids=keypoint_ids.astype(np.int32),
        )
        xyz = np.concatenate([xyz, type_xyz])
        errors_px = np.concatenate([errors_px, type_errors_px])
        by_type[f"points_{name}"] = len(type_xyz)
        by_type[f"observations_{name}"] = len(seen)
    if not len(xyz):
        raise DataError(
            f"no point could be triangulated: {sum(map(len, of_type.values()))} of the image pairs "
            "have verified matches. Check that the images overlap, and that their poses "
            "(cam_from_world) and cameras are correct",
            path=mapping.root,
        )
    _write_map(mapping, output, xyz, observations)
    num_observations = sum(map(len, observations.values()))
    return {
        "images": len(images),
        "pairs": sum(map(len, of_type.values())),
        "points": len(xyz),
        "observations": num_observations,
        **(by_type if len(types) > 1 else {}),
        "mean_track_length": round(num_observations / len(xyz), 3),
        "mean_reprojection_error_px": round(float(errors_px.mean()), 4),
    }


def matches_of(
    reader: MatchesReader, images: Sequence[str], pairs: NDArray[np.int64]
) -> dict[tuple[int, int], NDArray[np.int64]]:
    return {(a, b): reader.read(images[a], images[b])[0] for a, b in pairs.tolist()}


def matched_pairs(
    reader: MatchesReader, images: Sequence[str], asked: Collection[tuple[str, ...]] | None
) -> NDArray[np.int64]:
    """Return the pairs with matches, as rows of ``images`` (P, 2).

    ``asked`` restricts them to these pairs of names, sorted within a pair; None means all.
    """
    row_of = {image: row for row, image in enumerate(images)}
    pairs = [
        (row_of[a], row_of[b])
        for a, b in reader.pairs
        if a in row_of and b in row_of and (asked is None or (a, b) in asked)
        if reader.length(a, b)
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


def lift_map(
    mapping: KaptureFolder,
    local_types: Sequence[str],
    output: Path,
    *,
    work: Work = HERE,
) -> dict[str, float]:
    """Backproject keypoints with depth maps and write the map; return counts for the log."""
    records, images = depth_records(mapping.read()), list(mapping.read().poses())
    with_depth = [image for image in images if image in records]
    require(
        with_depth,
        "no mapping image has a pose and a depth map with its timestamp; this needs "
        "records_depth.txt and a rig with camera and depth sensor",
        path=mapping.root,
    )
    points: list[NDArray[np.float64]] = []
    seen: dict[str, Observations] = {}
    for local_type in local_types:
        lift = partial(_lift, mapping, local_type)
        lifted = list(work.map(lift, with_depth, f"lifting {local_type}"))
        counts = [len(ids) for _, ids in lifted]
        seen[local_type] = Observations(
            image_names=tuple(with_depth),
            point_ids=sum(map(len, points)) + np.arange(sum(counts)),
            image_ids=np.repeat(np.arange(len(with_depth), dtype=np.int32), counts),
            keypoint_ids=np.concatenate([ids for _, ids in lifted]),
        )
        points += [xyz for xyz, _ in lifted]
    xyz = np.concatenate(points)
    _write_map(mapping, output, xyz, seen)
    return {"images": len(images), "images_with_depth": len(with_depth), "points": len(xyz)}


def _lift(
    mapping: KaptureFolder, local_type: str, image: str
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return points in the world (N, 3) and their keypoint ids (N,)."""
    depth, cam_from_world = depth_and_pose(mapping, image)
    points, valid = lift_keypoints(
        mapping.keypoints(local_type).read(image),
        depth.depth_m,
        mapping.read().camera_of(image),
        depth.camera,
        depth.image_from_depth,
    )
    return cam_from_world.inverse().apply(points[valid]), np.flatnonzero(valid).astype(np.int32)


def _write_map(
    mapping: KaptureFolder,
    output: Path,
    xyz: NDArray[np.float64],
    observations: Mapping[str, Observations],
) -> None:
    write_map(mapping, output, np.concatenate([xyz, np.zeros_like(xyz)], axis=1), observations)
    # also copy the base type of a pyramid type, as queries are first matched with the base type
    copy_features(mapping, output, {*observations, *map(base_type, observations)})


class MakePoints(PipelineStage):
    """Triangulate the map's points, or backproject them from keypoints with depth maps."""

    name = "points"
    version = 4
    uses = ("map", "triangulation", "guided_pyramid.mode", *LOCAL_TYPES)
    explained_by = ("map",)
    inputs = (
        PipelineStage.mapping,
        paths.LOCAL_FEATURES,
        paths.GLOBAL_FEATURES,
        PipelineStage.mapping_matches,
    )
    outputs = (paths.UNREFINED_MAP,)

    def run(self, work: StageWork) -> Mapping[str, float]:
        options, out = self.options, work.out / paths.UNREFINED_MAP
        mapping = work.folder(self.mapping(), paths.FEATURES, *self.mapping_matches())
        if not options.triangulates():
            return lift_map(mapping, options.local_types(), out, work=work)
        types, threads = options.matched_types(), work.num_threads
        return triangulate_map(mapping, types, out, options.triangulation, num_threads=threads)
