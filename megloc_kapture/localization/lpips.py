"""Image distance LPIPS, with the published weights."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.nets.lpips import SMALLEST_PX, Lpips, Trunk, lpips_from
from megloc_kapture.nets.runtime import NetworkOptions, image_tensor, inference, pick_device


class LpipsOptions(NetworkOptions):
    """Options of LPIPS."""

    net: Trunk = Field(default="alex", description="alex, vgg or squeeze")
    trunk: str = Field(
        default="",
        description="a file with the network's weights under torchvision's names; empty: the "
        "published lpips-trunk-alex, -vgg or -squeeze",
    )
    heads: str = Field(
        default="", description="a file of linear heads; empty: lpips-alex, -vgg or -squeeze"
    )


class LpipsDistance:
    """Plugin ``lpips``: LPIPS 0.1 over the valid pixels.

    The formula is that of :class:`megloc_kapture.nets.lpips.Lpips`. Weights other than the
    published ones make it ``lpips-like``: its values compare with each other, not with published
    ones.
    """

    Options = LpipsOptions

    def __init__(self, options: LpipsOptions | None = None) -> None:
        self.options = options or LpipsOptions()
        net = self.options.net
        self._trunk = find_weights(self.options.trunk or f"lpips-trunk-{net}")
        self._heads = find_weights(self.options.heads or f"lpips-{net}")
        own = self.options.trunk or self.options.heads
        self.name = f"lpips-like-{net}" if own else f"lpips-{net}"

    def weights(self) -> dict[str, str]:
        """sha256 of trunk and heads by their files' names."""
        return {file.path.name: sha256_of(file) for file in (self._trunk, self._heads)}

    def distance(
        self, a: NDArray[np.uint8], b: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> float:
        """Distance of two RGB images uint8 (H, W, 3) over the valid pixels (H, W), 0 or more.

        Infinite where no pixel is valid, or the images are too small for the network.
        """
        if not valid.any() or min(valid.shape) < SMALLEST_PX:
            return float("inf")
        device = pick_device(self.options.device)
        net = _network(self.options.net, self._trunk, self._heads, device)
        counts = torch.from_numpy(np.ascontiguousarray(valid)).to(device)[None, None].float()
        with inference(device, self.options.half_precision):
            found = net(image_tensor(a, device), image_tensor(b, device), counts)
        return float(found[0])


@lru_cache(maxsize=2)
def _network(net: Trunk, trunk: WeightsFile, heads: WeightsFile, device: torch.device) -> Lpips:
    where = f"{trunk.path} and {heads.path}"
    return lpips_from(net, read_weights(trunk), read_weights(heads), where).to(device)
