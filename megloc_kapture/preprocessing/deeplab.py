"""DeepLabV3+ trained on Cityscapes as a segmenter: people and vehicles are what moves."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.nets.deeplabv3plus import DeepLabV3Plus, backbone_of, most_likely
from megloc_kapture.nets.runtime import (
    Checkpointed,
    NetworkOptions,
    image_tensor,
    inference,
    load_strictly,
)

# by train id, as cityscapesScripts numbers them
CITYSCAPES_CLASSES = (
    "road",
    "sidewalk",
    "building",
    "wall",
    "fence",
    "pole",
    "traffic light",
    "traffic sign",
    "vegetation",
    "terrain",
    "sky",
    "person",
    "rider",
    "car",
    "truck",
    "bus",
    "train",
    "motorcycle",
    "bicycle",
)
# Cityscapes' categories human and vehicle
CITYSCAPES_DYNAMIC = frozenset(CITYSCAPES_CLASSES[11:])


class DeepLabOptions(NetworkOptions):
    """Options of DeepLabV3+."""

    weights: str = Field(
        default="deeplabv3plus-resnet101",
        description="deeplabv3plus-resnet101, deeplabv3plus-mobilenet, or a file; the backbone "
        "is read from its keys",
    )
    max_size_px: int = Field(
        default=2048,
        ge=64,
        description="longer side that the network sees (a Cityscapes image's); it bounds memory",
    )


class DeepLab(Checkpointed[DeepLabOptions]):
    """Cityscapes' 19 classes of an image, at the image's own size."""

    name = "deeplabv3plus"
    classes = CITYSCAPES_CLASSES
    dynamic = CITYSCAPES_DYNAMIC
    Options = DeepLabOptions

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Labels uint8 (H, W), indices into ``classes``, of an RGB image, uint8 (H, W, 3).

        Raises DataError where the checkpoint does not fit, OptionError where the device is not
        there.
        """
        height, width = image.shape[:2]
        scale = self.options.max_size_px / max(height, width)
        if scale < 1:
            size = (max(round(width * scale), 1), max(round(height * scale), 1))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        network, device = self.network(_deeplab)
        with inference(device, self.options.half_precision):
            logits = network(image_tensor(image, device))[0].float()
            return most_likely(logits, height, width).cpu().numpy()


def _deeplab(tensors: Mapping[str, torch.Tensor], where: str) -> DeepLabV3Plus:
    network = DeepLabV3Plus(backbone_of(tensors, where), num_classes=len(CITYSCAPES_CLASSES))
    load_strictly(network, tensors, where)
    return network.eval()
