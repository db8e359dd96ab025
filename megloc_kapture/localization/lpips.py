"""Image distance LPIPS, with the published weights."""

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
    """Plugin ``lpips``: LPIPS 0.1 (:class:`megloc_kapture.nets.lpips.Lpips`) over the valid pixels.

    Weights other than the published ones make it ``lpips-like``: its values compare with each
    other, not with published ones. Features of the last few first images are kept with their valid
    pixels: who compares a query with one view after another over the same pixels pays once for it.
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
        device, half = pick_device(options.device), options.half_precision
        made = options.net, self._trunk, self._heads, device
        pixels = valid.tobytes()
        kept = _features_kept(made, half, a.shape, a.tobytes(), pixels)
        network = _network(*made)
        with inference(device, half):
            counts = _counts(valid.shape, pixels, device)
            features = network.described(image_tensor(b, device), counts)
            return float(network.between(kept, features, counts)[0])


# one for each camera of a rig; some 10 MB each at 320 x 240, VGG-16's 40
@lru_cache(maxsize=4)
def _features_kept(
    made: tuple[Trunk, WeightsFile, WeightsFile, torch.device],
    half_precision: bool,
    shape: tuple[int, ...],
    image: bytes,
    valid: bytes,
) -> list[torch.Tensor]:
    device = made[-1]
    pixels = np.frombuffer(image, np.uint8).reshape(shape)
    with inference(device, half_precision):
        counts = _counts(shape, valid, device)
        return _network(*made).described(image_tensor(pixels, device), counts)


def _counts(shape: tuple[int, ...], valid: bytes, device: torch.device) -> torch.Tensor:
    """Valid pixels as the network takes them, (1, 1, H, W)."""
    mask = np.frombuffer(valid, np.bool_).reshape(shape[:2]).astype(np.float32)
    return torch.from_numpy(mask).to(device)[None, None]


@lru_cache(maxsize=2)
def _network(kind: Trunk, trunk: WeightsFile, heads: WeightsFile, device: torch.device) -> Lpips:
    where = f"{trunk.path} and {heads.path}"
    return lpips_from(kind, read_weights(trunk), read_weights(heads), where).to(device)
