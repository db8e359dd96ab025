"""Depth by plane sweep, semi-global matching and slanted planes, or by COLMAP.

Planes parallel to the image plane of the reference (Collins, CVPR 1996; Gallup et al., CVPR 2007)
are scored by the two best normalised cross-correlations and regularised by semi-global matching
(Hirschmueller, PAMI 2008) at half size; depth is then refined by PatchMatch with slanted planes
(Bleyer et al., BMVC 2011) at full size. A homogeneous pixel ``p`` of inverse depth ``w`` projects
to ``infinity p + w baseline`` in a source, with ``infinity = K_s R K^-1`` and ``baseline = K_s t``.
Planes (H, W, 3) are the inverse depth at each pixel and its slopes along x and y.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import PluginError
from megloc_kapture.geometry.cameras import scaled_camera
from megloc_kapture.mvs.views import (
    Projections,
    pinhole_matrix,
    pixel_step,
    reduced_view,
    relative_projection,
)
from megloc_kapture.plugins import DepthEstimate, StereoView
from megloc_kapture.values import Camera, Options

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

_BLOCK = 16
_MIN_PLANES = 16
_REACH = 3  # pixels of a window on each side of its centre
_TONE = 20.0  # difference from the centre's brightness (0 to 255) that has the weight 1/e
# penalties for a step of one label and of more labels, and the contrast that halves the latter
_P1, _P2, _EDGE = 8.0, 40.0, 20.0
_DIRECTIONS = [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)]
# matching error in pixels, and factor for the least-squares deviation (docs/experiments/mvs.md)
_CALIBRATION = np.array([0.15, 2.0])
_MAX_COST = 0.7  # largest accepted 1 - ZNCC


class SweepOptions(Options):
    """Options of the plane sweep; docs/experiments/mvs.md has the reasons for the defaults."""

    max_planes: int = Field(
        default=128, ge=_MIN_PLANES, le=512, description="largest number of planes, at half size"
    )
    passes: int = Field(
        default=2,
        ge=1,
        le=8,
        description="passes of PatchMatch over slanted planes; each takes 2.5 s for 768x512",
    )


class Sweep:
    """Plugin ``sweep``: plane sweep at half size, then slanted planes at full size."""

    name = "sweep"
    Options = SweepOptions

    def __init__(self, options: SweepOptions | None = None) -> None:
        self.options = options or SweepOptions()

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        near, far = depth_range_m
        limits = np.array([1.0 / far, 1.0 / near])
        views = (reference, *sources)
        half = [reduced_view(view, scaled_camera(view.camera, 0.5)) for view in views]
        inverse, step = sweep(half[0], half[1:], limits, self.options.max_planes)
        size = reference.camera.width, reference.camera.height
        planes = tangent_planes(cv2.resize(inverse, size, interpolation=cv2.INTER_LINEAR))
        deviations = refine(reference, sources, planes, limits, 0.5 * step, self.options.passes)
        # pixels at the far limit, such as those of the sky, may have a larger true depth
        deviations[planes[..., 0] <= limits[0] + 0.5 * step] = 0.0
        return as_estimate(reference.camera, planes, deviations)


class ColmapStereo:
    """Plugin ``colmap``: COLMAP's PatchMatch (Schoenberger et al., ECCV 2016); needs CUDA."""

    name = "colmap"

    def __init__(self) -> None:
        from megloc_kapture.io.colmap_mapping import has_cuda

        if not has_cuda():
            raise PluginError(
                "the installed pycolmap has no CUDA, which COLMAP's stereo needs: install "
                "pycolmap-cuda12 in its place, or use the estimator sweep"
            )

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        from megloc_kapture.io.colmap import MapImage
        from megloc_kapture.io.colmap_mapping import (
            map_path,
            read_map,
            run_patch_match,
            write_workspace,
        )

        names = [f"{number}.png" for number in range(1 + len(sources))]
        views = (reference, *sources)
        pixels = [view.image for view in views]
        images = [
            MapImage(name, view.camera, view.cam_from_world, np.zeros((0, 2), np.float32))
            for name, view in zip(names, views, strict=True)
        ]
        nothing = [(np.zeros(0, np.int64), np.zeros(0, np.int64))] * len(views)
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            write_workspace(root, images, pixels, nothing, np.zeros((0, 3)))
            run_patch_match(root, names[0], names[1:], depth_range_m)
            depth = read_map(map_path(root, "depth", names[0]))
            normals = read_map(map_path(root, "normal", names[0]))
        known = (depth > 0) & (normals[..., 2] < 0)
        planes = planes_of(reference.camera, np.where(known, depth, 1), normals)
        deviations = matching_deviations(reference, sources, planes)
        deviations[~known] = 0.0
        return as_estimate(reference.camera, planes, deviations)


def as_estimate(camera: Camera, planes: Floats, deviations: NDArray[np.floating]) -> DepthEstimate:
    """Convert planes (H, W, 3) to depth, deviation and normals where deviations are not 0."""
    known = deviations > 0
    inverse = np.where(known, planes[..., 0], 1.0)
    depth = np.where(known, 1.0 / inverse, 0.0)
    y, x = np.mgrid[: known.shape[0], : known.shape[1]]
    offset = planes[..., 0] - planes[..., 1] * x - planes[..., 2] * y
    # n X = 1 on the plane, and n X / z = n K^-1 p = inverse depth
    covector = np.stack([planes[..., 1], planes[..., 2], offset], axis=-1)
    normals = -covector @ pinhole_matrix(camera)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    sigma, normals = deviations * depth**2, np.where(known[..., None], normals, 0.0)
    return DepthEstimate(*(array.astype(np.float32) for array in (depth, sigma, normals)))


def planes_of(camera: Camera, depth_m: NDArray[Any], normals: NDArray[Any]) -> Floats:
    """Convert depth (H, W) and normals (H, W, 3) to planes float64 (H, W, 3)."""
    matrix = pinhole_matrix(camera)
    y, x = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]]
    covector = normals.astype(np.float64) @ np.linalg.inv(matrix)
    along = covector[..., 0] * x + covector[..., 1] * y + covector[..., 2]
    # along is n X / z at the pixel; the plane n X = d has the inverse depth n K^-1 p / d
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = covector[..., :2] / (along * depth_m)[..., None]
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)
    return np.concatenate([1.0 / depth_m.astype(np.float64)[..., None], slopes], axis=-1)


def stereo_image(view: StereoView) -> Image:
    """Return brightness float32 (H, W) with mean 0; NaN where masked."""
    grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    grey -= np.float32(grey.mean(dtype=np.float64))
    if view.mask is not None:
        grey[~view.mask] = np.nan
    return grey


def sweep(
    reference: StereoView, sources: Sequence[StereoView], limits: Floats, max_planes: int
) -> tuple[Image, float]:
    """Return inverse depth float32 (H, W) and the step between planes.

    ``limits`` are the smallest and the largest inverse depth.
    """
    projections = [relative_projection(reference, source) for source in sources]
    step = pixel_step(projections, reference.camera, limits)
    wanted = int(np.ceil((limits[1] - limits[0]) / step)) + 1
    planes = np.linspace(limits[0], limits[1], int(np.clip(wanted, _MIN_PLANES, max_planes)))
    grey = stereo_image(reference)
    volume = cost_volume(grey, [stereo_image(image) for image in sources], projections, planes)
    step = float(planes[1] - planes[0])
    return (planes[0] + step * semi_global(volume, grey)).astype(np.float32), step


def cost_volume(
    reference: Image, sources: Sequence[Image], projections: Projections, inverse_depths: Floats
) -> NDArray[np.uint8]:
    """Return matching cost uint8 (H, W, D) for inverse depths (D,); see ``correlate``."""
    from megloc_kapture.mvs.kernels import correlate

    height, width = reference.shape
    volume = np.empty((height, width, len(inverse_depths)), np.uint8)
    warped = np.empty((len(sources), height, width), np.float32)
    block = np.empty((_BLOCK, height, width), np.uint8)
    for start in range(0, len(inverse_depths), _BLOCK):
        some = inverse_depths[start : start + _BLOCK]
        for number, inverse in enumerate(some):
            for s, (infinity, baseline) in enumerate(projections):
                homography = infinity.copy()
                homography[:, 2] += inverse * baseline
                cv2.warpPerspective(
                    *(sources[s], homography, (width, height), warped[s]),
                    flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                    borderMode=cv2.BORDER_CONSTANT,
                    borderValue=float("nan"),
                )
            correlate(reference, warped, _REACH, block[number])
        volume[:, :, start : start + len(some)] = block[: len(some)].transpose(1, 2, 0)
    return volume


def semi_global(volume: NDArray[np.uint8], grey: Image) -> Floats:
    """Find fractional labels (H, W) with the smallest path costs, summed over 8 directions."""
    from megloc_kapture.mvs.kernels import add_path, best_labels

    total = np.zeros(volume.shape, np.uint16)
    smooth = np.nan_to_num(grey)
    for dy, dx in _DIRECTIONS:
        add_path(volume, smooth, _P1, _P2, _EDGE, dy, dx, total)
    labels = np.empty(volume.shape[:2])
    best_labels(total, labels)
    return labels


def tangent_planes(inverse: NDArray[Any]) -> Floats:
    """Return tangent planes float64 (H, W, 3) of inverse depth (H, W), with smoothed slopes."""
    smooth = cv2.GaussianBlur(cv2.medianBlur(inverse, 5), (0, 0), 2)
    slopes = [cv2.Scharr(smooth, cv2.CV_32F, *axis) / 32 for axis in ((1, 0), (0, 1))]
    return np.stack([inverse, *slopes], axis=-1).astype(np.float64)


def refine(
    reference: StereoView,
    sources: Sequence[StereoView],
    planes: Floats,
    limits: Floats,
    step: float,
    passes: int,
) -> Image:
    """Refine planes (H, W, 3) in place; return float32 deviations (H, W), 0 without a match."""
    from megloc_kapture.mvs.plane_kernels import refine_planes

    grey = stereo_image(reference)
    views = _compared(reference, sources)
    costs = np.full(grey.shape, 2.0, np.float32)
    for number in range(passes):
        refine_planes(grey, *views, planes, costs, _REACH, _TONE, number, step, limits)
    deviations = matching_deviations(reference, sources, planes)
    deviations[costs > _MAX_COST] = 0.0
    return deviations


def matching_deviations(
    reference: StereoView, sources: Sequence[StereoView], planes: Floats
) -> Image:
    """Estimate deviations (H, W) of the planes' inverse depth from matching; 0 without a match."""
    from megloc_kapture.mvs.plane_kernels import plane_deviations

    grey = stereo_image(reference)
    deviations = np.empty(grey.shape, np.float32)
    views = _compared(reference, sources)
    plane_deviations(grey, *views, planes, _REACH, _TONE, _CALIBRATION, deviations)
    return deviations


def _compared(reference: StereoView, sources: Sequence[StereoView]) -> tuple[Image, Floats, Floats]:
    projections = [relative_projection(reference, source) for source in sources]
    infinities, baselines = (np.array(each) for each in zip(*projections, strict=True))
    # sources may differ in size
    images = [stereo_image(source) for source in sources]
    height, width = np.max([image.shape for image in images], axis=0)
    stacked = np.full((len(images), height, width), np.nan, np.float32)
    for image, place in zip(images, stacked, strict=True):
        place[: image.shape[0], : image.shape[1]] = image
    return stacked, infinities, baselines
