"""Localization from given matches: ours beside poselib, pycolmap and kapture-localization.

    python benchmarks/speed/localization.py [--queries 50] [--kloc-queries 5]

A query has matches with 20 images of a map of 200 images and 100,000 points: some 7,000 of them,
which say where 2,000 of its keypoints are in the map. The images are one place, or several of which
one is right: the matches are divided equally between the places, the right one's have the share of
inliers that the table says, with a noise of 1 px, and the others' are all wrong.

Everything runs warm, on one thread, on the same queries. Milliseconds are the processor's: on a
quiet machine those of the clock, and elsewhere not disturbed by having to wait.

- ours: from the matches to the refined pose: gathering, clusters, a pose for each, ranking,
  refinement. The step "gather" is in it and stands apart once more.
- poselib: its estimate from 2D-3D matches that somebody else gathered and divided, summed over the
  places; the place with the most inliers counts. Iterations and threshold are ours.
- pycolmap: as poselib, with its estimate and refinement.
- kapture-localization: its tool kapture_pycolmap_localize on the same map and matches as files,
  from the matches to the pose of all candidates together, threshold 12 px and the rest as it comes;
  what it needs to read the files of keypoints and matches is not counted.

Recall is the share of queries within 5 cm of the truth.
"""

from __future__ import annotations

import os

# before numpy is imported: after that it is too late
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse  # noqa: E402
import importlib  # noqa: E402
import logging  # noqa: E402
import runpy  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Sequence  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from functools import cache  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
import poselib  # noqa: E402
from kloc_tools import shims, tool_scripts  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from street import (  # noqa: E402
    CAMERA,
    STEP_M,
    Street,
    in_view,
    make_street,
    nearest_images,
    random_pose,
)
from timing import table  # noqa: E402

from megloc_kapture.errors import OptionError  # noqa: E402
from megloc_kapture.geometry.cameras import project  # noqa: E402
from megloc_kapture.io.kapture import (  # noqa: E402
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureData,
    KaptureFolder,
    MatchesWriter,
    Observations,
    Sensor,
    write_observations,
    write_pairs,
    write_points3d,
    write_sensors,
)
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions
from megloc_kapture.localization.cluster_poses import (  # noqa: E402
    ClusterOptions,
    cluster_candidates,
    localize_in_clusters,  # noqa: E402
)
from megloc_kapture.localization.map_index import (  # noqa: E402
    MapIndex,  # noqa: E402
    QueryView,
    TypedMatches,  # noqa: E402
)
from megloc_kapture.values import Pose  # noqa: E402

NUM_CANDIDATES = 20
NUM_KEYPOINTS = 4096
MAX_VIEWS = 4  # images that say the same
MAX_ERROR_M = 0.05
OPTIONS = AbsolutePoseOptions()
RANSAC = OPTIONS.for_poselib()
KEYPOINTS_TYPE = "synthetic"
TOOL = "kapture_pycolmap_localize"
METHODS = ("ours", "poselib", "pycolmap", "kapture-localization")

Matches = list[tuple[str, NDArray[np.int64], NDArray[np.float64]]]
Centre = NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class Query:
    """One query: where it is, its keypoints, and its matches with the images of each place."""

    name: str
    center: NDArray[np.float64]
    keypoints_px: NDArray[np.float32]
    places: list[list[str]]
    matches: Matches  # candidates of all places in turn


@dataclass(frozen=True)
class Result:
    """One query by one method: seconds, and how far from the truth it came."""

    seconds: float
    error_m: float


# ------------------------------------------------------------------------------------ queries


def make_query(
    street: Street, name: str, num_matches: int, inliers: float, num_places: int, seed: int
) -> Query:
    """Places of the street, the right one first, and matches with images of each."""
    rng = np.random.default_rng(seed)
    pose = random_pose(street, rng, NUM_CANDIDATES)
    px = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (NUM_KEYPOINTS, 2))
    places = []
    matches: dict[int, list[tuple[int, int, float]]] = {}
    # the others a street's length apart, all around
    span = len(street.poses) * STEP_M
    centers = [(pose.center()[0] + i * span / num_places) % span for i in range(num_places)]
    for number, center in enumerate(centers):
        size = NUM_CANDIDATES // num_places + (number < NUM_CANDIDATES % num_places)
        images = nearest_images(street, center, size)
        points = np.unique(np.concatenate([street.seen(image) for image in images]))
        count = num_matches // num_places
        keypoints = rng.permutation(NUM_KEYPOINTS)[:count]
        num_right = round(inliers * count) if number == 0 else 0
        right = rng.permutation(points[in_view(pose, street.xyz[points])])[:num_right]
        if len(right) < num_right:
            raise ValueError(f"{name}: sees {len(right)} of {num_right} points")
        wrong = rng.permutation(np.setdiff1d(points, right))[: count - num_right]
        seen = project(CAMERA, pose, street.xyz[right])
        px[keypoints[:num_right]] = seen + rng.normal(0.0, 1.0, seen.shape)
        chosen = np.concatenate([right, wrong])
        _match(street, images, keypoints, chosen, points, matches, rng)
        places.append([street.names[image] for image in images])
    by_name: Matches = []
    for image, rows in matches.items():
        array = np.array(sorted(rows), dtype=np.float64).reshape(-1, 3)
        by_name.append((street.names[image], array[:, :2].astype(np.int64), array[:, 2].copy()))
    return Query(name, pose.center(), px.astype(np.float32), places, by_name)


@cache
def keypoint_of_point(street: Street, image: int) -> dict[int, int]:
    """The map keypoints of an image by the points they see."""
    return dict(
        zip(street.seen(image).tolist(), street.keypoints_of_seen(image).tolist(), strict=True)
    )


def _match(
    street: Street,
    images: NDArray[np.int64],
    keypoints: NDArray[np.int64],
    points: NDArray[np.int64],
    others: NDArray[np.int64],
    matches: dict[int, list[tuple[int, int, float]]],
    rng: np.random.Generator,
) -> None:
    """Match keypoints with points through the images that see them, and some once more, worse."""
    keypoint_of = {image: keypoint_of_point(street, image) for image in images.tolist()}
    matches.update((image, []) for image in keypoint_of)
    used: dict[int, set[int]] = {image: set() for image in keypoint_of}
    for keypoint, point in zip(keypoints.tolist(), points.tolist(), strict=True):
        seeing = [image for image, of in keypoint_of.items() if point in of]
        for image in rng.permutation(seeing)[:MAX_VIEWS].tolist():
            score = rng.uniform(0.7, 1.0)
            matches[image].append((keypoint, keypoint_of[image][point], score))
            used[image].add(keypoint)
    unused = np.setdiff1d(others, points)
    for keypoint in rng.permutation(keypoints)[: len(keypoints) // 10].tolist():
        point = int(rng.choice(unused))
        seeing = [i for i, of in keypoint_of.items() if point in of and keypoint not in used[i]]
        if seeing:
            score = rng.uniform(0.5, 0.7)
            matches[seeing[0]].append((keypoint, keypoint_of[seeing[0]][point], score))
            used[seeing[0]].add(keypoint)


# ------------------------------------------------------------------------------------ methods


def ours(index: MapIndex, query: Query) -> Centre:
    """From the matches to the pose, as the localizer does it: the camera centre."""
    candidates = [image for image, _, _ in query.matches]
    clusters = cluster_candidates(
        candidates,
        [""] * len(candidates),
        ClusterOptions(by="covisibility"),
        centers={},
        indices=[index],
    )
    view = QueryView("query", CAMERA, (TypedMatches(index, query.keypoints_px, query.matches),))
    found, _ = localize_in_clusters(
        [view],
        clusters,
        OPTIONS,
        rank=lambda poses: np.array([float(p.views[0].inliers.sum()) for p in poses]),
    )
    return found.cam_from_world.center() if isinstance(found, Pose) else None


def gather(index: MapIndex, query: Query) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Pixels and points of each place's 2D-3D matches."""
    typed = TypedMatches(index, query.keypoints_px, query.matches)
    found = []
    for place in query.places:
        pairs = typed.correspondences(tuple(place))
        px = query.keypoints_px[pairs.keypoint_ids].astype(np.float64)
        found.append((px, index.xyz[pairs.point_ids]))
    return found


def bare_poselib(px: NDArray[np.float64], xyz: NDArray[np.float64]) -> tuple[int, Centre]:
    """Inliers and camera centre."""
    camera = {
        "model": CAMERA.model,
        "width": CAMERA.width,
        "height": CAMERA.height,
        "params": list(CAMERA.params),
    }
    pose, found = poselib.estimate_absolute_pose(px, xyz, camera, RANSAC, {})
    return found["num_inliers"], np.asarray(-pose.R.T @ pose.t)


def bare_pycolmap(px: NDArray[np.float64], xyz: NDArray[np.float64]) -> tuple[int, Centre]:
    """Inliers and camera centre; None where it finds no pose."""
    pycolmap: Any = importlib.import_module("pycolmap")
    camera = pycolmap.Camera(
        model=CAMERA.model, width=CAMERA.width, height=CAMERA.height, params=list(CAMERA.params)
    )
    ransac = {
        "max_error": OPTIONS.max_error_px,
        "min_num_trials": RANSAC["min_iterations"],
        "max_num_trials": RANSAC["max_iterations"],
        "confidence": RANSAC["success_prob"],
    }
    found = pycolmap.estimate_and_refine_absolute_pose(px, xyz, camera, {"ransac": ransac})
    if found is None:
        return 0, None
    matrix = found["cam_from_world"].matrix()
    return found["num_inliers"], np.asarray(-matrix[:, :3].T @ matrix[:, 3])


def best_place(
    solve: Callable[[NDArray[np.float64], NDArray[np.float64]], tuple[int, Centre]],
    problems: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> Centre:
    """The camera centre of the place with the most inliers."""
    return max((solve(px, xyz) for px, xyz in problems), key=lambda found: found[0])[1]


def timed(query: Query, work: Callable[..., Centre], *arguments: Any) -> Result:
    """Seconds of one query, and the error of the camera centre that comes out."""
    start = time.process_time()
    center = work(*arguments)
    seconds = time.process_time() - start
    error_m = np.inf if center is None else float(np.linalg.norm(center - query.center))
    return Result(seconds, error_m)


# ----------------------------------------------------------------------- kapture-localization


def write_kapture(street: Street, queries: Sequence[Query], folder: Path) -> None:
    """Map and queries in one kapture with keypoints, matches, points and observations; pairs."""
    names = list(street.names)
    sensor = Sensor.from_camera(CAMERA, name="camera")
    records = {(i, "camera"): name for i, name in enumerate([*names, *(q.name for q in queries)])}
    poses = {(i, "camera"): pose for i, pose in enumerate(street.poses)}
    write_sensors(folder, KaptureData({"camera": sensor}, {}, poses, records, {}))
    of_queries = {key: name for key, name in records.items() if name.startswith("query/")}
    write_sensors(folder / "query", KaptureData({"camera": sensor}, {}, {}, of_queries, {}))
    images, keypoints, points = street.observations()
    observed = Observations(
        KEYPOINTS_TYPE, street.names, points, images.astype(np.int32), keypoints.astype(np.int32)
    )
    write_points3d(folder, street.xyz)
    write_observations(folder, {KEYPOINTS_TYPE: observed})
    config = FeatureConfig(KEYPOINTS_TYPE, np.dtype(np.float32), 2)
    with FeatureWriter(folder, "keypoints", KEYPOINTS_TYPE, config) as writer:
        for i, name in enumerate(names):
            writer.write(name, street.keypoints_px(i))
        for query in queries:
            writer.write(query.name, query.keypoints_px)
    with MatchesWriter(folder, KEYPOINTS_TYPE) as matches:
        for query in queries:
            for image, pairs, scores in query.matches:
                matches.write(query.name, image, pairs, scores)
    write_pairs(
        folder / "pairs.txt",
        [ImagePair(q.name, image, 1.0) for q in queries for image, _, _ in q.matches],
    )


def run_kapture_localization(street: Street, queries: Sequence[Query]) -> dict[str, Result]:
    """Its own localizer on files, in this process, with a clock around each query."""
    pycolmap: Any = importlib.import_module("pycolmap")
    script = tool_scripts()[TOOL]
    seconds: dict[str, float] = {}
    started = 0.0
    reading = 0.0

    def reads(read: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **named: Any) -> Any:
            nonlocal reading
            start = time.process_time()
            found = read(*arguments, **named)
            reading += time.process_time() - start
            return found

        return wrapped

    logging.getLogger().setLevel(logging.CRITICAL)  # the tool's progress bar follows it
    with tempfile.TemporaryDirectory(prefix="megloc-bench-") as name, shims(pycolmap):
        folder = Path(name)
        write_kapture(street, queries, folder)
        sys.path.insert(0, str(script.parent))
        tool = runpy.run_path(str(script))["pycolmap_localize"].__globals__
        sys.path.remove(str(script.parent))
        gathering: Any = importlib.import_module(
            "kapture_localization.localization.correspondences"
        )
        gathering.image_matches_from_file = reads(gathering.image_matches_from_file)
        get_correspondences, estimate = (
            tool["get_correspondences"],
            tool["absolute_pose_estimation"],
        )
        current = ""

        def first_step(*arguments: Any, **named: Any) -> Any:
            nonlocal started, reading, current
            current = arguments[4]
            started, reading = time.process_time(), 0.0
            return get_correspondences(*arguments, **named)

        def last_step(*arguments: Any, **named: Any) -> Any:
            found = estimate(*arguments, **named)
            seconds[current] = time.process_time() - started - reading
            return found

        tool["get_correspondences"], tool["absolute_pose_estimation"] = first_step, last_step
        strategies = (
            tool["DuplicateCorrespondencesStrategy"].ignore,
            tool["RerankCorrespondencesStrategy"].none,
        )
        numbers = (OPTIONS.max_error_px, 0.01, 1000, 100_000, 0.9999)
        output = folder / "localized"
        tool["pycolmap_localize"](
            *(str(folder), str(folder / "query"), str(output), str(folder / "pairs.txt")),
            *(*numbers, KEYPOINTS_TYPE, *strategies, False, True),
        )
        poses = KaptureFolder(output).read().poses()
    results = {}
    for query in queries:
        error_m = np.inf
        if query.name in poses:
            error_m = float(np.linalg.norm(poses[query.name].center() - query.center))
        results[query.name] = Result(seconds[query.name], error_m)
    return results


# ------------------------------------------------------------------------------------- report


def row(label: str, results: dict[str, list[Result]]) -> list[str]:
    cells = [label]
    for method in METHODS:
        of_method = results.get(method, [])
        if not of_method:
            cells += ["", "", ""]
            continue
        ms = 1e3 * np.array([result.seconds for result in of_method])
        near = np.mean([result.error_m <= MAX_ERROR_M for result in of_method])
        cells += [f"{np.median(ms):.1f}", f"{np.percentile(ms, 95):.1f}", f"{100 * near:.0f}"]
    return cells


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--queries", type=int, default=50, help="of each setting")
    parser.add_argument("--kloc-queries", type=int, default=5, help="of these, 0: none")
    parser.add_argument("--matches", type=int, default=2000, help="2D-3D matches of a query")
    parser.add_argument("--inliers", type=float, nargs="+", default=[0.5, 0.2, 0.1])
    parser.add_argument("--places", type=int, nargs="+", default=[1, 3, 10])
    parser.add_argument("--fail-above", type=float, help="ms over 1.2 times poselib's median")
    options = parser.parse_args()

    street = make_street(200, 100_000, 3000, NUM_KEYPOINTS)
    index = street.index()
    settings = [(places, inliers) for places in options.places for inliers in options.inliers]
    queries = {
        setting: [
            make_query(
                street,
                f"query/{number}_{i:04d}.jpg",
                options.matches,
                inliers=setting[1],
                num_places=setting[0],
                seed=1000 * number + i,
            )
            for i in range(options.queries)
        ]
        for number, setting in enumerate(settings)
    }
    theirs: dict[str, Result] = {}
    if options.kloc_queries:
        asked = [query for own in queries.values() for query in own[: options.kloc_queries]]
        try:
            theirs = run_kapture_localization(street, asked)
        except OptionError as error:
            print(f"without kapture-localization: {error}")

    rows = [["places, inliers", "gather"], ["", "p50"]]
    for method in METHODS:
        rows[0] += [method, "", ""]
        rows[1] += ["p50 ms", "p95 ms", "%"]
    worst_ms = -np.inf
    for setting, own in queries.items():
        results: dict[str, list[Result]] = {method: [] for method in METHODS}
        gathering = []
        for number, query in enumerate([own[0], *own]):
            start = time.process_time()
            problems = gather(index, query)
            gathering.append(time.process_time() - start)
            found = {
                "ours": timed(query, ours, index, query),
                "poselib": timed(query, best_place, bare_poselib, problems),
                "pycolmap": timed(query, best_place, bare_pycolmap, problems),
            }
            if number > 0:  # the first one warms up
                for method, result in found.items():
                    results[method].append(result)
                if query.name in theirs:
                    results["kapture-localization"].append(theirs[query.name])
        median = {m: 1e3 * float(np.median([r.seconds for r in results[m]])) for m in METHODS[:2]}
        worst_ms = max(worst_ms, median["ours"] - 1.2 * median["poselib"])
        places, inliers = setting
        cells = row(f"{places}, {100 * inliers:.0f} %", results)
        rows.append([cells[0], f"{1e3 * np.median(gathering):.1f}", *cells[1:]])
    print(f"{options.queries} queries of each setting, one thread, load {os.getloadavg()[0]:.1f}")
    print(table(rows))
    print(f"ours over 1.2 times poselib, p50: at most {worst_ms:.1f} ms")
    return 0 if options.fail_above is None or worst_ms <= options.fail_above else 1


if __name__ == "__main__":
    sys.exit(main())
