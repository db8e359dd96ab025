"""Pairs of a map of 26,000 images: seconds, memory; and the same pairs as all pairs give.

    .venv/bin/python benchmarks/speed/pairs.py

The map is a street: images one unit apart that see points beside it, each point seen by ten images
near it. Verification is per pair of images, of matches with known poses under a distorted camera.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import zlib  # noqa: F401  pycolmap before zlib corrupts the heap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from timing import table

from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.mapping.pairs import (
    PairsByCovisibilityOptions,
    PairsByPosesOptions,
    PairsBySequenceOptions,
    exhaustive_pairs,
    frustum_overlap,
    pairs_by_covisibility,
    pairs_by_poses,
    pairs_by_sequence,
)
from megloc_kapture.matching.verification import ray_slopes, verify_with_poses
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("OPENCV", 640, 480, (520.0, 510.0, 320.5, 239.0, -0.1, 0.02, 1e-3, -5e-4))
LEVEL = (1.0, 0.0, 0.0, 0.0)
SMALL = 400
POINTS_PER_IMAGE, TRACK = 40, 10
Pairs = NDArray[np.int64]


def street(count: int) -> tuple[list[RigidTransform], Any, Any, Any]:
    """Poses, points (N, 3), and observations: point and image of each (O,)."""
    rng = np.random.default_rng(0)
    poses = [RigidTransform(LEVEL, (-float(k), 0.0, 0.0)) for k in range(count)]
    num_points = count * POINTS_PER_IMAGE
    along = np.arange(num_points) / POINTS_PER_IMAGE
    depth, height = rng.uniform(8, 20, num_points), rng.uniform(-2, 2, num_points)
    point_ids = np.repeat(np.arange(num_points), TRACK)
    near = point_ids // POINTS_PER_IMAGE + rng.integers(-8, 9, len(point_ids))
    return poses, np.column_stack([along, height, depth]), point_ids, np.clip(near, 0, count - 1)


def methods(count: int) -> dict[str, Callable[[], Pairs]]:
    """Each method on the street of so many images, or on what it finds hardest."""
    poses, xyz, point_ids, image_ids = street(count)
    turns = np.random.default_rng(1).normal(size=(count, 4))
    quaternions = [tuple(q) for q in (turns / np.linalg.norm(turns, axis=1)[:, None]).tolist()]
    one_place: Any = [RigidTransform(q, (0.0, 0.0, 0.0)) for q in quaternions]
    everywhere = np.repeat(np.arange(10), count), np.tile(np.arange(count), 10)

    def overlapping() -> Pairs:
        pairs = pairs_by_poses(poses)
        cameras = [CAMERA] * count
        shares = frustum_overlap(pairs, cameras, poses, xyz, point_ids, image_ids)
        return pairs[shares >= 0.3]

    return {
        "poses": lambda: pairs_by_poses(poses),
        "poses, overlap of 0.3": overlapping,
        "poses, all at one place": lambda: pairs_by_poses(one_place),
        "poses, at one place, within 3 deg": lambda: pairs_by_poses(
            one_place, PairsByPosesOptions(max_angle_deg=3.0)
        ),
        "covisibility": lambda: pairs_by_covisibility(count, point_ids, image_ids),
        "covisibility, 10 points seen by all": lambda: pairs_by_covisibility(
            count, *everywhere, PairsByCovisibilityOptions(min_shared_points=1)
        ),
        "sequence": lambda: pairs_by_sequence(
            ["left", "right"] * (count // 2), list(range(count)), PairsBySequenceOptions(loop=True)
        ),
    }


def measure(name: str, count: int) -> None:
    """Print seconds, megabytes and pairs of one method; the second call is timed."""
    methods(100)[name]()
    method = methods(count)[name]
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before = peak_mb()
    start, start_cpu = time.perf_counter(), time.process_time()
    pairs = method()
    wall_s, cpu_s = time.perf_counter() - start, time.process_time() - start_cpu
    print(json.dumps([wall_s, cpu_s, peak_mb() - before, len(pairs)]))


def peak_mb() -> float:
    """Most memory that this process has held since the peak was forgotten."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def brute_force(name: str) -> Pairs:
    """All pairs of the small street looked at one by one."""
    poses, _, point_ids, image_ids = street(SMALL)
    if name == "poses":
        score = -np.abs(np.subtract.outer(range(SMALL), range(SMALL))).astype(float)
        least = -np.inf
    else:
        seen = [set(point_ids[image_ids == image].tolist()) for image in range(SMALL)]
        score = np.zeros((SMALL, SMALL))
        for a, b in exhaustive_pairs(SMALL).tolist():
            score[a, b] = score[b, a] = len(seen[a] & seen[b])
        least = PairsByCovisibilityOptions().min_shared_points
    np.fill_diagonal(score, -np.inf)
    found = set()
    for image in range(SMALL):
        for other in np.argsort(-score[image], kind="stable")[:20].tolist():
            if score[image, other] >= least and other != image:
                found.add((min(image, other), max(image, other)))
    return np.array(sorted(found), dtype=np.int64)


def verification() -> str:
    """Microseconds of one pair, by its number of matches."""
    rng = np.random.default_rng(0)
    b_from_a = RigidTransform((0.995, 0.01, -0.08, 0.02), (-1.0, 0.1, 0.2))
    points = rng.uniform((-2, -1.5, 5), (2, 1.5, 12), (5000, 3))
    pixels = [project(CAMERA, pose, points) for pose in (RigidTransform.identity(), b_from_a)]
    rays = [bearing_rays(CAMERA, px) for px in pixels]
    slopes = [ray_slopes(CAMERA, px, ray) for px, ray in zip(pixels, rays, strict=True)]
    image = best_us(lambda: ray_slopes(CAMERA, pixels[0], rays[0]))
    rows = [("matches", "us per pair")]
    for count in (300, 1000, 3000):
        chosen = rng.choice(5000, count, replace=False)

        def verify(rows: Pairs = chosen) -> None:
            a, b = rays[0][rows], rays[1][rows]
            verify_with_poses(a, slopes[0][rows], b, slopes[1][rows], b_from_a)

        us = best_us(verify)
        rows.append((str(count), f"{us:.0f}"))
    return f"{table(rows)}\nand {image:.0f} us per image of 5000 keypoints"


def best_us(call: Callable[[], object], repeat: int = 200) -> float:
    """Of the fastest of many calls."""
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e6 * min(times)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=26_000)
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        measure(options.only, options.images)
        return 0
    print(f"{options.images} images, {options.images * POINTS_PER_IMAGE * TRACK} observations")
    rows = [("pairs by", "s", "processor s", "MB more", "pairs")]
    for name in methods(100):
        # a process of its own: what it needs at most cannot be told apart afterwards
        command = [sys.executable, __file__, "--images", str(options.images), "--only", name]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        wall_s, cpu_s, added, count = json.loads(done.stdout)
        rows.append((name, f"{wall_s:.2f}", f"{cpu_s:.2f}", f"{added:.0f}", str(count)))
    print(table(rows))
    print(f"\n{SMALL} images, beside all pairs one by one")
    rows = [("pairs by", "ours, s", "all pairs, s", "pairs", "the same")]
    same = True
    for name in ("poses", "covisibility"):
        method = methods(SMALL)[name]
        method()
        start = time.perf_counter()
        expected = brute_force(name)
        middle = time.perf_counter()
        found = method()
        ours_s, theirs_s = time.perf_counter() - middle, middle - start
        equal = np.array_equal(found, expected)
        same &= equal
        numbers = (f"{ours_s:.3f}", f"{theirs_s:.3f}", str(len(found)), "yes" if equal else "no")
        rows.append((name, *numbers))
    print(table(rows))
    print(f"\nverification with known poses\n{verification()}")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
