"""XFeat local features (Potje et al., CVPR 2024), the sparse variant."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch.nn import functional

from megloc_kapture.features.network import Images, LocalNetwork, LocalNetworkOptions, Masks
from megloc_kapture.nets.runtime import image_tensor, inference
from megloc_kapture.nets.score_maps import suppress_non_maxima
from megloc_kapture.nets.xfeat import (
    DESCRIPTOR_SIZE,
    STRIDE,
    descriptors_at,
    keypoint_scores,
    load_xfeat,
    sample_at_pixels,
)
from megloc_kapture.values import LocalFeatures


class XFeatOptions(LocalNetworkOptions):
    """Options of XFeat."""

    weights: str = Field(default="xfeat", description="name in the registry, or a file")
    descriptor_weights: str | None = Field(
        default=None, description="file of another XFeat network, whose descriptors are taken"
    )
    max_keypoints: int = Field(default=1500, gt=0, description="best kept; the authors keep 4096")
    threshold: float = Field(default=0.05, ge=0, lt=1, description="probability of a keypoint")
    nms_radius_px: int = Field(default=2, ge=0, description="2: a window of 5 by 5 pixels")


class XFeat(LocalNetwork[XFeatOptions]):
    """The extractor ``xfeat``: keypoints (N, 3) = x, y, score; descriptors float32 (N, 64).

    The network sees images resized to multiples of 32, downwards; a score is the probability of a
    keypoint times the reliability. With other descriptors than its own it is another type of
    features, named after their file.
    """

    name = "xfeat"
    descriptor_size = DESCRIPTOR_SIZE
    Options = XFeatOptions

    def __init__(self, options: XFeatOptions | None = None) -> None:
        super().__init__(options)
        if self._descriptor_weights is not None:
            # descriptors of different networks do not match
            self.name = f"xfeat-{self._descriptor_weights.path.stem}"

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        options = self.options
        # a third faster on a processor than with channels first
        make = partial(self.network, load_xfeat, channels_last=True)
        network, device = make()
        with inference(device, options.half_precision):
            resized = torch.cat([network_image(image, device) for image in images])
            features, logits, reliability = network(resized)
            peaks = keypoint_scores(logits)
            peaks = suppress_non_maxima(peaks, options.nms_radius_px, rounds=0)[:, 0]
            if self._descriptor_weights is not None:
                features = make(file=self._descriptor_weights)[0](resized)[0]
            size = resized.shape[-2], resized.shape[-1]
            maps = zip(peaks, reliability[:, None], features[:, None], images, masks, strict=True)
            return [self._selected(*own, size) for own in maps]

    def _selected(
        self,
        peaks: torch.Tensor,
        reliability: torch.Tensor,
        features: torch.Tensor,
        image: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        size: tuple[int, int],
    ) -> LocalFeatures:
        """The best keypoints of one image, whose maps are those of an image of this size."""
        yx = torch.nonzero(peaks > self.options.threshold)
        pixels = yx.flip(1)
        reliable = sample_at_pixels(reliability, pixels, size, mode="bilinear")[:, 0]
        scores = (peaks[yx[:, 0], yx[:, 1]] * reliable).cpu().numpy()
        # from here on in the image's own pixels, the first one's centre at (0.5, 0.5)
        ratio = np.array([image.shape[1] / size[1], image.shape[0] / size[0]])
        xy_px = ((pixels.cpu().numpy() + 0.5) * ratio).astype(np.float32)
        return self._best(
            np.column_stack([xy_px, scores]),
            scores,
            lambda rows: descriptors_at(features, pixels[rows.to(pixels.device)], size),
            image.shape,
            mask,
        )


def network_image(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """An RGB image as the network takes it, (1, 3, h, w): sides floored to multiples of 32."""
    tensor = image_tensor(image, device)
    size = [max(STRIDE, side // STRIDE * STRIDE) for side in tensor.shape[-2:]]
    if size == list(tensor.shape[-2:]):
        return tensor
    return functional.interpolate(tensor, size, mode="bilinear", align_corners=False)
