"""ASLFeat local features (Luo et al., CVPR 2020), with the official checkpoint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch.nn import functional

from megloc_kapture.features.image_bound import BoundedOptions
from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.nets.aslfeat import (
    DESCRIPTOR_SIZE,
    STRIDE,
    AslFeatNet,
    aslfeat_from,
    on_no_edge,
)
from megloc_kapture.nets.runtime import NetworkOptions, inference, pick_device
from megloc_kapture.nets.sampling import pixel_table, read_bilinear
from megloc_kapture.nets.score_maps import (
    parabola_peak,
    select_keypoints,
    select_pixels,
    suppress_non_maxima,
)
from megloc_kapture.values import LocalFeatures

_BORDER_PX = 5
# the image pyramid of the authors
_SCALE_STEP = math.sqrt(0.5)
_SMALLEST_SCALE = 0.3
_SMALLEST_SIDE_PX = 128
_BLUR_PX = 0.8  # of the smaller image, before each step


class AslFeatOptions(NetworkOptions, BoundedOptions):
    """Options of ASLFeat."""

    weights: str = Field(default="aslfeat", description="name in the registry, or a file")
    max_keypoints: int = Field(default=1500, gt=0, description="best scores kept")
    threshold: float = Field(default=0.5, ge=0, description="scores kept are larger")
    nms_radius: int = Field(default=1, ge=0, description="pixels")
    max_edge_ratio: float = Field(
        default=10.0, ge=1, description="of the score map's principal curvatures at a keypoint"
    )
    multi_scale: bool = Field(
        default=False, description="also at 1/sqrt(2) and 1/2 of the size, for changes of scale"
    )


@dataclass(frozen=True, eq=False)
class _Found:
    """Keypoints of one scale, in the whole image's pixels, and their descriptors."""

    xy_px: NDArray[np.float32]
    scores: NDArray[np.float32]
    descriptors: torch.Tensor


class AslFeat:
    """ASLFeat keypoints (x, y, score) with descriptors of unit length, float32 (N, 128)."""

    name = "aslfeat"
    descriptor_size = DESCRIPTOR_SIZE
    descriptor_dtype = "float32"
    metric = "L2"
    Options = AslFeatOptions

    def __init__(self, options: AslFeatOptions | None = None) -> None:
        self.options = options or AslFeatOptions()
        self._weights = find_weights(self.options.weights)

    def weights(self) -> dict[str, str]:
        """sha256 of the checkpoint by its file's name."""
        return {self._weights.path.name: sha256_of(self._weights)}

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image.

        Parameters
        ----------
        image : uint8 (H, W, 3), RGB.
        mask : bool (H, W) or None; keypoints on False pixels are dropped before the best are
            selected.
        """
        options = self.options
        size = image.shape[0], image.shape[1]
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        levels = _scales(gray) if options.multi_scale else [gray]
        # without contrast the network would see nothing but the zeros around the image
        usable = [] if gray.min() == gray.max() else levels
        found = [
            self._extract_one(level, size) for level in usable if min(level.shape) > 2 * _BORDER_PX
        ] or [_nothing()]
        xy_px = np.concatenate([level.xy_px for level in found])
        scores = np.concatenate([level.scores for level in found])
        rows, num_masked = select_keypoints(
            xy_px, scores, size=size, mask=mask, max_keypoints=options.max_keypoints
        )
        descriptors = torch.cat([level.descriptors for level in found]).cpu().numpy()
        return LocalFeatures(
            np.column_stack([xy_px[rows], scores[rows]]),
            scores[rows],
            descriptors[rows],
            num_masked,
        )

    def _extract_one(self, gray: NDArray[np.float32], full_size: tuple[int, int]) -> _Found:
        options = self.options
        device = pick_device(options.device)
        net = _network(self._weights, device)
        with inference(device, options.half_precision):
            maps = net(torch.from_numpy(gray).to(device)[None, None])
        with inference(device):
            candidates = select_pixels(
                suppress_non_maxima(maps.scores, options.nms_radius, rounds=0),
                threshold=options.threshold,
                border=_BORDER_PX,
            )
            kept = on_no_edge(maps.scores, candidates.xy, options.max_edge_ratio)
            xy = parabola_peak(maps.scores, candidates.xy[kept])
            scores = candidates.scores[kept]
            height, width = maps.features.shape[1:]
            x, y = (xy / STRIDE).unbind(1)
            # the border keeps all of them inside the features
            read = read_bilinear(pixel_table(maps.features), y, x, (height, width))
            descriptors = functional.normalize(read, dim=1)
        # the network puts the centre of the first pixel at (0, 0), COLMAP at (0.5, 0.5), where
        # the pixels of a resized image are those of the whole one times a factor
        ratio = np.array([full_size[1] / gray.shape[1], full_size[0] / gray.shape[0]])
        xy_px = ((xy.cpu().numpy() + 0.5) * ratio).astype(np.float32)
        return _Found(xy_px, scores.cpu().numpy(), descriptors)


def _scales(gray: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """The image at the scales of the authors' pyramid, each blurred and resized from the last."""
    smallest = max(_SMALLEST_SCALE, _SMALLEST_SIDE_PX / max(gray.shape))
    number = math.floor(max(math.log(smallest) / math.log(_SCALE_STEP), 1))
    levels = [gray]
    for _ in range(number - 1):
        blurred = cv2.GaussianBlur(levels[-1], (0, 0), _BLUR_PX / _SCALE_STEP)
        height, width = (round(side * _SCALE_STEP) for side in blurred.shape)
        # by size: by a factor OpenCV would sample at the factor, not at the ratio of the sizes
        resized = cv2.resize(blurred, (width, height))
        levels.append(np.asarray(resized, dtype=np.float32))
    return levels


def _nothing() -> _Found:
    return _Found(
        np.zeros((0, 2), np.float32), np.zeros(0, np.float32), torch.zeros(0, DESCRIPTOR_SIZE)
    )


@lru_cache(maxsize=2)
def _network(weights: WeightsFile, device: torch.device) -> AslFeatNet:
    return aslfeat_from(read_weights(weights), str(weights.path)).to(device)
