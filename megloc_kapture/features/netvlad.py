"""NetVLAD global features (Arandjelovic et al., CVPR 2016), with its authors' weights."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.features.global_network import GlobalNetwork
from megloc_kapture.features.image_size import sized_tensor
from megloc_kapture.io.weights import WeightsFile, read_weights
from megloc_kapture.nets.netvlad import STRIDE_PX, VggNetVlad, netvlad
from megloc_kapture.nets.runtime import NetworkOptions, inference, pick_device


class NetVladOptions(NetworkOptions):
    """Options of NetVLAD."""

    weights: str = Field(
        default="netvlad-pitts30k", description="netvlad-pitts30k, netvlad-tokyotm, or a file"
    )
    max_size_px: int = Field(
        default=1024, ge=STRIDE_PX, description="longer side; smaller images stay as they are"
    )


class NetVlad(GlobalNetwork):
    """NetVLAD on VGG-16 with its whitening: one vector of unit length, float32 (4096,)."""

    name = "netvlad"
    Options = NetVladOptions

    def __init__(self, options: NetVladOptions | None = None) -> None:
        self.options = options or NetVladOptions()
        super().__init__("netvlad", self.options.weights)

    def describe_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The vectors (B, 4096) of RGB images of one size, each as :meth:`describe` has it."""
        device = pick_device(self.options.device)
        planes = [sized_tensor(image, self.options.max_size_px, device) for image in images]
        network = _network(self._weights, device)
        return netvlad_vectors(network, planes, self.options.half_precision)


def netvlad_vectors(
    network: VggNetVlad,
    images: Sequence[torch.Tensor],
    half_precision: bool,
) -> NDArray[np.float32]:
    """Vectors (B, D) of unit length, of RGB images (1, 3, H, W) of one size, in [0, 1].

    Only the convolutions are made in half precision; sums and whitening stay in float32.

    Raises
    ------
    DataError : the images are less than 16 pixels a side.
    """
    device, (height, width) = images[0].device, images[0].shape[-2:]
    if min(height, width) < STRIDE_PX:
        raise DataError(
            f"an image of {width}x{height} pixels as the network sees it cannot be described: "
            f"it needs {STRIDE_PX} a side"
        )
    batch = torch.cat(list(images))
    with inference(device, half_precision):
        features = network.features(batch).float()
        # colours of 0 to 255 can take this trunk beyond what float16 holds
        overflow = half_precision and not bool(features.isfinite().all())
    with inference(device):
        if overflow:
            features = network.features(batch)
        return network.vectors(features).cpu().numpy()


@lru_cache(maxsize=2)
def _network(weights: WeightsFile, device: torch.device) -> VggNetVlad:
    return netvlad(read_weights(weights), str(weights.path)).to(device)
