"""ESPNetv2 with its decoder for segmentation, at width 1.0."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from espnetv2_segmenter.blocks import (
    Pyramid,
    PyramidPooling,
    Smaller,
    Weighted,
    encoder_layer,
    normalised,
)

_ENCODER = (32, 64, 128, 256)
_DECODER = (64, 48, 32)
_NARROW = 10  # channels inside a pyramid pooling: half of the classes
# branches stop where their reach would pass the level's limit; the rest stay at 1
_DILATIONS, _LAST_DILATIONS = (1, 2, 3, 4), (1, 1, 2, 3)
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Encoder(nn.Module):
    """Features at a half, a quarter, an eighth and a sixteenth of the size."""

    def __init__(self) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth = _ENCODER
        self.level1 = encoder_layer(3, half, 3, stride=2)
        self.level2_0 = Smaller(half, quarter, _DILATIONS)
        self.level3_0 = Smaller(quarter, eighth, _DILATIONS)
        self.level3 = _pyramids(3, eighth, _DILATIONS)
        self.level4_0 = Smaller(eighth, sixteenth, _DILATIONS)
        self.level4 = _pyramids(7, sixteenth, _LAST_DILATIONS)

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        half = self.level1(image)
        quarter = self.level2_0(half, image)
        eighth = self.level3(self.level3_0(quarter, image))
        return [half, quarter, eighth, self.level4(self.level4_0(eighth, image))]


def _pyramids(number: int, channels: int, dilations: tuple[int, ...]) -> nn.Sequential:
    return nn.Sequential(*(Pyramid(channels, channels, dilations, stride=1) for _ in range(number)))


class EspNetV2Network(nn.Module):
    """Image to a logit per class at half of its size; sides must be multiples of 16."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.base_net = Encoder()
        wide, middle, slim = _DECODER
        self.bu_dec_l1 = PyramidPooling(_ENCODER[3], _NARROW, wide, last=False)
        self.bu_dec_l2 = PyramidPooling(wide, _NARROW, middle, last=False)
        self.bu_dec_l3 = PyramidPooling(middle, _NARROW, slim, last=False)
        self.bu_dec_l4 = PyramidPooling(slim, _NARROW, num_classes, last=True)
        self.merge_enc_dec_l2 = Weighted(_ENCODER[2], wide)
        self.merge_enc_dec_l3 = Weighted(_ENCODER[1], middle)
        self.merge_enc_dec_l4 = Weighted(_ENCODER[0], slim)
        self.bu_br_l2 = normalised(wide)
        self.bu_br_l3 = normalised(middle)
        self.bu_br_l4 = normalised(slim)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Logits (B, classes, H / 2, W / 2) of an RGB image (B, 3, H, W) in [0, 1]."""
        mean = image.new_tensor(_MEAN)[:, None, None]
        image = (image - mean) / image.new_tensor(_DEVIATION)[:, None, None]
        half, quarter, eighth, sixteenth = self.base_net(image)
        x = self.bu_dec_l1(sixteenth)
        x = self.bu_dec_l2(self.bu_br_l2(self.merge_enc_dec_l2(eighth) + _doubled(x)))
        x = self.bu_dec_l3(self.bu_br_l3(self.merge_enc_dec_l3(quarter) + _doubled(x)))
        return self.bu_dec_l4(self.bu_br_l4(self.merge_enc_dec_l4(half) + _doubled(x)))


def _doubled(x: torch.Tensor) -> torch.Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
