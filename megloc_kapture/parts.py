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
    """Local features of an image, by the name of their extractor.

    Parameters
    ----------
    image : path of an image file, or uint8 (H, W, 3) RGB.
    options : the extractor's.

    Raises
    ------
    PluginError, MissingWeightsError : there is no such extractor, or it cannot be made.
    """
    pixels = image if isinstance(image, np.ndarray) else read_image_rgb(Path(image))
    found = extract_bounded(load_plugin(LOCAL_FEATURES, features, options), [(pixels, None)])[0]
    height, width = pixels.shape[:2]
    return ImageFeatures(found.keypoints_px, found.descriptors, width, height)


def match(
    matcher: str, first: ImageFeatures, second: ImageFeatures, **options: Any
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Matches of two images by the name of a matcher: int64 (K, 2) rows, and scores (K,).

    Raises
    ------
    PluginError, MissingWeightsError : there is no such matcher, or it cannot be made.
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
    """The pose of one image from 2D-3D matches: LO-RANSAC, then refinement with covariance.

    Parameters
    ----------
    points_px : (N, 2), first pixel's centre at (0.5, 0.5).
    points_world : (N, 3).
    max_error_px : reprojection error of an inlier.

    Raises
    ------
    DataError : the arrays do not have these shapes.
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
    """Train SuperGlue or descriptors as ``megloc train`` does; goes on where it was interrupted.

    Parameters
    ----------
    task : "matcher" or "descriptor".
    output : the file to write, ``X.safetensors``; others beside it, see
        :func:`megloc_kapture.training.train.train`.
    kaptures, held_out : kapture folders with poses and depth, to train on and to evaluate on.
    photographs : folders of images, trained on under random homographies.
    features : the extractor whose features are matched, or whose detector is frozen.
    set : options, ``{"steps": 20000}``.

    Returns
    -------
    The last row of the curves by column.

    Raises
    ------
    MeglocError : options, data, weights or the output cannot be used.
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
