"""A scene that ``megloc eval`` has mapped and matched, and the poses of its queries' clusters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.dataset_tables import SIDE_TABLES
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions
from megloc_kapture.localization.cluster_poses import (
    ClusterOptions,
    cluster_candidates,
    localize_in_clusters,
)
from megloc_kapture.localization.map_index import QueryView, TypedMatches
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.plugins import PoseHypothesis
from megloc_kapture.stages.candidates import Restrictions
from megloc_kapture.stages.matches import iterate_candidates
from megloc_kapture.stages.scene import KaptureScene
from megloc_kapture.stages.shared_index import index_map
from megloc_kapture.values import RigidTransform

FEATURES = "rootsift"


@dataclass(frozen=True, eq=False)
class Query:
    """A query's matches with its candidates, best first, and its true pose."""

    view: QueryView
    candidates: tuple[str, ...]
    truth: RigidTransform

    def best(self, count: int) -> Query:
        """With the best of its candidates only."""
        kept = self.candidates[:count]
        typed = self.view.matches[0]
        matches = [each for each in typed.matches if each[0] in kept]
        return replace(
            self,
            view=replace(self.view, matches=(replace(typed, matches=matches),)),
            candidates=kept,
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """A map and its queries, matched.

    Attributes
    ----------
    centers : of the map's images in the world, or in their frame's.
    restrictions : the coordinate frames of the map's images.
    """

    queries: tuple[Query, ...]
    centers: Mapping[str, NDArray[np.float64]]
    pixels: KaptureScene
    restrictions: Restrictions


def read_scene(run: Path) -> Scene:
    """Read the workspace of a run that went as far as ``query_matches``."""
    workspace = Workspace(run)
    mapping, query = workspace.folder("map"), workspace.folder("query", "")
    index = index_map(mapping, FEATURES)
    reader = workspace.folder("query", "matches/query").matches(FEATURES)
    truth = KaptureFolder(workspace.path("query_gt")).read().poses()
    queries = []
    for name, images in iterate_candidates(read_pairs(workspace.path("pairs/query.txt"))):
        matches = [(i, *reader.read(name, i)) for i in images if (name, i) in reader]
        keypoints = query.keypoints(FEATURES).read(name)
        view = QueryView(
            name, query.read().camera_of(name), (TypedMatches(index, keypoints, matches),)
        )
        queries.append(Query(view, tuple(images), truth[name]))
    centers = {image: pose.center() for image, pose in mapping.read().poses().items()}
    restrictions = Restrictions.read(workspace.path(SIDE_TABLES))
    return Scene(tuple(queries), centers, KaptureScene(mapping, query), restrictions)


def hypotheses(
    scene: Scene, query: Query, clusters: ClusterOptions, pose: AbsolutePoseOptions
) -> Sequence[PoseHypothesis]:
    """The poses of a query's clusters, before one is chosen and refined."""
    typed = query.view.matches[0]
    images = [image for image in query.candidates if image in query.view.matched_images()]
    frame_of = scene.restrictions.frame
    places = cluster_candidates(
        images,
        [frame_of(image) for image in images],
        clusters,
        centers=scene.centers,
        indices=[typed.index],
    )
    found: list[PoseHypothesis] = []

    def keep(poses: Sequence[PoseHypothesis]) -> NDArray[np.float64]:
        found.extend(poses)
        return np.zeros(len(poses))

    localize_in_clusters(
        [query.view],
        places,
        pose,
        rank=keep,
        max_clusters=clusters.max_clusters,
        frames=[frame_of(place[0]) for place in places],
    )
    return found


def errors(found: RigidTransform | None, truth: RigidTransform) -> tuple[float, float]:
    """Metres and degrees, infinite without a pose."""
    if found is None:
        return np.inf, np.inf
    turn = found.rotation_matrix() @ truth.rotation_matrix().T
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    distance = np.linalg.norm(found.center() - truth.center())
    return float(distance), float(np.degrees(angle))
