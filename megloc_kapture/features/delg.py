"""DELG global features (Cao et al., ECCV 2020), with the official checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from megloc_kapture.features.global_network import GlobalNetwork
from megloc_kapture.io.weights import WeightsFile, read_weights
from megloc_kapture.nets.delg import DelgNet, describe
from megloc_kapture.nets.delg_variables import delg_from
from megloc_kapture.nets.runtime import NetworkOptions, inference, pick_device


class DelgOptions(NetworkOptions):
    """Options of DELG; the defaults are the authors'."""

    weights: str = Field(
        default="delg-r101-gldv2clean",
        description="delg-{r50,r101}-{gld,gldv2clean}, or a file: a SavedModel's tar, or the "
        ".index in its folder variables",
    )
    max_size_px: int | None = Field(
        default=1024, ge=32, description="longer side that scale 1 is of; none: the image's own"
    )
    scales: tuple[float, ...] = Field(
        default=(0.70710677, 1.0, 1.4142135),
        min_length=1,
        description="whose vectors are summed; each is a run of the network",
    )


class Delg(GlobalNetwork):
    """DELG vectors of unit length, float32 (2048,)."""

    name = "delg"
    Options = DelgOptions

    def __init__(self, options: DelgOptions | None = None) -> None:
        self.options = options or DelgOptions()
        super().__init__("delg", self.options.weights)

    def describe_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The vectors, float32 (B, 2048), of RGB images of one size, in their order."""
        options = self.options
        device = pick_device(options.device)
        net = _network(self._weights, device)
        sized = np.stack([_with_longer_side(image, options.max_size_px) for image in images])
        batch = torch.from_numpy(sized).to(device).permute(0, 3, 1, 2).float()
        with inference(device, options.half_precision):
            return describe(net, batch, options.scales).cpu().numpy()


@lru_cache(maxsize=2)
def _network(weights: WeightsFile, device: torch.device) -> DelgNet:
    return delg_from(read_weights(weights), str(weights.path)).to(device)


def _with_longer_side(image: NDArray[np.uint8], max_size_px: int | None) -> NDArray[np.uint8]:
    """Made smaller as the authors do: Pillow's bilinear filter, which covers what it leaves out."""
    height, width = image.shape[:2]
    if max_size_px is None or max(height, width) <= max_size_px:
        return image
    scale = max_size_px / max(height, width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), np.uint8)
