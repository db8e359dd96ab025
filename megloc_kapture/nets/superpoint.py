"""SuperPoint (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018, section 3).

State-dict keys are those of Magic Leap's ``superpoint_v1.pth``. A network may lack one of its
heads: MegLoc keeps the detector frozen and gives the descriptors a network of their own. The
MIT-licensed retraining (rpautrat/SuperPoint) has the same topology with a batch normalisation
*after* each activation, and the keys of its own ``superpoint_v6_from_tf.pth``; its descriptors are
not those that SuperGlue's weights were trained with.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.nets.runtime import batch_counters, load_strictly

CELL_PX = 8
DESCRIPTOR_SIZE = 256
_STRIP_ROWS = 64  # even; measured: fewer cost more halo, more do not fit into the caches
DescriptorSampling = Literal["official", "exact"]
_EPSILON = 1e-3  # TensorFlow's default, which it was trained with


class SuperPointNet(nn.Module):
    """The network: gray image to scores per pixel and descriptors per cell of 8 x 8 pixels.

    ``detector`` and ``descriptor`` are the heads it has. ``official_sampling`` is that of
    descriptors in the authors' own code, see :func:`sample_descriptors`.
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

    def encode(self, gray: torch.Tensor) -> torch.Tensor:
        """Features (B, 128, h, w) of images (B, 1, H, W) in [0, 1]; h = H // 8, w = W // 8."""
        x = self._first_stage(gray)
        for first, second in ((self.conv2a, self.conv2b), (self.conv3a, self.conv3b)):
            x = second(functional.relu_(first(x)))
            x = functional.relu_(functional.max_pool2d(x, 2))  # in this order four times cheaper
        return functional.relu_(self.conv4b(functional.relu_(self.conv4a(x))))

    def _first_stage(self, gray: torch.Tensor) -> torch.Tensor:
        """Features (B, 64, H // 2, W // 2), in strips of rows.

        At full resolution 64 channels are 1 GB for two megapixels, and most of the time goes into
        moving them. Two rows more at each side of a strip make it the same numbers.
        """
        strips = []
        for top in range(0, gray.shape[2] // 2 * 2, _STRIP_ROWS):
            start = max(top - 2, 0)
            x = self.conv1a(gray[:, :, start : top + _STRIP_ROWS + 2])
            x = self.conv1b(functional.relu_(x))[:, :, top - start :][:, :, :_STRIP_ROWS]
            strips.append(functional.relu_(functional.max_pool2d(x, 2)))
        return torch.cat(strips, dim=2)

    def detect(self, features: torch.Tensor) -> torch.Tensor:
        """Scores (B, 8h, 8w) in (0, 1), before non-maximum suppression."""
        return pixel_scores(self.convPb(functional.relu_(self.convPa(features))))

    def describe(self, features: torch.Tensor) -> torch.Tensor:
        """Descriptors (B, 256, h, w) of unit length."""
        return functional.normalize(self.convDb(functional.relu_(self.convDa(features))), dim=1)

    def forward(self, gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Scores (B, 8h, 8w) and descriptors (B, 256, h, w) of gray images (B, 1, H, W)."""
        features = self.encode(gray)
        return self.detect(features), self.describe(features)


class SplitSuperPoint(nn.Module):
    """A detector and a descriptor network that share nothing (MegLoc, section "local features")."""

    official_sampling: DescriptorSampling = "official"

    def __init__(self, detector: SuperPointNet, descriptor: SuperPointNet) -> None:
        super().__init__()
        self.detector = detector
        self.descriptor = descriptor

    def forward(self, gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As :meth:`SuperPointNet.forward`."""
        scores = self.detector.detect(self.detector.encode(gray))
        return scores, self.descriptor.describe(self.descriptor.encode(gray))


def superpoint(tensors: Mapping[str, torch.Tensor], where: str) -> SuperPointNet:
    """The network of an official checkpoint; raises DataError that names what does not fit."""
    return load_strictly(SuperPointNet(), tensors, where)


def superpoint_with_descriptor(
    detector: Mapping[str, torch.Tensor],
    descriptor: Mapping[str, torch.Tensor],
    *,
    detector_where: str,
    descriptor_where: str,
) -> SuperPointNet | SplitSuperPoint:
    """The detector of one checkpoint and the descriptors of another.

    Raises DataError that names the keys that do not fit, and the file. ``detector``: an official
    checkpoint; its descriptor head may be missing and is not used; ``descriptor``: the descriptor
    head alone, which then works on the detector's features, or the head with a backbone of its own.
    A detector head in it is not used: that of the other file is frozen.
    """
    head = {key: value for key, value in descriptor.items() if not key.startswith("convP")}
    frozen = {key: value for key, value in detector.items() if not key.startswith("convD")}
    describes = SuperPointNet(detector=False)
    detects = SuperPointNet(descriptor=False)
    load_strictly(detects, frozen, detector_where)
    if any(key.startswith(("conv1", "conv2", "conv3", "conv4")) for key in head):
        load_strictly(describes, head, descriptor_where)
        return SplitSuperPoint(detects, describes)
    shared = {key: value for key, value in frozen.items() if not key.startswith("convP")}
    load_strictly(describes, {**shared, **head}, descriptor_where)
    whole = SuperPointNet()
    load_strictly(whole, {**frozen, **head}, descriptor_where)
    return whole


def pixel_scores(logits: torch.Tensor) -> torch.Tensor:
    """Scores (B, 8h, 8w) from the detector's logits (B, 65, h, w).

    Channel c of a cell is its pixel (c // 8, c % 8), row first; the last channel is "no keypoint".
    """
    probabilities = functional.softmax(logits.float(), dim=1)
    return functional.pixel_shuffle(probabilities[:, :-1], CELL_PX)[:, 0]


def sample_descriptors(
    descriptors: torch.Tensor, xy: torch.Tensor, sampling: DescriptorSampling
) -> torch.Tensor:
    """Descriptors float32 (N, D) at pixels, bilinear between cells and of unit length.

    Parameters
    ----------
    descriptors : float32 (D, h, w), of unit length.
    xy : (N, 2), pixels; the first pixel's centre is (0, 0).
    sampling : ``exact`` puts the centre of cell (i, j) at pixel (8 i + 3.5, 8 j + 3.5). So does
        ``official`` at the top left, but its scale is short by (w - 1) / (w - 9/16): it drifts to
        3.5 pixels at the bottom right. SuperGlue was trained with it.
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


class _Block(nn.Module):
    """Convolution, activation, normalisation, in this order."""

    def __init__(self, channels_in: int, channels_out: int, size: int, *, relu: bool = True):
        super().__init__()
        self.conv = nn.Conv2d(channels_in, channels_out, size, padding=size // 2)
        self.bn = nn.BatchNorm2d(channels_out, eps=_EPSILON)
        self.relu = relu

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.conv(x)
        return self.bn(functional.relu_(x) if self.relu else x)


class SuperPointBatchNormNet(nn.Module):
    """The retrained network: as :class:`SuperPointNet`, with both heads."""

    official_sampling: DescriptorSampling = "exact"

    def __init__(self) -> None:
        super().__init__()
        pool = nn.MaxPool2d(2)
        self.backbone = nn.Sequential(
            nn.Sequential(_Block(1, 64, 3), _Block(64, 64, 3), pool),
            nn.Sequential(_Block(64, 64, 3), _Block(64, 64, 3), pool),
            nn.Sequential(_Block(64, 128, 3), _Block(128, 128, 3), pool),
            nn.Sequential(_Block(128, 128, 3), _Block(128, 128, 3)),
        )
        self.detector = nn.Sequential(
            _Block(128, 256, 3), _Block(256, CELL_PX**2 + 1, 1, relu=False)
        )
        self.descriptor = nn.Sequential(
            _Block(128, 256, 3), _Block(256, DESCRIPTOR_SIZE, 1, relu=False)
        )

    def forward(self, gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Scores (B, 8h, 8w) and descriptors (B, 256, h, w) of gray images (B, 1, H, W)."""
        features = self.backbone(gray)
        descriptors = functional.normalize(self.descriptor(features), dim=1)
        return pixel_scores(self.detector(features)), descriptors


def is_superpoint_batchnorm(tensors: Mapping[str, torch.Tensor]) -> bool:
    """True if the keys are those of the retrained network."""
    return any(key.startswith("backbone.") for key in tensors)


def superpoint_batchnorm(tensors: Mapping[str, torch.Tensor], where: str) -> SuperPointBatchNormNet:
    """The network of a checkpoint of the retraining; raises DataError as :func:`superpoint`."""
    net = SuperPointBatchNormNet()
    return load_strictly(net, tensors, where, may_lack=batch_counters(net))
