"""Depth by COLMAP's own PatchMatch (Schoenberger et al., ECCV 2016), where pycolmap has CUDA."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from megloc_kapture.errors import PluginError
from megloc_kapture.io.colmap import MapImage
from megloc_kapture.io.colmap_mapping import (
    has_cuda,
    map_path,
    read_map,
    run_patch_match,
    write_workspace,
)
from megloc_kapture.mvs.sweep import CALIBRATION, as_estimate, matching_deviations, planes_of
from megloc_kapture.plugins import DepthEstimate, StereoView


class ColmapStereo:
    """COLMAP's PatchMatch; deviations as of the sweep, by the matching of its planes."""

    name = "colmap"

    def __init__(self) -> None:
        if not has_cuda():
            raise PluginError(
                "the installed pycolmap has no CUDA, which COLMAP's stereo needs: install "
                "pycolmap-cuda12 in its place, or take the estimator sweep"
            )

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        """Depth of the reference; see :class:`~megloc_kapture.plugins.DepthEstimator`."""
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
        deviations = matching_deviations(reference, sources, planes, CALIBRATION)
        deviations[~known] = 0.0
        return as_estimate(reference.camera, planes, deviations)
