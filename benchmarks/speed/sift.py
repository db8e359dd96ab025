"""Which SIFT: OpenCV's or pycolmap's, on the same images, at the same number of keypoints.

    .venv/bin/python benchmarks/speed/sift.py --scene ../shared/data/scenes/fountain_p11

Seconds per image with one thread each. Accuracy beside it: mutual nearest neighbours between the
mapping images, judged by their known poses: how many fit (Sampson distance up to 4 px), which
share of all matches that is, and the median distance of those that fit.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np
from end_to_end import scene_folder
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from timing import table

from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.matching.nearest_neighbours import match_nearest
from megloc_kapture.matching.verification import ray_slopes, sampson_error_px

Extract = Callable[[NDArray[np.uint8]], tuple[NDArray[np.float32], NDArray[np.float32]]]


def opencv(max_keypoints: int) -> Extract:
    extractor = RootSift(RootSiftOptions(max_keypoints=max_keypoints))

    def extract(image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        found = extractor.extract(image)
        return found.keypoints_px, found.descriptors

    return extract


def pycolmap_sift(max_keypoints: int) -> Extract:
    import pycolmap

    pycolmap.logging.minloglevel = 2
    warnings.filterwarnings("ignore", category=DeprecationWarning, message="pycolmap.Sift")
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.use_gpu = False
    options.sift.max_num_features = max_keypoints
    extractor = pycolmap.Sift(options)

    def extract(image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        found: tuple[NDArray[np.float32], NDArray[np.float32]] = extractor.extract(gray)
        keypoints, descriptors = found
        descriptors = np.asarray(descriptors, dtype=np.float32)
        # sorted by scale; it keeps whole octaves, so that the number must be cut by hand
        order = np.argsort(-np.asarray(keypoints)[:, 2], kind="stable")[:max_keypoints]
        norm = np.linalg.norm(descriptors[order], axis=1, keepdims=True)
        return np.asarray(keypoints, np.float32)[order, :2], descriptors[order] / norm

    return extract


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=scene_folder, required=True)
    parser.add_argument("--keypoints", type=int, default=5000)
    parser.add_argument("--images", type=int, default=10)
    options = parser.parse_args()
    folder = KaptureFolder(options.scene / "mapping")
    data = folder.read()
    names = sorted(data.poses())[: options.images]
    images = [read_image_rgb(folder.image_path(name)) for name in names]
    rows = [("SIFT", "s/image", "keypoints", "fitting matches", "of all", "median px")]
    cv2.setNumThreads(1)
    with threadpool_limits(limits=1):
        for label, extract in (
            ("OpenCV", opencv(options.keypoints)),
            ("pycolmap", pycolmap_sift(options.keypoints)),
        ):
            extract(images[0])
            start = time.perf_counter()
            features = [extract(image) for image in images]
            seconds = (time.perf_counter() - start) / len(images)
            fitting, total, errors = 0, 0, []
            for (a, fa), (b, fb) in pairwise(zip(names, features, strict=True)):
                matches, _ = match_nearest(fa[1], fb[1])
                camera_a, camera_b = data.camera_of(a), data.camera_of(b)
                pose_a, pose_b = data.cam_from_world(a), data.cam_from_world(b)
                if pose_a is None or pose_b is None:
                    continue
                px_a, px_b = fa[0][matches[:, 0]], fb[0][matches[:, 1]]
                rays_a, rays_b = bearing_rays(camera_a, px_a), bearing_rays(camera_b, px_b)
                error = sampson_error_px(
                    rays_a,
                    ray_slopes(camera_a, px_a, rays_a),
                    rays_b,
                    ray_slopes(camera_b, px_b, rays_b),
                    pose_b @ pose_a.inverse(),
                )
                good = error <= 4.0
                fitting += int(good.sum())
                total += len(error)
                errors.append(error[good])
            rows.append(
                (
                    label,
                    f"{seconds:.3f}",
                    f"{np.mean([len(f[0]) for f in features]):.0f}",
                    f"{fitting / (len(names) - 1):.0f}",
                    f"{fitting / max(total, 1):.2f}",
                    f"{np.median(np.concatenate(errors)):.2f}",
                )
            )
    print(f"{options.scene.name}, {len(names)} images, one thread")
    print(table(rows))


if __name__ == "__main__":
    main()
