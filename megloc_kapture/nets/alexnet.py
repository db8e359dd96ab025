"""The convolutions of AlexNet (Krizhevsky, "One weird trick for parallelizing convolutional neural
networks", arXiv 1404.5997, one tower) under torchvision's numbering."""

from __future__ import annotations

from torch import nn


class AlexNetFeatures(nn.Sequential):
    """AlexNet up to the ReLU of its fifth convolution, layer 11 of torchvision's ``features``.

    Takes (B, 3, H, W), at least 63 x 63 pixels. Keys of the state dict are ``{i}.weight`` and
    ``{i}.bias`` for i of 0, 3, 6, 8, 10.
    """

    def __init__(self) -> None:
        super().__init__(
            nn.Conv2d(3, 64, 11, stride=4, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(64, 192, 5, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(192, 384, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(384, 256, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1),
            nn.ReLU(),
        )
