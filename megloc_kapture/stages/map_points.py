"""Stage: the points of the map: triangulated, lifted through depth, or of a given model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import (
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.mapping.depth import LiftingOptions, lift_keypoints
from megloc_kapture.stages.given_map import given_map, given_type, has_descriptors, join_maps
from megloc_kapture.stages.rigs import DepthRecord, depth_records, read_depth
from megloc_kapture.stages.stage import (
    FEATURES,
    GLOBAL_FEATURES,
    LOCAL_FEATURES,
    LOCAL_TYPES,
    MAP,
    REFERENCE,
    UNREFINED,
    Layout,
    PipelineStage,
    StageWork,
)
from megloc_kapture.stages.triangulation import copy_features, triangulate_map
from megloc_kapture.stages.work import HERE, FolderSpec, Work


def lift_map(
    mapping: KaptureFolder,
    local_types: Sequence[str],
    output: Path,
    options: LiftingOptions,
    *,
    work: Work = HERE,
) -> dict[str, float]:
    """Lift the keypoints of the map's images through their depth maps, and write the map.

    Returns counts for the log. ``local_types``: keypoints types that get points, each its own.
    Raises DataError: no image has a pose, or none has depth; a depth map is missing or broken.
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
    spec, row_of = FolderSpec(mapping), {image: row for row, image in enumerate(images)}
    jobs = [(image, records[image]) for image in with_depth]
    points: list[NDArray[np.float64]] = []
    seen: dict[str, Observations] = {}
    total = 0
    for local_type in local_types:
        image_ids: list[NDArray[np.int32]] = []
        keypoint_ids: list[NDArray[np.int32]] = []
        lift = partial(_lift, spec, local_type, options)
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
    spec: FolderSpec, local_type: str, options: LiftingOptions, job: tuple[str, DepthRecord]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points in the image's camera frame (N, 3), and the keypoints they belong to (N,)."""
    image, depth = job
    folder = spec.open()
    points, valid = lift_keypoints(
        folder.keypoints(local_type).read(image),
        read_depth(folder, depth),
        folder.read().camera_of(image),
        depth.camera,
        depth.image_from_depth,
        options,
    )
    return points[valid], np.flatnonzero(valid).astype(np.int32)


def check_given_type(reference: KaptureFolder, expected: str) -> None:
    """Check that a given map is of the keypoints type that is extracted for it.

    Raises DataError: it is of another one, or no map.
    """
    found = given_type(reference)
    if found != expected:
        raise DataError(
            f"the given map is of keypoints type {found!r}, given_features extracts {expected!r}",
            path=reference.root,
        )


def is_given(stage: PipelineStage, local_type: str) -> bool:
    """Whether points of a keypoints type are those of the given map."""
    options = stage.options
    return options.uses_given_map() and local_type == options.make_given_extractor().name


def described_images(work: StageWork, stage: PipelineStage, local_type: str) -> KaptureFolder:
    """The map's images with their features of a type, before there is a map."""
    # descriptors of its own: those that were extracted for it lie in the workspace
    if is_given(stage, local_type) and has_descriptors(work.folder(REFERENCE)):
        return work.folder(REFERENCE, FEATURES)
    return work.folder(stage.layout.mapping(), FEATURES)


def matched_images(work: StageWork, stage: PipelineStage, local_type: str) -> KaptureFolder:
    """The map's images with the features of a type that queries are matched with.

    A given map has keypoints of its own, which are not all that its images' extraction gives.
    """
    if is_given(stage, local_type):
        return work.folder(MAP)
    return work.folder(stage.layout.mapping(), FEATURES, *stage.layout.mapping_matches())


class GivenMap(PipelineStage):
    """Take the points of the model that the dataset comes with."""

    name = "points"
    uses = ("map", "given_features")
    inputs = (REFERENCE, Layout.mapping, LOCAL_FEATURES, GLOBAL_FEATURES)
    outputs = (UNREFINED,)

    def is_wanted(self) -> bool:
        return self.options.map == "given"

    def run(self, work: StageWork) -> Mapping[str, float]:
        return write_given_map(work, self, work.out / UNREFINED)


def write_given_map(work: StageWork, stage: PipelineStage, output: Path) -> dict[str, float]:
    """Write the given map of a run; see :func:`given_map`."""
    reference = work.folder(REFERENCE)
    check_given_type(reference, stage.options.make_given_extractor().name)
    return given_map(reference, work.folder(stage.layout.mapping(), FEATURES), output)


class LiftPoints(PipelineStage):
    """Make the map's points of keypoints, by the depth of its images."""

    name = "points"
    uses = ("map", "lifting", "local_features.name", "local_features.options")
    inputs = (Layout.mapping, LOCAL_FEATURES, GLOBAL_FEATURES)
    outputs = (UNREFINED,)

    def is_wanted(self) -> bool:
        return self.options.map == "lift"

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping, types = work.folder(self.layout.mapping(), FEATURES), self.options.own_types()
        return lift_map(mapping, types, work.out / UNREFINED, self.options.lifting, work=work)


class TriangulatePoints(PipelineStage):
    """Triangulate the map's points, beside those of a given map where both are wanted."""

    name = "points"
    version = 2
    uses = ("triangulation", "guided_pyramid.mode", *LOCAL_TYPES)
    inputs = (
        Layout.mapping,
        LOCAL_FEATURES,
        GLOBAL_FEATURES,
        Layout.mapping_matches,
        Layout.reference,
    )
    outputs = (UNREFINED,)

    def is_wanted(self) -> bool:
        return self.options.triangulates()

    def run(self, work: StageWork) -> Mapping[str, float]:
        joined, options = self.options.uses_given_map(), self.options
        mapping = work.folder(self.layout.mapping(), FEATURES, *self.layout.mapping_matches())
        own, given = work.out / ("map_own" if joined else UNREFINED), work.out / "map_given"
        counts = triangulate_map(
            mapping,
            mapping,
            options.point_types(),
            own,
            options.triangulation,
            num_threads=work.num_threads,
            work=work,
        )
        if not joined:
            return counts
        write_given_map(work, self, given)
        both = join_maps(KaptureFolder(own), KaptureFolder(given), work.out / UNREFINED)
        return {**both, "points_triangulated": counts["points"]}
