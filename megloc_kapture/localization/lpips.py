"""Image distance LPIPS, with the published weights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.io.weights import WeightsFile, find_all_weights, read_weights, sha256_of
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

    Features of the last few first images are kept with their valid pixels: who compares a query
    with one view after another over the same pixels pays once for the query.
    """

    name = "lpips"
    Options = LpipsOptions

    def __init__(self, options: LpipsOptions | None = None) -> None:
        self.options = options or LpipsOptions()
        net = self.options.net
        self._trunk, self._heads = find_all_weights(
            [self.options.trunk or f"lpips-trunk-{net}", self.options.heads or f"lpips-{net}"]
        )
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
        options = self.options
        net = _Network(
            options.net,
            self._trunk,
            self._heads,
            pick_device(options.device),
            options.half_precision,
        )
        pixels = valid.tobytes()
        kept = _features_kept(net, a.shape, a.tobytes(), pixels)
        with inference(net.device, net.half_precision):
            counts = _counts(net, a.shape, pixels)
            features = net.module().described(image_tensor(b, net.device), counts)
            return float(net.module().between(kept, features, counts)[0])


@dataclass(frozen=True)
class _Network:
    """A network, and how it runs; hashable."""

    kind: Trunk
    trunk: WeightsFile
    heads: WeightsFile
    device: torch.device
    half_precision: bool

    def module(self) -> Lpips:
        return _module(self.kind, self.trunk, self.heads, self.device)


# one for each camera of a rig; some 10 MB each at 320 x 240, VGG-16's 40
@lru_cache(maxsize=4)
def _features_kept(
    net: _Network, shape: tuple[int, ...], image: bytes, valid: bytes
) -> list[torch.Tensor]:
    pixels = np.frombuffer(image, np.uint8).reshape(shape)
    with inference(net.device, net.half_precision):
        return net.module().described(image_tensor(pixels, net.device), _counts(net, shape, valid))


def _counts(net: _Network, shape: tuple[int, ...], valid: bytes) -> torch.Tensor:
    """Valid pixels as the network takes them, (1, 1, H, W)."""
    mask = np.frombuffer(valid, np.bool_).reshape(shape[:2]).astype(np.float32)
    return torch.from_numpy(mask).to(net.device)[None, None]


@lru_cache(maxsize=2)
def _module(kind: Trunk, trunk: WeightsFile, heads: WeightsFile, device: torch.device) -> Lpips:
    where = f"{trunk.path} and {heads.path}"
    return lpips_from(kind, read_weights(trunk), read_weights(heads), where).to(device)
