"""Time the uncertainties of a large map's points, and compare a small map with Ceres.

    .venv/bin/python benchmarks/speed/uncertainty.py

The large map is random, with ten observations per point. The time includes the eigenvalues
(standard deviations along three axes).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import zlib  # noqa: F401  pycolmap before zlib corrupts the heap
from typing import Any

import numpy as np
from numpy.typing import NDArray
from timing import table

from megloc_kapture.mapping.uncertainty import point_covariances, point_deviations
from megloc_kapture.values import Camera, RigidTransform

VIEWS = 10
CAMERAS = {
    "PINHOLE": Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0)),
    "OPENCV": Camera("OPENCV", 640, 480, (500.0, 510.0, 320.0, 240.0, -0.1, 0.03, 0.002, -0.003)),
    "OPENCV_FISHEYE": Camera(
        "OPENCV_FISHEYE", 640, 480, (400.0, 410.0, 320.0, 240.0, -0.05, 0.01, 0.002, -0.001)
    ),
}


def random_map(num_points: int, num_images: int, camera: Camera) -> tuple[Any, ...]:
    """Return random arguments of point_covariances; all images have the same orientation."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-5, -5, 8), (5, 5, 15), (num_points, 3))
    poses = [
        RigidTransform((1.0, 0.0, 0.0, 0.0), (x, y, z))
        for x, y, z in rng.uniform(-2, 2, (num_images, 3)).tolist()
    ]
    point_ids = np.repeat(np.arange(num_points), VIEWS)
    image_ids = rng.integers(0, num_images, num_points * VIEWS).astype(np.int32)
    return xyz, point_ids, image_ids, [camera] * num_images, poses


def seconds(arguments: tuple[Any, ...]) -> tuple[float, float]:
    """Return the wall-clock and CPU seconds of a computation with eigenvalues."""
    start, cpu = time.perf_counter(), time.process_time()
    point_deviations(point_covariances(*arguments))
    return time.perf_counter() - start, time.process_time() - cpu


def ceres_difference(model: str) -> tuple[int, float, float, float]:
    """Return the observations, the seconds of both and the largest relative difference."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, 10, 1000
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    options.camera_params = list(CAMERAS[model].params)
    options.camera_width, options.camera_height = 640, 480
    scene = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = 1.0, 0.01
    pycolmap.synthesize_noise(noise, scene)
    images, ids = sorted(scene.images), sorted(scene.points3D)
    poses = []
    for image_id in images:
        pose = scene.images[image_id].cam_from_world()
        matrix, translation = pose.rotation.matrix(), np.array(pose.translation)
        poses.append(RigidTransform.from_matrix(matrix, translation))
    rows = np.array(
        [
            (number, images.index(element.image_id))
            for number, point_id in enumerate(ids)
            for element in scene.points3D[point_id].track.elements
        ]
    )
    xyz = np.array([scene.points3D[point_id].xyz for point_id in ids])
    arguments = (xyz, rows[:, 0], rows[:, 1], [CAMERAS[model]] * len(images), poses)
    start = time.perf_counter()
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in images:
        config.add_image(image_id)
    for frame_id in scene.frames:
        config.set_constant_rig_from_world_pose(frame_id)
    for camera_id in scene.cameras:
        config.set_constant_cam_intrinsics(camera_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(
        pycolmap.BundleAdjustmentOptions(), config, scene
    )
    covariance_options = pycolmap.BACovarianceOptions()
    covariance_options.params = pycolmap.BACovarianceOptionsParams.POINTS
    covariance_options.damping = 0.0
    result: Any = pycolmap.estimate_ba_covariance(covariance_options, scene, adjuster)
    theirs_s = time.perf_counter() - start
    theirs: NDArray[np.float64] = np.array([result.get_point_cov(point_id) for point_id in ids])
    ours_s, _ = seconds(arguments)
    ours = point_covariances(*arguments)
    upper = theirs[:, *np.triu_indices(3)]
    scale = np.linalg.norm(theirs, axis=(1, 2))[:, None]
    return len(rows), theirs_s, ours_s, float(np.abs((ours - upper) / scale).max())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    print(
        f"{options.points} points, {options.points * VIEWS} observations, "
        f"{len(os.sched_getaffinity(0))} threads; covariances and eigenvalues"
    )
    rows: list[tuple[str, ...]] = [
        ("cameras", "first call, s", f"best of {options.repeat} more, s", "CPU s")
    ]
    for model, camera in CAMERAS.items():
        arguments = random_map(options.points, options.images, camera)
        first, _ = seconds(arguments)
        best, cpu = min(seconds(arguments) for _ in range(options.repeat))
        rows.append((model, f"{first:.2f}", f"{best:.2f}", f"{cpu:.2f}"))
    print(table(rows))
    print("(the first call compiles)\n\ncompared with Ceres, poses and cameras fixed")
    rows = [("cameras", "observations", "Ceres, s", "ours, s", "relative difference")]
    worst = 0.0
    for model in CAMERAS:
        count, theirs_s, ours_s, difference = ceres_difference(model)
        worst = max(worst, difference)
        rows.append((model, str(count), f"{theirs_s:.3f}", f"{ours_s:.4f}", f"{difference:.1e}"))
    print(table(rows))
    return 0 if worst < 1e-9 else 1


if __name__ == "__main__":
    sys.exit(main())
