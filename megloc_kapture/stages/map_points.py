"""Stages: map points, triangulated, lifted through depth, or from a prebuilt model."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import MapImage, TriangulatedPoints, TriangulationOptions, triangulate
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import (
    ImagePair,
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.matches import MatchesReader
from megloc_kapture.mapping.depth import lift_keypoints
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.stages.given_map import check_given_type, copy_features, given_map
from megloc_kapture.stages.scene import DepthRecord, depth_records, read_depth
from megloc_kapture.stages.stage import (
    FEATURES,
    GLOBAL_FEATURES,
    LOCAL_FEATURES,
    LOCAL_TYPES,
    REFERENCE,
    UNREFINED,
    Layout,
    PipelineStage,
    StageWork,
)
from megloc_kapture.stages.work import HERE, FolderSpec, Work

_IMAGES_AT_ONCE = 1000  # small parts are merged up to this size


def triangulate_map(
    mapping: KaptureFolder,
    matches: KaptureFolder,
    local_types: Sequence[str] | str,
    output: Path,
    options: TriangulationOptions,
    *,
    pairs: Sequence[ImagePair] | None = None,
    num_threads: int = 1,
    work: Work = HERE,
) -> dict[str, float]:
    """Triangulate with fixed poses and intrinsics, write the map, and return counts for the log.

    Each feature type has separate points, those of the first type first. Parts of a large map
    without matches between them are triangulated separately; with known poses the result is the
    same.

    Parameters
    ----------
    matches : folder of the verified matches.
    local_types : keypoints types; duplicates are ignored.
    pairs : restrict the matches to these pairs.
    num_threads : of COLMAP, if no workers share the parts.
    """
    types = tuple(dict.fromkeys([local_types] if isinstance(local_types, str) else local_types))
    data = mapping.read()
    images = sorted(data.poses())
    if not images:
        raise DataError("no mapping image has a pose", path=mapping.root)
    asked = None if pairs is None else {tuple(sorted((pair.query, pair.map))) for pair in pairs}
    of_type = {name: matched_pairs(matches.matches(name), images, asked) for name in types}
    for name in types:
        mapping.keypoints(name)
    specs = FolderSpec(mapping), FolderSpec(matches)
    xyz, errors_px = np.zeros((0, 3)), np.zeros(0)
    observations = {}
    by_type: dict[str, float] = {}
    for name, matched in of_type.items():
        parts = _unconnected(len(images), matched)
        threads = 1 if len(parts) > 1 and work.executor is not None else num_threads
        part = partial(_triangulate_part, specs, name, options, threads, output.absolute())
        found = _triangulate(part, images, matched, parts, work, f"triangulation of {name}")
        observations[name] = Observations(
            keypoints_type=name,
            image_names=tuple(images),
            point_ids=found.point_ids + len(xyz),
            image_ids=found.image_ids.astype(np.int32),
            keypoint_ids=found.keypoint_ids.astype(np.int32),
        )
        xyz = np.concatenate([xyz, found.xyz])
        errors_px = np.concatenate([errors_px, found.errors_px])
        by_type[f"points_{name}"] = len(found.xyz)
        by_type[f"observations_{name}"] = len(found.point_ids)
    if not len(xyz):
        raise DataError(
            f"no point could be triangulated: {sum(map(len, of_type.values()))} of the image pairs "
            "have verified matches. Check that the images overlap, and that their poses "
            "(cam_from_world) and cameras are right",
            path=mapping.root,
        )
    write_sensors(output, data)
    link_images(mapping.root, output)
    # keep a pyramid's base type, as queries are first matched with that
    there = mapping.types("keypoints")
    copy_features(mapping, output, {*types, *map(base_type, types)}.intersection(there))
    # kapture stores a colour per point; black means unknown
    write_points3d(output, np.concatenate([xyz, np.zeros_like(xyz)], axis=1))
    write_observations(output, observations)
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
    """Return matched pairs (P, 2) of rows of ``images``, among ``asked`` (first name first)."""
    row_of = {image: row for row, image in enumerate(images)}
    pairs = [
        (row_of[a], row_of[b])
        for a, b in reader.pairs
        if a in row_of and b in row_of and (asked is None or (a, b) in asked)
        if reader.length(a, b)
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


_Part = tuple[list[str], NDArray[np.int64]]  # images, and matching pairs (P, 2) of them


def _triangulate(
    triangulate_part: Callable[[_Part], TriangulatedPoints],
    images: list[str],
    pairs: NDArray[np.int64],
    members: Sequence[NDArray[np.int64]],
    work: Work,
    label: str,
) -> TriangulatedPoints:
    if len(members) == 1:
        return triangulate_part((images, pairs))
    parts = [
        (
            [images[row] for row in rows.tolist()],
            np.searchsorted(rows, pairs[np.isin(pairs[:, 0], rows)]),
        )
        for rows in members
    ]
    found = list(work.map(triangulate_part, parts, label))
    before = np.cumsum([0, *(len(one.xyz) for one in found)]).tolist()
    return TriangulatedPoints(
        xyz=np.concatenate([one.xyz for one in found]),
        errors_px=np.concatenate([one.errors_px for one in found]),
        point_ids=np.concatenate(
            [one.point_ids + offset for one, offset in zip(found, before, strict=False)]
        ),
        image_ids=np.concatenate(
            [rows[one.image_ids] for one, rows in zip(found, members, strict=True)]
        ),
        keypoint_ids=np.concatenate([one.keypoint_ids for one in found]),
    )


def _triangulate_part(
    specs: tuple[FolderSpec, FolderSpec],
    local_type: str,
    options: TriangulationOptions,
    num_threads: int,
    scratch: Path,
    part: _Part,
) -> TriangulatedPoints:
    names, pairs = part
    mapping, reader = specs[0].open(), specs[1].open().matches(local_type)
    data, keypoints = mapping.read(), mapping.keypoints(local_type)
    images = [
        MapImage(image, data.camera_of(image), pose, keypoints.read(image)[:, :2])
        for image in names
        if (pose := data.cam_from_world(image)) is not None
    ]
    verified = matches_of(reader, names, pairs)
    return triangulate(images, verified, options, num_threads=num_threads, scratch=scratch)


def _unconnected(num_images: int, pairs: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return image rows of the connected components; small ones are merged."""
    links = csr_array((np.ones(len(pairs)), pairs.T), shape=(num_images, num_images))
    _, part_of = connected_components(links, directed=False)
    rows = np.argsort(part_of, kind="stable")
    groups: list[list[NDArray[np.int64]]] = [[]]
    size = 0
    for part in np.split(rows, np.flatnonzero(np.diff(part_of[rows])) + 1):
        if size and size + len(part) > _IMAGES_AT_ONCE:
            groups.append([])
            size = 0
        groups[-1].append(part)
        size += len(part)
    return [np.sort(np.concatenate(group)) for group in groups]


def lift_map(
    mapping: KaptureFolder,
    local_types: Sequence[str],
    output: Path,
    *,
    work: Work = HERE,
) -> dict[str, float]:
    """Lift keypoints through the depth maps and write the map; return counts for the log."""
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
    spec, row_of = FolderSpec(mapping), {image: row for row, image in enumerate(images)}
    jobs = [(image, records[image]) for image in with_depth]
    points: list[NDArray[np.float64]] = []
    seen: dict[str, Observations] = {}
    total = 0
    for local_type in local_types:
        image_ids: list[NDArray[np.int32]] = []
        keypoint_ids: list[NDArray[np.int32]] = []
        lift = partial(_lift, spec, local_type)
        results = work.map(lift, jobs, f"lifting {local_type}")
        for image, (lifted, ids) in zip(with_depth, results, strict=True):
            points.append(poses[image].inverse().apply(lifted))
            image_ids.append(np.full(len(ids), row_of[image], np.int32))
            keypoint_ids.append(ids)
        keypoints = np.concatenate(keypoint_ids)
        seen[local_type] = Observations(
            keypoints_type=local_type,
            image_names=tuple(images),
            point_ids=total + np.arange(len(keypoints)),
            image_ids=np.concatenate(image_ids),
            keypoint_ids=keypoints,
        )
        total += len(keypoints)
    xyz = np.concatenate(points)
    write_sensors(output, data)
    link_images(mapping.root, output)
    copy_features(mapping, output, local_types)
    write_points3d(output, np.concatenate([xyz, np.zeros_like(xyz)], axis=1))
    write_observations(output, seen)
    return {"images": len(images), "images_with_depth": len(with_depth), "points": len(xyz)}


def _lift(
    spec: FolderSpec, local_type: str, job: tuple[str, DepthRecord]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return points in the camera frame (N, 3) and their keypoint ids (N,)."""
    image, depth = job
    folder = spec.open()
    points, valid = lift_keypoints(
        folder.keypoints(local_type).read(image),
        read_depth(folder, depth),
        folder.read().camera_of(image),
        depth.camera,
        depth.image_from_depth,
    )
    return points[valid], np.flatnonzero(valid).astype(np.int32)


class GivenMap(PipelineStage):
    """Use the points of the dataset's model."""

    name = "points"
    uses = ("map", "given_features")
    explained_by = ("map",)
    inputs = (REFERENCE, Layout.mapping, LOCAL_FEATURES, GLOBAL_FEATURES)
    outputs = (UNREFINED,)

    def is_wanted(self) -> bool:
        return self.options.map == "given"

    def run(self, work: StageWork) -> Mapping[str, float]:
        reference = work.folder(REFERENCE)
        check_given_type(reference, self.options.make_given_extractor().name)
        mapping = work.folder(self.layout.mapping(), FEATURES)
        return given_map(reference, mapping, work.out / UNREFINED)


class LiftPoints(PipelineStage):
    """Lift the map's points from keypoints through depth."""

    name = "points"
    uses = ("map", "local_features.name", "local_features.options")
    explained_by = ("map",)
    inputs = (Layout.mapping, LOCAL_FEATURES, GLOBAL_FEATURES)
    outputs = (UNREFINED,)

    def is_wanted(self) -> bool:
        return self.options.map == "lift"

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping, types = work.folder(self.layout.mapping(), FEATURES), self.options.own_types()
        return lift_map(mapping, types, work.out / UNREFINED, work=work)


class TriangulatePoints(PipelineStage):
    """Triangulate the map's points."""

    name = "points"
    version = 2
    uses = ("triangulation", "guided_pyramid.mode", *LOCAL_TYPES)
    explained_by = ("map",)
    inputs = (
        Layout.mapping,
        LOCAL_FEATURES,
        GLOBAL_FEATURES,
        Layout.mapping_matches,
    )
    outputs = (UNREFINED,)

    def is_wanted(self) -> bool:
        return self.options.triangulates()

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping = work.folder(self.layout.mapping(), FEATURES, *self.layout.mapping_matches())
        return triangulate_map(
            mapping,
            mapping,
            self.options.point_types(),
            work.out / UNREFINED,
            self.options.triangulation,
            num_threads=work.num_threads,
            work=work,
        )
