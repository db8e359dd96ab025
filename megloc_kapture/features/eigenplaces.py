"""EigenPlaces global features (Berton et al., ICCV 2023), with the official checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.global_network import GlobalNetwork
from megloc_kapture.features.image_size import sized_tensor
from megloc_kapture.io.weights import WeightsFile, read_weights
from megloc_kapture.nets.eigenplaces import EigenPlacesNet, eigenplaces_from
from megloc_kapture.nets.runtime import NetworkOptions, inference, pick_device


class EigenPlacesOptions(NetworkOptions):
    """Options of EigenPlaces."""

    weights: str = Field(
        default="eigenplaces",
        description="eigenplaces (ResNet-50, 2048-d), or a file, also of ResNet-101, of fewer "
        "components, or CosPlace's",
    )
    max_size_px: int | None = Field(
        default=1024,
        ge=32,
        description="longer side that the network sees; none: the image's own, as the authors "
        "evaluate",
    )


class EigenPlaces(GlobalNetwork):
    """EigenPlaces' vector of an image, float32 (D,), unit length; D is 2048 or the checkpoint's."""

    name = "eigenplaces"
    Options = EigenPlacesOptions

    def __init__(self, options: EigenPlacesOptions | None = None) -> None:
        self.options = options or EigenPlacesOptions()
        super().__init__("eigenplaces", self.options.weights)

    def describe_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The vectors of images of one size, float32 (B, D); as one by one but for rounding."""
        options = self.options
        device = pick_device(options.device)
        network = _network(self._weights, device)
        batch = torch.cat([sized_tensor(image, options.max_size_px, device) for image in images])
        with inference(device, options.half_precision):
            return network(batch).cpu().numpy()


@lru_cache(maxsize=2)
def _network(weights: WeightsFile, device: torch.device) -> EigenPlacesNet:
    network = eigenplaces_from(read_weights(weights), str(weights.path))
    # faster on a processor than with channels first
    return network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
