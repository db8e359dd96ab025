"""XFeat local features (Potje et al., CVPR 2024), the sparse variant."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch.nn import functional

from megloc_kapture.features.image_bound import BoundedOptions
from megloc_kapture.io.weights import WeightsFile, find_weights, read_weights, sha256_of
from megloc_kapture.nets.runtime import NetworkOptions, image_tensor, inference, pick_device
from megloc_kapture.nets.score_maps import select_keypoints, suppress_non_maxima
from megloc_kapture.nets.xfeat import (
    DESCRIPTOR_SIZE,
    STRIDE,
    XFeatNetwork,
    descriptors_at,
    keypoint_scores,
    load_xfeat,
    sample_at_pixels,
)
from megloc_kapture.values import LocalFeatures


class XFeatOptions(NetworkOptions, BoundedOptions):
    """Options of XFeat."""

    weights: str = Field(default="xfeat", description="name in the registry, or a file")
    descriptor_weights: str | None = Field(
        default=None, description="file of another XFeat network, whose descriptors are taken"
    )
    max_keypoints: int = Field(default=1500, gt=0, description="best kept; the authors keep 4096")
    threshold: float = Field(default=0.05, ge=0, lt=1, description="probability of a keypoint")
    nms_radius_px: int = Field(default=2, ge=0, description="2: a window of 5 by 5 pixels")


class XFeat:
    """The extractor ``xfeat``: keypoints (N, 3) = x, y, score; descriptors float32 (N, 64).

    With other descriptors than its own it is another type of features, named after their file.
    """

    name = "xfeat"
    descriptor_size = DESCRIPTOR_SIZE
    descriptor_dtype = "float32"
    metric = "L2"
    Options = XFeatOptions

    def __init__(self, options: XFeatOptions | None = None) -> None:
        self.options = options or XFeatOptions()
        self._file = find_weights(self.options.weights)
        self._descriptor_file: WeightsFile | None = None
        if self.options.descriptor_weights is not None:
            self._descriptor_file = find_weights(self.options.descriptor_weights)
            # descriptors of different networks do not match
            self.name = f"xfeat-{self._descriptor_file.path.stem}"

    def weights(self) -> dict[str, str]:
        """sha256 of each checkpoint by its file name."""
        files = [file for file in (self._file, self._descriptor_file) if file is not None]
        return {file.path.name: sha256_of(file) for file in files}

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image, uint8 (H, W, 3); none on False pixels of the mask (H, W).

        The network sees the image resized to multiples of 32, downwards. A score is the
        probability of a keypoint times the reliability.

        Raises
        ------
        DataError : the checkpoint does not fit.
        OptionError : the device is not there.
        """
        options = self.options
        device = pick_device(options.device)
        network = _network(self._file, device)
        height, width = image.shape[:2]
        with inference(device, options.half_precision):
            resized = network_image(image, device)
            size = resized.shape[-2], resized.shape[-1]
            features, logits, reliability = network(resized)
            peaks = keypoint_scores(logits)
            peaks = suppress_non_maxima(peaks, options.nms_radius_px, rounds=0)[0, 0]
            yx = torch.nonzero(peaks > options.threshold)
            pixels = yx.flip(1)
            reliable = sample_at_pixels(reliability, pixels, size, mode="bilinear")[:, 0]
            scores = (peaks[yx[:, 0], yx[:, 1]] * reliable).cpu().numpy()
            # from here on in the image's own pixels, the first one's centre at (0.5, 0.5)
            ratio = np.array([width / size[1], height / size[0]])
            xy_px = ((pixels.cpu().numpy() + 0.5) * ratio).astype(np.float32)
            rows, num_masked = select_keypoints(
                xy_px,
                scores,
                size=(height, width),
                mask=mask,
                max_keypoints=options.max_keypoints,
            )
            if self._descriptor_file is not None:
                features = _network(self._descriptor_file, device)(resized)[0]
            chosen = pixels[torch.from_numpy(rows).to(device)]
            descriptors = descriptors_at(features, chosen, size)
        return LocalFeatures(
            np.column_stack([xy_px[rows], scores[rows]]),
            scores[rows],
            descriptors.cpu().numpy(),
            num_masked,
        )


@lru_cache(maxsize=2)
def _network(file: WeightsFile, device: torch.device) -> XFeatNetwork:
    network = load_xfeat(read_weights(file), str(file.path))
    # a third faster on a processor than with channels first
    return network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]


def network_image(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """An RGB image as the network takes it, (1, 3, h, w): sides floored to multiples of 32."""
    tensor = image_tensor(image, device)
    size = [max(STRIDE, side // STRIDE * STRIDE) for side in tensor.shape[-2:]]
    if size == list(tensor.shape[-2:]):
        return tensor
    return functional.interpolate(tensor, size, mode="bilinear", align_corners=False)
