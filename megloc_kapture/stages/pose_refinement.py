"""Stage: pose refinement of localized queries."""

from __future__ import annotations

import math
import shutil
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from megloc_kapture.errors import DataError, OptionError, PluginError
from megloc_kapture.geometry.poses import movement
from megloc_kapture.io.csv_table import write_records
from megloc_kapture.io.dataset_tables import (
    METRES,
    NO_TABLES,
    SIDE_TABLES,
    SideTables,
    read_side_tables,
    unit_of,
)
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.io.tables import (
    CLUSTERS_FILE,
    CONSISTENCY_FILE,
    COVARIANCE_FILE,
    STATUS_FILE,
    ConsistencyRow,
    read_covariances,
    read_status,
)
from megloc_kapture.plugin_loading import AUTO, NetworkOptions, load_chosen
from megloc_kapture.plugins import (
    POSE_REFINERS,
    PluginChoice,
    PoseRefinement,
    PoseRefiner,
    RankingScene,
    chosen_by_name,
)
from megloc_kapture.refinement.references import (
    DISPLACEMENT,
    ReferenceImages,
    contradicts,
    spread_names,
)
from megloc_kapture.stages import paths
from megloc_kapture.stages.localized_folder import write_result_tables, write_timing
from megloc_kapture.stages.scene import KaptureScene
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, Work, ordered_map
from megloc_kapture.values import Camera, LocalizationResult, Options, Pose, RigidTransform

# largest and smallest number of held-out map images (five displacements are all above the true
# median with a chance of 1 in 32)
MAX_TESTED, MIN_TESTED = 24, 5
# map images held out in parallel; the test stops early, so a larger number wastes more work
_WINDOW = 4
# largest number of reference images of a pose: the nearest with a similar viewing direction
_MAX_REFERENCES = 30


class PoseRefinementOptions(Options):
    by: tuple[PluginChoice, ...] = Field(
        default=(), description="pose refiners, applied in order; empty: no refinement"
    )

    def with_refiners(self, names: Sequence[str]) -> PoseRefinementOptions:
        """Select refiners, in this order; those already in the options keep their settings."""
        return PoseRefinementOptions.model_validate({"by": chosen_by_name(self.by, names)})

    def refines(self) -> bool:
        return bool(self.by)

    def make_refiners(self, placement: NetworkOptions = AUTO) -> list[PoseRefiner]:
        return [load_chosen(POSE_REFINERS, chosen, placement) for chosen in self.by]


def judge_consistency(
    frame: str, method: str, displacements: Iterable[Mapping[str, float] | None]
) -> ConsistencyRow:
    """Judge a map by up to ``MAX_TESTED`` displacements of held-out images, see DISPLACEMENT."""
    known: list[Mapping[str, float]] = []
    for each in displacements:
        if each is not None:
            known.append(each)
            if len(known) == MAX_TESTED:
                break
    if not known:
        reason = "no map image with depth overlaps with images from other viewpoints"
        unknown = dict.fromkeys(DISPLACEMENT, np.nan)
        return ConsistencyRow(frame, method, 0, 0, **unknown, reason=reason)
    medians = {name: float(np.median([each[name] for each in known])) for name in DISPLACEMENT}
    contradicting = sum(map(contradicts, known))
    reason = ""
    if len(known) < MIN_TESTED:
        reason = (
            f"the map's consistency is unknown: {len(known)} of its images overlap with "
            f"images from other viewpoints, at least {MIN_TESTED} are needed"
        )
    elif 2 * contradicting > len(known):
        reason = (
            f"the map contradicts itself: {contradicting} of {len(known)} held-out images would "
            f"move by more than their uncertainty; the median motion is {medians['moved_m']:.3f} "
            f"m, {medians['turned_deg']:.2f} deg, {medians['moved_px']:.1f} px"
        )
    return ConsistencyRow(frame, method, len(known), contradicting, **medians, reason=reason)


class MapRefiners:
    """Pose refiners of a map; thread-safe.

    Refiners that need a consistent map are used only in coordinate frames that pass a consistency
    test with held-out map images.
    """

    def __init__(
        self,
        mapping: KaptureFolder,
        tables: SideTables,
        options: PoseRefinementOptions,
        placement: NetworkOptions = AUTO,
    ) -> None:
        if options.refines() and unit_of(mapping.root) != METRES:
            raise OptionError(
                f"pose_refinement.by {options.by[0].name}: its limits are in metres, but the map's "
                "scale is unknown; `megloc map --scale` makes a map in metres, `megloc import "
                "colmap --unit m` declares that a COLMAP model is in metres"
            )
        self.refiners = tuple(options.make_refiners(placement))
        self.map, self._tables = mapping, tables
        self._verdicts: dict[str, list[ConsistencyRow | None]] = {}
        self._lock = threading.Lock()

    @cached_property
    def _by_frame(self) -> dict[str, ReferenceImages]:
        poses_of: dict[str, dict[str, RigidTransform]] = {}
        for image, pose in self.map.read().poses().items():
            poses_of.setdefault(self._tables.frame(image), {})[image] = pose
        return {frame: ReferenceImages(poses) for frame, poses in poses_of.items()}

    def _frame(self, pose: Pose) -> str:
        return self._tables.frame(pose.candidates[0]) if pose.candidates else ""

    def test(self, poses: Iterable[Pose], *, work: Work = HERE) -> None:
        """Test the map's consistency in the frames of these poses, once per coordinate frame."""
        with self._lock:
            for frame in sorted({self._frame(pose) for pose in poses} - set(self._verdicts)):
                self._verdicts[frame] = [
                    self._judge(refiner, frame, work)
                    if getattr(refiner, "require_consistent_map", False)
                    else None
                    for refiner in self.refiners
                ]

    def _judge(self, refiner: Any, frame: str, work: Work) -> ConsistencyRow:
        images = self._by_frame[frame]
        hold_out, spread = partial(_hold_out, self.map, refiner, images), spread_names(images.names)
        displacements = ordered_map(hold_out, spread, work.executor, window=_WINDOW)
        return judge_consistency(frame, refiner.name, displacements)

    def tested(self) -> list[ConsistencyRow]:
        """Return the rows of ``map_consistency.csv``."""
        return [
            verdict
            for number in range(len(self.refiners))
            for _, verdicts in sorted(self._verdicts.items())
            if (verdict := verdicts[number]) is not None
        ]

    def uses(self, pose: Pose) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return ``references`` and ``distrusted`` for :func:`apply_refiners`.

        :meth:`test` must be called for the pose first.
        """
        frame = self._frame(pose)
        # a third-party pose has no candidates; the nearest map images are used
        near = self._by_frame[frame].near(
            pose.cam_from_world, pose.candidates, max_references=_MAX_REFERENCES
        )
        return tuple(near), tuple(
            verdict.reason if verdict else "" for verdict in self._verdicts[frame]
        )

    def refine(self, image: str, camera: Camera, pose: Pose, scene: RankingScene) -> Pose:
        if not self.refiners:
            return pose
        self.test([pose])
        return apply_refiners(image, camera, pose, *self.uses(pose), self.refiners, scene)


def _hold_out(
    mapping: KaptureFolder, refiner: Any, images: ReferenceImages, image: str
) -> dict[str, float] | None:
    displacement: dict[str, float] | None = refiner.hold_out(image, images, KaptureScene(mapping))
    return displacement


def apply_refiners(
    image: str,
    camera: Camera,
    pose: Pose,
    references: Sequence[str],
    distrusted: Sequence[str],
    refiners: Sequence[PoseRefiner],
    scene: RankingScene,
) -> Pose:
    """Apply several refiners to the pose of one query; return the last accepted pose.

    ``references`` are map images that may overlap with the query, best first. ``distrusted`` has,
    for each refiner, the reason not to use it, or "".
    """
    steps, seconds = [], dict(pose.seconds)
    for refiner, reason in zip(refiners, distrusted, strict=True):
        started = time.perf_counter()
        before = pose.cam_from_world
        if reason:
            refined = PoseRefinement(before, reason)
        else:
            refined = refiner.refine(image, camera, before, references, scene)
        who = f"plugin {refiner.name!r} on image {image}"
        if not isinstance(refined, PoseRefinement):
            raise PluginError(
                f"{who}: refine returned {type(refined).__name__}, not PoseRefinement"
            )
        after = before
        if refined.accepted:
            after = refined.cam_from_world
            w, x, y, z, t_x, t_y, t_z = map(float, (*after.quat_wxyz, *after.translation))
            if not abs(math.hypot(w, x, y, z) - 1) < 1e-3 or not math.isfinite(t_x + t_y + t_z):
                raise PluginError(f"{who}: refine returned an invalid pose: {after}")
            after = RigidTransform((w, x, y, z), (t_x, t_y, t_z))
            pose = replace(pose, cam_from_world=after, covariance=refined.covariance)
        moved_m, turned_deg = movement(before, after)
        steps.append(
            replace(
                refined,
                cam_from_world=after,
                method=refiner.name,
                before=before,
                moved_m=moved_m,
                turned_deg=turned_deg,
            )
        )
        seconds[refiner.name] = time.perf_counter() - started
    return replace(pose, refinements=tuple(steps), seconds=seconds)


def refine_poses(
    map_folder: KaptureFolder,
    query: KaptureFolder,
    localized: KaptureFolder,
    output: Path,
    options: PoseRefinementOptions,
    *,
    tables: SideTables = NO_TABLES,
    work: Work = HERE,
    timing: Path | None = None,
) -> dict[str, float]:
    """Refine the poses of localized queries and write them as a new localization folder.

    Failed queries and fallback poses stay unchanged. ``map_folder`` and ``query`` provide images,
    masks, depth maps and points to the refiners. ``refinement.csv`` gets a row per query and
    refiner, ``map_consistency.csv`` a row per tested coordinate frame and refiner. Return counts
    for the log.
    """
    refiners = MapRefiners(map_folder, tables, options, work.placement)
    data = localized.read()
    results = _read_results(localized)
    poses = {name: result for name, result in results.items() if isinstance(result, Pose)}
    refiners.test(poses.values(), work=work)
    jobs = [(image, pose, *refiners.uses(pose)) for image, pose in poses.items()]
    refine = partial(_refine, refiners.map, query, localized, refiners.refiners)
    refined = list(work.map(refine, jobs, "refining", plugins=refiners.refiners))
    results |= {pose.name: pose for pose in refined}
    trajectories = {data.record_of(pose.name): pose.cam_from_world for pose in refined}
    refined_data = replace(data, trajectories={**data.trajectories, **trajectories})
    write_sensors(output, refined_data)
    link_images(localized.root, output)
    write_result_tables(output, refined_data.poses(), list(results.values()))
    clusters = localized.root / CLUSTERS_FILE
    if clusters.is_file():
        shutil.copyfile(clusters, output / CLUSTERS_FILE)
    tested = refiners.tested()
    if tested:
        write_records(output / CONSISTENCY_FILE, ConsistencyRow, tested)
    if timing is not None:
        write_timing(timing, refined)
    counts: dict[str, float] = {"queries": len(poses)}
    for refiner in refiners.refiners:
        counts[f"accepted_by_{refiner.name}"] = sum(
            step.accepted
            for pose in refined
            for step in pose.refinements
            if step.method == refiner.name
        )
    for row in tested:
        name = f"frames_where_{row.method}_is_trusted"
        counts[name] = counts.get(name, 0) + (not row.reason)
    return counts


def _read_results(localized: KaptureFolder) -> dict[str, LocalizationResult]:
    """Read results by name; those of localized queries are :class:`Pose`, with covariances."""
    results = read_status(localized.root / STATUS_FILE)
    table = localized.root / COVARIANCE_FILE
    covariances = read_covariances(table) if table.is_file() else {}
    data = localized.read()
    for image, row in results.items():
        pose = data.cam_from_world(image) if row.status == "localized" else None
        if pose is not None:
            known = {**vars(row), "cam_from_world": pose}
            results[image] = Pose(**known, covariance=covariances.get(image))
    return results


def _refine(
    mapping: KaptureFolder,
    query: KaptureFolder,
    localized: KaptureFolder,
    refiners: Sequence[PoseRefiner],
    job: tuple[str, Pose, Sequence[str], Sequence[str]],
) -> Pose:
    image, pose, references, distrusted = job
    data = query.read()
    if data.sensors[data.record_of(image)[1]].is_unknown:
        query = localized  # it has the camera that was estimated with the pose
    scene, camera = KaptureScene(mapping, query), query.read().camera_of(image)
    try:
        return apply_refiners(image, camera, pose, references, distrusted, refiners, scene)
    except DataError as error:
        if error.path is None or not Path(error.path).is_relative_to(query.root):
            raise
        return replace(pose, remarks=(*pose.remarks, f"not refined: {error}"))


class RefinePoses(PipelineStage):
    """Refine the poses of localized queries by ICP or by rendering."""

    name = "refine_poses"
    version = 4
    uses = ("pose_refinement",)
    explained_by = ("pose_refinement.by",)
    inputs = (SIDE_TABLES, PipelineStage.query, paths.MAP, paths.UNREFINED_POSES)
    outputs = (paths.LOCALIZED, paths.REFINEMENT_TIMING)

    def explain(self) -> str:
        return f"{super().explain()}, references = map images of the query's cluster"

    def is_wanted(self) -> bool:
        return self.options.pose_refinement.refines()

    def plugins(self) -> Sequence[object]:
        return self.options.pose_refinement.make_refiners()

    def run(self, work: StageWork) -> Mapping[str, float]:
        return refine_poses(
            work.folder(paths.MAP),
            work.folder(self.query()),
            work.folder(paths.UNREFINED_POSES),
            work.out / paths.LOCALIZED,
            self.options.pose_refinement,
            tables=read_side_tables(work.path(SIDE_TABLES)),
            work=work,
            timing=work.out / paths.REFINEMENT_TIMING,
        )
