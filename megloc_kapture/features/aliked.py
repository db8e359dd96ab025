"""ALIKED local features (Zhao et al., IEEE TIM 2023), with the official checkpoints."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.image_bound import BoundedOptions
from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.nets.aliked import AlikedNet, aliked_from
from megloc_kapture.nets.runtime import NetworkOptions, image_tensor, inference, pick_device
from megloc_kapture.nets.sampling import read_bilinear
from megloc_kapture.nets.score_maps import (
    select_keypoints,
    select_pixels,
    soft_argmax,
    suppress_non_maxima,
)
from megloc_kapture.values import LocalFeatures

_TEMPERATURE = 0.1  # of the sub-pixel position, the one the network was trained with


class AlikedOptions(NetworkOptions, BoundedOptions):
    """Options of ALIKED."""

    weights: str = Field(
        default="aliked-n16",
        description="aliked-t16 (64-d), aliked-n16, aliked-n16rot, aliked-n32, or a file",
    )
    nms_radius: int = Field(default=2, gt=0, description="pixels")
    threshold: float = Field(default=0.2, ge=0, lt=1, description="scores kept are larger")
    max_keypoints: int = Field(default=1500, gt=0, description="best scores kept")


class Aliked:
    """ALIKED keypoints (x, y, score) with descriptors of unit length, float32 (N, 64 or 128)."""

    name = "aliked"
    descriptor_dtype = "float32"
    metric = "L2"
    Options = AlikedOptions

    def __init__(self, options: AlikedOptions | None = None) -> None:
        self.options = options or AlikedOptions()
        self._weights = find_weights(self.options.weights)
        # the type's name carries the model: descriptors of different ones do not match
        self.name = Path(self._weights.name).stem

    @property
    def descriptor_size(self) -> int:
        """64 or 128, of the checkpoint."""
        return _network(self._weights, pick_device(self.options.device)).descriptor_size

    def weights(self) -> dict[str, str]:
        """sha256 of the checkpoint by its file's name."""
        return {self._weights.path.name: sha256_of(self._weights)}

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image.

        Parameters
        ----------
        image : uint8 (H, W, 3), RGB.
        mask : bool (H, W) or None; keypoints on False pixels are dropped before the best are
            selected.
        """
        options = self.options
        device = pick_device(options.device)
        net = _network(self._weights, device)
        with inference(device, options.half_precision):
            maps = net(image_tensor(image, device))
        with inference(device):
            scores = maps.scores
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
            rows, num_masked = select_keypoints(
                xy_px,
                score,
                size=(height, width),
                mask=mask,
                max_keypoints=options.max_keypoints,
            )
            descriptors = net.desc_head(maps, xy[torch.from_numpy(rows).to(device)])
        return LocalFeatures(
            np.column_stack([xy_px[rows], score[rows]]),
            score[rows],
            descriptors.cpu().numpy(),
            num_masked,
        )


@lru_cache(maxsize=2)
def _network(weights: WeightsFile, device: torch.device) -> AlikedNet:
    return aliked_from(read_weights(weights), str(weights.path)).to(device)
