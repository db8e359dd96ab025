"""Compare kapture's reader and ours on a large map.

    python benchmarks/speed/map_reading.py [--points 1000000] [--observations 10000000]

The map is generated once, deterministically, and kept in the cache folder. The files are in the
page cache for both readers. The script compares all numbers and names and fails if any of them
differ.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from megloc_kapture.io.kapture import (
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
)

KEYPOINTS_TYPE = "superpoint"
KEYPOINTS_PER_IMAGE = 4096
OBSERVATIONS_PER_IMAGE = 1500  # similar to Aachen v1.1

T = TypeVar("T")


def generate(folder: Path, num_points: int, num_observations: int) -> tuple[float, float]:
    """Write a random map; return the seconds for points and for observations."""
    rng = np.random.default_rng(0)
    coordinates = rng.normal(0.0, 100.0, (num_points, 3))
    colours = rng.integers(0, 256, (num_points, 3))
    num_images = max(2, num_observations // OBSERVATIONS_PER_IMAGE)
    names = tuple(
        f"sequences/session_{i * 7 // num_images}/frame_{i:06d}.jpg" for i in range(num_images)
    )
    observations = Observations(
        names,
        np.sort(rng.integers(0, num_points, num_observations)),
        rng.integers(0, num_images, num_observations).astype(np.int32),
        rng.integers(0, KEYPOINTS_PER_IMAGE, num_observations).astype(np.int32),
    )
    points_s, _ = timed(lambda: write_points3d(folder, np.hstack([coordinates, colours])))
    observations_s, _ = timed(lambda: write_observations(folder, {KEYPOINTS_TYPE: observations}))
    return points_s, observations_s


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Return the seconds and the result of a function."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def read_ours(folder: Path) -> tuple[float, float, np.ndarray[Any, Any], Observations]:
    """Return the seconds for points and for observations (with range checks), and both arrays."""
    reader = KaptureFolder(folder)
    points_s, points = timed(reader.points3d)
    observations_s, observations = timed(reader.observations)
    return points_s, observations_s, points, observations[KEYPOINTS_TYPE]


def equal(
    points: np.ndarray[Any, Any], observations: Observations, theirs: tuple[Any, Any]
) -> bool:
    """Compare with kapture's objects: numbers, names and their order."""
    their_points, their_observations = theirs
    if not np.array_equal(points, their_points.as_array()):
        return False
    names = observations.image_names
    position = 0
    images = observations.image_ids.tolist()
    keypoints = observations.keypoint_ids.tolist()
    ids = observations.point_ids.tolist()
    for point in sorted(their_observations):
        for name, keypoint in their_observations[point, KEYPOINTS_TYPE]:
            if position == len(ids):
                return False
            ours = (ids[position], names[images[position]], keypoints[position])
            if ours != (point, name, keypoint):
                return False
            position += 1
    return position == len(ids)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--observations", type=int, default=10_000_000)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "megloc-bench")
    options = parser.parse_args()

    folder = options.cache / f"map_{options.points}_{options.observations}"
    files = [folder / "reconstruction" / n for n in ("points3d.txt", "observations.txt")]
    if not all(file.exists() for file in files):
        written = generate(folder, options.points, options.observations)
        print(f"generated {folder}: points {written[0]:.2f} s, observations {written[1]:.2f} s")
    for file in files:
        file.read_bytes()  # into the page cache

    first = read_ours(folder)
    best = min((read_ours(folder) for _ in range(3)), key=lambda read: read[0] + read[1])

    import kapture.io.csv

    their_points_s, their_points = timed(lambda: kapture.io.csv.points3d_from_file(str(files[0])))
    their_observations_s, their_observations = timed(
        lambda: kapture.io.csv.observations_from_file(str(files[1]))
    )
    same = equal(best[2], best[3], (their_points, their_observations))

    theirs_s = their_points_s + their_observations_s
    num_images = len(best[3].image_names)
    print(f"{options.points} points, {options.observations} observations, {num_images} images")
    print(f"{'':28}{'points':>10}{'observations':>14}{'both':>10}{'ratio':>8}")
    rows = [
        ("kapture", their_points_s, their_observations_s),
        ("ours, first in the process", first[0], first[1]),
        ("ours, best of three more", best[0], best[1]),
    ]
    for name, points_s, observations_s in rows:
        both = points_s + observations_s
        ratio = theirs_s / both
        print(f"{name:28}{points_s:8.2f} s{observations_s:12.2f} s{both:8.2f} s{ratio:7.1f}x")
    print("content equal" if same else "CONTENT DIFFERS")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
