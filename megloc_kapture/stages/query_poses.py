"""Stage: cluster-wise localization of queries from matches with map images.

The candidates of a query are clustered by location, and each cluster gives a pose. A ranker selects
the best pose, which is refined with the images of its cluster (MegLoc, "Cluster-wise
localization").
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain, starmap
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.io.dataset_tables import (
    NO_TABLES,
    SIDE_TABLES,
    SideTables,
    read_side_tables,
    read_unreadable,
)
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, read_pairs
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions
from megloc_kapture.localization.cluster_poses import (
    ClusterOptions,
    cluster_candidates,
    interleave,
    localize_in_clusters,
    poses_of_cameras,
)
from megloc_kapture.localization.map_index import PoseProblem, QueryView, TypedMatches
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.plugin_loading import AUTO, NetworkOptions, load_chosen
from megloc_kapture.plugins import POSE_RANKERS, PluginChoice, PoseRanker, RankingScene
from megloc_kapture.stages import paths
from megloc_kapture.stages.localized_folder import unreadable_image, write_localized
from megloc_kapture.stages.matches import candidates_of
from megloc_kapture.stages.scene import (
    KaptureScene,
    Unit,
    index_map,
    open_index,
    query_units,
    shared_index,
    with_noise,
)
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import MIN_CONFIDENCE, Failure, Fallback, Options, Pose, RigidTransform

_FIRST_TURN = 8  # candidates that are matched first; each further turn doubles their number
# with fewer inliers even a correct pose can be off by decimetres, and matching more candidates
# improves it (docs/performance.md)
_SURE_INLIERS = 30
_WRONG_RIG = "joint localization is rejected: a camera's matches contradict the pose of the rig"


class LocalizationOptions(Options):
    clusters: ClusterOptions = ClusterOptions()
    rank: PluginChoice = Field(
        default=PluginChoice(name="distinctive"),
        description="method that selects the query's pose among the poses of the clusters",
    )
    pose: AbsolutePoseOptions = AbsolutePoseOptions()
    min_confidence: float = Field(
        default=MIN_CONFIDENCE,
        ge=0,
        le=1,
        description="poses with a lower confidence are rejected; 0 (as in benchmarks) keeps all",
    )
    sure_confidence: float | None = Field(
        default=0.9,
        gt=0,
        le=1,
        description="Localizer, megloc localize and serve match candidates in turn, best first, "
        f"until the pose has {_SURE_INLIERS} inliers and this confidence; none: match all",
    )
    rigs: bool = Field(default=False, description="localize all cameras of a rig jointly")
    fallback: Fallback = Field(
        default="none",
        description="pose of a failed query; retrieval: that of its first candidate; rig: derived "
        "from another camera of the rig; none: no pose",
    )

    def make_ranker(self, placement: NetworkOptions = AUTO) -> PoseRanker:
        ranker: PoseRanker = load_chosen(POSE_RANKERS, self.rank, placement)
        return ranker


class QuerySource(Protocol):
    """A camera of a query, whose matches are computed live or read from kapture folders."""

    @property
    def candidates(self) -> Sequence[str]:
        """Map images, best first."""
        ...

    @property
    def in_turn(self) -> bool:
        """True if candidates are ranked and matching fewer of them saves time."""
        ...

    def view(self, count: int) -> QueryView:
        """Return the matches with the first ``count`` candidates."""
        ...


@dataclass(frozen=True)
class StoredSource:
    """Matches that were read from kapture folders."""

    stored: QueryView
    candidates: Sequence[str]
    in_turn: ClassVar[bool] = False

    def view(self, count: int) -> QueryView:
        return self.stored.among(self.candidates[:count])


def localize_query(
    sources: Sequence[QuerySource],
    options: LocalizationOptions,
    *,
    frame_of: Callable[[str], str],
    centers: Mapping[str, NDArray[np.float64]],
    ranker: PoseRanker,
    scene: RankingScene,
) -> list[Pose | Failure]:
    """Localize a query, or the cameras of a rig; return a result per camera.

    ``megloc eval``, ``megloc localize``, ``Localizer`` and the HTTP service all call this function.
    With ``sure_confidence``, sources that are ``in_turn`` match the best candidates first, and more
    of them only until all poses are certain (docs/performance.md). A rig without a joint pose is
    localized camera by camera.

    Parameters
    ----------
    frame_of : returns the name of a map image's coordinate frame.
    centers : camera centres (3,) of the candidates in the world.
    """

    def localize(
        together: Sequence[QueryView], candidates: Sequence[str]
    ) -> tuple[Pose | Failure, PoseProblem | None]:
        matched = {image for view in together for image in view.matched_images()}
        images = [image for image in candidates if image in matched]
        if not images:
            reason = "no map image matches" if candidates else "no map image is a candidate"
            return Failure(reason), None
        started = time.perf_counter()
        indices = {id(typed.index): typed.index for view in together for typed in view.matches}
        clusters = cluster_candidates(
            images,
            list(map(frame_of, images)),
            options.clusters,
            centers=centers,
            indices=list(indices.values()),
        )
        seconds = {"clusters": time.perf_counter() - started}
        result, problem = localize_in_clusters(
            together,
            clusters,
            options.pose,
            rank=lambda hypotheses: ranker.score(hypotheses, scene),
            frames=[frame_of(cluster[0]) for cluster in clusters],
            centers=centers,
            min_confidence=options.min_confidence,
            scene=scene,
        )
        return replace(result, seconds={**seconds, **result.seconds}), problem

    def alone(view: QueryView, candidates: Sequence[str]) -> Pose | Failure:
        single = QueryView(view.name, view.camera, view.matches)
        return replace(localize([single], candidates)[0], name=view.name)

    def contradicts(of_rig: Pose | Failure, view: QueryView) -> bool:
        """Return whether most of a camera's matches agree on a different pose than its rig's."""
        if 2 * of_rig.num_inliers >= of_rig.num_matches:
            return False
        single = alone(view, of_rig.candidates)
        trusted = isinstance(single, Pose) and (single.confidence or 0.0) >= MIN_CONFIDENCE
        return trusted and 2 * single.num_inliers > of_rig.num_matches

    def solve(count: int) -> list[Pose | Failure]:
        views = [source.view(count) for source in sources]
        candidates = interleave([source.candidates[:count] for source in sources])
        remarks: tuple[str, ...] = ()
        if len(views) > 1:
            result, problem = localize(views, candidates)
            if isinstance(result, Pose) and problem is not None:
                cameras = poses_of_cameras(views, result, problem)
                if not any(map(contradicts, cameras, views)):
                    return cameras
                remarks = (_WRONG_RIG,)
        results = [alone(view, candidates) for view in views]
        return [replace(each, remarks=(*each.remarks, *remarks)) for each in results]

    num_candidates = max((len(source.candidates) for source in sources), default=0)
    sure, count = options.sure_confidence, _FIRST_TURN
    if not all(source.in_turn for source in sources):
        sure = None
    while sure is not None and count < num_candidates:
        results = solve(count)
        if all(
            isinstance(r, Pose) and (r.confidence or 0.0) >= sure and r.num_inliers >= _SURE_INLIERS
            for r in results
        ):
            return results
        count *= 2
    return solve(num_candidates)


# a unit (a query, or the cameras of a rig), the candidates of each image, and their frames
_Job = tuple[Unit, Sequence[Sequence[str]], Mapping[str, str]]


def _localize_stored(
    mapping: KaptureFolder,
    query: KaptureFolder,
    indices: Mapping[str, Path],
    options: LocalizationOptions,
    ranker: PoseRanker,
    job: _Job,
) -> list[Pose | Failure]:
    """Localize a query, or the cameras of a rig; ``indices`` are folders by keypoints type."""
    unit, candidate_lists, frame_of = job
    started = time.perf_counter()
    centers = {
        image: pose.center()
        for image in interleave(candidate_lists)
        if (pose := mapping.read().cam_from_world(image)) is not None
    }
    sources = [
        StoredSource(
            _read(query, indices, *camera, images),
            [name for name in images if name in centers],
        )
        for camera, images in zip(unit, candidate_lists, strict=True)
    ]
    reading_s = (time.perf_counter() - started) / len(sources)
    results = localize_query(
        sources,
        options,
        frame_of=frame_of.__getitem__,
        centers=centers,
        ranker=ranker,
        scene=KaptureScene(mapping, query),
    )
    return [_for_writing(result, reading_s) for result in results]


def _read(
    query: KaptureFolder,
    indices: Mapping[str, Path],
    image: str,
    cam_from_rig: RigidTransform,
    candidates: Sequence[str],
) -> QueryView:
    typed = []
    for local_type, folder in indices.items():
        reader = query.matches(local_type)
        pairs = [
            (name, *reader.read(image, name)) for name in candidates if (image, name) in reader
        ]
        keypoints_px = query.keypoints(local_type).read(image)
        typed.append(TypedMatches(_opened(folder), keypoints_px, pairs))
    return QueryView(image, query.read().camera_of(image), tuple(typed), cam_from_rig)


def _for_writing(result: Pose | Failure, reading_s: float) -> Pose | Failure:
    result = replace(result, seconds={"reading": reading_s, **result.seconds})
    if isinstance(result, Failure):
        return result
    # only the Python API uses the arrays
    return replace(result, inliers=None, inlier_points_px=None, inlier_points_world=None)


_opened = lru_cache(maxsize=8)(open_index)


def localize_from_matches(
    map_folder: KaptureFolder,
    query: KaptureFolder,
    pairs: Sequence[ImagePair],
    local_types: Sequence[str],
    options: LocalizationOptions,
    *,
    tables: SideTables = NO_TABLES,
    work: Work = HERE,
    scratch: Path | None = None,
) -> Iterator[Pose | Failure]:
    """Localize every query from stored matches of ``local_types``; yield results sorted by name.

    ``query`` has the keypoints and the matches. Jointly localized cameras of a rig stay together,
    sorted by the first. A map may have the base type instead of a guided pyramid type. ``scratch``
    is a folder for a temporary map index.
    """
    ranker = options.make_ranker(work.placement)
    candidates = candidates_of(pairs)
    units = query_units(query.read(), rigs=options.rigs)
    read = {name: index_map(map_folder, type_in_map(map_folder, name)) for name in local_types}
    measured = {name: with_noise(map_folder, index) for name, index in read.items()}
    jobs: list[_Job] = []
    for unit in units:
        images_of = [candidates.get(image, ()) for image, _ in unit]
        frames = {candidate: tables.frame(candidate) for candidate in chain(*images_of)}
        jobs.append((unit, images_of, frames))
    with shared_index(measured, scratch) as indices:
        localize = partial(_localize_stored, map_folder, query, indices, options, ranker)
        for results in work.map(localize, jobs, "localizing", plugins=(ranker,)):
            yield from results


def type_in_map(map_folder: KaptureFolder, local_type: str) -> str:
    """Return the keypoints type that the map has: ``local_type`` or its base type."""
    names = (local_type, base_type(local_type))
    known = (map_folder.observations(), map_folder.types("keypoints"))
    return next((name for where in known for name in names if name in where), names[-1])


class LocalizeQueries(PipelineStage):
    """Estimate the poses of the queries from their matches with the map."""

    name = "localization"
    version = 11
    uses = ("localization", "guided_pyramid.mode", *LOCAL_TYPES)
    explained_by = (
        "localization.clusters.by",
        "localization.rank",
        "localization.min_confidence",
    )
    inputs = (
        paths.MAPPING,
        paths.QUERY,
        PipelineStage.query,
        SIDE_TABLES,
        paths.LOCAL_FEATURES,
        paths.MAP,
        paths.QUERY_PAIRS,
        PipelineStage.query_matches,
    )
    outputs = (PipelineStage.poses, paths.TIMING)

    def plugins(self) -> Sequence[object]:
        return (self.options.localization.make_ranker(),)

    def run(self, work: StageWork) -> Mapping[str, float]:
        query = work.folder(self.query(), paths.FEATURES, *self.query_matches())
        pairs = read_pairs(work.path(paths.QUERY_PAIRS))
        options, tables = self.options.localization, work.path(SIDE_TABLES)
        results = localize_from_matches(
            work.folder(paths.MAP),
            query,
            pairs,
            self.options.matched_types(),
            options,
            tables=read_side_tables(tables),
            work=work,
            scratch=work.out,
        )
        return write_localized(
            work.out / self.poses(),
            work.folder(paths.QUERY),
            chain(results, starmap(unreadable_image, read_unreadable(tables).items())),
            fallback=options.fallback,
            first_candidates=first_candidates(pairs, work.folder(paths.MAPPING)),
            timing=work.out / paths.TIMING,
        )


def first_candidates(
    pairs: Sequence[ImagePair], mapping: KaptureFolder
) -> dict[str, tuple[str, RigidTransform]]:
    """Map each query to its best retrieved map image and that image's pose."""
    poses = mapping.read().poses()
    best = {query: images[0] for query, images in candidates_of(pairs).items()}
    return {query: (image, poses[image]) for query, image in best.items() if image in poses}
