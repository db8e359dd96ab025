"""The plugin: what megloc-kapture finds by its entry point."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch.nn import functional as F

from espnetv2_segmenter.network import EspNetV2Network
from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.nets.runtime import (
    NetworkOptions,
    image_tensor,
    inference,
    load_strictly,
    pick_device,
)

# Cityscapes' train ids, and one for everything else
CLASSES = (
    *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign"),
    *("vegetation", "terrain", "sky", "person", "rider", "car", "truck", "bus", "train"),
    *("motorcycle", "bicycle", "background"),
)
_MULTIPLE = 32  # of which the network's sides are


class EspNetV2Options(NetworkOptions):
    """Options of ESPNetv2."""

    weights: str = Field(description="path of espnetv2_s_1.0_city_1024x512.pth")
    size_px: int = Field(
        default=1024, ge=64, description="longer side that the network sees; trained at 1024"
    )


class EspNetV2:
    """Cityscapes' classes of an image, by a network of a quarter of a million values."""

    name = "espnetv2"
    classes = CLASSES
    dynamic = frozenset(CLASSES[11:19])
    Options = EspNetV2Options

    def __init__(self, options: EspNetV2Options) -> None:
        self.options = options
        self._weights = find_weights(options.weights)

    def weights(self) -> dict[str, str]:
        return {self._weights.name: sha256_of(self._weights)}

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Labels uint8 (H, W), indices into ``classes``, of an RGB image, uint8 (H, W, 3)."""
        height, width = image.shape[:2]
        scale = self.options.size_px / max(height, width)
        seen = (_rounded(width * scale), _rounded(height * scale))
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = np.asarray(cv2.resize(image, seen, interpolation=how), np.uint8)
        device = pick_device(self.options.device)
        network = _network(self._weights, device)
        with inference(device, self.options.half_precision):
            logits = network(image_tensor(small, device)).float()
            whole = F.interpolate(logits, seen[::-1], mode="bilinear", align_corners=True)
            labels = whole[0].argmax(dim=0).to(torch.uint8).cpu().numpy()
        return np.asarray(
            cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8
        )


def _rounded(length: float) -> int:
    return max(round(length / _MULTIPLE), 1) * _MULTIPLE


@lru_cache(maxsize=2)
def _network(weights: WeightsFile, device: torch.device) -> EspNetV2Network:
    network = EspNetV2Network(len(CLASSES))
    load_strictly(network, read_weights(weights), str(weights.path))
    return network.eval().to(device)
