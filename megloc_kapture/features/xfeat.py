"""XFeat local features (Potje et al., CVPR 2024, section 3), with the official checkpoint's keys.

The sparse variant; the fine matcher of the semi-dense one, which refines matches by offsets, is
left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn
from torch.nn import functional

from megloc_kapture.features.network import (
    Images,
    LocalNetwork,
    LocalNetworkOptions,
    Masks,
    in_image_px,
)
from megloc_kapture.nets.runtime import batch_counters, image_tensor, inference, load_strictly
from megloc_kapture.nets.score_maps import CELL_PX, pixel_scores, suppress_non_maxima
from megloc_kapture.values import LocalFeatures

STRIDE = 32  # width and height of what the network sees are multiples of it
DESCRIPTOR_SIZE = 64


class XFeatOptions(LocalNetworkOptions):
    """Options of XFeat."""

    weights: str = Field(default="xfeat", description="name in the registry, or a file")
    descriptor_weights: str | None = Field(
        default=None, description="file of another XFeat network, whose descriptors are taken"
    )
    max_keypoints: int = Field(default=1500, gt=0, description="best kept; the authors keep 4096")
    threshold: float = Field(default=0.05, ge=0, lt=1, description="probability of a keypoint")
    nms_radius_px: int = Field(default=2, ge=0, description="2: a window of 5 by 5 pixels")


class XFeat(LocalNetwork[XFeatOptions]):
    """The extractor ``xfeat``: keypoints (N, 3) = x, y, score; descriptors float32 (N, 64).

    The network sees images resized to multiples of 32, downwards; a score is the probability of a
    keypoint times the reliability. With other descriptors than its own it is another type of
    features, named after their file.
    """

    name = "xfeat"
    descriptor_size = DESCRIPTOR_SIZE
    Options = XFeatOptions

    def __init__(self, options: XFeatOptions | None = None) -> None:
        super().__init__(options)
        if self._descriptor_weights is not None:
            # descriptors of different networks do not match
            self.name = f"xfeat-{self._descriptor_weights.path.stem}"

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        options = self.options
        # a third faster on a processor than with channels first
        make = partial(self.network, load_xfeat, channels_last=True)
        network, device = make()
        with inference(device, options.half_precision):
            resized = torch.cat([network_image(image, device) for image in images])
            features, logits, reliability = network(resized)
            peaks = pixel_scores(logits)
            peaks = suppress_non_maxima(peaks, options.nms_radius_px, rounds=0)
            if self._descriptor_weights is not None:
                features = make(file=self._descriptor_weights)[0](resized)[0]
            size = resized.shape[-2], resized.shape[-1]
            maps = zip(peaks, reliability[:, None], features[:, None], images, masks, strict=True)
            return [self._selected(*own, size) for own in maps]

    def _selected(
        self,
        peaks: torch.Tensor,
        reliability: torch.Tensor,
        features: torch.Tensor,
        image: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        size: tuple[int, int],
    ) -> LocalFeatures:
        """The best keypoints of one image, whose maps are those of an image of this size."""
        yx = torch.nonzero(peaks > self.options.threshold)
        pixels = yx.flip(1)
        reliable = sample_at_pixels(reliability, pixels, size, mode="bilinear")[:, 0]
        scores = (peaks[yx[:, 0], yx[:, 1]] * reliable).cpu().numpy()
        xy_px = in_image_px(pixels.cpu().numpy(), size, image.shape)
        return self._best(
            np.column_stack([xy_px, scores]),
            scores,
            lambda rows: descriptors_at(features, pixels[rows.to(pixels.device)], size),
            mask,
        )


def network_image(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """An RGB image as the network takes it, (1, 3, h, w): sides floored to multiples of 32."""
    tensor = image_tensor(image, device)
    size = [max(STRIDE, side // STRIDE * STRIDE) for side in tensor.shape[-2:]]
    if size == list(tensor.shape[-2:]):
        return tensor
    return functional.interpolate(tensor, size, mode="bilinear", align_corners=False)


class BasicLayer(nn.Module):
    """Convolution without bias, normalisation without affine part, ReLU."""

    def __init__(self, inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(outputs, affine=False),
            nn.ReLU(inplace=True),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layer(x)


class XFeatNetwork(nn.Module):
    """Descriptors, keypoints and reliability of images, all on a grid of 8 by 8 pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm2d(1)
        self.skip1 = nn.Sequential(nn.AvgPool2d(4, stride=4), nn.Conv2d(1, 24, 1))
        first = BasicLayer(1, 4), BasicLayer(4, 8, stride=2)
        self.block1 = nn.Sequential(*first, BasicLayer(8, 8), BasicLayer(8, 24, stride=2))
        self.block2 = nn.Sequential(BasicLayer(24, 24), BasicLayer(24, 24))
        self.block3 = nn.Sequential(
            BasicLayer(24, 64, stride=2), BasicLayer(64, 64), BasicLayer(64, 64, kernel=1)
        )
        self.block4 = nn.Sequential(
            BasicLayer(64, 64, stride=2), BasicLayer(64, 64), BasicLayer(64, 64)
        )
        self.block5 = nn.Sequential(
            BasicLayer(64, 128, stride=2),
            BasicLayer(128, 128),
            BasicLayer(128, 128),
            BasicLayer(128, 64, kernel=1),
        )
        self.block_fusion = nn.Sequential(
            BasicLayer(64, 64), BasicLayer(64, 64), nn.Conv2d(64, DESCRIPTOR_SIZE, 1)
        )
        self.heatmap_head = nn.Sequential(
            BasicLayer(64, 64, kernel=1),
            BasicLayer(64, 64, kernel=1),
            nn.Conv2d(64, 1, 1),
            nn.Sigmoid(),
        )
        self.keypoint_head = nn.Sequential(
            *(BasicLayer(CELL_PX**2, CELL_PX**2, kernel=1) for _ in range(3)),
            nn.Conv2d(CELL_PX**2, CELL_PX**2 + 1, 1),
        )

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Dense maps of images, float (B, C, H, W), H and W multiples of 32.

        The channels are averaged. Returns features (B, 64, H/8, W/8), not normalised; logits
        (B, 65, H/8, W/8), of each pixel of a cell (channel 8 y + x), and of no keypoint; and
        reliability (B, 1, H/8, W/8), in [0, 1].
        """
        grey = self.norm(images.mean(dim=1, keepdim=True))
        x3 = self.block3(self.block2(self.block1(grey) + self.skip1(grey)))
        x4 = self.block4(x3)
        x5 = self.block5(x4)
        features = self.block_fusion(x3 + _enlarged(x4, x3) + _enlarged(x5, x3))
        logits = self.keypoint_head(functional.pixel_unshuffle(grey, CELL_PX))
        return features, logits, self.heatmap_head(features)


def load_xfeat(tensors: Mapping[str, torch.Tensor], where: str) -> XFeatNetwork:
    """The network of a checkpoint, for inference; a fine matcher in it is left out.

    Raises DataError that names the keys that do not fit.
    """
    network = XFeatNetwork()
    used = {key: value for key, value in tensors.items() if not key.startswith("fine_matcher.")}
    return load_strictly(network, used, where, may_lack=batch_counters(network)).eval()


def sample_at_pixels(
    values: torch.Tensor, xy: torch.Tensor, size: tuple[int, int], *, mode: str
) -> torch.Tensor:
    """Values (N, C) of a coarse map (1, C, h, w) at pixels (N, 2), as XFeat samples them.

    The pixel (x, y), the first one's centre at (0, 0), of an image of ``size`` (H, W) is read at w
    x / (W - 1) - 0.5 and h y / (H - 1) - 0.5 of the map, half a pixel of the image from where it
    belongs; the network was trained so. ``mode`` is "bilinear" or "bicubic".
    """
    height, width = size
    last = torch.tensor([width - 1, height - 1], dtype=torch.float32, device=values.device)
    grid = 2 * xy.to(last) / last - 1
    found = functional.grid_sample(values.float(), grid[None, None], mode=mode, align_corners=False)
    return found[0, :, 0].T


def descriptors_at(features: torch.Tensor, xy: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Descriptors (N, 64) of unit length at pixels; see :func:`sample_at_pixels`."""
    normalised = functional.normalize(features.float(), dim=1)
    return functional.normalize(sample_at_pixels(normalised, xy, size, mode="bicubic"), dim=1)


def _enlarged(values: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return functional.interpolate(values, like.shape[-2:], mode="bilinear", align_corners=False)
