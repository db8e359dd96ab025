"""Refinement of a pose by rendering: reference images are warped into the query by their depth.

The pose is the one under which they look like the query, up to a gain and a bias per reference
(:mod:`megloc_kapture.refinement.photometric`). A result counts only where it is better than what
there was (:mod:`megloc_kapture.refinement.rendering_acceptance`); otherwise the old pose stays,
with the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial

from megloc_kapture.plugins import PoseRefinement, RankingScene
from megloc_kapture.refinement.consistency import Displacement, held_out
from megloc_kapture.refinement.photometric import MIN_POINTS, Alignment, LevelProblem
from megloc_kapture.refinement.photometric_directions import beside
from megloc_kapture.refinement.photometric_fit import correlation
from megloc_kapture.refinement.photometric_minimum import minimised
from megloc_kapture.refinement.photometric_occluders import agreeing
from megloc_kapture.refinement.photometric_points import (
    Visibility,
    choose_points,
    usable_cells,
    visibility,
)
from megloc_kapture.refinement.photometric_pyramid import FeatureMaps
from megloc_kapture.refinement.photometric_search import best_turns
from megloc_kapture.refinement.references import ReferenceImages
from megloc_kapture.refinement.rendering_acceptance import Candidate, judged
from megloc_kapture.refinement.rendering_options import RenderingOptions
from megloc_kapture.refinement.rendering_views import (
    REFERENCES,
    PyramidKind,
    RenderingQuery,
    RenderingReference,
    pyramid_of,
)
from megloc_kapture.values import Camera, RigidTransform

# turns of the camera, of those tried, from which the alignment begins
_MAX_STARTS = 5
# points by which turns are tried, and from each of those the alignment
_SEARCH_POINTS, _START_POINTS = 1500, 2500
# of a level: an alignment is done when it moves points by less, the last of all, the others
_LAST_STEP_PX, _COARSE_STEP_PX = 0.01, 0.2
# of a level, for each point that is chosen there; of a reference on coarse levels
_PX_PER_POINT, _COARSE_POINTS = 24, 3200
# standard errors by which the cost falls where nobody need ask whether the start was as good
_CLEAR = 4.0


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
    robust loss, 0 to 0.5), correlation and overlap before and after, by how many of its standard
    errors the cost falls, how far the pose moved in m and deg, the points and references used.

    Raises
    ------
    DataError : images, masks, depth maps or feature maps do not fit their cameras.
    """
    options = options or RenderingOptions()
    # what is independent goes to two threads; the order of results is that of the work
    with ThreadPoolExecutor(2) as threads:
        return _Refining(query, references, options, features, threads).refine(cam_from_world)


def displacement_by_rendering(
    query: RenderingQuery,
    references: Sequence[RenderingReference],
    cam_from_world: RigidTransform,
    options: RenderingOptions | None = None,
    *,
    features: FeatureMaps | None = None,
) -> Displacement | None:
    """How far :func:`refine_by_rendering` moves a pose that should be right.

    Where it keeps the pose, how far the least cost nearby is from it. None where the references do
    not determine the pose: they cover too little, correlate too little, or lead out of its bounds.

    Raises
    ------
    DataError : as there.
    """
    options = options or RenderingOptions()
    with ThreadPoolExecutor(2) as threads:
        refining = _Refining(query, references, options, features, threads)
        refined = refining.refine(cam_from_world)
        if not refined.accepted:
            refined = refining.refine_nearby(cam_from_world)
    found = refined.measures
    if "squared_distance" not in found or (
        found["moved_m"] > options.max_translation_m
        or found["turned_deg"] > options.max_rotation_deg
        or found["correlation_after"] < options.min_correlation
    ):
        return None
    return Displacement(**{name: found[name] for name in Displacement.__dataclass_fields__})


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
        self.threads = threads
        kind = PyramidKind(options.levels, options.max_side_px, options.appearance, features)
        ours = threads.submit(pyramid_of, query, kind)
        prepared = list(threads.map(lambda each: REFERENCES.prepared(each, kind), references))
        self.query_levels = ours.result()
        self.levels = [each.pyramid for each in prepared]
        self.points = [each.points for each in prepared]

    def refine(self, start: RigidTransform) -> PoseRefinement:
        """See :func:`refine_by_rendering`."""
        sight, overlap = self._sight(start)
        if sight is None:
            return _uncovered(start, overlap)
        coarsest = min([len(self.query_levels), *map(len, self.levels)]) - 1
        searched = self._judged(start, overlap, self._searched(coarsest, start, sight))
        clear = searched.accepted and searched.measures["significance"] >= _CLEAR
        if clear or coarsest == 0:
            return searched
        # looking around may lead away from a pose that was nearly right
        direct = self._judged(start, overlap, self._aligned(0, start, sight))
        if not searched.accepted:
            return direct if direct.accepted else searched
        return max((direct, searched), key=_correlation_after)

    def refine_nearby(self, start: RigidTransform) -> PoseRefinement:
        """The same at the finest level alone, without looking around."""
        sight, overlap = self._sight(start)
        if sight is None:
            return _uncovered(start, overlap)
        return self._judged(start, overlap, self._aligned(0, start, sight))

    def _sight(self, start: RigidTransform) -> tuple[Visibility | None, float]:
        """What is seen of the references, if enough, and the share of the query they cover."""
        sight = visibility(self.points, self.camera, start)
        overlap = self._overlap(sight)
        return None if overlap < max(self.options.min_overlap, 1e-9) else sight, overlap

    def _searched(
        self, coarsest: int, start: RigidTransform, sight: Visibility
    ) -> Candidate | None:
        """Coarse to fine, from the best of what is found around the start."""
        problem = self._problem(coarsest, start, sight)
        if len(problem.chosen.points) < MIN_POINTS:
            return None
        pose = self._begun_beside(problem, self._begun(problem, start))
        found = self._aligned(coarsest, pose, sight)
        for number in range(coarsest - 1, -1, -1):
            if found is None:
                break
            pose = found.alignment.cam_from_world
            if number == coarsest - 1:  # later steps are too small to uncover anything
                sight = visibility(self.points, self.camera, pose)
            found = self._aligned(number, pose, sight)
        return found

    def _aligned(self, number: int, pose: RigidTransform, sight: Visibility) -> Candidate | None:
        """The alignment of one level; None where there are too few points."""
        problem = self._problem(number, pose, sight)
        if len(problem.chosen.points) < MIN_POINTS:
            return None
        found = problem.nuisance_at(pose)
        for step_px in (_COARSE_STEP_PX, _COARSE_STEP_PX if number else _LAST_STEP_PX):
            # what is in front of the scene shows the better the better the pose
            free = self._without_occluders(problem, found)
            found = minimised(free, found, last_step_px=step_px, rounds=1 if number else 2)
        return Candidate(problem, free, found)

    def _problem(self, number: int, pose: RigidTransform, sight: Visibility) -> LevelProblem:
        level = self.query_levels[number]
        levels = [pyramid[number] for pyramid in self.levels]
        count = max(_COARSE_POINTS, level.valid.size // _PX_PER_POINT)
        chosen = choose_points(self.points, levels, sight.seen, min(self.options.max_points, count))
        return LevelProblem(chosen, level, self.camera, pose)

    def _begun(self, problem: LevelProblem, pose: RigidTransform) -> RigidTransform:
        """Of the turns of the camera that may be right the one that leads to the best pose."""
        starts = best_turns(
            problem.chosen.thinned(_SEARCH_POINTS),
            problem.level,
            self.camera,
            pose,
            max_deg=self.options.search_deg,
            count=_MAX_STARTS,
        )
        fewer = problem.thinned(_START_POINTS)
        return self._best(fewer, self.threads.map(fewer.nuisance_at, starts))

    def _begun_beside(self, problem: LevelProblem, pose: RigidTransform) -> RigidTransform:
        """The same beside it, where the alignment looks much the same and may have stopped."""
        fewer = problem.thinned(_START_POINTS)
        here = minimised(fewer, fewer.nuisance_at(pose), last_step_px=_COARSE_STEP_PX)
        return self._best(fewer, [here, *beside(fewer, here)[:_MAX_STARTS]])

    def _best(self, problem: LevelProblem, starts: Iterable[Alignment]) -> RigidTransform:
        align = partial(minimised, problem, last_step_px=_COARSE_STEP_PX, rounds=1)
        tried = list(self.threads.map(align, starts))
        return max(tried, key=partial(correlation, problem)).cam_from_world

    def _without_occluders(self, problem: LevelProblem, at: Alignment) -> LevelProblem:
        free = agreeing(problem, at)
        return problem.subset(free) if free.sum() >= MIN_POINTS else problem

    def _judged(
        self, start: RigidTransform, old_overlap: float, found: Candidate | None
    ) -> PoseRefinement:
        if found is None:
            reason = f"fewer than {MIN_POINTS} points to compare"
            return PoseRefinement(start, reason, {"overlap_before": old_overlap})
        pose = found.alignment.cam_from_world
        overlap = self._overlap(visibility(self.points, self.camera, pose))
        return judged(start, found, (old_overlap, overlap), self.options)

    def _overlap(self, sight: Visibility) -> float:
        """Share of the query's usable cells in which references have points."""
        usable = usable_cells(self.query_levels[0].valid, sight.covered.shape)
        return float((sight.covered & usable).sum() / max(usable.sum(), 1))


def _uncovered(start: RigidTransform, overlap: float) -> PoseRefinement:
    reason = f"references with depth cover {overlap:.0%} of the query"
    return PoseRefinement(start, reason, {"overlap_before": overlap})


def _correlation_after(refined: PoseRefinement) -> float:
    return refined.measures.get("correlation_after", -1.0)


class Rendering:
    """Plugin ``rendering``: poses refined by warping the references into the query.

    ``features`` compares a dense network's feature maps instead of brightness.
    """

    name = "rendering"
    Options = RenderingOptions

    def __init__(
        self,
        options: RenderingOptions | None = None,
        *,
        features: FeatureMaps | None = None,
    ) -> None:
        self.options = options or RenderingOptions()
        self.features = features
        self.require_consistent_map = self.options.require_consistent_map

    def hold_out(
        self, image: str, images: ReferenceImages, scene: RankingScene
    ) -> Displacement | None:
        """How far a map image would move; see :func:`~.consistency.held_out`."""
        displace = partial(displacement_by_rendering, options=self.options, features=self.features)
        return held_out(image, images, scene, displace, max_references=self.options.max_references)

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
