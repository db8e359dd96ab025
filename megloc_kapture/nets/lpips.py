"""LPIPS 0.1, a learned perceptual image distance over valid pixels (Zhang et al., CVPR 2018)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import torch
from torch import nn
from torch.nn import functional as F

from megloc_kapture.nets.runtime import in_fast_layout, load_strictly
from megloc_kapture.nets.trunks import vgg16_features

Trunk = Literal["alex", "vgg", "squeeze"]


def alexnet_features() -> nn.Sequential:
    """Build AlexNet (Krizhevsky, arXiv 1404.5997) up to layer 11 of torchvision's ``features``."""
    layers = [
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, stride=2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, stride=2)),
    ]
    for channels, out in ((192, 384), (384, 256), (256, 256)):
        layers += [nn.Conv2d(channels, out, 3, padding=1), nn.ReLU()]
    return nn.Sequential(*layers)


class Fire(nn.Module):
    """Fire module: a 1x1 convolution to few channels, then parallel 1x1 and 3x3 convolutions."""

    def __init__(self, channels: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = F.relu(self.squeeze(x))
        return F.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1))


def squeezenet_features() -> nn.Sequential:
    """Build SqueezeNet 1.1 (Iandola et al., arXiv 1602.07360) up to layer 12 of ``features``."""
    first = nn.Conv2d(3, 64, 3, stride=2), nn.ReLU()
    pool = nn.MaxPool2d(3, stride=2, ceil_mode=True)
    middle = Fire(64, 16, 64), Fire(128, 16, 64), pool, Fire(128, 32, 128), Fire(256, 32, 128)
    last = Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)
    return nn.Sequential(*first, pool, *middle, pool, *last)


# compared layers and their channels
_TAPS: dict[Trunk, tuple[tuple[int, int], ...]] = {
    "alex": ((1, 64), (4, 192), (7, 384), (9, 256), (11, 256)),
    "vgg": ((3, 64), (8, 128), (15, 256), (22, 512), (29, 512)),
    "squeeze": ((1, 64), (4, 128), (7, 256), (9, 384), (10, 384), (11, 512), (12, 512)),
}
_TRUNKS: dict[Trunk, Callable[[], nn.Sequential]] = {
    "alex": alexnet_features,
    "vgg": lambda: vgg16_features(last=29),
    "squeeze": squeezenet_features,
}
# input normalisation of the published module, for RGB in [-1, 1]
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_MIN_LENGTH = 1e-10
SMALLEST_PX = 64  # smallest side that leaves enough cells after AlexNet's pooling


class Lpips(nn.Module):
    """LPIPS with one of the three published trunks.

    Parameters have torchvision's names ``features.*`` and the published names
    ``lin{k}.model.1.weight``; the latter are the squares of the weights in equation 1 of the paper.
    """

    def __init__(self, trunk: Trunk) -> None:
        super().__init__()
        self.taps = tuple(number for number, _ in _TAPS[trunk])
        self.features = _TRUNKS[trunk]()
        for number, (_, channels) in enumerate(_TAPS[trunk]):
            # in the published heads, layer 0 is a dropout
            head = nn.Sequential(nn.Identity(), nn.Conv2d(channels, 1, 1, bias=False))
            self.add_module(f"lin{number}", nn.ModuleDict({"model": head}))

    def forward(self, a: torch.Tensor, b: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        """Return the distances (B,) of image pairs; NaN for pairs without valid pixels.

        ``a`` and ``b`` (B, 3, H, W) are RGB in [0, 1], with sides of at least 64 pixels; ``valid``
        (B, 1, H, W) is 1 where both images are valid, else 0. Each feature is weighted by the share
        of valid pixels in its cell.
        """
        return self.between(self.described(a, valid), self.described(b, valid), valid)

    def described(self, image: torch.Tensor, valid: torch.Tensor) -> list[torch.Tensor]:
        """Return each layer's unit-norm features (B, C, h, w); see :meth:`forward`."""
        # on a CPU, channels last is faster, with the same features
        x = in_fast_layout(self._normalised(image) * valid)
        normalised = []
        for number, layer in enumerate(self.features):
            x = layer(x)
            if number in self.taps:
                features = x.to(image.dtype)
                length = (features * features).sum(dim=1, keepdim=True).sqrt()
                normalised.append(features / (length + _MIN_LENGTH))
        return normalised

    def between(
        self, first: Sequence[torch.Tensor], second: Sequence[torch.Tensor], valid: torch.Tensor
    ) -> torch.Tensor:
        """Return distances (B,) between results of :meth:`described` with the same valid pixels."""
        total = torch.zeros(len(valid), dtype=valid.dtype, device=valid.device)
        for layer, (a, b) in enumerate(zip(first, second, strict=True)):
            different = self.get_submodule(f"lin{layer}.model")((a - b) ** 2)
            weight = F.interpolate(valid, size=different.shape[-2:], mode="area")
            total = total + (different * weight).sum(dim=(1, 2, 3)) / weight.sum(dim=(1, 2, 3))
        return total

    def _normalised(self, image: torch.Tensor) -> torch.Tensor:
        shift, scale = (image.new_tensor(v)[:, None, None] for v in (_SHIFT, _SCALE))
        return (2.0 * image - 1.0 - shift) / scale


def lpips_from(
    trunk: Trunk,
    of_trunk: Mapping[str, torch.Tensor],
    of_heads: Mapping[str, torch.Tensor],
    where: str,
) -> Lpips:
    module = Lpips(trunk)
    features = {key: value for key, value in of_trunk.items() if not key.startswith("classifier.")}
    return load_strictly(module, {**features, **of_heads}, where).eval()
