"""Plugin for the image distance LPIPS, by default with the published weights."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.io.weights import WeightsFile, find_all_weights, read_weights, sha256_of
from megloc_kapture.nets.lpips import SMALLEST_PX, Lpips, Trunk, lpips_from
from megloc_kapture.nets.runtime import NetworkOptions, image_tensor, inference, pick_device


class LpipsOptions(NetworkOptions):
    net: Trunk = Field(default="alex", description="alex, vgg or squeeze")
    trunk: str = Field(
        default="",
        description="file of trunk weights with torchvision's parameter names; empty: the "
        "published lpips-trunk-alex, -vgg or -squeeze",
    )
    heads: str = Field(
        default="", description="file of linear heads; empty: lpips-alex, -vgg or -squeeze"
    )


class LpipsDistance:
    """Plugin ``lpips``: LPIPS 0.1 (:class:`megloc_kapture.nets.lpips.Lpips`) over the valid pixels.

    Values with other weights are not comparable with published ones.
    """

    Options = LpipsOptions

    def __init__(self, options: LpipsOptions | None = None) -> None:
        self.options = options or LpipsOptions()
        net = self.options.net
        self._trunk, self._heads = find_all_weights(
            [self.options.trunk or f"lpips-trunk-{net}", self.options.heads or f"lpips-{net}"]
        )

    def weights(self) -> dict[str, str]:
        """Return the sha256 of trunk and heads by file name."""
        return {file.path.name: sha256_of(file) for file in (self._trunk, self._heads)}

    def distance(
        self, a: NDArray[np.uint8], b: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> float:
        """Return the distance, at least 0, of RGB images uint8 (H, W, 3) over ``valid`` (H, W).

        It is infinite without valid pixels or if the images are too small for the network.
        """
        if not valid.any() or min(valid.shape) < SMALLEST_PX:
            return float("inf")
        device = pick_device(self.options.device)
        network = _network(self.options.net, self._trunk, self._heads, device)
        with inference(device, self.options.half_precision):
            mask = torch.from_numpy(valid.astype(np.float32)).to(device)[None, None]
            first, second = (image_tensor(image, device) for image in (a, b))
            return float(network(first, second, mask)[0])


@lru_cache(maxsize=2)
def _network(kind: Trunk, trunk: WeightsFile, heads: WeightsFile, device: torch.device) -> Lpips:
    where = f"{trunk.path} and {heads.path}"
    return lpips_from(kind, read_weights(trunk), read_weights(heads), where).to(device)
