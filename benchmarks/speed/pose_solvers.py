"""Compare absolute pose solvers: ours, poselib, pycolmap and OpenCV.

    python benchmarks/speed/pose_solvers.py [--problems 40] [--camera PINHOLE]

Random scenes at 4 to 15 m with 1 px of noise; outliers are permuted matches. All solvers run warm
on one thread, in an order that rotates with each problem. Times are CPU times. poselib gets pixels
undistorted in advance and our options; the others get the original pixels. Threshold, confidence
and maximum iterations are equal. The table lists p50, p95 and the share of poses within 5 cm and
0.5 deg; "over poselib" is the median of ours - 1.2 x poselib.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from timing import table  # noqa: E402

from megloc_kapture.geometry.cameras import bearing_rays, focal_px, project  # noqa: E402
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    absolute_pose,  # noqa: E402
)
from megloc_kapture.values import Camera, Pose, RigidTransform  # noqa: E402

Array = NDArray[np.float64]
Solver = Callable[[Array, Array], RigidTransform | None]
CAMERAS = {
    "PINHOLE": Camera("PINHOLE", 1600, 1200, (1200.0, 1210.0, 805.0, 599.0)),
    "OPENCV": Camera("OPENCV", 1600, 1200, (1200.0, 1210.0, 805.0, 599.0, -0.1, 0.02, 1e-3, -1e-3)),
}
OPTIONS = AbsolutePoseOptions()
RANSAC = OPTIONS.for_poselib()


def problem(
    camera: Camera, count: int, inlier_ratio: float, seed: int
) -> tuple[RigidTransform, Array, Array]:
    """Return the true pose, pixels (N, 2) and points (N, 3); outliers have permuted points."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    w, x, y, z = (quat / np.linalg.norm(quat)).tolist()
    tx, ty, tz = rng.normal(0.0, 5.0, 3).tolist()
    truth = RigidTransform((w, x, y, z), (tx, ty, tz))
    rays = bearing_rays(camera, rng.uniform((0, 0), (camera.width, camera.height), (count, 2)))
    world = truth.inverse().apply(rays * rng.uniform(4.0, 15.0, (count, 1)))
    pixels = project(camera, truth, world) + rng.normal(size=(count, 2))
    wrong = rng.permutation(count)[round(inlier_ratio * count) :]
    world[wrong] = world[rng.permutation(wrong)]
    return truth, pixels, world


def ours(camera: Camera) -> Solver:
    def solve(pixels: Array, world: Array) -> RigidTransform | None:
        pose = absolute_pose(pixels, world, camera, OPTIONS)
        return pose.cam_from_world if isinstance(pose, Pose) else None

    return solve


def bare_poselib(camera: Camera) -> Solver:
    """Return a solver for undistorted pixels; the undistortion is not timed."""
    import poselib

    focal = focal_px(camera)
    pinhole = {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0.0, 0.0]}

    def solve(undistorted: Array, world: Array) -> RigidTransform | None:
        pose, _ = poselib.estimate_absolute_pose(
            undistorted, world, pinhole, RANSAC, {"loss_type": "CAUCHY"}
        )
        return RigidTransform.from_matrix(pose.R, pose.t)

    return solve


def with_pycolmap(camera: Camera) -> Solver:
    import pycolmap

    theirs = pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = OPTIONS.max_error_px
    estimation.ransac.confidence = RANSAC["success_prob"]
    estimation.ransac.max_num_trials = RANSAC["max_iterations"]
    estimation.ransac.min_inlier_ratio = 0.01
    estimation.ransac.random_seed = OPTIONS.seed

    def solve(pixels: Array, world: Array) -> RigidTransform | None:
        result: Any = pycolmap.estimate_and_refine_absolute_pose(
            pixels, world, theirs, estimation, return_covariance=True
        )
        if result is None:
            return None
        matrix = result["cam_from_world"].matrix()
        return RigidTransform.from_matrix(matrix[:, :3], matrix[:, 3])

    return solve


def with_opencv(camera: Camera) -> Solver:
    fx, fy, cx, cy, *distortion = camera.params
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    coefficients = np.array(distortion) if distortion else None

    def solve(pixels: Array, world: Array) -> RigidTransform | None:
        success, rotation, translation, _ = cv2.solvePnPRansac(
            world,
            pixels,
            intrinsics,
            coefficients,
            iterationsCount=RANSAC["max_iterations"],
            reprojectionError=OPTIONS.max_error_px,
            confidence=RANSAC["success_prob"],
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not success:
            return None
        matrix = np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64)
        return RigidTransform.from_matrix(matrix, np.asarray(translation, dtype=np.float64))

    return solve


def is_good(pose: RigidTransform | None, truth: RigidTransform) -> bool:
    """Test whether a pose is within 5 cm and 0.5 deg of the truth."""
    if pose is None:
        return False
    difference = (pose @ truth.inverse()).quat_wxyz
    angle_deg = np.degrees(2 * np.arctan2(np.linalg.norm(difference[1:]), abs(difference[0])))
    return bool(np.linalg.norm(pose.center() - truth.center()) < 0.05 and angle_deg < 0.5)


def measure(
    camera: Camera, count: int, inlier_ratio: float, num_problems: int
) -> tuple[list[list[str]], float]:
    """Return rows of the table and the median of ours minus 1.2 times poselib, in ms."""
    solvers = {
        "ours": ours(camera),
        "poselib, bare": bare_poselib(camera),
        "pycolmap": with_pycolmap(camera),
        "OpenCV, AP3P": with_opencv(camera),
    }
    milliseconds: dict[str, list[float]] = {name: [] for name in solvers}
    good = dict.fromkeys(solvers, 0)
    for seed in range(-2, num_problems):
        truth, pixels, world = problem(camera, count, inlier_ratio, abs(seed))
        undistorted = np.ascontiguousarray(bearing_rays(camera, pixels)[:, :2]) * focal_px(camera)
        names = list(solvers)
        first = seed % len(names)
        for name in names[first:] + names[:first]:
            points = undistorted if name == "poselib, bare" else pixels
            start = time.thread_time()
            pose = solvers[name](points, world)
            spent = time.thread_time() - start
            if seed >= 0:  # the first problems are a warm-up
                milliseconds[name].append(1e3 * spent)
                good[name] += is_good(pose, truth)
    rows = []
    for name, spent_ms in milliseconds.items():
        p50, p95 = np.percentile(spent_ms, (50, 95))
        rows.append(
            [
                f"{count} matches, {inlier_ratio:.0%} inliers: {name}",
                f"{p50:.2f}",
                f"{p95:.2f}",
                f"{good[name] / num_problems:.3f}",
            ]
        )
    beyond = np.subtract(milliseconds["ours"], np.multiply(1.2, milliseconds["poselib, bare"]))
    return rows, float(np.median(beyond))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=40, help="random scenes per setting")
    parser.add_argument("--camera", choices=CAMERAS, default="PINHOLE")
    parser.add_argument("--matches", type=int, nargs="+", default=[500, 2000])
    parser.add_argument("--inliers", type=float, nargs="+", default=[0.5, 0.2, 0.1])
    options = parser.parse_args()
    cv2.setNumThreads(1)
    camera = CAMERAS[options.camera]
    rows = [[camera.model, "p50 ms", "p95 ms", "within 5 cm, 0.5 deg"]]
    beyond = {}
    for count in options.matches:
        for inlier_ratio in options.inliers:
            setting_rows, beyond[count, inlier_ratio] = measure(
                camera, count, inlier_ratio, options.problems
            )
            rows += setting_rows
    print(table(rows))
    for (count, inlier_ratio), milliseconds in beyond.items():
        print(f"{count} matches, {inlier_ratio:.0%} inliers: over poselib {milliseconds:+.2f} ms")


if __name__ == "__main__":
    main()
