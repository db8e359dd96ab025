"""Stage: better poses of localized queries, or the old ones with the reason why they stay."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import PluginError
from megloc_kapture.geometry.poses import movement
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
from megloc_kapture.plugins import (
    POSE_REFINERS,
    PluginChoice,
    PoseRefinement,
    PoseRefiner,
    RankingScene,
    load_plugin,
)
from megloc_kapture.refinement.consistency import Consistency, HoldsOut
from megloc_kapture.refinement.references import ReferenceImages
from megloc_kapture.stages.layout import LOCALIZED, MAP, REFINEMENT_TIMING, UNREFINED_POSES
from megloc_kapture.stages.map_consistency import consistency_row, map_consistency
from megloc_kapture.stages.ranking_scene import KaptureScene
from megloc_kapture.stages.restrictions import UNRESTRICTED, Restrictions
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, FolderSpec, Work
from megloc_kapture.values import Camera, Options, RefinementRow, RigidTransform

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions


class PoseRefinementOptions(Options):
    """How the poses of localized queries are refined."""

    by: tuple[PluginChoice, ...] = Field(
        default=(), description="pose refiners, one after another; none: poses stay"
    )
    max_references: int = Field(
        default=30,
        gt=0,
        description="map images a refiner may choose from: that look the query's way, the nearest",
    )

    def idle(self) -> dict[str, str]:
        return {} if self.refines() else {"max_references": "pose_refinement.by is empty"}

    def with_refiners(self, names: Sequence[str]) -> PoseRefinementOptions:
        """With these refiners, in this order, each with the options that it has here."""
        known = {one.name: one.options for one in self.by}
        chosen = [{"name": name, "options": known.get(name, {})} for name in names]
        return PoseRefinementOptions.model_validate({**self.model_dump(), "by": chosen})

    def refines(self) -> bool:
        """Whether anything is done."""
        return bool(self.by)

    def make_refiners(self) -> list[PoseRefiner]:
        """The refiners, in order; raises PluginError, MissingWeightsError."""
        return [load_plugin(POSE_REFINERS, one.name, one.options) for one in self.by]


@dataclass(frozen=True)
class _Job:
    map: FolderSpec
    query: FolderSpec
    refiners: tuple[PoseRefiner, ...]
    distrusted: tuple[str, ...]  # of each refiner, why it must not be used; empty where it may
    image: str
    cam_from_world: RigidTransform
    references: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A query's pose after all refiners.

    Attributes
    ----------
    covariance : float64 (6, 6) that the last refiner whose pose counts gave; None without.
    rows : what each refiner made of it, in their order.
    """

    cam_from_world: RigidTransform
    covariance: NDArray[np.float64] | None
    rows: tuple[RefinementRow, ...]
    seconds: dict[str, float]


class PoseReferences:
    """Which map images a pose is refined against, by coordinate frame.

    Parameters
    ----------
    poses : ``cam_from_world`` of the map's images.
    """

    def __init__(
        self,
        poses: Mapping[str, RigidTransform],
        restrictions: Restrictions,
        options: PoseRefinementOptions,
    ) -> None:
        images = sorted(poses)
        self._restrictions, self._options = restrictions, options
        self._by_frame = {
            restrictions.frame(images[members[0]]): ReferenceImages(
                {images[member]: poses[images[member]] for member in members}
            )
            for members in restrictions.frames(images)
        }

    def frame(self, candidates: Sequence[str]) -> str:
        """The coordinate frame of a pose, by the map images that it comes from."""
        return self._restrictions.frame(candidates[0]) if candidates else ""

    def near(self, cam_from_world: RigidTransform, candidates: Sequence[str]) -> list[str]:
        """Map images that may show what a query sees, best first.

        Parameters
        ----------
        candidates : map images that its pose comes from.
        """
        return self._by_frame[self.frame(candidates)].near(
            cam_from_world, candidates, max_references=self._options.max_references
        )

    def verdicts(
        self,
        mapping: FolderSpec,
        frames: Sequence[str],
        refiners: Sequence[PoseRefiner],
        *,
        work: Work = HERE,
    ) -> list[dict[str, Consistency]]:
        """Of each refiner whose poses are as good as the map is consistent, that of each frame.

        Raises
        ------
        DataError : an image or a depth map cannot be read.
        """
        asked = {frame: self._by_frame[frame] for frame in frames}
        return [
            map_consistency(mapping, asked, refiner, work=work)
            if isinstance(refiner, HoldsOut) and refiner.require_consistent_map
            else {}
            for refiner in refiners
        ]


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
    refiners = tuple(options.make_refiners())
    statuses = read_status(localized.root / STATUS_FILE)
    data = localized.read()
    map_spec, query_spec = (FolderSpec(f) for f in (map_folder, query))
    references = PoseReferences(map_folder.read().poses(), restrictions, options)
    refined = {
        image: (pose, references.frame(status.candidates))
        for image, status in statuses.items()
        if status.status == "localized" and (pose := data.cam_from_world(image)) is not None
    }
    frames = sorted({frame for _, frame in refined.values()})
    verdicts = references.verdicts(map_spec, frames, refiners, work=work)
    jobs = []
    for image, (pose, frame) in refined.items():
        near = references.near(pose, statuses[image].candidates)
        why = tuple(found[frame].reason if found else "" for found in verdicts)
        jobs.append(_Job(map_spec, query_spec, refiners, why, image, pose, tuple(near)))
    results = work.map(_refine, jobs, "refining")
    found = {job.image: refined for job, refined in zip(jobs, results, strict=True)}
    _write(output, data, localized, statuses, found)
    tested = [
        consistency_row(frame, refiner.name, verdict)
        for refiner, verdict_of in zip(refiners, verdicts, strict=True)
        for frame, verdict in verdict_of.items()
    ]
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
    for refiner in refiners:
        counts[f"accepted_by_{refiner.name}"] = sum(
            row.accepted
            for refined in found.values()
            for row in refined.rows
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
    found: dict[str, RefinedPose],
) -> None:
    poses = dict(data.trajectories)
    for image, refined in found.items():
        poses[data.record_of(image)] = refined.cam_from_world
    write_sensors(output, replace(data, trajectories=poses))
    link_images(localized.root, output)
    write_status(
        output / STATUS_FILE,
        (
            status.model_copy(update={"refinement": refinement_text(found[image].rows)})
            if image in found
            else status
            for image, status in statuses.items()
        ),
    )
    clusters = localized.root / CLUSTERS_FILE
    if clusters.is_file():
        shutil.copyfile(clusters, output / CLUSTERS_FILE)
    write_refinement(
        output / REFINEMENT_FILE, (row for refined in found.values() for row in refined.rows)
    )


def _refine(job: _Job) -> RefinedPose:
    mapping, query = job.map.open(), job.query.open()
    return refine_pose(
        job.image,
        query.read().camera_of(job.image),
        job.cam_from_world,
        job.references,
        job.refiners,
        job.distrusted,
        KaptureScene(mapping, query),
    )


def refine_pose(
    image: str,
    camera: Camera,
    cam_from_world: RigidTransform,
    references: Sequence[str],
    refiners: Sequence[PoseRefiner],
    distrusted: Sequence[str],
    scene: RankingScene,
) -> RefinedPose:
    """Refine the pose of one query by one refiner after another.

    Parameters
    ----------
    references : map images, see :class:`PoseReferences`.
    distrusted : of each refiner, why it must not be used in this map; empty where it may.

    Raises
    ------
    PluginError : a refiner breaks its protocol.
    """
    pose, covariance, rows, seconds = cam_from_world, None, [], {}
    for refiner, reason in zip(refiners, distrusted, strict=True):
        started = time.perf_counter()
        if reason:
            refined = PoseRefinement(pose, reason)
        else:
            refined = refiner.refine(image, camera, pose, references, scene)
        rows.append(_row(refiner, image, pose, refined))
        if refined.accepted:
            pose, covariance = refined.cam_from_world, refined.covariance
        seconds[refiner.name] = time.perf_counter() - started
    return RefinedPose(pose, covariance, tuple(rows), seconds)


def _row(
    refiner: PoseRefiner, image: str, before: RigidTransform, refined: PoseRefinement
) -> RefinementRow:
    if not isinstance(refined, PoseRefinement):
        raise PluginError(
            f"plugin {refiner.name!r} on image {image}: refine returned "
            f"{type(refined).__name__}, not PoseRefinement"
        )
    after = refined.cam_from_world if refined.accepted else before
    moved_m, turned_deg = movement(before, after)
    return RefinementRow(
        image=image,
        method=refiner.name,
        reason=refined.reason,
        moved_m=moved_m,
        turned_deg=turned_deg,
        measures=tuple(f"{name}={value:.6g}" for name, value in refined.measures.items()),
        before=before,
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
