"""Stage: pose refinement of localized queries."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Literal

from pydantic import Field

from megloc_kapture.errors import OptionError, PluginError
from megloc_kapture.geometry.poses import movement
from megloc_kapture.io.dataset_tables import METRES, SIDE_TABLES, unit_of
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, write_sensors
from megloc_kapture.io.tables import (
    CLUSTERS_FILE,
    CONSISTENCY_FILE,
    COVARIANCE_FILE,
    POSES_FILE,
    REFINEMENT_FILE,
    STATUS_FILE,
    ConsistencyRow,
    QueryStatus,
    read_covariances,
    read_status,
    refinement_text,
    write_consistency,
    write_covariances,
    write_refinement,
    write_status,
)
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import (
    POSE_REFINERS,
    PluginChoice,
    PoseRefinement,
    PoseRefiner,
    RankingScene,
    chosen_by_name,
)
from megloc_kapture.refinement.references import (
    Consistency,
    Displacement,
    HoldsOut,
    ReferenceImages,
    judge_consistency,
    spread_names,
)
from megloc_kapture.stages.candidates import UNRESTRICTED, Restrictions
from megloc_kapture.stages.localized_folder import write_poses, write_timing
from megloc_kapture.stages.scene import KaptureScene
from megloc_kapture.stages.stage import (
    LOCALIZED,
    MAP,
    REFINEMENT_TIMING,
    UNREFINED_POSES,
    Layout,
    PipelineStage,
    StageWork,
)
from megloc_kapture.stages.work import HERE, FolderSpec, Work, ordered_map
from megloc_kapture.values import Camera, Options, Pose, RefinementRow, RigidTransform

# map images held out at once; a larger window wastes work after the last one needed
_WINDOW = 4
# map images a refiner may choose from: the nearest that look the query's way
_MAX_REFERENCES = 30


class PoseRefinementOptions(Options):
    by: tuple[PluginChoice, ...] = Field(
        default=(), description="pose refiners, applied in order; empty: no refinement"
    )
    references: Literal["cluster", "frame"] = Field(
        default="cluster",
        description="reference images for refiners: those of the pose's cluster, or also others "
        "of its coordinate frame",
    )

    def with_refiners(self, names: Sequence[str]) -> PoseRefinementOptions:
        """Select refiners, in this order; known ones keep their options."""
        chosen = chosen_by_name(self.by, names)
        return PoseRefinementOptions.model_validate({**self.model_dump(), "by": chosen})

    def refines(self) -> bool:
        return bool(self.by)

    def make_refiners(self) -> list[PoseRefiner]:
        return [load_plugin(POSE_REFINERS, one.name, one.options) for one in self.by]


class MapRefiners:
    """Pose refiners of a map; thread-safe.

    Refiners that need a consistent map are used only in coordinate frames that pass a test on
    held-out map images.
    """

    def __init__(
        self, mapping: KaptureFolder, restrictions: Restrictions, options: PoseRefinementOptions
    ) -> None:
        if options.refines() and unit_of(mapping.root) != METRES:
            raise OptionError(
                f"pose_refinement.by {options.by[0].name}: its limits are in metres, and the map's "
                "scale is not known; `megloc map --scale` makes a map in metres, `megloc import "
                "colmap --unit m` says that a COLMAP model is in metres"
            )
        self.refiners = tuple(options.make_refiners())
        self.map = FolderSpec(mapping)
        self._mapping, self._restrictions, self._options = mapping, restrictions, options
        self._verdicts: dict[str, list[Consistency | None]] = {}
        self._lock = threading.Lock()

    @cached_property
    def _by_frame(self) -> dict[str, ReferenceImages]:
        poses = self._mapping.read().poses()
        images = sorted(poses)
        return {
            self._restrictions.frame(images[members[0]]): ReferenceImages(
                {images[member]: poses[images[member]] for member in members}
            )
            for members in self._restrictions.frames(images)
        }

    def _frame(self, pose: Pose) -> str:
        return self._restrictions.frame(pose.candidates[0]) if pose.candidates else ""

    def test(self, poses: Iterable[Pose], *, work: Work = HERE) -> None:
        """Test the coordinate frames of these poses that are not tested yet."""
        with self._lock:
            for frame in sorted({self._frame(pose) for pose in poses} - set(self._verdicts)):
                self._verdicts[frame] = [
                    self._judge(refiner, self._by_frame[frame], work)
                    if isinstance(refiner, HoldsOut) and refiner.require_consistent_map
                    else None
                    for refiner in self.refiners
                ]

    def _judge(self, refiner: HoldsOut, images: ReferenceImages, work: Work) -> Consistency:
        hold_out, spread = partial(_hold_out, self.map, refiner, images), spread_names(images.names)
        return judge_consistency(ordered_map(hold_out, spread, work.executor, window=_WINDOW))

    def tested(self) -> list[ConsistencyRow]:
        """Return the rows of ``map_consistency.csv``."""
        return [
            _consistency_row(frame, refiner.name, verdict)
            for number, refiner in enumerate(self.refiners)
            for frame, verdicts in sorted(self._verdicts.items())
            if (verdict := verdicts[number]) is not None
        ]

    def uses(self, pose: Pose) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return ``references`` and ``distrusted`` for :func:`refine_pose`, in a tested frame."""
        frame = self._frame(pose)
        near = self._by_frame[frame].near(
            pose.cam_from_world,
            pose.candidates,
            max_references=_MAX_REFERENCES,
            # a pose made elsewhere comes from no cluster
            only_first=self._options.references == "cluster" and bool(pose.candidates),
        )
        return tuple(near), tuple(one.reason if one else "" for one in self._verdicts[frame])

    def refine(self, image: str, camera: Camera, pose: Pose, scene: RankingScene) -> Pose:
        if not self.refiners:
            return pose
        self.test([pose])
        return refine_pose(image, camera, pose, *self.uses(pose), self.refiners, scene)


def _hold_out(
    mapping: FolderSpec, refiner: HoldsOut, images: ReferenceImages, image: str
) -> Displacement | None:
    return refiner.hold_out(image, images, KaptureScene(mapping.open()))


def _consistency_row(frame: str, method: str, found: Consistency) -> ConsistencyRow:
    median = found.median or Displacement(*[float("nan")] * len(fields(Displacement)))
    counts = (found.images, found.contradicting)
    return ConsistencyRow(frame, method, *counts, **vars(median), reason=found.reason)


def refine_pose(
    image: str,
    camera: Camera,
    pose: Pose,
    references: Sequence[str],
    distrusted: Sequence[str],
    refiners: Sequence[PoseRefiner],
    scene: RankingScene,
) -> Pose:
    """Apply several refiners to the pose of one query; return the last accepted pose.

    ``references`` are map images that may overlap with the query, best first. ``distrusted`` has a
    reason not to use a refiner, or "", for each.
    """
    rows, seconds = [], dict(pose.seconds)
    for refiner, reason in zip(refiners, distrusted, strict=True):
        started = time.perf_counter()
        before = pose.cam_from_world
        if reason:
            refined = PoseRefinement(before, reason)
        else:
            refined = refiner.refine(image, camera, before, references, scene)
        rows.append(_row(refiner, image, before, refined))
        if refined.accepted:
            after = refined.cam_from_world
            w, x, y, z = map(float, after.quat_wxyz)
            t_x, t_y, t_z = map(float, after.translation)
            after = RigidTransform((w, x, y, z), (t_x, t_y, t_z))
            pose = replace(pose, cam_from_world=after, covariance=refined.covariance)
        seconds[refiner.name] = time.perf_counter() - started
    return replace(pose, refinements=tuple(rows), seconds=seconds)


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
    """Refine the poses of localized queries and write them as a new localization folder.

    Failed queries and fallback poses stay unchanged. ``map_folder`` and ``query`` provide what the
    refiners need: images, masks, depth maps, points. ``refinement.csv`` has the measures of each
    refiner, ``map_consistency.csv`` those of each coordinate frame. Return counts for the log.
    """
    refiners = MapRefiners(map_folder, restrictions, options)
    statuses = read_status(localized.root / STATUS_FILE)
    data = localized.read()
    covariances = {}
    if (table := localized.root / COVARIANCE_FILE).is_file():
        covariances = read_covariances(table)
    poses = {
        image: Pose(
            pose,
            row.num_matches,
            row.num_inliers,
            candidates=row.candidates,
            covariance=covariances.get(image),
        )
        for image, row in statuses.items()
        if row.status == "localized" and (pose := data.cam_from_world(image)) is not None
    }
    refiners.test(poses.values(), work=work)
    uses = {image: refiners.uses(pose) for image, pose in poses.items()}
    jobs = [(image, pose, *uses[image]) for image, pose in poses.items()]
    refine = partial(_refine, refiners.map, FolderSpec(query), refiners.refiners)
    results = work.map(refine, jobs, "refining", plugins=refiners.refiners)
    found = dict(zip(poses, results, strict=True))
    _write(output, data, localized, statuses, found)
    tested = refiners.tested()
    if tested:
        write_consistency(output / CONSISTENCY_FILE, tested)
    if timing is not None:
        write_timing(timing, found.items())
    counts: dict[str, float] = {"queries": len(poses)}
    for refiner in refiners.refiners:
        counts[f"accepted_by_{refiner.name}"] = sum(
            row.accepted
            for refined in found.values()
            for row in refined.refinements
            if row.method == refiner.name
        )
    for row in tested:
        name = f"frames_where_{row.method}_is_trusted"
        counts[name] = counts.get(name, 0) + (not row.reason)
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
    refined_data = replace(data, trajectories=poses)
    write_sensors(output, refined_data)
    write_poses(output / POSES_FILE, refined_data.poses())
    link_images(localized.root, output)
    for image, refined in found.items():
        told = {"refinement": refinement_text(refined.refinements)}
        statuses[image] = statuses[image].model_copy(update=told)
    write_status(output / STATUS_FILE, statuses.values())
    write_covariances(output / COVARIANCE_FILE, found)
    clusters = localized.root / CLUSTERS_FILE
    if clusters.is_file():
        shutil.copyfile(clusters, output / CLUSTERS_FILE)
    write_refinement(
        output / REFINEMENT_FILE, (row for refined in found.values() for row in refined.refinements)
    )


def _refine(
    mapping: FolderSpec,
    query: FolderSpec,
    refiners: Sequence[PoseRefiner],
    job: tuple[str, Pose, Sequence[str], Sequence[str]],
) -> Pose:
    image, pose, references, distrusted = job
    scene, camera = KaptureScene(mapping.open(), query.open()), query.open().read().camera_of(image)
    return refine_pose(image, camera, pose, references, distrusted, refiners, scene)


class RefinePoses(PipelineStage):
    """Refine the poses of localized queries by ICP or by rendering."""

    name = "refine_poses"
    version = 4
    uses = ("pose_refinement",)
    explained_by = ("pose_refinement.by", "pose_refinement.references")
    inputs = (SIDE_TABLES, Layout.query, MAP, UNREFINED_POSES)
    outputs = (LOCALIZED, REFINEMENT_TIMING)

    def is_wanted(self) -> bool:
        return self.options.pose_refinement.refines()

    def plugins(self) -> Sequence[object]:
        return self.options.pose_refinement.make_refiners()

    def run(self, work: StageWork) -> Mapping[str, float]:
        return refine_poses(
            work.folder(MAP),
            work.folder(self.layout.query()),
            work.folder(UNREFINED_POSES),
            work.out / LOCALIZED,
            self.options.pose_refinement,
            restrictions=Restrictions.read(work.path(SIDE_TABLES)),
            work=work,
            timing=work.out / REFINEMENT_TIMING,
        )
