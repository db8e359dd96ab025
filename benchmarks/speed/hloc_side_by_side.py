"""Compare with hloc step by step on the same images, SIFT features and pairs.

    make hloc-env
    .venv/bin/python benchmarks/speed/hloc_side_by_side.py --hloc-python .venv-hloc/bin/python \\
        --scene ../shared/data/scenes/redkitchen_rgbd [--keypoints sparse]

hloc is not on PyPI, so ``hloc_steps.py`` reimplements its steps with the same libraries. Both sides
use SIFT of pycolmap 3.13, either ``sparse`` as configured by hloc (first octave at image size) or
``dense``, COLMAP's default (first octave at twice the size), and pairs from our VLAD over these
features. Each side matches (hloc with ratio 0.8, ours as in the preset ``classic``), triangulates
and localizes in a separate process on one thread; imports are not timed. The rounds alternate
between the sides, and the table has the minimum CPU seconds. ``--most 0.5`` fails if ours takes
more than half of hloc's time.

``hloc_lightglue_side_by_side.py`` uses ALIKED and LightGlue instead.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import h5py  # noqa: E402
import numpy as np  # noqa: E402

# the package imports these when first needed, which would count as time of a step
import poselib  # noqa: E402, F401
import pycolmap  # noqa: E402, F401
from end_to_end import scene_folder  # noqa: E402
from timing import table  # noqa: E402

from megloc_kapture.geometry.projection import project_with_jacobian  # noqa: E402
from megloc_kapture.io.colmap import TriangulationOptions  # noqa: E402
from megloc_kapture.io.images import read_image_rgb  # noqa: E402
from megloc_kapture.io.kapture import (  # noqa: E402
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    read_pairs,
)
from megloc_kapture.io.tables import read_match_counts  # noqa: E402
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours  # noqa: E402
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions  # noqa: E402
from megloc_kapture.pipeline.executors import single_threaded  # noqa: E402
from megloc_kapture.pipeline.presets import PRESETS  # noqa: E402
from megloc_kapture.plugin_loading import load_plugin  # noqa: E402
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS  # noqa: E402
from megloc_kapture.stages.map_points import triangulate_map  # noqa: E402
from megloc_kapture.stages.matches import (  # noqa: E402
    match_pairs,
    pairs_to_rematch,
)
from megloc_kapture.stages.query_poses import (  # noqa: E402
    LocalizationOptions,
    localize_from_matches,
)
from megloc_kapture.values import Camera, Pose, RigidTransform  # noqa: E402

TYPE, FLOAT = "features", np.dtype("float32")
MODERN = PRESETS["modern"]
ALIKED = {**MODERN.local_features[0].options, "device": "cpu"}
SIFT = {"sparse": {"first_octave": 0, "peak_threshold": 0.01}, "dense": {}}
THRESHOLDS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
KEEP_ALL = LocalizationOptions(min_confidence=0.0)  # as hloc; a rejected pose counts as a miss
STEPS = ("match map", "triangulation", "match queries", "localization")
HERE = Path(__file__).resolve().parent
# files in memory: on a disk, creating a file takes 0.02 to 0.6 ms, depending on what it holds
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
Poses = dict[str, RigidTransform]


def ours(job: dict[str, Any]) -> dict[str, Any]:
    """Return the CPU seconds of each step, poses and number of points, as ``hloc_steps.run``."""
    seconds: dict[str, float] = {}
    features, folder = Path(job["kapture"]), Path(job["folder"])
    mapping, query = (
        KaptureFolder(Path(job["scene"]) / name, features_dirs=[features])
        for name in ("mapping", "query")
    )
    map_pairs, query_pairs = (read_pairs(Path(job[name])) for name in ("map_txt", "query_txt"))

    def step(name: str, work: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = work()
        seconds[name] = time.process_time() - start
        return result

    # compiled code is loaded by the first call; not timed, like the imports
    project_with_jacobian(Camera("SIMPLE_PINHOLE", 2, 2, (1.0, 1.0, 1.0)), np.ones((1, 3)))
    weights = {"weights": job["lightglue"], "device": "cpu"}
    matcher = load_plugin(MATCHERS, "lightglue", weights) if weights["weights"] else None

    def match(first: KaptureFolder, pairs: Any, verification: Any) -> KaptureFolder:
        used = NearestNeighbours() if matcher is None or job["second"] else matcher
        match_pairs(first, mapping, pairs, TYPE, used, verification, folder)
        return KaptureFolder(first.root, features_dirs=[features, folder])

    def match_map() -> KaptureFolder:
        # hloc bounds the distance in each image by 4 px, which is a Sampson distance of 4 / sqrt(2)
        bound = KnownPoseOptions(max_error_px=4 / 2**0.5) if matcher else KnownPoseOptions()
        matched = match(mapping, map_pairs, bound)
        if matcher is None or not job["second"]:
            return matched
        counts = {pair: row.verified for pair, row in read_match_counts(folder, TYPE).items()}
        weak = [
            ImagePair(*pair, 1.0)
            for pair in pairs_to_rematch(counts, MODERN.second_matching, of_both=True)
        ]
        again = folder / "again"
        match_pairs(mapping, mapping, weak, TYPE, matcher, bound, again)
        return KaptureFolder(mapping.root, features_dirs=[features, again, folder])

    map_matches = step("match map", match_map)
    output, options = folder / "map", TriangulationOptions()
    step("triangulation", lambda: triangulate_map(map_matches, [TYPE], output, options))
    query_matches = step("match queries", lambda: match(query, query_pairs, TwoViewOptions()))

    def localize() -> dict[str, Any]:
        results = localize_from_matches(
            KaptureFolder(output), query_matches, query_pairs, [TYPE], KEEP_ALL
        )
        return {
            pose.name: pose.cam_from_world.matrix()[:3].tolist()
            for pose in results
            if isinstance(pose, Pose)
        }

    poses = step("localization", localize)
    return {
        "seconds": seconds,
        "poses": {"clusters": poses},
        "points": len(KaptureFolder(output).points3d()),
    }


# ----------------------------------------------------------------------------------------- inputs


def prepare(options: argparse.Namespace, root: Path) -> dict[str, Any]:
    """Write features and pairs below ``root`` in the formats of both sides; return the job."""
    folders = [KaptureFolder(options.scene / name) for name in ("mapping", "query")]
    job: dict[str, Any] = {"sift": SIFT[options.keypoints], "scene": str(options.scene)}
    job["lightglue"] = options.lightglue and str(options.lightglue)
    job |= {name: str(root / name) for name in ("features", "arrays", "kapture")}
    job["arrays"] += ".npz"
    job |= {"images": {}, "cameras": {}, "poses": {}}
    for folder in folders:
        data = folder.read()
        for name in data.image_names():
            camera: Camera = data.camera_of(name)
            job["images"][name] = str(folder.image_path(name))
            job["cameras"][name] = [camera.model, camera.width, camera.height, list(camera.params)]
    for name, pose in sorted(folders[0].read().poses().items()):
        job["poses"][name] = [*map(float, pose.quat_wxyz), *map(float, pose.translation)]
    if options.lightglue:
        extract_aliked(job, options.aliked)
    else:
        run_hloc(options.hloc_python, "features", job, root)

    # SIFT and ALIKED have 128 dimensions
    kinds: Any = (("keypoints", (2,)), ("descriptors", (128, TYPE, "L2")))
    writers = {
        kind: FeatureWriter(
            root / "kapture", kind, TYPE, FeatureConfig(TYPE, FLOAT, *config), orphan=True
        )
        for kind, config in kinds
    }
    with np.load(job["arrays"]) as arrays, h5py.File(job["features"], "w") as file:
        for key in arrays.files:
            name, kind = key.rsplit(".", 1)
            array = arrays[key]
            writers[kind].write(name, array)
            transposed = array.T if kind == "descriptors" else array  # hloc stores (D, N)
            file.create_dataset(f"{name}/{kind}", data=transposed)
        job["mean"] = sum(len(arrays[key]) for key in arrays.files) / len(arrays.files)

    mapping, query = (["-i", str(folders[0].root)], ["--query", str(folders[1].root)])
    features = ["--features-dir", job["kapture"]]
    job["map_txt"], job["query_txt"] = (str(root / name) for name in ("map.txt", "query.txt"))
    describe = [*mapping, *query, *features, "--features", "vlad", "-o", job["kapture"], "-f"]
    megloc("extract-global", *describe, "--set", "global_features.options.num_clusters=64")
    pairs_of_map = ["pairs-mapping", *mapping, *features]
    pairs_of_query = ["pairs-query", *mapping, *query, *features]
    few = ["--set", f"mapping_pairs.top_k={options.candidates}"] if options.lightglue else []
    megloc(*pairs_of_map, *few, "-o", job["map_txt"])
    megloc(*pairs_of_query, "--topk", str(options.candidates), "-o", job["query_txt"])
    pairs = {tuple(sorted((pair.query, pair.map))) for pair in read_pairs(Path(job["map_txt"]))}
    job["mapping_pairs"], job["query_pairs"] = sorted(pairs), {}
    for pair in read_pairs(Path(job["query_txt"])):
        job["query_pairs"].setdefault(pair.query, []).append(pair.map)
    job["second"] = options.second
    if options.second:  # as many pairs as in the preset modern
        job |= {"map_txt": str(root / "more_map.txt"), "query_txt": str(root / "more_query.txt")}
        megloc(*pairs_of_map, "-o", job["map_txt"])
        megloc(*pairs_of_query, "-o", job["query_txt"])
    return job


def extract_aliked(job: dict[str, Any], weights: str) -> None:
    """Write ALIKED features of all images into the .npz file of the job."""
    aliked = load_plugin(LOCAL_FEATURES, "aliked", {"weights": weights, **ALIKED})
    arrays: dict[str, Any] = {}
    for name, path in job["images"].items():
        features = aliked.extract(read_image_rgb(Path(path)))
        arrays[f"{name}.keypoints"] = features.keypoints_px[:, :2]
        arrays[f"{name}.descriptors"] = features.descriptors
    np.savez(job["arrays"], **arrays)


def megloc(*arguments: str) -> None:
    command = str(Path(sys.executable).with_name("megloc"))
    subprocess.run([command, *arguments, "-q"], check=True)


def run_hloc(python: Path, task: str, job: dict[str, Any], folder: Path) -> Any:
    return run_job([str(python), str(HERE / "hloc_steps.py"), task], job, folder)


def run_job(command: list[str], job: dict[str, Any], folder: Path) -> Any:
    """Run a job in a separate process and return its result."""
    path = folder / "job.json"
    result = folder / "result.json"
    path.write_text(json.dumps({**job, "result": str(result)}))
    done = subprocess.run([*command, str(path)], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{done.stdout[-2000:]}{done.stderr[-2000:]}\n{' '.join(command)} failed")
    return json.loads(result.read_text()) if result.exists() else None


# ----------------------------------------------------------------------------------------- tables


def errors(poses: dict[str, Any], truth: Poses) -> np.ndarray:
    """Return the errors (Q, 2) of all queries in metres and degrees; infinite without a pose."""
    result = np.full((len(truth), 2), np.inf)
    for row, (name, true) in enumerate(sorted(truth.items())):
        if name in poses:
            matrix = np.array(poses[name])
            center = -matrix[:, :3].T @ matrix[:, 3]
            cosine = (np.trace(matrix[:, :3] @ true.rotation_matrix().T) - 1) / 2
            angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            result[row] = np.linalg.norm(center - true.center()), angle_deg
    return result


def recall_row(name: str, points: int, poses: dict[str, Any], truth: Poses) -> tuple[str, ...]:
    errors_of = errors(poses, truth)
    within = [100 * float((errors_of <= limits).all(axis=1).mean()) for limits in THRESHOLDS]
    metres, degrees = np.median(errors_of, axis=0)
    recall = " / ".join(f"{share:.1f}" for share in within)
    return name, str(points), recall, f"{100 * metres:.1f} cm, {degrees:.2f} deg"


def main(*, lightglue: bool = False) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--hloc-python", type=Path, help="Python built by make hloc-env")
    parser.add_argument("--scene", type=scene_folder)
    parser.add_argument("--keypoints", choices=SIFT, default="sparse")
    parser.add_argument("--candidates", type=int, default=5 if lightglue else 30)
    parser.add_argument("--rounds", type=int, default=1 if lightglue else 3)
    parser.add_argument("--aliked", default="aliked-n16", help="weights of ALIKED")
    parser.add_argument("--lightglue", type=Path, help="weights of LightGlue for ALIKED")
    parser.add_argument("--second", action="store_true", help="see the description")
    parser.add_argument("--most", type=float, help="largest accepted share of hloc's CPU seconds")
    parser.add_argument("--ours", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.ours:
        job = json.loads(options.ours.read_text())
        with single_threaded():
            Path(job["result"]).write_text(json.dumps(ours(job)))
        return 0
    if lightglue and not options.lightglue:
        parser.error("--lightglue FILE is required: aliked_lightglue.pth of the authors")
    if not (options.scene and options.hloc_python and options.hloc_python.exists()):
        parser.error("--scene and --hloc-python are required; make hloc-env builds the latter")
    sides: dict[str, list[dict[str, Any]]] = {"ours": [], "hloc": []}
    with tempfile.TemporaryDirectory(prefix="megloc-hloc-", dir=MEMORY) as temporary:
        root = Path(temporary)
        job = prepare(options, root)
        for number in range(options.rounds):
            for side, runs in sides.items():
                folder = root / f"{side}{number}"
                folder.mkdir()
                side_job = {**job, "folder": str(folder)}
                side_job |= {f"{n}_matches": str(folder / f"{n}.h5") for n in ("mapping", "query")}
                if side == "ours":
                    runs.append(run_job([sys.executable, __file__, "--ours"], side_job, folder))
                else:
                    runs.append(run_hloc(options.hloc_python, "localize", side_job, folder))
    num_query = sum(map(len, job["query_pairs"].values()))
    print(f"{len(job['mapping_pairs'])} map pairs, {num_query} query pairs")
    print(f"{job['mean']:.0f} keypoints per image; load {os.getloadavg()[0]:.1f}")
    rows: list[tuple[str, ...]] = [("CPU s", *STEPS, "total", "with clusters")]
    totals = {}
    for side, runs in sides.items():
        least = {k: min(run["seconds"][k] for run in runs) for k in runs[0]["seconds"]}
        totals[side] = sum(least[name] for name in STEPS)
        clusters = least.get("localization, clusters", least["localization"])
        cells = [*(least[name] for name in STEPS), totals[side]]
        cells.append(totals[side] + clusters - least["localization"])
        rows.append((side, *(f"{cell:.2f}" for cell in cells)))
    print(table(rows))
    truth = KaptureFolder(options.scene / "query_gt").read().poses()
    rows = [("", "points", "recall, %", "median")]
    for side, (run, *_) in sides.items():
        for method, poses in run["poses"].items():
            rows.append(recall_row(f"{side}, {method}", run["points"], poses, truth))
    print(table(rows))
    share = totals["ours"] / totals["hloc"]
    print(f"ours takes {share:.2f} of hloc's CPU seconds")
    return int(options.most is not None and share > options.most)


if __name__ == "__main__":
    sys.exit(main())
