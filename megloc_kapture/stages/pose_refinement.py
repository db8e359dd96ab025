"""Stage: better poses of localized queries, or the old ones with the reason why they stay."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.dataset_tables import SIDE_TABLES
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, write_sensors
from megloc_kapture.io.tables import (
    CLUSTERS_FILE,
    CONSISTENCY_FILE,
    REFINEMENT_FILE,
    STATUS_FILE,
    QueryStatus,
    read_status,
    refinement_text,
    write_consistency,
    write_refinement,
    write_status,
)
from megloc_kapture.plugins import PoseRefiner
from megloc_kapture.stages.kept_items import Digest
from megloc_kapture.stages.layout import LOCALIZED, MAP, REFINEMENT_TIMING, UNREFINED_POSES
from megloc_kapture.stages.localized_folder import plain_result, pose_of
from megloc_kapture.stages.map_refiners import MapRefiners, PoseRefinementOptions, refine_pose
from megloc_kapture.stages.ranking_scene import KaptureScene, image_inputs
from megloc_kapture.stages.restrictions import UNRESTRICTED, Restrictions
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, FolderSpec, Work
from megloc_kapture.values import Pose

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions


@dataclass(frozen=True)
class _Job:
    map: FolderSpec
    query: FolderSpec
    image: str
    pose: Pose
    references: tuple[str, ...]
    distrusted: tuple[str, ...]
    refiners: tuple[PoseRefiner, ...]


def refine_poses(
    map_folder: KaptureFolder,
    query: KaptureFolder,
    localized: KaptureFolder,
    output: Path,
    options: PoseRefinementOptions,
    *,
    restrictions: Restrictions = UNRESTRICTED,
    work: Work = HERE,
    timing: Path | None = None,
) -> dict[str, float]:
    """Refine the poses of queries that were localized, and write them as a result of their own.

    A query that failed, or has a fallback pose, is left as it is. What became of each pose stands
    in ``status.csv``, with measures in ``refinement.csv``. A refiner whose poses are as good as the
    map is consistent is used in those coordinate frames only that prove to be; the measurement
    stands in ``map_consistency.csv``.

    Parameters
    ----------
    map_folder : kapture with poses, and whatever the refiners need: images, depth maps, points.
    query : images of the queries, their masks and depth maps.
    localized : what localization wrote.
    restrictions : the coordinate frames of the map's images, which are never mixed.
    timing : where to write seconds per query and refiner.

    Returns
    -------
    Counts for the log.

    Raises
    ------
    DataError : ``status.csv`` is absent or broken; images or depth maps cannot be read.
    PluginError : there is no such refiner, or it breaks its protocol.
    """
    refiners = MapRefiners(map_folder, restrictions, options)
    statuses = read_status(localized.root / STATUS_FILE)
    data = localized.read()
    query_spec = FolderSpec(query)
    poses = {
        image: Pose(pose, row.num_matches, row.num_inliers, candidates=row.candidates)
        for image, row in statuses.items()
        if row.status == "localized" and (pose := data.cam_from_world(image)) is not None
    }
    refiners.test(poses.values(), work=work)
    uses = {image: refiners.uses(pose) for image, pose in poses.items()}
    of_query = image_inputs(query)

    def inputs(image: str, digest: Digest) -> object:
        camera = query.read().camera_of(image)
        own = (asdict(poses[image]), astuple(camera), of_query(image, digest), uses[image])
        return [refiners.map_content(digest), *own]

    items = work.items("refined", list(poses), inputs)
    jobs = [
        _Job(refiners.map, query_spec, image, pose, *uses[image], refiners.refiners)
        for image, pose in poses.items()
        if image not in items.done
    ]
    found = {image: pose_of(plain) for image, plain in items.done.items()}
    results = work.map(_refine, jobs, items.label("refining"))
    for job, refined in zip(jobs, results, strict=True):
        found[job.image] = refined
        items.add(job.image, (), plain_result(refined))
    found = {image: found[image] for image in poses}
    _write(output, data, localized, statuses, found)
    tested = refiners.tested()
    if tested:
        write_consistency(output / CONSISTENCY_FILE, tested)
    if timing is not None:
        rows = (
            (image, step, f"{seconds:.5f}")
            for image, refined in found.items()
            for step, seconds in refined.seconds.items()
        )
        write_csv_table(timing, ("image", "step", "seconds"), rows)
    counts: dict[str, float] = {"queries": len(jobs)}
    for refiner in refiners.refiners:
        counts[f"accepted_by_{refiner.name}"] = sum(
            row.accepted
            for refined in found.values()
            for row in refined.refinements
            if row.method == refiner.name
        )
    for row in tested:
        counts[" ".join(filter(None, (row.method, "trusted", row.frame)))] = float(not row.reason)
    return counts


def _write(
    output: Path,
    data: KaptureData,
    localized: KaptureFolder,
    statuses: dict[str, QueryStatus],
    found: dict[str, Pose],
) -> None:
    poses = dict(data.trajectories)
    for image, refined in found.items():
        poses[data.record_of(image)] = refined.cam_from_world
    write_sensors(output, replace(data, trajectories=poses))
    link_images(localized.root, output)
    write_status(
        output / STATUS_FILE,
        (
            status.model_copy(update={"refinement": refinement_text(found[image].refinements)})
            if image in found
            else status
            for image, status in statuses.items()
        ),
    )
    clusters = localized.root / CLUSTERS_FILE
    if clusters.is_file():
        shutil.copyfile(clusters, output / CLUSTERS_FILE)
    write_refinement(
        output / REFINEMENT_FILE, (row for refined in found.values() for row in refined.refinements)
    )


def _refine(job: _Job) -> Pose:
    mapping, query = job.map.open(), job.query.open()
    return refine_pose(
        job.image,
        query.read().camera_of(job.image),
        job.pose,
        job.references,
        job.distrusted,
        job.refiners,
        KaptureScene(mapping, query),
    )


class RefinePoses(PipelineStage):
    """Refine the poses of localized queries by ICP or by rendering."""

    name = "refine_poses"
    version = 2
    uses = ("pose_refinement",)
    writes = (LOCALIZED, REFINEMENT_TIMING)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (SIDE_TABLES, self.layout.query, MAP, UNREFINED_POSES)

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.pose_refinement.refines()

    def plugins(self) -> Sequence[object]:
        return self.options.pose_refinement.make_refiners()

    def run(self, work: StageWork) -> Mapping[str, float]:
        return refine_poses(
            work.folder(MAP),
            work.folder(self.layout.query),
            work.folder(UNREFINED_POSES),
            work.out / LOCALIZED,
            self.options.pose_refinement,
            restrictions=work.restrictions(),
            work=work,
            timing=work.out / REFINEMENT_TIMING,
        )
