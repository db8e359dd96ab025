"""Depth by PatchmatchNet (Wang et al., CVPR 2021): learned stereo, with the official keys.

A pyramid of features; at an eighth, a quarter and half the size depth hypotheses are drawn, spread
to neighbours at learned offsets (section 3.2.1), and scored by group-wise correlation with the
sources, each weighted per pixel (3.2.2); the last stage refines at the whole size (3.3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn
from torch.nn import functional

from megloc_kapture.mvs.sweep import as_estimate, matching_deviations, tangent_planes
from megloc_kapture.mvs.views import relative_projection
from megloc_kapture.nets.runtime import Checkpointed, image_tensor, inference, load_strictly
from megloc_kapture.plugins import DepthEstimate, StereoView
from megloc_kapture.values import Device, Options

# matching error in pixels, and multiple of the bound of least squares: docs/experiments/mvs.md
_CALIBRATION = np.array([0.5, 2.5])
MULTIPLE = 8  # width and height of what the network sees are multiples of it
_FIRST_SAMPLES = 48
_BEHIND = 1e-3  # depth in a source before which nothing is seen

Tensor = torch.Tensor


class LearnedStereoOptions(Options):
    """Options of PatchmatchNet."""

    weights: str = Field(default="patchmatchnet", description="the name, or a file")
    device: Device = Field(default="auto", description="auto: a GPU where there is one")
    min_confidence: float = Field(
        default=0.3, ge=0, le=1, description="of its probability, what must lie near its depth"
    )
    seed: int = Field(default=0, ge=0, description="of its first hypotheses")


class LearnedStereo(Checkpointed[LearnedStereoOptions]):
    """PatchmatchNet; deviations as of :class:`~megloc_kapture.mvs.sweep.Sweep`, by its matching."""

    name = "patchmatchnet"
    Options = LearnedStereoOptions

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        """Depth of the reference; see :class:`~megloc_kapture.plugins.DepthEstimator`."""
        options = self.options
        network, device = self.network(patchmatchnet_from)
        # stretched to sides that can be halved three times
        fitted, stretches = zip(
            *(_fitted(view.image) for view in (reference, *sources)), strict=True
        )
        projections = []
        for source, stretch in zip(sources, stretches[1:], strict=True):
            infinity, baseline = relative_projection(reference, source)
            infinity = stretch @ infinity @ np.linalg.inv(stretches[0])
            projections.append((torch.from_numpy(infinity), torch.from_numpy(stretch @ baseline)))
        with inference(device):
            images = [image_tensor(image, device) for image in fitted]
            depth, confidence = network(images, projections, depth_range_m, options.seed)
        size = reference.camera.width, reference.camera.height
        found = cv2.resize(depth.cpu().numpy(), size, interpolation=cv2.INTER_LINEAR)
        sure = cv2.resize(confidence.cpu().numpy(), size, interpolation=cv2.INTER_LINEAR)
        planes = tangent_planes((1 / np.clip(found, *depth_range_m)).astype(np.float32))
        deviations = matching_deviations(reference, sources, planes, _CALIBRATION)
        deviations[sure < options.min_confidence] = 0.0
        return as_estimate(reference.camera, planes, deviations)


def _fitted(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The image with sides that are multiples, and the stretch (3, 3) of array coordinates."""
    height, width = image.shape[:2]
    rows, columns = (max(1, round(n / MULTIPLE)) * MULTIPLE for n in (height, width))
    x, y = columns / width, rows / height
    stretch = np.array([[x, 0, 0.5 * x - 0.5], [0, y, 0.5 * y - 0.5], [0, 0, 1]])
    if (rows, columns) == (height, width):
        return image, stretch
    resized = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(resized, np.uint8), stretch


@dataclass(frozen=True)
class _Stage:
    """What differs between the stages; the published setting."""

    channels: int
    groups: int
    dilation: int
    iterations: int
    samples: int
    interval: float  # of normalised inverse depth
    neighbours: int  # that hypotheses come from


_STAGES = {
    3: _Stage(64, 8, 2, 2, 16, 0.025, 16),
    2: _Stage(32, 8, 4, 2, 8, 0.0125, 8),
    1: _Stage(16, 4, 6, 1, 8, 0.005, 0),
}


class _Layer(nn.Module):
    """Convolution without bias, normalisation, ReLU; over the pixels, or over hypotheses."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, *, points: bool = False
    ) -> None:
        super().__init__()
        self.conv: nn.Module
        self.bn: nn.Module
        if points:
            self.conv = nn.Conv3d(inputs, outputs, 1, bias=False)
            self.bn = nn.BatchNorm3d(outputs)
        else:
            self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
            self.bn = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.bn(self.conv(x)))


class _FeatureNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv0, self.conv1 = _Layer(3, 8), _Layer(8, 8)
        self.conv2, self.conv3, self.conv4 = _Layer(8, 16, 5, 2), _Layer(16, 16), _Layer(16, 16)
        self.conv5, self.conv6, self.conv7 = _Layer(16, 32, 5, 2), _Layer(32, 32), _Layer(32, 32)
        self.conv8, self.conv9, self.conv10 = _Layer(32, 64, 5, 2), _Layer(64, 64), _Layer(64, 64)
        self.output1 = nn.Conv2d(64, 64, 1, bias=False)
        self.inner1, self.inner2 = nn.Conv2d(32, 64, 1), nn.Conv2d(16, 64, 1)
        self.output2 = nn.Conv2d(64, 32, 1, bias=False)
        self.output3 = nn.Conv2d(64, 16, 1, bias=False)

    def forward(self, image: Tensor) -> dict[int, Tensor]:
        half = self.conv4(self.conv3(self.conv2(self.conv1(self.conv0(image)))))
        quarter = self.conv7(self.conv6(self.conv5(half)))
        eighth = self.conv10(self.conv9(self.conv8(quarter)))
        middle = _smoothly_doubled(eighth) + self.inner1(quarter)
        finest = _smoothly_doubled(middle) + self.inner2(half)
        return {3: self.output1(eighth), 2: self.output2(middle), 1: self.output3(finest)}


class _PointNet(nn.Module):
    """Three layers over the groups of a similarity (B, G, D, H, W)."""

    last = "similarity"

    def __init__(self, groups: int) -> None:
        super().__init__()
        self.conv0 = _Layer(groups, 16, points=True)
        self.conv1 = _Layer(16, 8, points=True)
        setattr(self, self.last, nn.Conv3d(8, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """(B, D, H, W)"""
        found: Tensor = getattr(self, self.last)(self.conv1(self.conv0(x)))
        return found.squeeze(1)


class _PixelwiseNet(_PointNet):
    last = "conv2"


class _Evaluation(nn.Module):
    def __init__(self, groups: int) -> None:
        super().__init__()
        self.pixel_wise_net = _PixelwiseNet(groups)
        self.similarity_net = _PointNet(groups)


class _PatchMatch(nn.Module):
    """One stage: hypotheses, their spread, their scores."""

    def __init__(self, stage: _Stage) -> None:
        super().__init__()
        self.stage = stage
        wide = stage.dilation
        self.evaluation = _Evaluation(stage.groups)
        self.propa_conv = nn.Conv2d(stage.channels, max(2 * stage.neighbours, 1), 3, 1, wide, wide)
        self.eval_conv = nn.Conv2d(stage.channels, 18, 3, 1, wide, wide)
        self.feature_weight_net = _PointNet(stage.groups)

    def forward(
        self,
        reference: Tensor,
        sources: Sequence[Tensor],
        projections: Sequence[tuple[Tensor, Tensor]],
        limits: tuple[float, float],
        depth: Tensor | None,
        view_weights: Tensor | None,
        generator: torch.Generator,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Depth (1, 1, H, W), score (1, D, H, W) and weights of the sources (1, S, H, W)."""
        stage, (height, width) = self.stage, reference.shape[-2:]
        step = stage.dilation - 1
        near = [(y, x) for y in (-step, 0, step) for x in (-step, 0, step)]
        eval_grid = _grid(near, self.eval_conv(reference))
        spread = None
        if stage.neighbours:
            step = stage.dilation
            ring = [(y, x) for y in (-step, 0, step) for x in (-step, 0, step) if (y, x) != (0, 0)]
            ring += [(2 * y, 2 * x) for y, x in ring]
            spread = _grid(ring[: stage.neighbours], self.propa_conv(reference))
        grouped = reference.view(1, stage.groups, -1, 1, height, width)
        around = _sampled(reference, eval_grid).view(1, stage.groups, -1, 9, height, width)
        feature_weights = self.feature_weight_net((around * grouped).mean(2)).sigmoid()
        score = torch.empty(0)
        for turn in range(stage.iterations):
            samples = self._samples(depth, limits, (height, width), generator, reference)
            # the very last one tells how sure it is from evenly spaced samples
            if spread is not None:
                middle = samples[:, samples.shape[1] // 2, None]
                samples = torch.cat([samples, _sampled(middle, spread)[:, 0]], dim=1).sort(1)[0]
            weights = self._depth_weights(samples, limits, eval_grid) * feature_weights[:, None]
            weights = weights / weights.sum(2, keepdim=True)
            score, view_weights = self._score(
                grouped, sources, projections, samples, eval_grid, weights, view_weights
            )
            if spread is None and turn == stage.iterations - 1:
                count = samples.shape[1]
                ramp = torch.arange(count, device=score.device).view(1, count, 1, 1)
                at = (ramp * score).sum(1, keepdim=True) / (count - 1)
                far, close = 1 / samples[:, :1], 1 / samples[:, -1:]
                depth = 1 / (far + at * (close - far))
            else:
                depth = (samples * score).sum(1, keepdim=True)
        assert depth is not None and view_weights is not None
        return depth, score, view_weights

    def _samples(
        self,
        depth: Tensor | None,
        limits: tuple[float, float],
        size: tuple[int, int],
        generator: torch.Generator,
        like: Tensor,
    ) -> Tensor:
        """Hypotheses (1, D, H, W): one drawn in each part of the range, or around a depth."""
        close, far = 1 / limits[0], 1 / limits[1]
        if depth is None:
            # drawn on the processor: the same whatever the device
            drawn = torch.rand((1, _FIRST_SAMPLES, *size), generator=generator).to(like)
            parts = drawn + torch.arange(_FIRST_SAMPLES, device=like.device).view(1, -1, 1, 1)
            return 1 / (far + parts / _FIRST_SAMPLES * (close - far))
        half = self.stage.samples // 2
        steps = torch.arange(-half, half, device=like.device).view(1, -1, 1, 1)
        inverse = 1 / depth + (close - far) * self.stage.interval * steps
        return 1 / inverse.clamp(far, close)

    def _depth_weights(self, samples: Tensor, limits: tuple[float, float], grid: Tensor) -> Tensor:
        """Weights (1, D, 9, H, W) of neighbours, by how near their hypotheses are."""
        close, far = 1 / limits[0], 1 / limits[1]
        inverse = (1 / samples - far) / (close - far)
        off = (_sampled(inverse, grid) - inverse[:, :, None]).abs() / self.stage.interval
        return torch.sigmoid(4 - 2 * off.clamp(0, 4))

    def _score(
        self,
        grouped: Tensor,
        sources: Sequence[Tensor],
        projections: Sequence[tuple[Tensor, Tensor]],
        samples: Tensor,
        grid: Tensor,
        weights: Tensor,
        view_weights: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        count, (height, width) = samples.shape[1], samples.shape[-2:]
        total = grouped.new_zeros((1, self.stage.groups, count, height, width))
        sum_weights = grouped.new_full((1, 1, 1, height, width), 1e-5)
        own = []
        for number, (source, projection) in enumerate(zip(sources, projections, strict=True)):
            warped = _warped(source, projection, samples)
            similarity = (
                warped.view(1, self.stage.groups, -1, count, height, width) * grouped
            ).mean(2)
            if view_weights is None:
                weight = self.evaluation.pixel_wise_net(similarity).sigmoid().amax(1, keepdim=True)
                own.append(weight)
            else:
                weight = view_weights[:, number, None]
            total += similarity * weight[:, :, None]
            sum_weights += weight[:, :, None]
        found = self.evaluation.similarity_net(total / sum_weights)
        score = (_sampled(found, grid) * weights).sum(2).softmax(1)
        return score, torch.cat(own, 1) if view_weights is None else view_weights


class _Refinement(nn.Module):
    """Depth at the whole size: a residual that the image tells."""

    def __init__(self) -> None:
        super().__init__()
        self.conv0, self.conv1, self.conv2 = _Layer(3, 8), _Layer(1, 8), _Layer(8, 8)
        self.deconv = nn.ConvTranspose2d(8, 8, 3, 2, 1, 1, bias=False)
        self.bn = nn.BatchNorm2d(8)
        self.conv3 = _Layer(16, 8)
        self.res = nn.Conv2d(8, 1, 3, padding=1, bias=False)

    def forward(self, image: Tensor, depth: Tensor, limits: tuple[float, float]) -> Tensor:
        near, far = limits
        scaled = (depth - near) / (far - near)
        up = functional.relu(self.bn(self.deconv(self.conv2(self.conv1(scaled)))))
        residual = self.res(self.conv3(torch.cat([up, self.conv0(image)], dim=1)))
        return (_doubled(scaled) + residual) * (far - near) + near


class PatchmatchNet(nn.Module):
    """Depth of an image from its neighbours."""

    def __init__(self) -> None:
        super().__init__()
        self.feature = _FeatureNet()
        self.patchmatch_1 = _PatchMatch(_STAGES[1])
        self.patchmatch_2 = _PatchMatch(_STAGES[2])
        self.patchmatch_3 = _PatchMatch(_STAGES[3])
        self.upsample_net = _Refinement()

    def forward(
        self,
        images: Sequence[Tensor],
        projections: Sequence[tuple[Tensor, Tensor]],
        limits: tuple[float, float],
        seed: int = 0,
    ) -> tuple[Tensor, Tensor]:
        """Depth (H, W) of the first image, and how much of its probability is near, (H/2, W/2).

        Parameters
        ----------
        images : float32 (1, 3, H, W) in [0, 1], sides multiples of 8, the reference first.
        projections : of each source: ``K_s R K^-1`` (3, 3) and ``K_s t`` (3,), array coordinates.
        limits : nearest and farthest depth.
        seed : of the first hypotheses.
        """
        features = [self.feature(image) for image in images]
        generator = torch.Generator().manual_seed(seed)
        depth = weights = score = None
        for number in (3, 2, 1):
            scale = 0.5**number
            # pixels scale about the centre of the first: the strides take it first
            grow = torch.tensor([scale, scale, 1.0], dtype=torch.float64)
            scaled = [
                (grow[:, None] * infinity / grow, grow * baseline)
                for infinity, baseline in projections
            ]
            depth, score, weights = getattr(self, f"patchmatch_{number}")(
                features[0][number],
                [one[number] for one in features[1:]],
                scaled,
                limits,
                depth,
                weights,
                generator,
            )
            if number > 1:
                depth, weights = _doubled(depth), _doubled(weights)
        found = self.upsample_net(images[0], depth, limits)
        assert score is not None
        count = score.shape[1]
        ramp = torch.arange(count, device=score.device).view(1, count, 1, 1)
        at = (score * ramp).sum(1, keepdim=True).long().clamp(0, count - 1)
        padded = functional.pad(score[:, None], (0, 0, 0, 0, 1, 2))
        sums = 4 * functional.avg_pool3d(padded, (4, 1, 1), stride=1)[:, 0]
        return found[0, 0], sums.gather(1, at)[0, 0]


def patchmatchnet_from(tensors: Mapping[str, Tensor], where: str) -> PatchmatchNet:
    """The network of a checkpoint, for inference; raises DataError that names what does not fit."""
    return load_strictly(PatchmatchNet(), tensors, where).eval()


def _doubled(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")


def _smoothly_doubled(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def _grid(offsets: Sequence[tuple[int, int]], learned: Tensor) -> Tensor:
    """Where pixels look: (1, N, H, W, 2) normalised, at (y, x) offsets plus learned ones.

    Normalised by the outer centres, and read by the outer edges: the network was trained so.
    """
    height, width = learned.shape[-2:]
    y = torch.arange(height, dtype=torch.float32, device=learned.device).view(1, height, 1)
    x = torch.arange(width, dtype=torch.float32, device=learned.device).view(1, 1, width)
    base = torch.tensor(offsets, dtype=torch.float32, device=learned.device)
    moved = learned.view(len(offsets), 2, height, width)
    at_x = (x + base[:, 1, None, None] + moved[:, 0]) / ((width - 1) / 2) - 1
    at_y = (y + base[:, 0, None, None] + moved[:, 1]) / ((height - 1) / 2) - 1
    return torch.stack([at_x, at_y], dim=-1)[None]


def _sampled(values: Tensor, grid: Tensor) -> Tensor:
    """(1, C, N, H, W) of values (1, C, H, W) at a grid (1, N, H, W, 2)."""
    count, height, width = grid.shape[1:4]
    found = functional.grid_sample(
        values,
        grid.reshape(1, count * height, width, 2),
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return found.view(1, values.shape[1], count, height, width)


def _warped(source: Tensor, projection: tuple[Tensor, Tensor], samples: Tensor) -> Tensor:
    """A source's features (1, C, D, H, W) where hypotheses (1, D, H, W) of the reference lie."""
    count, (height, width) = samples.shape[1], samples.shape[-2:]
    rows, columns = source.shape[-2:]
    infinity, baseline = (one.to(samples) for one in projection)
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float32, device=samples.device),
        torch.arange(width, dtype=torch.float32, device=samples.device),
        indexing="ij",
    )
    turned = infinity @ torch.stack([x.ravel(), y.ravel(), torch.ones_like(x).ravel()])
    path = turned[:, None] * samples.view(1, count, -1) + baseline[:, None, None]
    behind = path[2] <= _BEHIND
    z = torch.where(behind, 1.0, path[2])
    at_x = torch.where(behind, float(columns), path[0]) / z / ((columns - 1) / 2) - 1
    at_y = torch.where(behind, float(rows), path[1]) / z / ((rows - 1) / 2) - 1
    grid = torch.stack([at_x, at_y], dim=-1).view(1, count * height, width, 2)
    found = functional.grid_sample(
        source, grid, mode="bilinear", padding_mode="zeros", align_corners=True
    )
    return found.view(1, source.shape[1], count, height, width)
