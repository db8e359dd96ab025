"""ALIKED local features (Zhao et al., IEEE TIM 2023), with the official checkpoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.network import Images, LocalNetwork, LocalNetworkOptions, Masks
from megloc_kapture.nets.aliked import AlikedMaps, AlikedNet, aliked_from
from megloc_kapture.nets.runtime import image_tensor, inference
from megloc_kapture.nets.sampling import read_bilinear
from megloc_kapture.nets.score_maps import select_pixels, soft_argmax, suppress_non_maxima
from megloc_kapture.values import LocalFeatures

_TEMPERATURE = 0.1  # of the sub-pixel position, the one the network was trained with


class AlikedOptions(LocalNetworkOptions):
    """Options of ALIKED."""

    weights: str = Field(
        default="aliked-n16",
        description="aliked-t16 (64-d), aliked-n16, aliked-n16rot, aliked-n32, or a file",
    )
    nms_radius: int = Field(default=2, gt=0, description="pixels")
    threshold: float = Field(default=0.2, ge=0, lt=1, description="scores kept are larger")


class Aliked(LocalNetwork[AlikedOptions]):
    """ALIKED keypoints (x, y, score) with descriptors of unit length, float32 (N, 64 or 128)."""

    name = "aliked"
    Options = AlikedOptions

    def __init__(self, options: AlikedOptions | None = None) -> None:
        super().__init__(options)
        # the type's name carries the model: descriptors of different ones do not match
        self.name = Path(self._weights.name).stem

    @property
    def descriptor_size(self) -> int:
        """64 or 128, of the checkpoint."""
        return int(self.network(aliked_from)[0].descriptor_size)

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        net, device = self.network(aliked_from)
        with inference(device, self.options.half_precision):
            found = net(torch.cat([image_tensor(image, device) for image in images]))
        with inference(device):
            return [self._selected(net, *each) for each in zip(found, masks, strict=True)]

    def _selected(
        self, net: AlikedNet, maps: AlikedMaps, mask: NDArray[np.bool_] | None
    ) -> LocalFeatures:
        """The best keypoints of one image, and their descriptors."""
        options, scores = self.options, maps.scores
        found = select_pixels(
            suppress_non_maxima(scores, options.nms_radius),
            threshold=options.threshold,
            border=options.nms_radius,
        )
        xy = soft_argmax(scores, found.xy, options.nms_radius, _TEMPERATURE)
        height, width = scores.shape
        read = read_bilinear(scores.reshape(-1, 1), xy[:, 1], xy[:, 0], (height, width))
        # the network puts the centre of the first pixel at (0, 0), COLMAP at (0.5, 0.5)
        xy_px = xy.cpu().numpy() + np.float32(0.5)
        score = read[:, 0].cpu().numpy()
        return self._best(
            np.column_stack([xy_px, score]),
            score,
            lambda rows: net.desc_head(maps, xy[rows.to(xy.device)]),
            scores.shape,
            mask,
        )
