"""R2D2 local features (Revaud et al., NeurIPS 2019), the kind that kapture's own tools make."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch.nn import functional

from megloc_kapture.features.image_bound import BoundedOptions
from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.nets.r2d2 import (
    DESCRIPTOR_SIZE,
    R2D2Maps,
    R2D2Network,
    load_r2d2,
    pyramid_levels,
)
from megloc_kapture.nets.runtime import NetworkOptions, image_tensor, inference, pick_device
from megloc_kapture.nets.score_maps import select_keypoints, window_maximum
from megloc_kapture.values import LocalFeatures

_DEFAULT_WEIGHTS = "r2d2_WASF_N16"
_PATCH_PX = 32.0  # the scale of a keypoint found at the image's own size, as the authors write it


class R2D2Options(NetworkOptions, BoundedOptions):
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


class R2D2:
    """The extractor ``r2d2``: keypoints (N, 3) = x, y, scale; descriptors float32 (N, 128).

    Other weights than the default make another type of features, named after their file.
    """

    name = "r2d2"
    descriptor_size = DESCRIPTOR_SIZE
    descriptor_dtype = "float32"
    metric = "L2"
    Options = R2D2Options

    def __init__(self, options: R2D2Options | None = None) -> None:
        self.options = options or R2D2Options()
        self._file = find_weights(self.options.weights)
        if self.options.weights != _DEFAULT_WEIGHTS:
            self.name = f"r2d2_{Path(self.options.weights).stem.removeprefix('r2d2_')}"

    def weights(self) -> dict[str, str]:
        """sha256 of the checkpoint by its file name."""
        return {self._file.path.name: sha256_of(self._file)}

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image, uint8 (H, W, 3); none on False pixels of the mask (H, W).

        Keypoints of all levels of a pyramid; a score is reliability times repeatability.

        Raises
        ------
        DataError : the checkpoint does not fit.
        OptionError : the device is not there.
        """
        options = self.options
        device = pick_device(options.device)
        network = _network(self._file, device)
        height, width = image.shape[:2]
        keypoints, scores, descriptors = [], [], []
        with inference(device, options.half_precision):
            levels = pyramid_levels(
                image_tensor(image, device), min_size=options.min_size, max_size=options.max_size
            )
            for level in levels:
                maps = network(level.contiguous(memory_format=torch.channels_last))
                yx = _maxima(maps, options)
                at = 0, slice(None), yx[:, 0], yx[:, 1]
                descriptors.append(functional.normalize(maps.features[at].float(), dim=0).T)
                found = maps.reliability[at] * maps.repeatability[at]
                scores.append(found[0].cpu().numpy())
                keypoints.append(_in_image_pixels(yx.cpu().numpy(), level.shape[-2:], image))
        xys, score = np.concatenate(keypoints), np.concatenate(scores)
        rows, num_masked = select_keypoints(
            xys[:, :2],
            score,
            size=(height, width),
            mask=mask,
            max_keypoints=options.max_keypoints,
        )
        chosen = torch.cat(descriptors)[torch.from_numpy(rows).to(device)]
        return LocalFeatures(xys[rows], score[rows], chosen.cpu().numpy(), num_masked)


@lru_cache(maxsize=2)
def _network(file: WeightsFile, device: torch.device) -> R2D2Network:
    network = load_r2d2(read_weights(file), str(file.path))
    # twice as fast on a processor as with channels first
    return network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]


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
