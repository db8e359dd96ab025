"""R2D2 local features (Revaud et al., NeurIPS 2019, section 3), the default of kapture's tools.

The network is an L2-Net with dilations instead of strides, so that its output maps have full
resolution, and with three 2x2 convolutions in place of the last 8x8 convolution. It has the
official parameter names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import nn
from torch.nn import functional

from megloc_kapture.features.network import (
    Images,
    Level,
    LocalNetwork,
    LocalNetworkOptions,
    Masks,
    in_image_px,
)
from megloc_kapture.nets.runtime import image_tensor, in_fast_layout, inference, load_strictly
from megloc_kapture.nets.score_maps import window_maximum
from megloc_kapture.nets.trunks import imagenet_normalised
from megloc_kapture.values import LocalFeatures

DESCRIPTOR_SIZE = 128
# kernel size, width as a multiple of the base width, dilation; ReLU after 3x3 kernels
_LAYERS = ((3, 1, 1), (3, 1, 1), (3, 2, 1), (3, 2, 2), (3, 4, 2), (3, 4, 4), (2, 4, 4), (2, 4, 8))
_STEPS_PER_OCTAVE = 4
_TOLERANCE = 0.001  # for comparing scales with their limits, as in the authors' code
_DEFAULT_WEIGHTS = "r2d2_WASF_N16"
_MIN_RELIABILITY = _MIN_REPEATABILITY = 0.7  # of keypoints, as in the authors' code
_PATCH_PX = 32.0  # scale of keypoints at full resolution, as in the authors' code


class R2D2Options(LocalNetworkOptions):
    """Options of R2D2; defaults are the authors' values except for the number of keypoints."""

    weights: str = Field(default=_DEFAULT_WEIGHTS, description="name in the registry, or a file")
    min_size: int = Field(
        default=256, gt=0, description="smallest longer side of a reduced level, pixels"
    )
    max_size: int = Field(default=1024, gt=0, description="largest longer side of a level, pixels")

    @model_validator(mode="after")
    def _levels_exist(self) -> R2D2Options:
        if self.max_size < 1.2 * self.min_size:
            raise ValueError("max_size must be at least 1.2 times min_size")
        return self


class R2D2(LocalNetwork[R2D2Options]):
    """The extractor ``r2d2``: keypoints (N, 3) = x, y, scale; descriptors float32 (N, 128).

    Keypoints come from all pyramid levels; the score is reliability times repeatability. Other
    weights define another feature type, named after their file.
    """

    name = "r2d2"
    Options = R2D2Options

    def __init__(self, options: R2D2Options | None = None) -> None:
        super().__init__(options)
        if self.options.weights != _DEFAULT_WEIGHTS:
            self.name = f"r2d2_{Path(self.options.weights).stem.removeprefix('r2d2_')}"

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        options = self.options
        # channels last is twice as fast on a CPU
        network, device = self.network(load_r2d2, channels_last=True)
        levels_of: list[list[Level]] = [[] for _ in images]
        with inference(device, options.half_precision):
            levels = pyramid_levels(
                torch.cat([image_tensor(image, device) for image in images]),
                min_size=options.min_size,
                max_size=options.max_size,
            )
            for level in levels:
                outputs = network(in_fast_layout(level))
                scale = np.float32(_PATCH_PX * max(images[0].shape[:2]) / max(level.shape[-2:]))
                for of_image, features, reliability, repeatability in zip(
                    levels_of, *outputs, strict=True
                ):
                    rows, columns = torch.nonzero(
                        (repeatability == window_maximum(repeatability, 1))
                        & (repeatability >= _MIN_REPEATABILITY)
                        & (reliability >= _MIN_RELIABILITY)
                    ).unbind(1)
                    xy = torch.stack([columns, rows], dim=1).cpu().numpy()
                    xy_px = in_image_px(xy, level.shape[-2:], images[0].shape)
                    scores = reliability[rows, columns] * repeatability[rows, columns]
                    descriptors = functional.normalize(features[:, rows, columns].float(), dim=0).T
                    table = np.column_stack([xy_px, np.full(len(xy_px), scale)])
                    of_image.append((table, scores.cpu().numpy(), descriptors))
        return self._best_of_levels(levels_of, masks)


class R2D2Network(nn.Module):
    """Dense features, reliability and repeatability; ``base_width`` is 48 in the "big" model."""

    def __init__(self, base_width: int = 32) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        inputs = 3
        for kernel, width, dilation in _LAYERS:
            outputs = width * base_width
            margin = dilation * (kernel - 1) // 2
            layers += [
                nn.Conv2d(inputs, outputs, kernel, padding=margin, dilation=dilation),
                nn.BatchNorm2d(outputs, affine=False),
            ]
            if kernel == 3:
                layers.append(nn.ReLU(inplace=True))
            inputs = outputs
        layers.append(nn.Conv2d(inputs, DESCRIPTOR_SIZE, 2, padding=8, dilation=16))
        self.ops = nn.Sequential(*layers)
        self.clf = nn.Conv2d(DESCRIPTOR_SIZE, 2, 1)
        self.sal = nn.Conv2d(DESCRIPTOR_SIZE, 1, 1)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Compute the maps of RGB images, float (B, 3, H, W) in [0, 1].

        Return unnormalised descriptors (B, 128, H, W) and two maps (B, H, W) in [0, 1]:
        reliability, the expected matching success of the descriptor, and repeatability of a local
        maximum.
        """
        features = self.ops(imagenet_normalised(images))
        squared = features**2
        reliability = self.clf(squared).float().softmax(dim=1)[:, 1]
        positive = functional.softplus(self.sal(squared).float())[:, 0]
        return features, reliability, positive / (1 + positive)


def load_r2d2(tensors: Mapping[str, torch.Tensor], where: str) -> R2D2Network:
    """Build the network for inference, with its width inferred from the checkpoint's shapes."""
    first = tensors.get("ops.0.weight")
    network = R2D2Network() if first is None else R2D2Network(base_width=len(first))
    return load_strictly(network, tensors, where).eval()


def pyramid_levels(image: torch.Tensor, *, min_size: int, max_size: int) -> Iterator[torch.Tensor]:
    """Yield an image at scales 1, 2^-1/4, 2^-1/2 and so on, each resized from the previous one.

    This is R2D2's pyramid (Revaud et al., 2019, section 4). Levels whose longer side is outside the
    limits are omitted, except that an image smaller than ``min_size`` has one level.
    """
    height, width = image.shape[-2:]
    longer = max(height, width)
    smallest = min(1.0, min_size / longer)
    level, step = image, 0
    while (scale := 2.0 ** (-step / _STEPS_PER_OCTAVE)) + _TOLERANCE >= smallest:
        size = round(height * scale), round(width * scale)
        if min(size) == 0:
            return
        if step:
            level = functional.interpolate(level, size, mode="bilinear", align_corners=False)
        if scale - _TOLERANCE <= max_size / longer:
            yield level
        step += 1
