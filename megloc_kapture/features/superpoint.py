"""SuperPoint local features (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018).

Detection and descriptors as the authors of SuperGlue run it, or with the descriptors of a second
checkpoint: MegLoc freezes the detector and fine-tunes the descriptors.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import OptionError
from megloc_kapture.features.image_bound import BoundedOptions
from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.nets.runtime import NetworkOptions, inference, pick_device
from megloc_kapture.nets.score_maps import select_pixels, suppress_non_maxima
from megloc_kapture.nets.superpoint import (
    CELL_PX,
    DESCRIPTOR_SIZE,
    PointNetwork,
    is_superpoint_batchnorm,
    sample_descriptors,
    superpoint,
    superpoint_batchnorm,
    superpoint_with_descriptor,
)
from megloc_kapture.values import LocalFeatures

_OFFICIAL_WEIGHTS = "superpoint_v1"


class SuperPointOptions(NetworkOptions, BoundedOptions):
    """Options of SuperPoint; radius, threshold and border are the authors' own."""

    weights: str = Field(
        default=_OFFICIAL_WEIGHTS,
        description="name or file: superpoint_v1, or the batch-norm variant superpoint_v6_from_tf",
    )
    descriptor_weights: str | None = Field(
        default=None,
        description="file with another descriptor head, or with such a head and its own backbone",
    )
    max_keypoints: int = Field(default=1500, gt=0, description="best scores kept")
    threshold: float = Field(default=0.005, ge=0, lt=1, description="scores kept are larger")
    nms_radius: int = Field(default=4, ge=0, description="pixels; SuperGlue outdoors: 3")
    remove_borders: int = Field(default=4, ge=0, description="pixels without keypoints")
    descriptor_sampling: Literal["official", "exact"] = Field(
        default="official",
        description="official: as the weights' authors do, in Magic Leap's up to 3.5 px off, which "
        "SuperGlue was trained with; exact: at the keypoint",
    )


class SuperPoint:
    """SuperPoint keypoints (x, y, score) and descriptors, float32 (N, 256) of unit length.

    Other weights than the official ones make another type of features, named after their files.
    """

    name = "superpoint"
    descriptor_size = DESCRIPTOR_SIZE
    descriptor_dtype = "float32"
    metric = "L2"
    Options = SuperPointOptions

    def __init__(self, options: SuperPointOptions | None = None) -> None:
        self.options = options = options or SuperPointOptions()
        self._weights = find_weights(options.weights)
        self._descriptor_weights: WeightsFile | None = None
        others = [Path(options.weights).stem]
        if options.descriptor_weights is not None:
            self._descriptor_weights = find_weights(options.descriptor_weights)
            others.append(Path(options.descriptor_weights).stem)
        names = [name.removeprefix("superpoint_") for name in others if name != _OFFICIAL_WEIGHTS]
        self.name = "-".join(["superpoint", *names])

    def weights(self) -> dict[str, str]:
        """sha256 of each checkpoint by its file's name."""
        files = [file for file in (self._weights, self._descriptor_weights) if file is not None]
        return {file.path.name: sha256_of(file) for file in files}

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image.

        Parameters
        ----------
        image : uint8 (H, W, 3), RGB. What H and W exceed a multiple of 8 by has no keypoints.
        mask : bool (H, W) or None; keypoints on False pixels are removed after non-maximum
            suppression, before the best are selected.
        """
        options = self.options
        if min(image.shape[:2]) < CELL_PX:
            return LocalFeatures(
                np.zeros((0, 3), np.float32),
                np.zeros(0, np.float32),
                np.zeros((0, DESCRIPTOR_SIZE), np.float32),
            )
        device = pick_device(options.device)
        net = _network(self._weights, self._descriptor_weights, device)
        sampling = "exact" if options.descriptor_sampling == "exact" else net.official_sampling
        with inference(device, options.half_precision):
            scores, descriptors = net(gray_tensor(image, device))
            found = select_pixels(
                suppress_non_maxima(scores[0], options.nms_radius),
                threshold=options.threshold,
                border=options.remove_borders,
                mask=mask,
                max_keypoints=options.max_keypoints,
            )
            sampled = sample_descriptors(descriptors[0], found.xy, sampling).cpu().numpy()
        values = found.scores.cpu().numpy()
        # the network's first pixel is (0, 0), COLMAP's (0.5, 0.5)
        xy = found.xy.cpu().numpy().astype(np.float32) + np.float32(0.5)
        return LocalFeatures(
            np.column_stack([xy, values]), values, np.ascontiguousarray(sampled), found.num_masked
        )


def gray_tensor(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """An RGB image as the network was trained to see it, float32 (1, 1, H, W) in [0, 1].

    Luma rounded to 8 bits, as an image that is read as gray.
    """
    gray = np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY))
    return torch.from_numpy(gray).to(device)[None, None].float() / 255.0


@lru_cache(maxsize=2)
def _network(
    weights: WeightsFile, descriptor_weights: WeightsFile | None, device: torch.device
) -> PointNetwork:
    tensors, where = read_weights(weights), str(weights.path)
    net: torch.nn.Module
    if is_superpoint_batchnorm(tensors):
        if descriptor_weights is not None:
            raise OptionError(
                f"descriptor_weights goes with weights of the layout of {_OFFICIAL_WEIGHTS}; "
                f"{weights.name} has batch normalisation"
            )
        net = superpoint_batchnorm(tensors, where)
    elif descriptor_weights is not None:
        net = superpoint_with_descriptor(
            tensors,
            read_weights(descriptor_weights),
            detector_where=where,
            descriptor_where=str(descriptor_weights.path),
        )
    else:
        net = superpoint(tensors, where)
    net = net.eval().to(device)
    if device.type == "cpu":
        # oneDNN's convolutions are a third faster where the channels of a pixel lie together
        net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in its stubs
    return net
