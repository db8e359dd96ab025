"""ASLFeat local features (Luo et al., CVPR 2020), with the official checkpoint."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch.nn import functional

from megloc_kapture.features.network import Images, Level, LocalNetwork, LocalNetworkOptions, Masks
from megloc_kapture.nets.aslfeat import (
    DESCRIPTOR_SIZE,
    STRIDE,
    AslFeatMaps,
    aslfeat_from,
    on_no_edge,
)
from megloc_kapture.nets.runtime import inference
from megloc_kapture.nets.score_maps import (
    parabola_peak,
    pixel_table,
    read_bilinear,
    select_pixels,
    suppress_non_maxima,
)
from megloc_kapture.values import LocalFeatures

_BORDER_PX = 5
_NOTHING = (np.zeros((0, 3), np.float32), np.zeros(0, np.float32), torch.zeros(0, DESCRIPTOR_SIZE))
# the image pyramid of the authors
_SCALE_STEP = math.sqrt(0.5)
_SMALLEST_SCALE = 0.3
_SMALLEST_SIDE_PX = 128
_BLUR_PX = 0.8  # of the smaller image, before each step


class AslFeatOptions(LocalNetworkOptions):
    """Options of ASLFeat."""

    weights: str = Field(default="aslfeat", description="name in the registry, or a file")
    threshold: float = Field(default=0.5, ge=0, description="scores kept are larger")
    nms_radius: int = Field(default=1, ge=0, description="pixels")
    max_edge_ratio: float = Field(
        default=10.0, ge=1, description="of the score map's principal curvatures at a keypoint"
    )
    multi_scale: bool = Field(
        default=False, description="also at 1/sqrt(2) and 1/2 of the size, for changes of scale"
    )


class AslFeat(LocalNetwork[AslFeatOptions]):
    """ASLFeat keypoints (x, y, score) with descriptors of unit length, float32 (N, 128)."""

    name = "aslfeat"
    descriptor_size = DESCRIPTOR_SIZE
    Options = AslFeatOptions

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        size = images[0].shape[0], images[0].shape[1]
        grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in images]
        # without contrast the network would see nothing but the zeros around the image
        usable = [k for k, gray in enumerate(grays) if gray.min() != gray.max()]
        of_image = [_scales(grays[k]) if self.options.multi_scale else [grays[k]] for k in usable]
        found: list[list[Level]] = [[] for _ in images]
        for levels in zip(*of_image, strict=True):
            if min(levels[0].shape) > 2 * _BORDER_PX:
                for k, own in zip(usable, self._extract_level(levels, size), strict=True):
                    found[k].append(own)
        return [
            self._best_of_levels(each or [_NOTHING], size, mask)
            for each, mask in zip(found, masks, strict=True)
        ]

    def _extract_level(
        self, grays: Sequence[NDArray[np.float32]], full_size: tuple[int, int]
    ) -> list[Level]:
        """Keypoints of gray images of one size."""
        net, device = self.network(aslfeat_from)
        with inference(device, self.options.half_precision):
            found = net(torch.stack([torch.from_numpy(gray) for gray in grays])[:, None].to(device))
        return [self._selected(maps, full_size) for maps in found]

    def _selected(self, maps: AslFeatMaps, full_size: tuple[int, int]) -> Level:
        options = self.options
        with inference(maps.scores.device):
            candidates = select_pixels(
                suppress_non_maxima(maps.scores, options.nms_radius, rounds=0),
                threshold=options.threshold,
                border=_BORDER_PX,
            )
            kept = on_no_edge(maps.scores, candidates.xy, options.max_edge_ratio)
            xy = parabola_peak(maps.scores, candidates.xy[kept])
            scores = candidates.scores[kept]
            coarse = maps.features.shape[1], maps.features.shape[2]
            x, y = (xy / STRIDE).unbind(1)
            # the border keeps all of them inside the features
            read = read_bilinear(pixel_table(maps.features), y, x, coarse)
            descriptors = functional.normalize(read, dim=1)
        # the network puts the centre of the first pixel at (0, 0), COLMAP at (0.5, 0.5), where
        # the pixels of a resized image are those of the whole one times a factor
        height, width = maps.scores.shape
        ratio = np.array([full_size[1] / width, full_size[0] / height])
        xy_px = ((xy.cpu().numpy() + 0.5) * ratio).astype(np.float32)
        values = scores.cpu().numpy()
        return np.column_stack([xy_px, values]), values, descriptors


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
