"""Clusters of candidates in a corridor of rooms that are alike, beside one PnP over all of them.

    .venv/bin/python benchmarks/corridor.py                      # the table, seeds 0 to 4
    .venv/bin/python benchmarks/corridor.py --choose --seeds 100 101 102 103 104

A scene per seed is rendered (corridor_scene.py) and mapped by ``megloc eval``: features, retrieval,
triangulation, matches. These are shared; what differs is the last step:

- one PnP over all candidates, as the pipeline does it with ``localization.clusters.by=none``:
  every keypoint has the point that most images say
- one PnP in which every match is kept: a keypoint may have a point in every room
- clusters by poses and by co-visibility, a PnP each, ranked

``--choose`` tries options on other scenes than those of the table and prints the best of each row;
CHOSEN below is what it printed for seeds 100 to 104. Scenes, maps and matches are kept in the
workspace, so that a second run only localizes.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from corridor_scene import ROOM_DISTANCE_M, Seen, write_corridor
from mapped_scene import Query, Scene, errors, hypotheses, read_scene
from scenes import megloc

from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions, absolute_pose
from megloc_kapture.localization.cluster_poses import ClusterOptions
from megloc_kapture.localization.ranking import DistinctiveInliers, InlierCount
from megloc_kapture.plugins import PoseHypothesis, PoseRanker
from megloc_kapture.stages.query_poses import LocalizationOptions, localize_unit
from megloc_kapture.values import Failure, Pose, RigidTransform

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

THRESHOLDS = ((0.25, 5.0), (0.5, 10.0))
TOP_K = 30
PIPELINE = (
    # most similar images are those of other rooms
    'mapping_pairs.by=["poses"]',
    "mapping_pairs.poses.max_distance=6",
    f"query_pairs.top_k={TOP_K}",
    "global_features.options.num_clusters=64",
    "global_features.options.training_descriptors=50000",
)
SHOWN = 6  # of the options tried, the best
RANKERS: dict[str, PoseRanker] = {
    "inliers": InlierCount(),
    **{
        f"distinctive (radius {radius:g}, power {power:g})": DistinctiveInliers(
            DistinctiveInliers.Options(radius=radius, power=power)
        )
        for radius, power in product((0.0, 0.03), (1.0, 2.0, 4.0, 8.0))
    },
}


@dataclass(frozen=True)
class Method:
    """A way to localize with given matches.

    Attributes
    ----------
    top_k : candidates of a query.
    keep_all : every match, rather than one point per keypoint.
    """

    name: str
    clusters: ClusterOptions = ClusterOptions(by="none")
    max_error_px: float = 12.0
    top_k: int = TOP_K
    ranker: str = "inliers"
    keep_all: bool = False

    def told(self) -> str:
        """Its options in words."""
        scale = {
            "none": "",
            "poses": f"radius {self.clusters.radius} m, ",
            "covisibility": f"{self.clusters.min_shared_points} shared points, ",
        }[self.clusters.by]
        rank = "" if self.clusters.by == "none" else f"ranked by {self.ranker}, "
        return f"{scale}{rank}{self.top_k} candidates, inliers within {self.max_error_px:g} px"


ONE = Method("one PnP over all")
KEPT = Method("one PnP, every match kept", keep_all=True)
POSES = Method("clusters by poses", ClusterOptions(by="poses", radius=3.0, max_clusters=20))
SHARED = Method("clusters by co-visibility", ClusterOptions(by="covisibility", max_clusters=20))


def _with_shared(count: int) -> ClusterOptions:
    return SHARED.clusters.model_copy(update={"min_shared_points": count})


def _with_radius(radius: float) -> ClusterOptions:
    return POSES.clusters.model_copy(update={"radius": radius})


_DISTINCTIVE = "distinctive (radius 0.03, power 4)"
CHOSEN = (
    replace(ONE, top_k=10, max_error_px=4.0),
    replace(KEPT, top_k=10, max_error_px=4.0),
    replace(POSES, ranker=_DISTINCTIVE),
    replace(SHARED, ranker=_DISTINCTIVE, clusters=_with_shared(5)),
)
# what the ranking does to the same clusters
BY_INLIERS = tuple(
    replace(method, name=f"{method.name}, ranked by inliers", ranker="inliers")
    for method in CHOSEN[2:]
)

GRIDS: dict[str, list[Method]] = {
    method.name: [
        replace(method, top_k=k, max_error_px=e) for k, e in product((10, TOP_K), (4.0, 12.0))
    ]
    for method in (ONE, KEPT)
}
GRIDS[POSES.name] = [replace(POSES, clusters=_with_radius(radius)) for radius in (1.5, 3.0, 5.0)]
GRIDS[SHARED.name] = [replace(SHARED, clusters=_with_shared(count)) for count in (5, 10, 20)]


def prepare(workspace: Path, seed: int) -> tuple[Path, Seen]:
    """Render, map and match the scene of a seed, as far as that is not done yet."""
    folder = workspace / f"seed{seed}"
    root, done = folder / "scene", folder / "seen.json"
    if not done.is_file():
        seen = write_corridor(root, seed)
        done.write_text(json.dumps(asdict(seen)))
    run = folder / "run"
    settings = [part for setting in PIPELINE for part in ("--set", setting)]
    where = ("--root", str(root), "--workspace", str(run), "--executor", "inline")
    megloc("eval", "kapture", *where, *settings, "--until", "query_matches")
    return run, Seen(**json.loads(done.read_text()))


def localize(scene: Scene, query: Query, method: Method) -> Pose | Failure:
    """The pose of a query."""
    query = query.best(method.top_k)
    pose = AbsolutePoseOptions(max_error_px=method.max_error_px)
    if method.keep_all:
        return _localize_with_all(query, pose)
    return localize_unit(
        [query.view],
        query.candidates,
        [""] * len(query.candidates),
        LocalizationOptions(clusters=method.clusters, pose=pose),
        centers=scene.centers,
        ranker=RANKERS[method.ranker],
        scene=scene.pixels,
    )[0]


def _localize_with_all(query: Query, options: AbsolutePoseOptions) -> Pose | Failure:
    typed = query.view.matches[0]
    matches = np.unique(np.stack(typed.observed[:2], axis=1), axis=0)
    return absolute_pose(
        typed.keypoints_px[matches[:, 0], :2].astype(np.float64),
        typed.index.xyz[matches[:, 1]],
        query.view.camera,
        options,
    )


def hypotheses_by(method: Method, scene: Scene, query: Query) -> Sequence[PoseHypothesis]:
    """The poses of a query's clusters as a method makes them."""
    pose = AbsolutePoseOptions(max_error_px=method.max_error_px)
    return hypotheses(scene, query.best(method.top_k), method.clusters, pose)


def judged(found: RigidTransform | None, truth: RigidTransform) -> list[float]:
    """1 or 0 for each threshold, and for the right room."""
    distance, angle = errors(found, truth)
    hits = [float(distance <= m and angle <= deg) for m, deg in THRESHOLDS]
    return [*hits, float(distance < ROOM_DISTANCE_M / 2)]


@dataclass(frozen=True)
class CorridorRooms:
    """The corridors as scenes to compare rankers in; clusters by poses."""

    method: Method = CHOSEN[2]
    thresholds = THRESHOLDS

    def told(self) -> str:
        """What they are, in words."""
        return f"corridors, {self.method.name}, inliers within {self.method.max_error_px:g} px"

    def run(self, workspace: Path, seed: int) -> Path:
        """Render, map and match the scene of a seed, as far as that is not done yet."""
        return prepare(workspace, seed)[0]

    def hypotheses(self, scene: Scene, query: Query) -> Sequence[PoseHypothesis]:
        """The poses of a query's clusters."""
        return hypotheses_by(self.method, scene, query)

    def judged(self, scene: Scene, query: Query, found: PoseHypothesis | None) -> list[float]:
        """1 or 0 for each threshold, and for the right room."""
        return judged(None if found is None else found.views[0].cam_from_world, query.truth)


def measure(
    workspace: Path, methods: Sequence[Method], seed: int
) -> tuple[Seen, list[list[float]]]:
    """Of each method the shares at the thresholds and in the right room; last the best cluster."""
    run, seen = prepare(workspace, seed)
    scene = read_scene(run)
    rows = []
    for method in methods:
        found = [localize(scene, query, method) for query in scene.queries]
        poses = [pose.cam_from_world if isinstance(pose, Pose) else None for pose in found]
        rows.append(_means(judged(p, q.truth) for p, q in zip(poses, scene.queries, strict=True)))
    by_poses = next(method for method in methods if method.clusters.by == "poses")
    rows.append(_means(_best(scene, query, by_poses) for query in scene.queries))
    return seen, rows


def _best(scene: Scene, query: Query, method: Method) -> list[float]:
    """What a ranker that knows the truth would make of the clusters."""
    of_all = [
        judged(each.views[0].cam_from_world, query.truth)
        for each in hypotheses_by(method, scene, query)
    ]
    return max(of_all, default=judged(None, query.truth))


def _means(rows: Iterable[Sequence[float]]) -> list[float]:
    return [float(value) for value in np.mean(list(rows), axis=0)]


def try_all(workspace: Path, seed: int) -> dict[str, list[float]]:
    """Recall at the first threshold and share in the right room of every option."""
    run, _ = prepare(workspace, seed)
    scene = read_scene(run)
    result: dict[str, list[float]] = {}
    for method in (method for grid in GRIDS.values() for method in grid):
        if method.clusters.by == "none":
            found = [localize(scene, query, method) for query in scene.queries]
            poses = [pose.cam_from_world if isinstance(pose, Pose) else None for pose in found]
            hits = [judged(p, q.truth) for p, q in zip(poses, scene.queries, strict=True)]
            result[f"{method.name}: {method.told()}"] = _means(hits)
            continue
        of_rankers: dict[str, list[list[float]]] = {name: [] for name in RANKERS}
        for query in scene.queries:
            poses_of = hypotheses_by(method, scene, query)
            for name, ranker in RANKERS.items():
                best = None
                if poses_of:
                    at = int(np.argmax(ranker.score(poses_of, scene.pixels)))
                    best = poses_of[at].views[0].cam_from_world
                of_rankers[name].append(judged(best, query.truth))
        for name, hits in of_rankers.items():
            result[f"{method.name}: {replace(method, ranker=name).told()}"] = _means(hits)
    return result


def choose(workspace: Path, seeds: Sequence[int], workers: int) -> str:
    """The best options of each method by their recall on these seeds, and the rankers compared."""
    found = list(_over_seeds(partial(try_all, workspace), seeds, workers))
    parts = []
    for name in GRIDS:
        keys = [key for key in found[0] if key.startswith(f"{name}: ")]
        means = {key: np.mean([each[key] for each in found], axis=0) for key in keys}
        # the first of equals is the first that was tried
        keys.sort(key=lambda key: -means[key][0])
        rows: list[tuple[str, ...]] = [(name, _threshold(0), "right room")]
        rows += [
            (key[len(name) + 2 :], *(f"{means[key][i]:.3f}" for i in (0, 2)))
            for key in keys[:SHOWN]
        ]
        parts.append(table(rows))
    parts.append(_rankers_compared(found))
    return f"{os.linesep}{os.linesep}".join(parts)


def _rankers_compared(found: Sequence[Mapping[str, Sequence[float]]]) -> str:
    """How often each ranker finds the right room, over all options of clusters."""
    rows = [("ranker, mean over all options of clusters", _threshold(0), "right room")]
    for name in RANKERS:
        values = [v for each in found for key, v in each.items() if f"ranked by {name}, " in key]
        recall, _, room = np.mean(values, axis=0)
        rows.append((name, f"{recall:.3f}", f"{room:.3f}"))
    return table(rows)


def _threshold(number: int) -> str:
    m, deg = THRESHOLDS[number]
    return f"{m:g} m, {deg:g} deg"


def _over_seeds(function, seeds: Sequence[int], workers: int) -> Iterator:  # type: ignore[no-untyped-def,type-arg]
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(function, seeds)


def compare(workspace: Path, seeds: Sequence[int], workers: int) -> str:
    """The table, and what clusters gain."""
    methods = (*CHOSEN, *BY_INLIERS)
    found = list(_over_seeds(partial(measure, workspace, methods), seeds, workers))
    seen = [each for each, _ in found]
    shares = np.array([rows for _, rows in found])  # seeds, methods, figures
    names = [m.name for m in methods] + ["(by poses, the best cluster by the truth)"]
    rows: list[tuple[str, ...]] = [
        ("recall, mean +- std over seeds", _threshold(0), _threshold(1), "right room")
    ]
    for number, name in enumerate(names):
        cells = [
            f"{shares[:, number, k].mean():.3f} +- {shares[:, number, k].std():.3f}"
            for k in range(3)
        ]
        rows.append((name, *cells))
    gains: list[tuple[str, ...]] = [("gain at " + _threshold(0), *(m.name for m in methods[:2]))]
    for number, method in enumerate(methods[2:], start=2):
        differences = [shares[:, number, 0] - shares[:, base, 0] for base in (0, 1)]
        gains.append((method.name, *(f"{d.mean():+.3f} +- {d.std():.3f}" for d in differences)))
    told = [f"{method.name}: {method.told()}" for method in methods]
    surface, map_views, query_views = (
        np.mean([getattr(each, name) for each in seen])
        for name in ("of_surface", "of_map_views", "of_query_views")
    )
    scene = (
        f"seeds {' '.join(map(str, seeds))}; rooms differ in {surface:.1%} of their surface, "
        f"which is {map_views:.1%} of map views and {query_views:.1%} of query views"
    )
    return os.linesep.join([scene, *told, "", table(rows), "", table(gains)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    parser.add_argument("--choose", action="store_true", help="try all options on these seeds")
    parser.add_argument("--workspace", type=Path, help="keep scenes, maps and matches here")
    parser.add_argument("--workers", type=int, default=2, help="scenes at a time")
    options = parser.parse_args()
    # one scene per process: more threads would only fight each other
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with tempfile.TemporaryDirectory(prefix="megloc-corridor-") as temporary:
        workspace = (options.workspace or Path(temporary)).resolve()
        run = choose if options.choose else compare
        print(run(workspace, options.seeds, options.workers))


if __name__ == "__main__":
    main()
