"""OpenIBL global features (Ge et al., ECCV 2020, "SFRS"), with its authors' weights."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from megloc_kapture.features.global_network import GlobalNetwork
from megloc_kapture.features.image_size import sized_tensor
from megloc_kapture.features.netvlad import netvlad_vectors
from megloc_kapture.io.weights import WeightsFile, read_weights
from megloc_kapture.nets.netvlad import STRIDE_PX, VggNetVlad, openibl
from megloc_kapture.nets.runtime import NetworkOptions, image_tensor, pick_device

_OFFICIAL_WIDTH_PX, _OFFICIAL_HEIGHT_PX = 640, 480


class OpenIblOptions(NetworkOptions):
    """Options of OpenIBL."""

    weights: str = Field(default="openibl", description="openibl, or a file")
    max_size_px: int | None = Field(
        default=None,
        ge=STRIDE_PX,
        description="longer side, ratio kept, smaller images as they are; None: all images are "
        "made 640 x 480 whatever their ratio, as in training",
    )


class OpenIbl(GlobalNetwork):
    """OpenIBL's VGG-16 with NetVLAD and PCA: one vector of unit length, float32 (4096,)."""

    name = "openibl"
    Options = OpenIblOptions

    def __init__(self, options: OpenIblOptions | None = None) -> None:
        self.options = options or OpenIblOptions()
        super().__init__("openibl", self.options.weights)

    def describe_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The vectors (B, 4096) of RGB images of one size, each as :meth:`describe` has it."""
        device = pick_device(self.options.device)
        planes = [self._seen(image, device) for image in images]
        network = _network(self._weights, device)
        return netvlad_vectors(network, planes, self.options.half_precision)

    def _seen(self, image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
        if self.options.max_size_px is None:
            return image_tensor(official_size(image), device)
        return sized_tensor(image, self.options.max_size_px, device)


def official_size(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image, uint8 (480, 640, 3), as the authors resize it.

    Bilinear over all pixels that a smaller one covers, rounded to 8 bits.
    """
    size = (_OFFICIAL_WIDTH_PX, _OFFICIAL_HEIGHT_PX)
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR))


@lru_cache(maxsize=2)
def _network(weights: WeightsFile, device: torch.device) -> VggNetVlad:
    return openibl(read_weights(weights), str(weights.path)).to(device)
