"""COLMAP's SIFT: the features that official models and their databases are made of.

Lowe's detector (IJCV 2004) as VLFeat has it, descriptors normalised as RootSIFT (Arandjelovic and
Zisserman, CVPR 2012, section 3) and stored as bytes. Where no given model has to be met,
``rootsift`` is the faster choice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.image_bound import BoundedOptions
from megloc_kapture.io.colmap_mapping import extract_sift
from megloc_kapture.values import LocalFeatures

_NO_LIMIT = 2**31 - 1


class ColmapSiftOptions(BoundedOptions):
    """Options of COLMAP's SIFT; the defaults are COLMAP's, and so what official models have."""

    max_keypoints: int = Field(
        default=8192,
        gt=0,
        description="coarsest kept; COLMAP keeps whole scale levels, the last may exceed it",
    )
    first_octave: int = Field(
        default=-1, ge=-1, le=5, description="-1 doubles the image first, 0 is the image's own"
    )
    peak_threshold: float = Field(
        default=0.02 / 3, gt=0, description="smallest difference of Gaussians, of grey in 0..1"
    )


class ColmapSift:
    """The extractor ``sift``; descriptors uint8 (N, 128), about 512 long."""

    name = "sift"
    descriptor_size = 128
    descriptor_dtype = "uint8"
    metric = "L2"
    Options = ColmapSiftOptions

    def __init__(self, options: ColmapSiftOptions | None = None) -> None:
        self.options = options or ColmapSiftOptions()

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image, uint8 (H, W, 3); scores are scales, by which COLMAP selects.

        Keypoints on False pixels of the mask (H, W) are dropped before the coarsest are selected,
        exactly ``max_keypoints`` of them where there are so many.
        """
        options = self.options
        masked = mask is not None and not mask.all()
        keypoints, descriptors = extract_sift(
            image,
            max_keypoints=_NO_LIMIT if masked else options.max_keypoints,
            first_octave=options.first_octave,
            peak_threshold=options.peak_threshold,
        )
        # several orientations at one position keep their order
        order = np.argsort(-keypoints[:, 2], kind="stable")
        num_masked = 0
        if mask is not None and masked:
            last = np.array(mask.shape[::-1]) - 1
            column, row = np.clip(keypoints[order, :2].astype(np.int64), 0, last).T
            allowed = mask[row, column]
            num_masked = int((~allowed).sum())
            order = order[allowed][: options.max_keypoints]
        return LocalFeatures(
            np.ascontiguousarray(keypoints[order, :2]),
            np.ascontiguousarray(keypoints[order, 2]),
            descriptors[order],
            num_masked,
        )
