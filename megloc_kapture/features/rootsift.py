"""SIFT with RootSIFT descriptors (Arandjelovic and Zisserman, CVPR 2012, section 3).

``rootsift`` uses OpenCV's SIFT, which is four times as fast as pycolmap's
(docs/experiments/features.md). ``sift`` is COLMAP's SIFT: VLFeat's implementation of Lowe's
detector (IJCV 2004) with byte descriptors, as in the databases of published COLMAP models.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.image_bound import BoundedOptions, on_mask
from megloc_kapture.io.colmap_mapping import extract_sift
from megloc_kapture.values import LocalFeatures

_NO_LIMIT = 2**31 - 1


class RootSiftOptions(BoundedOptions):
    max_keypoints: int = Field(default=5000, gt=0, description="number of strongest keypoints kept")
    contrast_threshold: float = Field(
        default=0.01, ge=0, description="smallest contrast of a keypoint (OpenCV's default is 0.04)"
    )


class RootSift:
    """SIFT keypoints with Hellinger-normalised descriptors, float32 (N, 128), unit length."""

    name = "rootsift"
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
            # OpenCV applies a mask after the selection, so no limit is passed with a mask.
            # Describing only the unmasked keypoints in a second call would change descriptors:
            # if none of them is in the first octave, OpenCV builds a different pyramid
            nfeatures=options.max_keypoints if mask is None else 0,
            contrastThreshold=options.contrast_threshold,
            # without it, the first octave is shifted by a quarter pixel
            enable_precise_upscale=True,
        )
        keypoints, descriptors = sift.detectAndCompute(gray, None)
        if descriptors is None:
            descriptors = np.zeros((0, 128), np.float32)
        rows = [
            (*keypoint.pt, keypoint.response, keypoint.size, keypoint.angle)
            for keypoint in keypoints
        ]
        x, y, response, size, angle = np.array(rows, np.float64).reshape(-1, 5).T
        # the first pixel's centre is (0, 0) in OpenCV, (0.5, 0.5) in COLMAP
        xy_px = np.stack([x, y], axis=1) + 0.5
        order = np.lexsort((angle, size, x, y, -response))
        if mask is not None:
            order = order[on_mask(mask, xy_px[order])]
        num_masked = len(keypoints) - len(order)
        order = order[: options.max_keypoints]
        return LocalFeatures(
            xy_px[order].astype(np.float32),
            response[order].astype(np.float32),
            root_sift(descriptors[order]),
            num_masked,
        )


def root_sift(descriptors: NDArray[Any]) -> NDArray[np.float32]:
    """Return the square root of L1-normalised SIFT, float32 (N, 128), for Hellinger distances."""
    values = np.asarray(descriptors, dtype=np.float32)
    total = values.sum(axis=1, keepdims=True)
    return np.sqrt(values / np.maximum(total, np.finfo(np.float32).tiny))


class ColmapSiftOptions(BoundedOptions):
    """Options of COLMAP's SIFT, with COLMAP's defaults."""

    max_keypoints: int = Field(
        default=8192,
        gt=0,
        description="number of coarsest keypoints kept; without a mask there may be more, because "
        "COLMAP keeps whole scale levels",
    )
    first_octave: int = Field(
        default=-1, ge=-1, le=5, description="first octave; -1 doubles the image size, 0 keeps it"
    )
    peak_threshold: float = Field(
        default=0.02 / 3,
        gt=0,
        description="smallest difference of Gaussians of a keypoint, for grey values from 0 to 1",
    )


class ColmapSift:
    """The extractor ``sift``; descriptors uint8 (N, 128) have a norm of about 512."""

    name = "sift"
    Options = ColmapSiftOptions

    def __init__(self, options: ColmapSiftOptions | None = None) -> None:
        self.options = options or ColmapSiftOptions()

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image, uint8 (H, W, 3); scores are scales, as in COLMAP's selection.

        Keypoints on False pixels of the mask (H, W) are dropped before the coarsest
        ``max_keypoints`` are selected.
        """
        options = self.options
        masked = mask is not None and not mask.all()
        keypoints, descriptors = extract_sift(
            image,
            max_keypoints=_NO_LIMIT if masked else options.max_keypoints,
            first_octave=options.first_octave,
            peak_threshold=options.peak_threshold,
        )
        order = np.argsort(-keypoints[:, 2], kind="stable")
        num_masked = 0
        if mask is not None and masked:
            allowed = on_mask(mask, keypoints[order, :2])
            num_masked = int((~allowed).sum())
            order = order[allowed][: options.max_keypoints]
        return LocalFeatures(
            np.ascontiguousarray(keypoints[order, :2]),
            np.ascontiguousarray(keypoints[order, 2]),
            descriptors[order],
            num_masked,
        )
