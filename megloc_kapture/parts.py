"""Parts of the pipeline in a call each: features of an image, matches, a pose, a training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError, suggestion
from megloc_kapture.features.image_bound import extract_bounded
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions, absolute_pose
from megloc_kapture.pipeline.presets import options_with
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS
from megloc_kapture.values import Camera, Failure, ImageFeatures, Pose


def extract(features: str, image: Path | str | NDArray[np.uint8], **options: Any) -> ImageFeatures:
    """Extract local features of an image by the name of the extractor.

    ``image`` is an image file or uint8 (H, W, 3) RGB; ``options`` are the extractor's. PluginError
    or MissingWeightsError if the extractor cannot be loaded.
    """
    pixels = image if isinstance(image, np.ndarray) else read_image_rgb(Path(image))
    found = extract_bounded(load_plugin(LOCAL_FEATURES, features, options), [(pixels, None)])[0]
    height, width = pixels.shape[:2]
    return ImageFeatures(found.keypoints_px, found.descriptors, width, height)


def match(
    matcher: str, first: ImageFeatures, second: ImageFeatures, **options: Any
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Match two images by the name of a matcher: int64 (K, 2) rows, and scores (K,).

    PluginError or MissingWeightsError if the matcher cannot be loaded.
    """
    found: tuple[NDArray[np.int64], NDArray[np.float32]]
    found = load_plugin(MATCHERS, matcher, options).match(first, second)
    return found


def solve_pose(
    points_px: NDArray[Any],
    points_world: NDArray[Any],
    camera: Camera,
    *,
    max_error_px: float = 12.0,
    min_inliers: int = 12,
    seed: int = 0,
) -> Pose | Failure:
    """Estimate one image's pose from 2D-3D matches: LO-RANSAC, then refinement with covariance.

    Parameters
    ----------
    points_px : (N, 2), first pixel's centre at (0.5, 0.5).
    points_world : (N, 3).
    max_error_px : inlier threshold of the reprojection error.
    """
    options = AbsolutePoseOptions(max_error_px=max_error_px, min_inliers=min_inliers, seed=seed)
    return absolute_pose(points_px, np.asarray(points_world, np.float64), camera, options)


def train(
    task: str,
    output: Path | str,
    *,
    kaptures: Sequence[Path | str] = (),
    photographs: Sequence[Path | str] = (),
    held_out: Sequence[Path | str] = (),
    features: str = "superpoint",
    set: Mapping[str, Any] | None = None,
    threads: int = 1,
    force: bool = False,
) -> dict[str, float]:
    """Train SuperGlue or descriptors as ``megloc train`` does; an interrupted run is resumed.

    Returns the last row of the training curves by column.

    Parameters
    ----------
    task : "matcher" or "descriptor".
    output : ``X.safetensors``; for further files see :func:`megloc_kapture.training.train.train`.
    kaptures, held_out : kapture folders with poses and depth, for training and for evaluation.
    photographs : folders of images, for training with random homographies.
    features : extractor of the matched features, or of the frozen detector.
    set : options, ``{"steps": 20000}``.
    """
    from megloc_kapture.training.train import TASKS, TrainingData
    from megloc_kapture.training.train import train as run_training

    if task not in TASKS:
        raise OptionError(f"unknown task {task!r}; {suggestion(task, TASKS)}")
    options = options_with(TASKS[task], set or {}, {"features.name": features})
    data = TrainingData(
        [KaptureFolder(path) for path in kaptures],
        [Path(path) for path in photographs],
        [KaptureFolder(path) for path in held_out],
    )
    return run_training(options, data, Path(output), force=force, threads=threads)
