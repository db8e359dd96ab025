"""Depth by PatchmatchNet, a network that was trained on multi-view stereo."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.mvs.sweep import as_estimate, matching_deviations, tangent_planes
from megloc_kapture.mvs.views import relative_projection
from megloc_kapture.nets.patchmatchnet import MULTIPLE, patchmatchnet_from
from megloc_kapture.nets.runtime import Checkpointed, image_tensor, inference
from megloc_kapture.plugins import DepthEstimate, StereoView
from megloc_kapture.values import Device, Options

# matching error in pixels, and multiple of the bound of least squares: docs/experiments/mvs.md
_CALIBRATION = np.array([0.5, 2.5])


class LearnedStereoOptions(Options):
    """Options of PatchmatchNet."""

    weights: str = Field(default="patchmatchnet", description="the name, or a file")
    device: Device = Field(default="auto", description="auto: a GPU where there is one")
    min_confidence: float = Field(
        default=0.3, ge=0, le=1, description="of its probability, what must lie near its depth"
    )
    seed: int = Field(default=0, ge=0, description="of its first hypotheses")


class LearnedStereo(Checkpointed[LearnedStereoOptions]):
    """PatchmatchNet; deviations as of :class:`~megloc_kapture.mvs.sweep.Sweep`, by its matching."""

    name = "patchmatchnet"
    Options = LearnedStereoOptions

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        """Depth of the reference; see :class:`~megloc_kapture.plugins.DepthEstimator`."""
        options = self.options
        network, device = self.network(patchmatchnet_from)
        # stretched to sides that can be halved three times
        fitted, stretches = zip(
            *(_fitted(view.image) for view in (reference, *sources)), strict=True
        )
        projections = []
        for source, stretch in zip(sources, stretches[1:], strict=True):
            infinity, baseline = relative_projection(reference, source)
            infinity = stretch @ infinity @ np.linalg.inv(stretches[0])
            projections.append((torch.from_numpy(infinity), torch.from_numpy(stretch @ baseline)))
        with inference(device):
            images = [image_tensor(image, device) for image in fitted]
            depth, confidence = network(images, projections, depth_range_m, options.seed)
        size = reference.camera.width, reference.camera.height
        found = cv2.resize(depth.cpu().numpy(), size, interpolation=cv2.INTER_LINEAR)
        sure = cv2.resize(confidence.cpu().numpy(), size, interpolation=cv2.INTER_LINEAR)
        planes = tangent_planes((1 / np.clip(found, *depth_range_m)).astype(np.float32))
        deviations = matching_deviations(reference, sources, planes, _CALIBRATION)
        deviations[sure < options.min_confidence] = 0.0
        return as_estimate(reference.camera, planes, deviations)


def _fitted(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The image with sides that are multiples, and the stretch (3, 3) of array coordinates."""
    height, width = image.shape[:2]
    rows, columns = (max(1, round(n / MULTIPLE)) * MULTIPLE for n in (height, width))
    x, y = columns / width, rows / height
    stretch = np.array([[x, 0, 0.5 * x - 0.5], [0, y, 0.5 * y - 0.5], [0, 0, 1]])
    if (rows, columns) == (height, width):
        return image, stretch
    resized = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(resized, np.uint8), stretch
