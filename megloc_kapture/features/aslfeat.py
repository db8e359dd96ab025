"""ASLFeat local features (Luo et al., CVPR 2020), for the official checkpoint after conversion.

The network is for inference only: batch normalisation is folded into the convolutions, except for
``conv1`` and ``conv3``, whose outputs before normalisation are scored. Parameters keep TensorFlow's
names, written in torch's notation (``scripts/convert_weights.py``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn
from torch.nn import functional

from megloc_kapture.features.network import (
    Images,
    Level,
    LocalNetwork,
    LocalNetworkOptions,
    Masks,
    in_image_px,
)
from megloc_kapture.nets.runtime import batch_counters, in_fast_layout, inference, load_strictly
from megloc_kapture.nets.score_maps import (
    conv_same,
    deform_conv2d,
    norm_factors,
    on_no_edge,
    parabola_peak,
    pixel_table,
    read_bilinear,
    select_pixels,
    suppress_non_maxima,
    with_norm,
)
from megloc_kapture.values import LocalFeatures

DESCRIPTOR_SIZE = 128
STRIDE = 4  # the descriptor map is sampled as if its cell (i, j) were centred at pixel (4 i, 4 j)
# layers that add to the score map: dilation of the neighbourhood, and weight in the sum
_SCORED = {"conv1": (3, 1 / 6), "conv3": (2, 2 / 6), "conv6": (1, 3 / 6)}
_DEFORMABLE = ("conv6_0", "conv6_1", "conv6")
# the score map is computed in strips of at most this many activations, to bound memory
_VALUES_AT_ONCE = {"cpu": 1 << 19, "cuda": 1 << 27}
_BORDER_PX = 5
_NOTHING = (np.zeros((0, 3), np.float32), np.zeros(0, np.float32), torch.zeros(0, DESCRIPTOR_SIZE))
_SCALE_STEP = math.sqrt(0.5)
_SMALLEST_SCALE = 0.3
_SMALLEST_SIDE_PX = 128
_BLUR_PX = 0.8  # Gaussian sigma before each step, in pixels of the smaller image


class AslFeatOptions(LocalNetworkOptions):
    weights: str = Field(default="aslfeat", description="name in the registry, or a file")
    threshold: float = Field(default=0.5, ge=0, description="smallest score of a keypoint")
    nms_radius: int = Field(
        default=1, ge=0, description="radius of non-maximum suppression, pixels"
    )
    max_edge_ratio: float = Field(
        default=10.0,
        ge=1,
        description="largest ratio of the score map's principal curvatures at a keypoint",
    )
    multi_scale: bool = Field(
        default=False,
        description="also extract at 1/sqrt(2) and 1/2 of the image size, to match images of "
        "different scale; small images have fewer scales",
    )


class AslFeat(LocalNetwork[AslFeatOptions]):
    """ASLFeat keypoints (x, y, score) with unit-norm descriptors, float32 (N, 128)."""

    name = "aslfeat"
    Options = AslFeatOptions

    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in images]
        # in a uniform image the network would respond only to its zero padding
        usable = [k for k, gray in enumerate(grays) if gray.min() != gray.max()]
        of_image = [_scales(grays[k]) if self.options.multi_scale else [grays[k]] for k in usable]
        levels_of: list[list[Level]] = [[] for _ in images]
        for levels in zip(*of_image, strict=True):
            if min(levels[0].shape) <= 2 * _BORDER_PX:
                continue
            net, device = self.network(aslfeat_from)
            stacked = torch.from_numpy(np.stack(levels))[:, None].to(device)
            with inference(device, self.options.half_precision):
                maps = net(stacked)
            for k, scores, features in zip(usable, *maps, strict=True):
                levels_of[k].append(self._selected(scores, features, images[0].shape))
        return self._best_of_levels([levels or [_NOTHING] for levels in levels_of], masks)

    def _selected(
        self, score_map: torch.Tensor, features: torch.Tensor, full_size: Sequence[int]
    ) -> Level:
        options = self.options
        with inference(score_map.device):
            pixels, of_pixels = select_pixels(
                suppress_non_maxima(score_map, options.nms_radius, rounds=0),
                threshold=options.threshold,
                border=_BORDER_PX,
            )
            kept = on_no_edge(score_map, pixels, options.max_edge_ratio)
            xy = parabola_peak(score_map, pixels[kept])
            scores = of_pixels[kept]
            coarse = features.shape[1], features.shape[2]
            x, y = (xy / STRIDE).unbind(1)
            # _BORDER_PX keeps keypoints inside the descriptor map
            read = read_bilinear(pixel_table(features), y, x, coarse)
            descriptors = functional.normalize(read, dim=1)
        xy_px = in_image_px(xy.cpu().numpy(), score_map.shape, full_size)
        values = scores.cpu().numpy()
        return np.column_stack([xy_px, values]), values, descriptors


def _scales(gray: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    smallest = max(_SMALLEST_SCALE, _SMALLEST_SIDE_PX / max(gray.shape))
    number = math.floor(max(math.log(smallest) / math.log(_SCALE_STEP), 1))
    levels = [gray]
    for _ in range(number - 1):
        blurred = cv2.GaussianBlur(levels[-1], (0, 0), _BLUR_PX / _SCALE_STEP)
        height, width = (round(side * _SCALE_STEP) for side in blurred.shape)
        # pass the size: given a factor, OpenCV samples as if the size were not rounded
        resized = cv2.resize(blurred, (width, height))
        levels.append(np.asarray(resized, dtype=np.float32))
    return levels


class AslFeatNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv0 = _Conv(1, 32)
        self.conv1 = _Conv(32, 32)
        self.conv2 = _Conv(32, 64, stride=2)
        self.conv3 = _Conv(64, 64)
        self.conv4 = _Conv(64, 128, stride=2)
        self.conv5 = _Conv(128, 128)
        self.conv6_0 = _Conv(128, 128)
        self.conv6_1 = _Conv(128, 128)
        self.conv6 = _Conv(128, 128, normalised=False)
        self.deform_param = nn.ModuleDict({name: _deformation(128) for name in _DEFORMABLE})
        self.tower = nn.ModuleDict({name: nn.Module() for name in _SCORED})
        for part in self.tower.values():
            part.register_buffer("instance_max", torch.ones(()))

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the maps of gray images (B, 1, H, W) in [0, 255], both sides at least 11 px.

        Return non-negative scores float32 (B, H, W) and unnormalised descriptors (B, 128, h, w).
        """
        height, width = images.shape[2:]
        normalised = []
        for image in torch.split(images, 1):
            variance, mean = torch.var_mean(image, correction=0)
            normalised.append((image - mean) * torch.rsqrt(variance + 1e-5))
        x = in_fast_layout(torch.cat(normalised))
        scores = images.new_zeros(len(images), height, width)
        x = self.conv0.normalised(x)
        for scored, strided in (("conv1", self.conv2), ("conv3", self.conv4)):
            conv: _Conv = getattr(self, scored)
            x = conv(x)
            assert conv.bn is not None
            scores += self._scores(scored, x, (height, width))
            scale, shift = norm_factors(conv.bn)
            x = x.mul_(scale[:, None, None]).add_(shift[:, None, None]).relu_()
            x = strided.normalised(x)
        x = self.conv5.normalised(x)
        for name in _DEFORMABLE:
            x = self._deformable(name, x)
        return scores + self._scores("conv6", x, (height, width)), x

    def _deformable(self, name: str, x: torch.Tensor) -> torch.Tensor:
        conv: _Conv = getattr(self, name)
        offset = self.get_submodule(f"deform_param.{name}.offset")(x)
        amplitude = torch.sigmoid(self.get_submodule(f"deform_param.{name}.amplitude")(x))
        if conv.bn is None:
            return deform_conv2d(x, offset, conv.weight, None, amplitude)
        weight, bias = with_norm(conv.weight, conv.bn)
        return deform_conv2d(x, offset, weight, bias, amplitude).relu_()

    def _scores(self, name: str, features: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
        dilation, weight = _SCORED[name]
        scale = self.get_buffer(f"tower.{name}.instance_max")
        peaky = (peakiness(feature_map, dilation, scale) for feature_map in features)
        return torch.stack(
            [weight * resize_as_tensorflow_1(feature_map, size) for feature_map in peaky]
        )


class _Conv(nn.Module):
    """3x3 convolution without bias, with TensorFlow's SAME padding and optional batch norm."""

    def __init__(
        self, inputs: int, outputs: int, *, stride: int = 1, normalised: bool = True
    ) -> None:
        super().__init__()
        self.stride = stride
        self.weight = nn.Parameter(torch.zeros(outputs, inputs, 3, 3))
        self.bn = nn.BatchNorm2d(outputs, affine=False) if normalised else None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return conv_same(x, self.weight, None, self.stride)

    def normalised(self, x: torch.Tensor) -> torch.Tensor:
        assert self.bn is not None
        return conv_same(x, *with_norm(self.weight, self.bn), self.stride).relu_()


def _deformation(channels: int) -> nn.ModuleDict:
    sizes = {"offset": 18, "amplitude": 9}
    return nn.ModuleDict({k: nn.Conv2d(channels, n, 3, padding=1) for k, n in sizes.items()})


def aslfeat_from(tensors: Mapping[str, torch.Tensor], where: str) -> AslFeatNet:
    """Build the network from a converted checkpoint, in eval mode."""
    net = AslFeatNet()
    return load_strictly(net, tensors, where, may_lack=batch_counters(net)).eval()


def peakiness(features: torch.Tensor, dilation: int, scale: torch.Tensor) -> torch.Tensor:
    """Return the peakiness scores (H, W) of features (C, H, W) (equations 6 to 8 of ASLFeat).

    With y = features / scale, the score is the maximum over the channels of
    softplus(y - local mean) * softplus(y - mean over channels). The local mean is over a dilated
    3x3 neighbourhood, with reflection padding.
    """
    channels, height, width = features.shape
    pixels = features.permute(1, 2, 0)
    columns = _reflected(-dilation, width + dilation, width, features.device)
    at_once = max(_VALUES_AT_ONCE[features.device.type] // (width * channels), 1)
    strips = []
    for start in range(0, height, at_once):
        stop = min(start + at_once, height)
        rows = _reflected(start - dilation, stop + dilation, height, features.device)
        padded = pixels.index_select(0, rows).index_select(1, columns)
        padded = padded.to(torch.promote_types(padded.dtype, torch.float32)) / scale
        step, number = dilation, stop - start
        inner = padded[step : step + number, step : step + width]
        three = padded[:number] + padded[step : step + number] + padded[2 * step :]
        nine = three[:, :width] + three[:, step : step + width] + three[:, 2 * step :]
        in_space = functional.softplus(inner - nine / 9)
        among_channels = functional.softplus(inner - inner.mean(dim=2, keepdim=True))
        strips.append((in_space * among_channels).amax(dim=2))
    return torch.cat(strips)


def _reflected(start: int, stop: int, size: int, device: torch.device) -> torch.Tensor:
    index = torch.arange(start, stop, device=device).abs()
    return size - 1 - (size - 1 - index).abs()


def resize_as_tensorflow_1(values: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Resize (h, w) to (H, W) bilinearly as TensorFlow 1 does: pixel i is read at i * h / H."""
    for axis, wanted in enumerate(size):
        given = values.shape[axis]
        if given == wanted:
            continue
        index = torch.arange(wanted, device=values.device, dtype=values.dtype)
        position = index * (given / wanted)
        lower = position.long().clamp(max=given - 1)
        upper = (lower + 1).clamp(max=given - 1)
        share = (position - lower).unsqueeze(1 - axis)
        first = values.index_select(axis, lower)
        values = first + (values.index_select(axis, upper) - first) * share
    return values
