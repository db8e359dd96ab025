"""RootSIFT local features (Arandjelovic and Zisserman, CVPR 2012, section 3).

OpenCV's SIFT is used rather than pycolmap's: 2 to 5 times faster per image, with matches that fit
the true poses as well (docs/experiments/features.md; measured by benchmarks/speed/sift.py).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.image_bound import BoundedOptions
from megloc_kapture.values import LocalFeatures


class RootSiftOptions(BoundedOptions):
    """Options of RootSIFT."""

    max_keypoints: int = Field(default=5000, gt=0, description="strongest responses kept")
    contrast_threshold: float = Field(
        default=0.01, ge=0, description="lower keeps weaker blobs (OpenCV's own default is 0.04)"
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
        """Extract from an RGB image, uint8 (H, W, 3).

        Keypoints on False pixels of the mask (H, W) are dropped before the strongest are selected.
        """
        options = self.options
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        sift = cv2.SIFT.create(
            # OpenCV applies its own mask after the selection of the strongest, so with a mask it
            # gets no limit; nor does it describe only what is left, for without a keypoint of the
            # first octave it builds another pyramid and other descriptors
            options.max_keypoints if mask is None else 0,
            3,
            options.contrast_threshold,
            options.edge_threshold,
            options.sigma_px,
            True,  # precise upscaling: without it the first octave is shifted by a quarter pixel
        )
        keypoints, descriptors = sift.detectAndCompute(gray, None)

        def strongest_first(k: int) -> tuple[float, ...]:
            point = keypoints[k]
            return -point.response, point.pt[1], point.pt[0], point.size, point.angle

        usable = (k for k, one in enumerate(keypoints) if mask is None or _is_on(mask, one))
        order = sorted(usable, key=strongest_first)
        if descriptors is None or not order:
            return LocalFeatures(
                np.zeros((0, 2), np.float32),
                np.zeros(0, np.float32),
                np.zeros((0, self.descriptor_size), np.float32),
                num_masked=len(keypoints) - len(order),
            )
        num_masked = len(keypoints) - len(order)
        order = order[: options.max_keypoints]
        xy = np.array([keypoints[k].pt for k in order], dtype=np.float32)
        scores = np.array([keypoints[k].response for k in order], dtype=np.float32)
        # OpenCV puts the centre of the first pixel at (0, 0), COLMAP at (0.5, 0.5)
        values = np.asarray(descriptors[order], dtype=np.float32)
        return LocalFeatures(xy + np.float32(0.5), scores, root_sift(values), num_masked)


def _is_on(mask: NDArray[np.bool_], keypoint: cv2.KeyPoint) -> bool:
    height, width = mask.shape
    # the keypoint is still in OpenCV's coordinates, where a pixel's centre is an integer
    column = min(max(int(keypoint.pt[0] + 0.5), 0), width - 1)
    row = min(max(int(keypoint.pt[1] + 0.5), 0), height - 1)
    return bool(mask[row, column])


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Square root of L1-normalised SIFT, (N, 128) float32: Euclidean distance becomes Hellinger."""
    values = np.asarray(descriptors, dtype=np.float32)
    total = values.sum(axis=1, keepdims=True)
    return np.sqrt(values / np.maximum(total, np.finfo(np.float32).tiny))
