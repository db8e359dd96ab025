"""Refinement of a pose by rendering: reference images are warped into the query by their depth.

The pose is the one under which they look like the query, up to a gain and a bias per reference
(:mod:`megloc_kapture.refinement.photometric`). A result counts only where it is better than what
there was; otherwise the old pose stays, with the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.poses import rotation_angles_deg
from megloc_kapture.plugins import DepthView, PoseRefinement, RankingScene
from megloc_kapture.refinement.photometric import MIN_POINTS, Alignment, LevelProblem
from megloc_kapture.refinement.photometric_points import (
    Visibility,
    choose_points,
    lift_points,
    usable_cells,
    visibility,
)
from megloc_kapture.refinement.photometric_pyramid import (
    Appearance,
    FeatureMaps,
    Level,
    build_pyramid,
)
from megloc_kapture.refinement.photometric_search import best_turns
from megloc_kapture.values import Camera, Options, RigidTransform

# turns of the camera, of those tried, from which the alignment begins
_MAX_STARTS = 5
# points by which turns are tried, and from each of those the alignment
_SEARCH_POINTS, _START_POINTS = 1500, 2500
# of a level: an alignment is done when it moves points by less, the last of all, the others
_LAST_STEP_PX, _COARSE_STEP_PX = 0.01, 0.2
# of a level, for each point that is chosen there
_PX_PER_POINT = 6


class RenderingOptions(Options):
    """Options of the refinement by rendering."""

    appearance: Appearance = Field(
        default="normalised",
        description="what is compared: brightness of locally normalised contrast (day and night), "
        "plain brightness (intensity), or magnitudes of its gradient (gradients)",
    )
    max_references: int = Field(
        default=4, gt=0, description="reference images with depth that are used, best first"
    )
    max_points: int = Field(
        default=12000, ge=MIN_POINTS, description="points of a reference and level of its pyramid"
    )
    max_side_px: int = Field(
        default=640, ge=64, description="longer side of the finest level; larger images are reduced"
    )
    levels: int = Field(
        default=3, ge=1, description="of the pyramids, each of half the size; begin at the coarsest"
    )
    search_deg: float = Field(
        default=4.0, ge=0, description="turns of the camera that are tried at the coarsest level"
    )
    max_translation_m: float = Field(
        default=0.5, gt=0, description="a pose whose centre moves further is not accepted"
    )
    max_rotation_deg: float = Field(
        default=5.0, gt=0, description="a pose that turns further is not accepted"
    )
    min_improvement: float = Field(
        default=0.02, ge=0, lt=1, description="share by which the robust cost must fall"
    )
    min_correlation: float = Field(
        default=0.12,
        ge=-1,
        le=1,
        description="of the query with the warped references, below which a pose is not accepted",
    )
    min_overlap: float = Field(
        default=0.2, ge=0, le=1, description="share of the query that references must cover"
    )
    max_overlap_loss: float = Field(
        default=0.1, ge=0, le=1, description="share of that overlap that a new pose may lose"
    )


@dataclass(frozen=True, eq=False)
class RenderingQuery:
    """The image whose pose is refined.

    Attributes
    ----------
    image : uint8 (H, W, 3), RGB.
    camera : its intrinsics.
    mask : bool (H, W), True = use; None for all.
    """

    image: NDArray[np.uint8]
    camera: Camera
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class RenderingReference:
    """An image of the map that is warped into the query.

    Attributes
    ----------
    image : uint8 (H, W, 3), RGB.
    camera, cam_from_world : of the image.
    depth : taken with it, maybe by another camera.
    mask : bool (H, W), True = use; None for all.
    """

    image: NDArray[np.uint8]
    camera: Camera
    cam_from_world: RigidTransform
    depth: DepthView
    mask: NDArray[np.bool_] | None = None


def refine_by_rendering(
    query: RenderingQuery,
    references: Sequence[RenderingReference],
    cam_from_world: RigidTransform,
    options: RenderingOptions | None = None,
    *,
    features: FeatureMaps | None = None,
) -> PoseRefinement:
    """Refine the pose of an image by what reference images show, lifted by their depth.

    Parameters
    ----------
    references : all of them are used; those that do not see the same cost time only.
    cam_from_world : of the query, in the frame of the references' poses, metres.
    features : compare a dense network's feature maps instead of brightness.

    Returns
    -------
    The new pose with its covariance, or the old one and the reason. ``measures``: cost (of the
    robust loss, 0 to 0.5), correlation and overlap before and after, how far the pose moved in m
    and deg, the points and references used.

    Raises
    ------
    DataError : images, masks, depth maps or feature maps do not fit their cameras.
    """
    options = options or RenderingOptions()
    # what is independent goes to two threads; the order of results is that of the work
    with ThreadPoolExecutor(2) as threads:
        return _Refining(query, references, options, features, threads).refine(cam_from_world)


class _Refining:
    """The pyramids and points of one query and its references."""

    def __init__(
        self,
        query: RenderingQuery,
        references: Sequence[RenderingReference],
        options: RenderingOptions,
        features: FeatureMaps | None,
        threads: Executor,
    ) -> None:
        self.options = options
        self.camera = query.camera
        self.features = features
        self.threads = threads
        self.query_levels, *self.levels = threads.map(self._pyramid, [query, *references])
        self.points = list(
            threads.map(
                lambda each: lift_points(each.camera, each.cam_from_world, each.depth), references
            )
        )

    def _pyramid(self, view: RenderingQuery | RenderingReference) -> list[Level]:
        image, camera, mask = view.image, view.camera, view.mask
        if image.shape != (camera.height, camera.width, 3):
            raise DataError(
                f"an image of {image.shape} does not fit a camera of {camera.width}x{camera.height}"
            )
        return build_pyramid(
            image,
            mask,
            levels=self.options.levels,
            max_side_px=self.options.max_side_px,
            appearance=self.options.appearance,
            features=self.features,
        )

    def refine(self, start: RigidTransform) -> PoseRefinement:
        """See :func:`refine_by_rendering`."""
        sight = visibility(self.points, self.camera, start)
        old_overlap = self._overlap(sight)
        if old_overlap < max(self.options.min_overlap, 1e-9):
            reason = f"references with depth cover {old_overlap:.0%} of the query"
            return PoseRefinement(start, reason, {"overlap_before": old_overlap})
        pose = start
        coarsest = min([len(self.query_levels), *map(len, self.levels)]) - 1
        for number in range(coarsest, -1, -1):
            problem = self._problem(number, pose, sight)
            if len(problem.chosen.points) < MIN_POINTS:
                reason = f"fewer than {MIN_POINTS} points to compare"
                return PoseRefinement(start, reason, {"overlap_before": old_overlap})
            if number == coarsest:
                pose = self._begun(problem, pose)
            if number > 0 or coarsest == 0:
                pose = self._begun_beside(problem, pose)
            found = problem.nuisance_at(pose)
            for last_step_px in (
                _COARSE_STEP_PX,
                _LAST_STEP_PX if number == 0 else _COARSE_STEP_PX,
            ):
                # what is in front of the scene shows the better the better the pose
                free = self._without_occluders(problem, found)
                found = free.minimised(found, last_step_px=last_step_px)
            pose = found.cam_from_world
            if number == coarsest:  # later steps are too small to uncover anything
                sight = visibility(self.points, self.camera, pose)
        return self._judged(start, old_overlap, problem, free, found)

    def _problem(self, number: int, pose: RigidTransform, sight: Visibility) -> LevelProblem:
        level = self.query_levels[number]
        levels = [pyramid[number] for pyramid in self.levels]
        count = min(self.options.max_points, max(MIN_POINTS, level.valid.size // _PX_PER_POINT))
        chosen = choose_points(self.points, levels, sight.seen, count)
        return LevelProblem(chosen, level, self.camera, pose)

    def _begun(self, problem: LevelProblem, pose: RigidTransform) -> RigidTransform:
        """Of the turns of the camera that may be right the one that leads to the best pose."""
        chosen, level = problem.chosen, problem.level
        starts = best_turns(
            chosen.thinned(_SEARCH_POINTS),
            level,
            self.camera,
            pose,
            max_deg=self.options.search_deg,
            count=_MAX_STARTS,
        )
        fewer = LevelProblem(chosen.thinned(_START_POINTS), level, self.camera, pose)
        return self._best(fewer, self.threads.map(fewer.nuisance_at, starts))

    def _begun_beside(self, problem: LevelProblem, pose: RigidTransform) -> RigidTransform:
        """The same beside it, where the alignment looks much the same and may have stopped."""
        chosen = problem.chosen.thinned(_START_POINTS)
        fewer = LevelProblem(chosen, problem.level, self.camera, pose)
        here = fewer.minimised(fewer.nuisance_at(pose), last_step_px=_COARSE_STEP_PX)
        return self._best(fewer, [here, *fewer.beside(here)[:_MAX_STARTS]])

    def _best(self, problem: LevelProblem, starts: Iterable[Alignment]) -> RigidTransform:
        align = partial(problem.minimised, last_step_px=_COARSE_STEP_PX, rounds=1)
        tried = list(self.threads.map(align, starts))
        return max(tried, key=problem.correlation).cam_from_world

    def _without_occluders(self, problem: LevelProblem, at: Alignment) -> LevelProblem:
        agreeing = problem.agreeing(at)
        if agreeing.sum() < MIN_POINTS:
            return problem
        chosen = problem.chosen.subset(agreeing)
        return LevelProblem(
            chosen, problem.level, self.camera, at.cam_from_world, num_groups=problem.num_groups
        )

    def _overlap(self, sight: Visibility) -> float:
        """Share of the query's usable cells in which references have points."""
        usable = usable_cells(self.query_levels[0].valid, sight.covered.shape)
        return float((sight.covered & usable).sum() / max(usable.sum(), 1))

    def _judged(
        self,
        start: RigidTransform,
        old_overlap: float,
        problem: LevelProblem,
        free: LevelProblem,
        found: Alignment,
    ) -> PoseRefinement:
        """The acceptance rule: cost, correlation, overlap, and how far the pose moved.

        They are judged on all points of ``problem``, also those that ``free`` leaves out.
        """
        options, pose = self.options, found.cam_from_world
        overlap = self._overlap(visibility(self.points, self.camera, pose))
        before, after = problem.compared(start, pose)
        moved_m = float(np.linalg.norm(pose.center() - start.center()))
        turned_deg = float(rotation_angles_deg(np.array(pose.quat_wxyz), np.array(start.quat_wxyz)))
        improvement = 1.0 - after.cost / before.cost if before.cost > 0 else 0.0
        measures = {
            "cost_before": before.cost,
            "cost_after": after.cost,
            "correlation_before": before.correlation,
            "correlation_after": after.correlation,
            "overlap_before": old_overlap,
            "overlap_after": overlap,
            "moved_m": moved_m,
            "turned_deg": turned_deg,
            "points": float(after.count),
            "references": float(len(np.unique(problem.chosen.groups))),
        }
        reason = ""
        if after.count < MIN_POINTS:
            reason = f"only {after.count} points are seen from both poses"
        elif moved_m > options.max_translation_m:
            reason = f"would move {moved_m:.2f} m, more than {options.max_translation_m:g} m"
        elif turned_deg > options.max_rotation_deg:
            reason = f"would turn {turned_deg:.2f} deg, more than {options.max_rotation_deg:g} deg"
        elif after.correlation < options.min_correlation:
            reason = (
                f"references and query correlate by {after.correlation:.2f}, "
                f"less than {options.min_correlation:g}"
            )
        elif improvement < options.min_improvement:
            reason = (
                f"the cost improves by {improvement:.1%}, less than {options.min_improvement:.1%}"
            )
        elif overlap < (1.0 - options.max_overlap_loss) * old_overlap:
            reason = f"the overlap falls from {old_overlap:.0%} to {overlap:.0%}"
        if reason:
            return PoseRefinement(start, reason, measures)
        covariance = free.covariance(found)
        if covariance is None:
            return PoseRefinement(start, "the images do not determine the pose", measures)
        return PoseRefinement(pose, "", measures, covariance)


class Rendering:
    """Plugin ``rendering``: poses refined by warping the references into the query.

    ``features`` compares a dense network's feature maps instead of brightness.
    """

    name = "rendering"
    Options = RenderingOptions

    def __init__(
        self, options: RenderingOptions | None = None, *, features: FeatureMaps | None = None
    ) -> None:
        self.options = options or RenderingOptions()
        self.features = features

    def refine(
        self,
        query: str,
        camera: Camera,
        cam_from_world: RigidTransform,
        references: Sequence[str],
        scene: RankingScene,
    ) -> PoseRefinement:
        """Refine the pose of a query by the best references that have depth."""
        used: list[RenderingReference] = []
        for name in references:
            if len(used) == self.options.max_references:
                break
            depth = scene.map_depth(name)
            if depth is not None:
                used.append(
                    RenderingReference(
                        scene.map_image(name),
                        scene.map_camera(name),
                        scene.map_pose(name),
                        depth,
                        scene.map_mask(name),
                    )
                )
        if not used:
            return PoseRefinement(cam_from_world, "no reference image has depth")
        seen = RenderingQuery(scene.query_image(query), camera, scene.query_mask(query))
        return refine_by_rendering(seen, used, cam_from_world, self.options, features=self.features)
