"""SuperPoint local features (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018, section 3).

Checkpoints have the keys of Magic Leap's ``superpoint_v1.pth`` or of ``superpoint_v6_from_tf.pth``,
the MIT-licensed retrained network (rpautrat/SuperPoint). The latter applies batch normalisation
*after* each activation, and its descriptors do not work with SuperGlue's weights. Descriptors may
come from a second checkpoint: MegLoc fine-tunes them with a frozen detector.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import OptionError
from megloc_kapture.features.network import Images, LocalNetwork, LocalNetworkOptions, Masks
from megloc_kapture.io.weights import WeightsFile, read_weights
from megloc_kapture.nets.runtime import batch_counters, inference, load_strictly
from megloc_kapture.nets.score_maps import CELL_PX, pixel_scores, select_pixels, suppress_non_maxima
from megloc_kapture.values import LocalFeatures

_OFFICIAL_WEIGHTS = "superpoint_v1"
DESCRIPTOR_SIZE = 256
_BORDER_PX = 4  # border without keypoints, as in SuperGlue's code
# image rows per strip, even; 64 is fastest: thinner strips overlap more, thicker ones do not fit
# the CPU's caches
_STRIP_ROWS = 64
DescriptorSampling = Literal["official", "exact"]
_EPSILON = 1e-3  # of batch normalisation: TensorFlow's default, as in training


class SuperPointOptions(LocalNetworkOptions):
    """Options of SuperPoint; NMS radius and threshold default to those of SuperGlue's code."""

    weights: str = Field(
        default=_OFFICIAL_WEIGHTS,
        description="name or file: superpoint_v1, or the batch-norm variant superpoint_v6_from_tf",
    )
    descriptor_weights: str | None = Field(
        default=None,
        description="file with another descriptor head, optionally with a backbone",
    )
    threshold: float = Field(default=0.005, ge=0, lt=1, description="smallest score of a keypoint")
    nms_radius: int = Field(default=4, ge=0, description="in pixels; SuperGlue uses 3 outdoors")
    descriptor_sampling: DescriptorSampling = Field(
        default="official",
        description="official: as the authors of the weights do (Magic Leap's sampling is up to "
        "3.5 px off, and SuperGlue was trained with it); exact: at the keypoint",
    )


class SuperPoint(LocalNetwork[SuperPointOptions]):
    """SuperPoint keypoints (x, y, score) with unit-norm descriptors, float32 (N, 256).

    Rows and columns beyond the last whole cell of 8 pixels have no keypoints. Weights other than
    the official ones define another feature type, named after their files.
    """

    name = "superpoint"
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
        # oneDNN's convolutions are a third faster with channels last
        net, device = self.network(superpoint_from, self._descriptor_weights, channels_last=True)
        exact = options.descriptor_sampling == "exact"
        sampling: DescriptorSampling = "exact" if exact else net.official_sampling
        features = []
        with inference(device, options.half_precision):
            scores, descriptors = net(torch.cat([gray_tensor(image, device) for image in images]))
            maxima = suppress_non_maxima(scores, options.nms_radius)
            for of_image, described, mask in zip(maxima, descriptors, masks, strict=True):
                xy, of_pixels = select_pixels(
                    of_image, threshold=options.threshold, border=_BORDER_PX
                )
                # the first pixel's centre is (0, 0) in the network, (0.5, 0.5) in COLMAP
                xy_px = xy.cpu().numpy().astype(np.float32) + np.float32(0.5)
                values = of_pixels.cpu().numpy()
                describe = partial(_describe, described, xy, sampling)
                features.append(
                    self._best(np.column_stack([xy_px, values]), values, describe, mask)
                )
        return features


def _describe(
    descriptors: torch.Tensor, xy: torch.Tensor, sampling: DescriptorSampling, rows: torch.Tensor
) -> torch.Tensor:
    return sample_descriptors(descriptors, xy[rows.to(xy.device)], sampling).contiguous()


def gray_tensor(image: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """Convert RGB to luma, rounded to 8 bits and returned as float32 (1, 1, H, W) in [0, 1]."""
    gray = np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY))
    return torch.from_numpy(gray).to(device)[None, None].float() / 255.0


class SuperPointNet(nn.Module):
    """Network from gray image to scores per pixel and descriptors per cell of 8 x 8 pixels.

    ``describer`` is another network that computes the descriptors, if any.
    """

    official_sampling: DescriptorSampling = "official"

    def __init__(self, *, detector: bool = True, descriptor: bool = True) -> None:
        super().__init__()
        self.conv1a, self.conv1b = _conv3(1, 64), _conv3(64, 64)
        self.conv2a, self.conv2b = _conv3(64, 64), _conv3(64, 64)
        self.conv3a, self.conv3b = _conv3(64, 128), _conv3(128, 128)
        self.conv4a, self.conv4b = _conv3(128, 128), _conv3(128, 128)
        if detector:
            self.convPa = _conv3(128, 256)
            self.convPb = nn.Conv2d(256, CELL_PX**2 + 1, kernel_size=1)
        if descriptor:
            self.convDa = _conv3(128, 256)
            self.convDb = nn.Conv2d(256, DESCRIPTOR_SIZE, kernel_size=1)
        self.describer: SuperPointNet | None = None

    def encode(self, gray: torch.Tensor) -> torch.Tensor:
        """Compute features (B, 128, H // 8, W // 8) of images (B, 1, H, W) in [0, 1]."""
        x = self._first_stage(gray)
        for first, second in ((self.conv2a, self.conv2b), (self.conv3a, self.conv3b)):
            x = second(functional.relu_(first(x)))
            # ReLU after pooling is four times cheaper
            x = functional.relu_(functional.max_pool2d(x, 2))
        return functional.relu_(self.conv4b(functional.relu_(self.conv4a(x))))

    def _first_stage(self, gray: torch.Tensor) -> torch.Tensor:
        """Compute features (B, 64, H // 2, W // 2) strip by strip, which saves memory traffic."""
        strips = []
        for top in range(0, gray.shape[2] // 2 * 2, _STRIP_ROWS):
            start = max(top - 2, 0)
            x = self.conv1a(gray[:, :, start : top + _STRIP_ROWS + 2])
            x = self.conv1b(functional.relu_(x))[:, :, top - start :][:, :, :_STRIP_ROWS]
            strips.append(functional.relu_(functional.max_pool2d(x, 2)))
        return torch.cat(strips, dim=2)

    def detect(self, features: torch.Tensor) -> torch.Tensor:
        return pixel_scores(self.convPb(functional.relu_(self.convPa(features))))

    def describe(self, features: torch.Tensor) -> torch.Tensor:
        return functional.normalize(self.convDb(functional.relu_(self.convDa(features))), dim=1)

    def forward(self, gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return scores (B, 8h, 8w) and unit-norm descriptors (B, 256, h, w).

        ``gray`` (B, 1, H, W) is in [0, 1]; h = H // 8, w = W // 8.
        """
        features = self.encode(gray)
        scores = self.detect(features)
        if self.describer is None:
            return scores, self.describe(features)
        return scores, self.describer.describe(self.describer.encode(gray))


def superpoint_from(
    tensors: Mapping[str, torch.Tensor], where: str, descriptor_weights: WeightsFile | None = None
) -> SuperPointNet | SuperPointBatchNormNet:
    """Build the network of a checkpoint in either layout, with optional descriptor weights.

    A descriptor head without a backbone uses the detector's features.
    """
    if any(key.startswith("backbone.") for key in tensors):
        if descriptor_weights is not None:
            raise OptionError(
                f"descriptor_weights needs weights in the layout of {_OFFICIAL_WEIGHTS}; "
                f"{where} has batch normalisation"
            )
        net = SuperPointBatchNormNet()
        return load_strictly(net, tensors, where, may_lack=batch_counters(net))
    if descriptor_weights is None:
        return load_strictly(SuperPointNet(), tensors, where)
    descriptor, descriptor_where = read_weights(descriptor_weights), str(descriptor_weights.path)
    head = {key: value for key, value in descriptor.items() if not key.startswith("convP")}
    frozen = {key: value for key, value in tensors.items() if not key.startswith("convD")}
    detects = load_strictly(SuperPointNet(descriptor=False), frozen, where)
    if any(key.startswith(("conv1", "conv2", "conv3", "conv4")) for key in head):
        detects.describer = load_strictly(SuperPointNet(detector=False), head, descriptor_where)
        return detects
    return load_strictly(SuperPointNet(), {**frozen, **head}, descriptor_where)


def sample_descriptors(
    descriptors: torch.Tensor, xy: torch.Tensor, sampling: DescriptorSampling
) -> torch.Tensor:
    """Sample a descriptor map (D, h, w) bilinearly at pixels (N, 2): unit-norm float32 (N, D).

    The first pixel's centre is (0, 0). ``exact`` puts the centre of cell (i, j) at pixel
    (8 i + 3.5, 8 j + 3.5). ``official`` multiplies the correct scale by (w - 1) / (w - 9/16), and
    likewise with h, so that the error grows to 3.5 pixels at the bottom right. SuperGlue was
    trained with it.
    """
    size, height, width = descriptors.shape
    if len(xy) == 0:
        return descriptors.new_zeros((0, size), dtype=torch.float32)
    cells = torch.tensor([width, height], dtype=torch.float32, device=descriptors.device)
    if sampling == "official":
        centre = (CELL_PX - 1) / 2
        grid = 2 * (xy - centre) / (CELL_PX * cells - (CELL_PX + 1) / 2) - 1
    else:
        grid = 2 * (xy + 0.5) / (CELL_PX * cells) - 1
    sampled = functional.grid_sample(
        descriptors[None].float(),
        grid[None, None],
        mode="bilinear",
        padding_mode="zeros",
        align_corners=sampling == "official",
    )
    return functional.normalize(sampled[0, :, 0].T, dim=1)


def _conv3(channels_in: int, channels_out: int) -> nn.Conv2d:
    return nn.Conv2d(channels_in, channels_out, kernel_size=3, padding=1)


def _block(channels_in: int, channels_out: int, size: int, *, relu: bool = True) -> nn.Sequential:
    layers: dict[str, nn.Module] = {
        "conv": nn.Conv2d(channels_in, channels_out, size, padding=size // 2),
        "relu": nn.ReLU(inplace=True) if relu else nn.Identity(),
        "bn": nn.BatchNorm2d(channels_out, eps=_EPSILON),
    }
    return nn.Sequential(OrderedDict(layers))


class SuperPointBatchNormNet(nn.Module):
    """The retrained network; ``forward`` takes and returns the same as :class:`SuperPointNet`'s."""

    official_sampling: DescriptorSampling = "exact"

    def __init__(self) -> None:
        super().__init__()
        pool = nn.MaxPool2d(2)
        self.backbone = nn.Sequential(
            nn.Sequential(_block(1, 64, 3), _block(64, 64, 3), pool),
            nn.Sequential(_block(64, 64, 3), _block(64, 64, 3), pool),
            nn.Sequential(_block(64, 128, 3), _block(128, 128, 3), pool),
            nn.Sequential(_block(128, 128, 3), _block(128, 128, 3)),
        )
        self.detector = nn.Sequential(
            _block(128, 256, 3), _block(256, CELL_PX**2 + 1, 1, relu=False)
        )
        self.descriptor = nn.Sequential(
            _block(128, 256, 3), _block(256, DESCRIPTOR_SIZE, 1, relu=False)
        )

    def forward(self, gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        features = self.backbone(gray)
        descriptors = functional.normalize(self.descriptor(features), dim=1)
        return pixel_scores(self.detector(features)), descriptors
