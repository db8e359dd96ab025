"""The convolutions of VGG-16 (Simonyan and Zisserman, ICLR 2015) under torchvision's numbering."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

# widths of the 3x3 convolutions of each of the five stages; a pooling ends each stage
_STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))


class Vgg16Features(nn.Sequential):
    """VGG-16 (configuration D) up to a layer, numbered as torchvision's ``features``.

    Every convolution is 3x3 with a border of zeros and a bias, followed by a ReLU; stages end in
    a 2x2 maximum with stride 2, which drops an odd last row or column. Keys of the state dict are
    ``{i}.weight`` and ``{i}.bias``.

    Parameters
    ----------
    last : number of the last layer, 0 to 30: 28 is conv5_3 without its ReLU (512 channels, 1/16 of
        the size), 29 is that ReLU, 30 is the fifth pooling.
    """

    def __init__(self, *, last: int = 30) -> None:
        layers: list[nn.Module] = []
        channels = 3
        for widths in _STAGES:
            for width in widths:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
            layers.append(nn.MaxPool2d(2))
        if not 0 <= last < len(layers):
            raise ValueError(f"last is {last}, not of 0 to {len(layers) - 1}")
        super().__init__(*layers[: last + 1])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Activation (B, C, h, w) after the last layer, of (B, 3, H, W), which stays as it is."""
        return self.taps(x, (len(self) - 1,))[0]

    def taps(self, x: torch.Tensor, indices: Sequence[int]) -> list[torch.Tensor]:
        """Activations (B, C, h, w) after chosen layers, in the order of the indices.

        Parameters
        ----------
        x : (B, 3, H, W), normalised as the weights want it; stays as it is.
        indices : numbers of layers that this trunk has; layers after the last one are not run.

        Raises
        ------
        ValueError : an index is none of a layer's.
        """
        wrong = sorted(set(indices) - set(range(len(self))))
        if wrong or not indices:
            raise ValueError(f"layers {wrong} are not of 0 to {len(self) - 1}")
        found: dict[int, torch.Tensor] = {}
        for number, layer in enumerate(list(self)[: max(indices) + 1]):
            # the maps of a large image have 200 MB: where nobody wants the one before, a ReLU
            # needs none of its own
            if isinstance(layer, nn.ReLU) and number - 1 not in found:
                x = torch.relu_(x)
            else:
                x = layer(x)
            if number in indices:
                found[number] = x
        return [found[number] for number in indices]
