"""Time and peak memory of opening a map of a million points and localizing in it.

    python benchmarks/speed/large_map.py [--points 1000000] [--images 6667]

The map is a street in kapture files: each image has 4096 keypoints with short descriptors and sees
1500 points, 10 million observations by default. It is generated once, deterministically, and kept
in the cache folder; descriptors of images that are never candidates are sparse files. A new process
opens the map and localizes queries with precomputed features and their 20 nearest images as
candidates; matching and verification are timed.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from street import CAMERA, STEP_M, Street, in_view, looking_left, make_street, nearest_images

from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    Observations,
    Sensor,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.values import Failure, LocalFeatures

KEYPOINTS_TYPE = "synthetic"
NUM_KEYPOINTS = 4096
NUM_SEEN = 1500
NUM_CANDIDATES = 20
DIMENSIONS = 16
NUM_QUERIES = 5


def query_places(street: Street) -> list[float]:
    """Return the positions of the queries along the street in metres."""
    return [float(x) for x in np.linspace(0.1, 0.9, NUM_QUERIES) * len(street.poses) * STEP_M]


def descriptors_of_points(points: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return a unit vector (N, DIMENSIONS) for each map point."""
    rng = np.random.default_rng(3)
    mixing = rng.normal(size=(4, DIMENSIONS)) * 1e3
    # pseudo-random numbers without a table of all points
    phases = np.stack([points % 9973, points % 7919, points % 6151, points % 4799], axis=1)
    return unit(np.sin(phases @ mixing))


def unit(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Normalize vectors (N, D) to unit length."""
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def generate(street: Street, folder: Path) -> None:
    """Write the map in kapture format."""
    records = {(i, "camera"): name for i, name in enumerate(street.names)}
    poses = {(i, "camera"): pose for i, pose in enumerate(street.poses)}
    sensor = Sensor.from_camera(CAMERA, name="camera")
    write_sensors(folder, KaptureData({"camera": sensor}, {}, poses, records, {}))
    write_points3d(folder, street.xyz)
    keypoints = FeatureConfig(KEYPOINTS_TYPE, np.dtype(np.float32), 2)
    writer = FeatureWriter(folder, "keypoints", KEYPOINTS_TYPE, keypoints)
    for i, name in enumerate(street.names):
        writer.write(name, street.keypoints_px(i))
    needed = {
        int(i) for x in query_places(street) for i in nearest_images(street, x, NUM_CANDIDATES)
    }
    described = FeatureConfig(
        KEYPOINTS_TYPE, np.dtype(np.float32), DIMENSIONS, KEYPOINTS_TYPE, "L2"
    )
    writer = FeatureWriter(folder, "descriptors", KEYPOINTS_TYPE, described)
    for i in sorted(needed):
        vectors = unit(np.random.default_rng([4, i]).normal(size=(NUM_KEYPOINTS, DIMENSIONS)))
        vectors[street.keypoints_of_seen(i)] = descriptors_of_points(street.seen(i))
        writer.write(street.names[i], vectors)
    descriptors = folder / "reconstruction" / "descriptors" / KEYPOINTS_TYPE
    for i, name in enumerate(street.names):
        if i not in needed:
            with open(descriptors / f"{name}.desc", "wb") as file:
                file.truncate(NUM_KEYPOINTS * described.dsize * described.dtype.itemsize)
    images, rows, points = street.observations()
    observed = Observations(street.names, points, images.astype(np.int32), rows.astype(np.int32))
    # written last, as a marker of a complete map
    write_observations(folder, {KEYPOINTS_TYPE: observed})


def query_features(street: Street, x: float) -> tuple[LocalFeatures, NDArray[np.float64]]:
    """Return features of a query, half of them of map points, and its true centre."""
    rng = np.random.default_rng(5)
    pose = looking_left(x, 0.3, 0.1, 0.1)
    images = nearest_images(street, x, NUM_CANDIDATES)
    points = np.unique(np.concatenate([street.seen(i) for i in images]))
    seen = rng.permutation(points[in_view(pose, street.xyz[points])])[:2000]
    px = project(CAMERA, pose, street.xyz[seen]) + rng.normal(size=(len(seen), 2))
    others = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (2000, 2))
    vectors = descriptors_of_points(seen) + 0.05 * rng.normal(size=(len(seen), DIMENSIONS))
    features = LocalFeatures(
        np.concatenate([px, others]).astype(np.float32),
        np.ones(len(px) + len(others), np.float32),
        np.concatenate([unit(vectors), unit(rng.normal(size=(2000, DIMENSIONS)))]),
    )
    return features, pose.center()


def measure(folder: Path, street: Street) -> dict[str, float]:
    """Open the map and localize; return times, errors and peak memory."""
    from megloc_kapture.pipeline.kapture_map import KaptureMap
    from megloc_kapture.pipeline.localizer import Localizer
    from megloc_kapture.pipeline.queries import Query

    queries = [(x, *query_features(street, x)) for x in query_places(street)]
    start, start_cpu = time.perf_counter(), time.process_time()
    kapture_map = KaptureMap.open(folder)
    open_s, open_cpu_s = time.perf_counter() - start, time.process_time() - start_cpu
    start = time.perf_counter()
    localizer = Localizer(kapture_map)
    start_s = time.perf_counter() - start
    seconds, errors_m = [], []
    for x, features, center in queries:
        candidates = tuple(street.names[i] for i in nearest_images(street, x, NUM_CANDIDATES))
        start = time.perf_counter()
        features_by_type = {local.name: features for local in localizer.types}
        result = localizer.localize_query(
            Query(CAMERA, features=features_by_type, candidates=candidates)
        )
        seconds.append(time.perf_counter() - start)
        if isinstance(result, Failure):
            raise SystemExit(f"a query failed: {result.reason}")
        errors_m.append(float(np.linalg.norm(result.cam_from_world.center() - center)))
    return {
        "open_s": open_s,
        "open_cpu_s": open_cpu_s,
        "start_s": start_s,
        "first_s": seconds[0],
        "query_s": float(np.median(seconds[1:])),
        "error_m": max(errors_m),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--images", type=int, default=6667)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "megloc-bench")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()

    folder = options.cache / f"street_{options.points}_{options.images}"
    street = make_street(options.images, options.points, NUM_SEEN, NUM_KEYPOINTS)
    if options.measure:
        print(json.dumps(measure(folder, street)))
        return
    if not (folder / "reconstruction" / "observations.txt").exists():
        start = time.perf_counter()
        generate(street, folder)
        print(f"generated {folder} in {time.perf_counter() - start:.0f} s")
    for name in ("points3d.txt", "observations.txt"):
        (folder / "reconstruction" / name).read_bytes()  # into the page cache

    # the first process compiles the numba functions if they are not cached
    command = [sys.executable, *sys.argv, "--measure"]
    runs = [
        json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        for _ in range(2)
    ]
    result = runs[1]
    observations = options.images * NUM_SEEN
    print(f"{options.points} points, {observations} observations, {options.images} images")
    print(
        f"load {os.getloadavg()[0]:.1f}; the first process took {runs[0]['open_s']:.1f} s to open"
    )
    cpu = f"({result['open_cpu_s']:.2f} s of CPU time)"
    print(f"open the map           {result['open_s']:8.2f} s {cpu}")
    print(f"create the localizer   {result['start_s']:8.2f} s")
    print(f"first query            {result['first_s']:8.2f} s")
    print(f"median of {NUM_QUERIES - 1} queries    {result['query_s']:8.2f} s")
    print(f"worst position error   {result['error_m']:8.4f} m")
    print(f"peak memory            {result['peak_gb']:8.2f} GB")


if __name__ == "__main__":
    main()
