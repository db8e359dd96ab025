"""Matching networks: SuperGlue (Sarlin et al., CVPR 2020), LightGlue (Lindenberger et al., ICCV
2023) and LighterGlue, a smaller LightGlue for XFeat.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import WeightsFile
from megloc_kapture.nets.kornia_networks import load_lighterglue, load_lightglue, require_kornia
from megloc_kapture.nets.runtime import Checkpointed, NetworkOptions, inference
from megloc_kapture.nets.superglue import (
    ImageKeypoints,
    mutual_matches,
    normalise_keypoints,
    superglue,
)
from megloc_kapture.values import ImageFeatures

Matches = tuple[NDArray[np.int64], NDArray[np.float32]]
PairOptions = TypeVar("PairOptions", bound=NetworkOptions)


class PairNetwork(Checkpointed[PairOptions], ABC):
    def match(self, a: ImageFeatures, b: ImageFeatures) -> Matches:
        """Match two images; return indices of keypoints, int64 (K, 2), and scores (K,).

        A keypoint has at most one match; matches are sorted by the first column.
        """
        return self.match_many(a, [b])[0]

    @abstractmethod
    def match_many(self, a: ImageFeatures, others: Sequence[ImageFeatures]) -> list[Matches]:
        """Match one image with several, in one batch if possible; see :meth:`match`."""


def _matched(
    num_others: int, rows: Sequence[int], matched: Iterable[tuple[torch.Tensor, torch.Tensor]]
) -> list[Matches]:
    matches: list[Matches] = [
        (np.zeros((0, 2), np.int64), np.zeros(0, np.float32)) for _ in range(num_others)
    ]
    for row, (pairs, scores) in zip(rows, matched, strict=True):
        matches[row] = pairs.cpu().numpy(), scores.cpu().numpy()
    return matches


class SuperGlueOptions(NetworkOptions):
    """Options of SuperGlue; threshold and iterations default to the authors' values."""

    weights: str = Field(
        default="superglue_outdoor",
        description="superglue_outdoor, superglue_indoor, or a file with the same parameter names",
    )
    match_threshold: float = Field(default=0.2, ge=0, lt=1, description="smallest score of a match")
    sinkhorn_iterations: int = Field(default=100, gt=0)


class SuperGlue(PairNetwork[SuperGlueOptions]):
    """Matcher plugin ``superglue``: keypoints need the detector's score as the third column."""

    Options = SuperGlueOptions

    def match_many(self, a: ImageFeatures, others: Sequence[ImageFeatures]) -> list[Matches]:
        options = self.options
        net, device = self.network(superglue)
        with inference(device, options.half_precision):
            side, *sides = (
                network_input(image, net.descriptor_size, self._weights.name, device)
                for image in (a, *others)
            )
            rows = [k for k, b in enumerate(sides) if len(side.scores) and len(b.scores)]
            pairs = [(side, sides[k]) for k in rows]
            assignments = net(pairs, options.sinkhorn_iterations) if pairs else ()
            matched = [
                mutual_matches(assignment, options.match_threshold) for assignment in assignments
            ]
            return _matched(len(others), rows, matched)


def network_input(
    image: ImageFeatures, descriptor_size: int, where: str, device: torch.device
) -> ImageKeypoints:
    """Convert an image's features for SuperGlue; ``where`` names the weights.

    Raises DataError if scores are missing or outside (0, 1], or descriptors have another size.
    """
    table = np.asarray(image.keypoints_px, dtype=np.float32)
    descriptors = np.asarray(image.descriptors, dtype=np.float32)
    if table.ndim != 2 or table.shape[1] < 3:
        raise DataError(
            f"SuperGlue needs keypoints (N, 3) of x, y, score; these have the shape {table.shape} "
            "(superpoint, aliked and xfeat store scores)"
        )
    scores = table[:, 2]
    if not ((scores > 0) & (scores <= 1)).all():
        worst = scores[~((scores > 0) & (scores <= 1))][0]
        raise DataError(
            "SuperGlue needs the detector's score as the third column of the keypoints, above 0 "
            f"and at most 1; a keypoint has {worst:g}"
        )
    if len(table) and descriptors.shape != (len(table), descriptor_size):
        raise DataError(
            f"{where} needs descriptors of {descriptor_size} dimensions, one "
            f"for each of {len(table)} keypoints; these have the shape {descriptors.shape}"
        )
    # in the network, the first pixel's centre is (0, 0)
    xy = torch.from_numpy(table[:, :2] - np.float32(0.5)).to(device)
    return ImageKeypoints(
        normalise_keypoints(xy, image.width, image.height),
        torch.from_numpy(scores.copy()).to(device),
        torch.from_numpy(np.array(descriptors, order="C")).to(device),
    )


class LightGlueOptions(NetworkOptions):
    """Options of LightGlue, with the authors' defaults."""

    weights: str = Field(
        default="superpoint_lightglue",
        description="superpoint_lightglue, aliked_lightglue, disk_lightglue, or a file",
    )
    threshold: float = Field(default=0.1, ge=0, lt=1, description="smallest probability of a match")
    depth_confidence: float = Field(
        default=0.95, ge=-1, le=1, description="stop early at this confidence; -1: run all layers"
    )
    width_confidence: float = Field(
        default=0.99, ge=-1, le=1, description="drop keypoints at this confidence; -1: keep all"
    )


class LightGlue(PairNetwork[LightGlueOptions]):
    """Matcher plugin ``lightglue`` by kornia, for the features that its weights were trained on.

    Each pair is matched separately, without padding.
    """

    Options = LightGlueOptions
    _load: Any = staticmethod(load_lightglue)

    def __init__(self, options: LightGlueOptions | None = None) -> None:
        require_kornia("LightGlue")
        super().__init__(options)

    def match_many(self, a: ImageFeatures, others: Sequence[ImageFeatures]) -> list[Matches]:
        options = self.options
        confidences = options.depth_confidence, options.width_confidence
        network, device = self.network(
            self._load, options.threshold, *confidences, options.half_precision
        )
        for image in (a, *others):
            _check(image, network.conf.input_dim, self._weights)
        rows = [at for at, b in enumerate(others) if len(a.keypoints_px) and len(b.keypoints_px)]
        matched = []
        with inference(device):
            side = _kornia_input(a, device)
            for row in rows:
                result = network({"image0": side, "image1": _kornia_input(others[row], device)})
                pairs, scores = result["matches"][0], result["scores"][0]
                order = torch.argsort(pairs[:, 0])
                matched.append((pairs[order], scores[order].float()))
        return _matched(len(others), rows, matched)


def _check(image: ImageFeatures, expected: int, file: WeightsFile) -> None:
    if len(image.descriptors) and image.descriptors.shape[1] != expected:
        raise DataError(
            f"these weights match descriptors of {expected} dimensions, but the features have "
            f"{image.descriptors.shape[1]}",
            path=file.path,
        )


def _kornia_input(image: ImageFeatures, device: torch.device) -> dict[str, torch.Tensor]:
    """Return keypoints, descriptors and size of an image with a leading axis of length 1.

    In the networks, the first pixel's centre is (0, 0). Keypoints are clamped, since kornia rejects
    negative coordinates.
    """
    xy = image.keypoints_px[:, :2].astype(np.float32) - np.float32(0.5)
    size = np.array([image.width, image.height], np.float32)
    descriptors = np.ascontiguousarray(image.descriptors, np.float32)
    values = {"keypoints": np.clip(xy, 0, size), "descriptors": descriptors, "image_size": size}
    return {name: torch.from_numpy(array)[None].to(device) for name, array in values.items()}


class LighterGlueOptions(LightGlueOptions):
    """Options of LighterGlue, with the authors' defaults."""

    weights: str = Field(default="xfeat-lighterglue", description="name in the registry, or a file")
    depth_confidence: float = Field(
        default=-1.0, ge=-1, le=1, description="stop early at this confidence; -1: run all layers"
    )
    width_confidence: float = Field(
        default=0.95, ge=-1, le=1, description="drop keypoints at this confidence; -1: keep all"
    )


class LighterGlue(LightGlue):
    """Matcher plugin ``lighterglue`` for features of type ``xfeat``."""

    Options = LighterGlueOptions
    _load: Any = staticmethod(load_lighterglue)
