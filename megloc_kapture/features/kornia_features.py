"""Local features from kornia: XFeat (Potje et al., CVPR 2024), DISK (Tyszkiewicz et al., 2020)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.network import (
    Images,
    Level,
    LocalNetwork,
    LocalNetworkOptions,
    Masks,
)
from megloc_kapture.nets.kornia_networks import (
    load_disk,
    load_xfeat,
    require_kornia,
    xfeat_descriptors,
)
from megloc_kapture.nets.runtime import image_tensor, inference
from megloc_kapture.values import LocalFeatures

_XFEAT_STRIDE_PX = 32  # XFeat rounds image sides down to multiples of 32 pixels
_ALL = 1 << 30  # detect all keypoints, since the mask is applied before the best are selected


def _level(
    xy: torch.Tensor, scores: torch.Tensor, descriptors: torch.Tensor, offset_px: Any = 0.5
) -> Level:
    values = scores.float().cpu().numpy()
    # in kornia, the first pixel's centre is (0, 0)
    table = np.column_stack([xy.cpu().numpy() + offset_px, values]).astype(np.float32)
    return table, values, descriptors.float()


class XFeatOptions(LocalNetworkOptions):
    weights: str = Field(default="xfeat", description="name in the registry, or a file")
    descriptor_weights: str | None = Field(
        default=None, description="file of another XFeat network that computes the descriptors"
    )
    threshold: float = Field(
        default=0.05, ge=0, lt=1, description="smallest probability of a keypoint"
    )


class XFeat(LocalNetwork[XFeatOptions]):
    """The extractor ``xfeat``: keypoints (N, 3) = x, y, score; descriptors float32 (N, 64).

    Other descriptor weights define another feature type, named after their file.
    """

    name = "xfeat"
    Options = XFeatOptions

    def __init__(self, options: XFeatOptions | None = None) -> None:
        require_kornia(self.name)
        super().__init__(options)
        if self._descriptor_weights is not None:
            self.name = f"xfeat-{self._descriptor_weights.path.stem}"

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        make = partial(self.network, load_xfeat, channels_last=True)
        network, device = make()
        tensors = [image_tensor(image, device) for image in images]
        with inference(device, self.options.half_precision):
            detections = network.detectAndCompute(torch.cat(tensors), _ALL, self.options.threshold)
            if self._descriptor_weights is not None:
                other, _ = make(file=self._descriptor_weights)
                for detection, tensor in zip(detections, tensors, strict=True):
                    detection["descriptors"] = xfeat_descriptors(
                        other, tensor, detection["keypoints"]
                    )
        offset_px = xfeat_offset_px(images[0].shape)
        levels = [
            _level(found["keypoints"], found["scores"], found["descriptors"], offset_px)
            for found in detections
        ]
        return self._best_of_levels([[level] for level in levels], masks)


def xfeat_offset_px(shape: Sequence[int]) -> NDArray[np.float32]:
    """Return the offset (x, y) from kornia's pixel coordinates to COLMAP's, in image pixels.

    It is half a pixel of the image as resized by kornia for XFeat.
    """
    sides = np.array([shape[1], shape[0]], np.float32)
    resized = np.maximum(sides // _XFEAT_STRIDE_PX, 1) * _XFEAT_STRIDE_PX
    return np.asarray(0.5 * sides / resized, np.float32)


class DiskOptions(LocalNetworkOptions):
    weights: str = Field(default="disk", description="name in the registry, or a file")


class Disk(LocalNetwork[DiskOptions]):
    """The extractor ``disk``: keypoints (N, 3) = x, y, score; descriptors float32 (N, 128)."""

    name = "disk"
    Options = DiskOptions

    def __init__(self, options: DiskOptions | None = None) -> None:
        require_kornia(self.name)
        super().__init__(options)

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        network, device = self.network(load_disk)
        batch = torch.cat([image_tensor(image, device) for image in images])
        with inference(device, self.options.half_precision):
            detections = network(batch, pad_if_not_divisible=True)
        levels = [
            _level(found.keypoints, found.detection_scores, found.descriptors)
            for found in detections
        ]
        return self._best_of_levels([[level] for level in levels], masks)
