"""SuperPoint local features (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018).

Detection and descriptors as the authors of SuperGlue run it, or with the descriptors of a second
checkpoint: MegLoc freezes the detector and fine-tunes the descriptors.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import OptionError
from megloc_kapture.features.network import Images, LocalNetwork, LocalNetworkOptions, Masks
from megloc_kapture.io.weights import WeightsFile, read_weights
from megloc_kapture.nets.runtime import inference
from megloc_kapture.nets.score_maps import select_pixels, suppress_non_maxima
from megloc_kapture.nets.superpoint import (
    CELL_PX,
    DESCRIPTOR_SIZE,
    DescriptorSampling,
    is_superpoint_batchnorm,
    sample_descriptors,
    superpoint,
    superpoint_batchnorm,
    superpoint_with_descriptor,
)
from megloc_kapture.values import LocalFeatures

_OFFICIAL_WEIGHTS = "superpoint_v1"


class SuperPointOptions(LocalNetworkOptions):
    """Options of SuperPoint; radius, threshold and border are the authors' own."""

    weights: str = Field(
        default=_OFFICIAL_WEIGHTS,
        description="name or file: superpoint_v1, or the batch-norm variant superpoint_v6_from_tf",
    )
    descriptor_weights: str | None = Field(
        default=None,
        description="file with another descriptor head, or with such a head and its own backbone",
    )
    threshold: float = Field(default=0.005, ge=0, lt=1, description="scores kept are larger")
    nms_radius: int = Field(default=4, ge=0, description="pixels; SuperGlue outdoors: 3")
    remove_borders: int = Field(default=4, ge=0, description="pixels without keypoints")
    descriptor_sampling: Literal["official", "exact"] = Field(
        default="official",
        description="official: as the weights' authors do, in Magic Leap's up to 3.5 px off, which "
        "SuperGlue was trained with; exact: at the keypoint",
    )


class SuperPoint(LocalNetwork[SuperPointOptions]):
    """SuperPoint keypoints (x, y, score) and descriptors, float32 (N, 256) of unit length.

    What an image's sides exceed a multiple of 8 by has no keypoints. Other weights than the
    official ones make another type of features, named after their files.
    """

    name = "superpoint"
    descriptor_size = DESCRIPTOR_SIZE
    Options = SuperPointOptions

    def __init__(self, options: SuperPointOptions | None = None) -> None:
        super().__init__(options)
        given = self.options.weights, self.options.descriptor_weights
        others = [Path(file).stem for file in given if file is not None]
        names = [name.removeprefix("superpoint_") for name in others if name != _OFFICIAL_WEIGHTS]
        self.name = "-".join(["superpoint", *names])

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        options = self.options
        if min(images[0].shape[:2]) < CELL_PX:
            nothing = LocalFeatures(
                np.zeros((0, 3), np.float32),
                np.zeros(0, np.float32),
                np.zeros((0, DESCRIPTOR_SIZE), np.float32),
            )
            return [nothing] * len(images)
        # oneDNN's convolutions are a third faster where the channels of a pixel lie together
        net, device = self.network(_superpoint, self._descriptor_weights, channels_last=True)
        exact = options.descriptor_sampling == "exact"
        sampling: DescriptorSampling = "exact" if exact else net.official_sampling
        features = []
        with inference(device, options.half_precision):
            scores, descriptors = net(torch.cat([gray_tensor(image, device) for image in images]))
            maxima = suppress_non_maxima(scores, options.nms_radius)
            for k, mask in enumerate(masks):
                found = select_pixels(
                    maxima[k],
                    threshold=options.threshold,
                    border=options.remove_borders,
                    mask=mask,
                    max_keypoints=options.max_keypoints,
                )
                sampled = sample_descriptors(descriptors[k], found.xy, sampling).cpu().numpy()
                values = found.scores.cpu().numpy()
                # the network's first pixel is (0, 0), COLMAP's (0.5, 0.5)
                xy = found.xy.cpu().numpy().astype(np.float32) + np.float32(0.5)
                table = np.column_stack([xy, values])
                sampled = np.ascontiguousarray(sampled)
                features.append(LocalFeatures(table, values, sampled, found.num_masked))
        return features


def gray_tensor(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """An RGB image as the network was trained to see it, float32 (1, 1, H, W) in [0, 1].

    Luma rounded to 8 bits, as an image that is read as gray.
    """
    gray = np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY))
    return torch.from_numpy(gray).to(device)[None, None].float() / 255.0


def _superpoint(
    tensors: Mapping[str, torch.Tensor], where: str, descriptor_weights: WeightsFile | None
) -> torch.nn.Module:
    if is_superpoint_batchnorm(tensors):
        if descriptor_weights is not None:
            raise OptionError(
                f"descriptor_weights goes with weights of the layout of {_OFFICIAL_WEIGHTS}; "
                f"{where} has batch normalisation"
            )
        return superpoint_batchnorm(tensors, where)
    if descriptor_weights is None:
        return superpoint(tensors, where)
    return superpoint_with_descriptor(
        tensors,
        read_weights(descriptor_weights),
        detector_where=where,
        descriptor_where=str(descriptor_weights.path),
    )
