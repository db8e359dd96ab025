"""MegaLoc global features (Berton and Masone, CVPR Workshops 2025), with the official weights."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.global_network import GlobalNetwork
from megloc_kapture.io.weights import WeightsFile, read_weights
from megloc_kapture.nets.dinov2 import PATCH_PX
from megloc_kapture.nets.megaloc import MegaLocNet, megaloc_from, squared
from megloc_kapture.nets.runtime import NetworkOptions, image_tensor, inference, pick_device

_SIZE_PX = 322  # the paper's, section 4


class MegaLocOptions(NetworkOptions):
    """Options of MegaLoc."""

    weights: str = Field(default="megaloc", description="name in the registry, or a file")
    size_px: int = Field(
        default=_SIZE_PX,
        ge=9 * PATCH_PX,  # with fewer patches not every cluster gets one
        multiple_of=PATCH_PX,
        description="both sides that the network sees; the map's must be the queries'",
    )


class MegaLoc(GlobalNetwork):
    """MegaLoc's vector of an image, float32 (8448,), unit length.

    The image is scaled to a square, its shape is not kept: so the paper evaluates.
    """

    name = "megaloc"
    Options = MegaLocOptions

    def __init__(self, options: MegaLocOptions | None = None) -> None:
        self.options = options or MegaLocOptions()
        super().__init__("megaloc", self.options.weights)
        if self.options.size_px != _SIZE_PX:
            self.name += f"-{self.options.size_px}px"

    def describe_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The vectors of images, float32 (B, 8448); as those of one by one but for rounding."""
        options = self.options
        device = pick_device(options.device)
        network = _network(self._weights, device)
        with inference(device):
            batch = [squared(image_tensor(image, device), options.size_px) for image in images]
        with inference(device, options.half_precision):
            return network(torch.cat(batch)).cpu().numpy()


@lru_cache(maxsize=2)
def _network(weights: WeightsFile, device: torch.device) -> MegaLocNet:
    return megaloc_from(read_weights(weights), str(weights.path)).to(device)
