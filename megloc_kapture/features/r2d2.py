"""R2D2 local features (Revaud et al., NeurIPS 2019), the kind that kapture's own tools make."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch.nn import functional

from megloc_kapture.features.network import Images, Level, LocalNetwork, LocalNetworkOptions, Masks
from megloc_kapture.nets.r2d2 import DESCRIPTOR_SIZE, R2D2Maps, load_r2d2, pyramid_levels
from megloc_kapture.nets.runtime import image_tensor, inference
from megloc_kapture.nets.score_maps import window_maximum
from megloc_kapture.values import LocalFeatures

_DEFAULT_WEIGHTS = "r2d2_WASF_N16"
_PATCH_PX = 32.0  # the scale of a keypoint found at the image's own size, as the authors write it


class R2D2Options(LocalNetworkOptions):
    """Options of R2D2; the authors' but for the number of keypoints."""

    weights: str = Field(default=_DEFAULT_WEIGHTS, description="name in the registry, or a file")
    max_keypoints: int = Field(default=1500, gt=0, description="best kept; the authors keep 5000")
    min_size: int = Field(default=256, gt=0, description="longer side of the smallest level, px")
    max_size: int = Field(default=1024, gt=0, description="longer side of the largest level, px")
    min_reliability: float = Field(default=0.7, ge=0, le=1)
    min_repeatability: float = Field(default=0.7, ge=0, le=1)

    @model_validator(mode="after")
    def _levels_exist(self) -> R2D2Options:
        # the levels are 2^(1/4) apart: a range that wide has at least one
        if self.max_size < 1.2 * self.min_size:
            raise ValueError("max_size is at least 1.2 times min_size")
        return self


class R2D2(LocalNetwork[R2D2Options]):
    """The extractor ``r2d2``: keypoints (N, 3) = x, y, scale; descriptors float32 (N, 128).

    Keypoints of all levels of a pyramid; a score is reliability times repeatability. Other weights
    than the default make another type of features, named after their file.
    """

    name = "r2d2"
    descriptor_size = DESCRIPTOR_SIZE
    Options = R2D2Options

    def __init__(self, options: R2D2Options | None = None) -> None:
        super().__init__(options)
        if self.options.weights != _DEFAULT_WEIGHTS:
            self.name = f"r2d2_{Path(self.options.weights).stem.removeprefix('r2d2_')}"

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        options = self.options
        # twice as fast on a processor as with channels first
        network, device = self.network(load_r2d2, channels_last=True)
        found: list[list[Level]] = [[] for _ in images]
        with inference(device, options.half_precision):
            levels = pyramid_levels(
                torch.cat([image_tensor(image, device) for image in images]),
                min_size=options.min_size,
                max_size=options.max_size,
            )
            for level in levels:
                maps = network(level.contiguous(memory_format=torch.channels_last))
                for k, image in enumerate(images):
                    own = R2D2Maps(*(values[k : k + 1] for values in maps))
                    yx = _maxima(own, options)
                    at = 0, slice(None), yx[:, 0], yx[:, 1]
                    scores = own.reliability[at] * own.repeatability[at]
                    xys = _in_image_pixels(yx.cpu().numpy(), level.shape[-2:], image)
                    descriptors = functional.normalize(own.features[at].float(), dim=0).T
                    found[k].append((xys, scores[0].cpu().numpy(), descriptors))
        return [
            self._best_of_levels(levels, image.shape, mask)
            for levels, image, mask in zip(found, images, masks, strict=True)
        ]


def _maxima(maps: R2D2Maps, options: R2D2Options) -> torch.Tensor:
    """Rows and columns (N, 2) of the keypoints of one level (section 3.3 of the paper)."""
    repeatability, reliability = maps.repeatability[0, 0], maps.reliability[0, 0]
    return torch.nonzero(
        (repeatability == window_maximum(repeatability, 1))
        & (repeatability >= options.min_repeatability)
        & (reliability >= options.min_reliability)
    )


def _in_image_pixels(
    yx: NDArray[np.int64], size: torch.Size, image: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """x, y, scale (N, 3) in the image's pixels, the first one's centre at (0.5, 0.5)."""
    ratio = np.array([image.shape[1] / size[1], image.shape[0] / size[0]])
    scale = _PATCH_PX * max(image.shape[:2]) / max(size)
    xy = (yx[:, ::-1] + 0.5) * ratio
    return np.column_stack([xy, np.full(len(xy), scale)]).astype(np.float32)
