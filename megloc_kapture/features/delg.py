"""DELG global features (Cao et al., ECCV 2020), with the official checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
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


class Delg:
    """DELG vectors of unit length, float32 (2048,)."""

    name = "delg"
    Options = DelgOptions

    def __init__(self, options: DelgOptions | None = None) -> None:
        self.options = options or DelgOptions()
        self._weights = find_weights(self.options.weights)
        # the type's name carries the model: vectors of different ones do not compare
        self.name = Path(self._weights.name).name.split(".")[0]

    def weights(self) -> dict[str, str]:
        """sha256 of the checkpoint by its file's name."""
        return {self._weights.path.name: sha256_of(self._weights)}

    def describe(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The vector, float32 (2048,), of an RGB image, uint8 (H, W, 3).

        Raises
        ------
        DataError : the checkpoint does not fit, or the image is too small.
        OptionError : the device is not there.
        """
        return self.describe_many([image])[0]

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
