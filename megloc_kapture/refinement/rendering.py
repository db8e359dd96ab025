"""Pose refinement by rendering: depth maps warp reference images into the query.

:mod:`megloc_kapture.refinement.photometric` aligns them, and
:mod:`megloc_kapture.refinement.acceptance` accepts or rejects the result. Alignment converges only
from a few pixels away, so it begins at a coarse level, from several perturbed poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.warping import PosedImage, image_with_depth
from megloc_kapture.plugins import PoseRefinement, RankingScene
from megloc_kapture.refinement.acceptance import (
    MIN_CORRELATION,
    Candidate,
    RenderingOptions,
    accept_or_keep,
    correlation,
    perturbed_starts,
)
from megloc_kapture.refinement.photometric import (
    MIN_POINTS,
    LevelProblem,
    minimise,
    unoccluded_points,
)
from megloc_kapture.refinement.pyramid import (
    Seen,
    build_pyramid,
    choose_points,
    lift_points,
    usable_cells,
    visibility,
)
from megloc_kapture.refinement.references import (
    ReferenceImages,
    references_elsewhere,
)
from megloc_kapture.values import Camera, RigidTransform

_MAX_STARTS, _START_POINTS = 5, 2500
# smallest share of the query that the references must cover
_MIN_OVERLAP = 0.2
# alignment ends with a step this small, in pixels of the level: finest level, other levels
_LAST_STEP_PX, _COARSE_STEP_PX = 0.01, 0.2
# pixels of a query level per point of each reference; smallest number of points
_PX_PER_POINT, _COARSE_POINTS = 24, 3200
_MAX_POINTS = 12000  # of each reference, per level
# if alignment from perturbed poses decreases the cost by at least this many standard errors,
# alignment from the unperturbed pose is skipped
_CLEAR = 4.0


class RenderingRefinement:
    """Refinement of an image's pose, in metres, by warping references with depth into it.

    ``measures`` of the results: cost (robust loss, 0 to 0.5), correlation and overlap before and
    after; decrease of the cost in standard errors; motion in m, deg and px; numbers of points and
    references; if the pose is determined, standard deviations and the squared Mahalanobis distance.
    """

    def __init__(
        self, query: PosedImage, references: Sequence[PosedImage], options: RenderingOptions
    ) -> None:
        self.options = options
        self.camera, self.start = query.camera, query.cam_from_world
        side_px, appearance = options.max_side_px, options.appearance
        self.query_levels, *self.levels = (
            build_pyramid(each.image, each.mask, max_side_px=side_px, appearance=appearance)
            for each in (query, *references)
        )
        self.points = [lift_points(each) for each in references]

    def refine(self) -> PoseRefinement:
        start = self.start
        seen, overlap = self._visibility(start)
        if overlap < _MIN_OVERLAP:
            return _uncovered(start, overlap)
        coarsest = min([len(self.query_levels), *map(len, self.levels)]) - 1
        searched = self._decide(overlap, self._align_from_search(coarsest, start, seen))
        clear = searched.accepted and searched.measures["significance"] >= _CLEAR
        if clear or coarsest == 0:
            return searched
        # the best perturbed pose may lead away from a nearly correct pose
        direct = self._decide(overlap, self._align(0, start, seen))
        if not searched.accepted:
            return direct if direct.accepted else searched
        return max((direct, searched), key=lambda each: each.measures.get("correlation_after", -1))

    def judge(
        self, pose: RigidTransform, judged: NDArray[np.bool_] | None = None
    ) -> PoseRefinement:
        """Judge a pose from another method, after alignment at the finest level.

        ``judged`` bool (H, W) are the pixels over which the poses are compared, by default all.
        """
        seen, overlap = self._visibility(pose)
        if overlap < _MIN_OVERLAP:
            return _uncovered(self.start, overlap)
        candidate = self._align(0, pose, seen)
        if candidate is not None and judged is not None:
            candidate = replace(candidate, problem=candidate.problem.within(judged))
        return self._decide(overlap, candidate)

    def _visibility(self, pose: RigidTransform) -> tuple[Seen, float]:
        """Return the visible points, and the share of the query that they cover."""
        seen, covered = visibility(self.points, self.camera, pose)
        usable = usable_cells(self.query_levels[0].valid, covered.shape)
        return seen, float((covered & usable).sum() / max(usable.sum(), 1))

    def _align_from_search(
        self, coarsest: int, start: RigidTransform, seen: Seen
    ) -> Candidate | None:
        problem = self._problem(coarsest, start, seen)
        if len(problem.chosen.points) < MIN_POINTS:
            return None
        pose = self._best_perturbation(problem, start)
        candidate = self._align(coarsest, pose, seen)
        for number in range(coarsest - 1, -1, -1):
            if candidate is None:
                break
            pose = candidate.alignment.cam_from_world
            if number == coarsest - 1:  # later steps are too small to change visibility
                seen, _ = visibility(self.points, self.camera, pose)
            candidate = self._align(number, pose, seen)
        return candidate

    def _align(self, number: int, pose: RigidTransform, seen: Seen) -> Candidate | None:
        problem = self._problem(number, pose, seen)
        if len(problem.chosen.points) < MIN_POINTS:
            return None
        alignment = problem.nuisance_at(pose)
        for step_px in (_COARSE_STEP_PX, _COARSE_STEP_PX if number else _LAST_STEP_PX):
            # occlusion estimates improve with the pose
            unoccluded = unoccluded_points(problem, alignment)
            free = problem.subset(unoccluded) if unoccluded.sum() >= MIN_POINTS else problem
            alignment = minimise(free, alignment, last_step_px=step_px, rounds=1 if number else 2)
        return Candidate(problem, free, alignment)

    def _problem(self, number: int, pose: RigidTransform, seen: Seen) -> LevelProblem:
        level = self.query_levels[number]
        levels = [pyramid[number] for pyramid in self.levels]
        count = max(_COARSE_POINTS, level.valid.size // _PX_PER_POINT)
        chosen = choose_points(self.points, levels, seen, min(_MAX_POINTS, count))
        return LevelProblem(chosen, level, self.camera, pose)

    def _best_perturbation(self, problem: LevelProblem, pose: RigidTransform) -> RigidTransform:
        fewer = problem.thinned(_START_POINTS)
        here = minimise(fewer, fewer.nuisance_at(pose), last_step_px=_COARSE_STEP_PX)
        starts = [here, *perturbed_starts(fewer, here)[:_MAX_STARTS]]
        tried = [minimise(fewer, each, last_step_px=_COARSE_STEP_PX, rounds=1) for each in starts]
        return max(tried, key=lambda at: correlation(fewer, fewer.rows(at))).cam_from_world

    def _decide(self, old_overlap: float, candidate: Candidate | None) -> PoseRefinement:
        if candidate is None:
            reason = f"fewer than {MIN_POINTS} points can be compared"
            return PoseRefinement(self.start, reason, {"overlap_before": old_overlap})
        _, overlap = self._visibility(candidate.alignment.cam_from_world)
        return accept_or_keep(self.start, candidate, (old_overlap, overlap), self.options)


def _uncovered(start: RigidTransform, overlap: float) -> PoseRefinement:
    reason = f"the references with depth only cover {overlap:.0%} of the query"
    return PoseRefinement(start, reason, {"overlap_before": overlap})


class Rendering:
    """Plugin ``rendering``, which refines poses by warping the references into the query."""

    name = "rendering"
    Options = RenderingOptions

    def __init__(self, options: RenderingOptions | None = None) -> None:
        self.options = options or RenderingOptions()
        self.require_consistent_map = self.options.require_consistent_map

    def hold_out(
        self, image: str, images: ReferenceImages, scene: RankingScene
    ) -> dict[str, float] | None:
        """Return measures of how far refinement moves a map image, see ``DISPLACEMENT``.

        If the refined pose is rejected, they are measured at the minimum nearest to the map's pose.
        None if overlap or correlation is too small, other images do not determine the pose, or the
        pose moves too far.
        """
        view = image_with_depth(image, scene)
        if view is None:
            return None
        references = references_elsewhere(view, images, scene)[: self.options.max_references]
        if not references:
            return None
        options = self.options.model_copy(update={"accept_always": False})
        refiner = RenderingRefinement(view, references, options)
        refined = refiner.refine()
        if not refined.accepted:
            refined = refiner.judge(view.cam_from_world)
        measures = refined.measures
        if "squared_distance" not in measures or (
            measures["moved_m"] > options.max_translation_m
            or measures["turned_deg"] > options.max_rotation_deg
            or measures["correlation_after"] < MIN_CORRELATION
        ):
            return None
        return dict(measures)

    def refine(
        self,
        query: str,
        camera: Camera,
        cam_from_world: RigidTransform,
        references: Sequence[str],
        scene: RankingScene,
    ) -> PoseRefinement:
        found = filter(None, (image_with_depth(name, scene) for name in references))
        used = list(islice(found, self.options.max_references))
        if not used:
            return PoseRefinement(cam_from_world, "no reference image has depth")
        image, mask = scene.query_image(query), scene.query_mask(query)
        posed = PosedImage(image, camera, cam_from_world, mask=mask)
        return RenderingRefinement(posed, used, self.options).refine()
