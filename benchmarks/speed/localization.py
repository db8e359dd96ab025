"""Compare localization from existing matches with poselib, pycolmap and kapture-localization.

    python benchmarks/speed/localization.py [--queries 50] [--kloc-queries 5]

A query has about 7,000 matches with 20 images of a map of 200 images and 100,000 points, which give
2D-3D matches for 2,000 of its keypoints. The images belong to one or more locations, of which one
is correct. The matches are divided equally between the locations; those of the correct location
have the inlier ratio of the table and 1 px of noise, and all others are wrong.

All methods run warm on one thread with the same queries. Times are CPU milliseconds.

- ours: gathering of 2D-3D matches, clustering, a pose per cluster, ranking and refinement. The
  table also lists the gathering separately.
- poselib: pose estimation from gathered and divided 2D-3D matches, summed over the locations; the
  location with the most inliers is taken. Iterations and threshold equal ours.
- pycolmap: the same with pycolmap's estimation and refinement.
- kapture-localization: kapture_pycolmap_localize on files of the same map and matches, one pose
  from all candidates, threshold 12 px, other options at their defaults. Reading of keypoints and
  matches is not timed.

Recall is the share of queries within 5 cm of the truth.
"""

from __future__ import annotations

import os

# have no effect after the import of numpy
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
MAX_VIEWS = 4  # matched images per 2D-3D match
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
    """A query with its true centre and its matches with the images of each location."""

    name: str
    center: NDArray[np.float64]
    keypoints_px: NDArray[np.float32]
    locations: list[list[str]]  # image names
    matches: Matches  # of all locations in order


@dataclass(frozen=True)
class Result:
    """CPU seconds and position error of a query."""

    seconds: float
    error_m: float


# ------------------------------------------------------------------------------------ queries


def make_query(
    street: Street, name: str, num_matches: int, inliers: float, num_locations: int, seed: int
) -> Query:
    """Generate a query with matches in each location; the first location is correct."""
    rng = np.random.default_rng(seed)
    pose = random_pose(street, rng, NUM_CANDIDATES)
    px = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (NUM_KEYPOINTS, 2))
    locations = []
    matches: dict[int, list[tuple[int, int, float]]] = {}
    # the locations are equally spaced along the street
    span = len(street.poses) * STEP_M
    centers = [(pose.center()[0] + i * span / num_locations) % span for i in range(num_locations)]
    for number, center in enumerate(centers):
        size = NUM_CANDIDATES // num_locations + (number < NUM_CANDIDATES % num_locations)
        images = nearest_images(street, center, size)
        points = np.unique(np.concatenate([street.seen(image) for image in images]))
        count = num_matches // num_locations
        keypoints = rng.permutation(NUM_KEYPOINTS)[:count]
        num_right = round(inliers * count) if number == 0 else 0
        right = rng.permutation(points[in_view(pose, street.xyz[points])])[:num_right]
        if len(right) < num_right:
            raise ValueError(f"{name} sees only {len(right)} points, {num_right} needed")
        wrong = rng.permutation(np.setdiff1d(points, right))[: count - num_right]
        seen = project(CAMERA, pose, street.xyz[right])
        px[keypoints[:num_right]] = seen + rng.normal(0.0, 1.0, seen.shape)
        matched = np.concatenate([right, wrong])
        _match(street, images, keypoints, matched, points, matches, rng)
        locations.append([street.names[image] for image in images])
    by_name: Matches = []
    for image, rows in matches.items():
        array = np.array(sorted(rows), dtype=np.float64).reshape(-1, 3)
        by_name.append((street.names[image], array[:, :2].astype(np.int64), array[:, 2].copy()))
    return Query(name, pose.center(), px.astype(np.float32), locations, by_name)


@cache
def keypoint_of_point(street: Street, image: int) -> dict[int, int]:
    """Return the keypoint of each point that a map image sees."""
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
    """Match keypoints with images that see their points, and add 10 % conflicting matches."""
    keypoint_of = {image: keypoint_of_point(street, image) for image in images.tolist()}
    matches.update((image, []) for image in keypoint_of)
    used: dict[int, set[int]] = {image: set() for image in keypoint_of}
    for keypoint, point in zip(keypoints.tolist(), points.tolist(), strict=True):
        seeing = [image for image, ids in keypoint_of.items() if point in ids]
        for image in rng.permutation(seeing)[:MAX_VIEWS].tolist():
            score = rng.uniform(0.7, 1.0)
            matches[image].append((keypoint, keypoint_of[image][point], score))
            used[image].add(keypoint)
    unused = np.setdiff1d(others, points)
    for keypoint in rng.permutation(keypoints)[: len(keypoints) // 10].tolist():
        point = int(rng.choice(unused))
        seeing = [i for i, ids in keypoint_of.items() if point in ids and keypoint not in used[i]]
        if seeing:
            score = rng.uniform(0.5, 0.7)
            matches[seeing[0]].append((keypoint, keypoint_of[seeing[0]][point], score))
            used[seeing[0]].add(keypoint)


# ------------------------------------------------------------------------------------ methods


def ours(index: MapIndex, query: Query) -> Centre:
    """Localize as the localizer does; return the camera centre."""
    candidates = [image for image, _, _ in query.matches]
    clusters = cluster_candidates(
        candidates,
        [""] * len(candidates),
        ClusterOptions(by="covisibility"),
        centers={},
        indices=[index],
    )
    view = QueryView("query", CAMERA, (TypedMatches(index, query.keypoints_px, query.matches),))
    pose, _ = localize_in_clusters(
        [view],
        clusters,
        OPTIONS,
        rank=lambda poses: np.array([float(p.views[0].inliers.sum()) for p in poses]),
    )
    return pose.cam_from_world.center() if isinstance(pose, Pose) else None


def gather(index: MapIndex, query: Query) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the 2D-3D matches of each location as pixels and points."""
    typed = TypedMatches(index, query.keypoints_px, query.matches)
    problems = []
    for images in query.locations:
        pairs = typed.correspondences(tuple(images))
        px = query.keypoints_px[pairs.keypoint_ids].astype(np.float64)
        problems.append((px, index.xyz[pairs.point_ids]))
    return problems


def bare_poselib(px: NDArray[np.float64], xyz: NDArray[np.float64]) -> tuple[int, Centre]:
    """Return the number of inliers and the camera centre."""
    camera = {
        "model": CAMERA.model,
        "width": CAMERA.width,
        "height": CAMERA.height,
        "params": list(CAMERA.params),
    }
    pose, info = poselib.estimate_absolute_pose(px, xyz, camera, RANSAC, {})
    return info["num_inliers"], np.asarray(-pose.R.T @ pose.t)


def bare_pycolmap(px: NDArray[np.float64], xyz: NDArray[np.float64]) -> tuple[int, Centre]:
    """Return the number of inliers and the camera centre; None without a pose."""
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
    result = pycolmap.estimate_and_refine_absolute_pose(px, xyz, camera, {"ransac": ransac})
    if result is None:
        return 0, None
    matrix = result["cam_from_world"].matrix()
    return result["num_inliers"], np.asarray(-matrix[:, :3].T @ matrix[:, 3])


def best_location(
    solve: Callable[[NDArray[np.float64], NDArray[np.float64]], tuple[int, Centre]],
    problems: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> Centre:
    """Return the camera centre of the location with the most inliers."""
    return max((solve(px, xyz) for px, xyz in problems), key=lambda result: result[0])[1]


def timed(query: Query, work: Callable[..., Centre], *arguments: Any) -> Result:
    """Measure the CPU seconds and the position error of a query."""
    start = time.process_time()
    center = work(*arguments)
    seconds = time.process_time() - start
    error_m = np.inf if center is None else float(np.linalg.norm(center - query.center))
    return Result(seconds, error_m)


# ----------------------------------------------------------------------- kapture-localization


def write_kapture(street: Street, queries: Sequence[Query], folder: Path) -> None:
    """Write the map, the queries with their matches, and the pairs into a kapture folder."""
    names = list(street.names)
    sensor = Sensor.from_camera(CAMERA, name="camera")
    records = {(i, "camera"): name for i, name in enumerate([*names, *(q.name for q in queries)])}
    poses = {(i, "camera"): pose for i, pose in enumerate(street.poses)}
    write_sensors(folder, KaptureData({"camera": sensor}, {}, poses, records, {}))
    query_records = {key: name for key, name in records.items() if name.startswith("query/")}
    write_sensors(folder / "query", KaptureData({"camera": sensor}, {}, {}, query_records, {}))
    images, keypoints, points = street.observations()
    observed = Observations(
        street.names, points, images.astype(np.int32), keypoints.astype(np.int32)
    )
    write_points3d(folder, street.xyz)
    write_observations(folder, {KEYPOINTS_TYPE: observed})
    config = FeatureConfig(KEYPOINTS_TYPE, np.dtype(np.float32), 2)
    writer = FeatureWriter(folder, "keypoints", KEYPOINTS_TYPE, config)
    for i, name in enumerate(names):
        writer.write(name, street.keypoints_px(i))
    for query in queries:
        writer.write(query.name, query.keypoints_px)
    matches = MatchesWriter(folder, KEYPOINTS_TYPE)
    for query in queries:
        for image, pairs, scores in query.matches:
            matches.write(query.name, image, pairs, scores)
    write_pairs(
        folder / "pairs.txt",
        [ImagePair(q.name, image, 1.0) for q in queries for image, _, _ in q.matches],
    )


def run_kapture_localization(street: Street, queries: Sequence[Query]) -> dict[str, Result]:
    """Run its localizer on files in this process and time each query."""
    pycolmap: Any = importlib.import_module("pycolmap")
    script = tool_scripts()[TOOL]
    seconds: dict[str, float] = {}
    started = 0.0
    reading = 0.0

    def untimed(read: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **named: Any) -> Any:
            nonlocal reading
            start = time.process_time()
            result = read(*arguments, **named)
            reading += time.process_time() - start
            return result

        return wrapped

    logging.getLogger().setLevel(logging.CRITICAL)  # disables the tool's progress bar
    with tempfile.TemporaryDirectory(prefix="megloc-bench-") as name, shims(pycolmap):
        folder = Path(name)
        write_kapture(street, queries, folder)
        sys.path.insert(0, str(script.parent))
        tool = runpy.run_path(str(script))["pycolmap_localize"].__globals__
        sys.path.remove(str(script.parent))
        gathering: Any = importlib.import_module(
            "kapture_localization.localization.correspondences"
        )
        gathering.image_matches_from_file = untimed(gathering.image_matches_from_file)
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
            result = estimate(*arguments, **named)
            seconds[current] = time.process_time() - started - reading
            return result

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--queries", type=int, default=50, help="queries per setting")
    parser.add_argument(
        "--kloc-queries",
        type=int,
        default=5,
        help="queries per setting for kapture-localization; 0 skips it",
    )
    parser.add_argument("--matches", type=int, default=2000, help="2D-3D matches per query")
    parser.add_argument("--inliers", type=float, nargs="+", default=[0.5, 0.2, 0.1])
    parser.add_argument(
        "--places", type=int, nargs="+", default=[1, 3, 10], help="numbers of locations"
    )
    options = parser.parse_args()

    street = make_street(200, 100_000, 3000, NUM_KEYPOINTS)
    index = street.index()
    settings = [(locations, inliers) for locations in options.places for inliers in options.inliers]
    queries = {
        setting: [
            make_query(
                street,
                f"query/{number}_{i:04d}.jpg",
                options.matches,
                inliers=setting[1],
                num_locations=setting[0],
                seed=1000 * number + i,
            )
            for i in range(options.queries)
        ]
        for number, setting in enumerate(settings)
    }
    theirs: dict[str, Result] = {}
    if options.kloc_queries:
        subset = [query for group in queries.values() for query in group[: options.kloc_queries]]
        try:
            theirs = run_kapture_localization(street, subset)
        except OptionError as error:
            print(f"without kapture-localization: {error}")

    rows = [["locations, inliers", "gather"], ["", "p50"]]
    for method in METHODS:
        rows[0] += [method, "", ""]
        rows[1] += ["p50 ms", "p95 ms", "%"]
    worst_ms = -np.inf
    for setting, group in queries.items():
        results: dict[str, list[Result]] = {method: [] for method in METHODS}
        gathering = []
        for number, query in enumerate([group[0], *group]):
            start = time.process_time()
            problems = gather(index, query)
            gathering.append(time.process_time() - start)
            timings = {
                "ours": timed(query, ours, index, query),
                "poselib": timed(query, best_location, bare_poselib, problems),
                "pycolmap": timed(query, best_location, bare_pycolmap, problems),
            }
            if number > 0:  # the first is a warm-up
                for method, result in timings.items():
                    results[method].append(result)
                if query.name in theirs:
                    results["kapture-localization"].append(theirs[query.name])
        median = {m: 1e3 * float(np.median([r.seconds for r in results[m]])) for m in METHODS[:2]}
        worst_ms = max(worst_ms, median["ours"] - 1.2 * median["poselib"])
        locations, inliers = setting
        cells = row(f"{locations}, {100 * inliers:.0f} %", results)
        rows.append([cells[0], f"{1e3 * np.median(gathering):.1f}", *cells[1:]])
    print(f"{options.queries} queries per setting, one thread, load {os.getloadavg()[0]:.1f}")
    print(table(rows))
    print(f"ours minus 1.2 times poselib, p50: at most {worst_ms:.1f} ms")


if __name__ == "__main__":
    main()
