"""RootSIFT local features (Arandjelovic and Zisserman, CVPR 2012, section 3).

OpenCV's SIFT is used rather than pycolmap's: on the test scenes it is 7 to 10 times faster per
image at the same pose accuracy (docs/choices.md, `benchmarks/speed/sift.py`).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.values import LocalFeatures, Options


class RootSiftOptions(Options):
    """Options of RootSIFT."""

    max_keypoints: int = Field(default=5000, gt=0, description="strongest responses kept")
    contrast_threshold: float = Field(
        default=0.01,
        ge=0,
        description="lower keeps weaker blobs (OpenCV's own default is 0.04)",
    )
    edge_threshold: float = Field(default=10.0, gt=0)
    sigma_px: float = Field(default=1.6, gt=0, description="blur of the first octave")


class RootSift:
    """SIFT keypoints with Hellinger-normalised descriptors, float32 (N, 128) of unit length."""

    name = "rootsift"
    descriptor_size = 128
    descriptor_dtype = "float32"
    metric = "L2"
    Options = RootSiftOptions

    def __init__(self, options: RootSiftOptions | None = None) -> None:
        self.options = options or RootSiftOptions()

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image.

        Parameters
        ----------
        image : uint8 (H, W, 3), RGB.
        mask : bool (H, W) or None; keypoints on False pixels are dropped before the strongest
            are selected.
        """
        options = self.options
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

        def sift(limit: int) -> cv2.SIFT:
            # precise upscaling: without it OpenCV shifts the first octave by a quarter pixel
            return cv2.SIFT.create(
                limit,
                3,
                options.contrast_threshold,
                options.edge_threshold,
                options.sigma_px,
                True,
            )

        if mask is None:
            keypoints, descriptors = sift(options.max_keypoints).detectAndCompute(gray, None)
            keypoints = list(keypoints)
        else:
            # OpenCV applies its own mask after the selection of the strongest, hence two steps
            found = sift(0).detect(gray, None)
            height, width = gray.shape
            keypoints = []
            for keypoint in found:
                column = min(max(int(keypoint.pt[0] + 0.5), 0), width - 1)
                row = min(max(int(keypoint.pt[1] + 0.5), 0), height - 1)
                if mask[row, column]:
                    keypoints.append(keypoint)
            keypoints.sort(key=_strongest_first)
            keypoints = keypoints[: options.max_keypoints]
            computed, descriptors = sift(0).compute(gray, keypoints)
            keypoints = list(computed)
        if descriptors is None or not keypoints:
            return LocalFeatures(
                np.zeros((0, 2), np.float32),
                np.zeros(0, np.float32),
                np.zeros((0, self.descriptor_size), np.float32),
            )
        order = sorted(range(len(keypoints)), key=lambda k: _strongest_first(keypoints[k]))
        order = order[: options.max_keypoints]
        xy = np.array([keypoints[k].pt for k in order], dtype=np.float32)
        scores = np.array([keypoints[k].response for k in order], dtype=np.float32)
        # OpenCV puts the centre of the first pixel at (0, 0), COLMAP at (0.5, 0.5)
        return LocalFeatures(xy + np.float32(0.5), scores, root_sift(descriptors[order]))


def _strongest_first(
    keypoint: cv2.KeyPoint,
) -> tuple[float, float, float, float, float]:
    return (
        -keypoint.response,
        keypoint.pt[1],
        keypoint.pt[0],
        keypoint.size,
        keypoint.angle,
    )


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Square root of L1-normalised SIFT, (N, 128) float32: Euclidean distance becomes Hellinger."""
    values = np.asarray(descriptors, dtype=np.float32)
    total = values.sum(axis=1, keepdims=True)
    return np.sqrt(values / np.maximum(total, np.finfo(np.float32).tiny))
