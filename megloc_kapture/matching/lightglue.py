"""LightGlue (Lindenberger et al., ICCV 2023), and LighterGlue, its small form for XFeat."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch.nn.utils.rnn import pad_sequence

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import WeightsFile
from megloc_kapture.nets.lightglue import (
    KeypointBatch,
    load_lighterglue,
    load_lightglue,
    mutual_matches,
    require_kornia,
)
from megloc_kapture.nets.runtime import Checkpointed, NetworkOptions, inference
from megloc_kapture.values import ImageFeatures

Matches = tuple[NDArray[np.int64], NDArray[np.float32]]


class PairNetworkOptions(NetworkOptions):
    """Options that these matchers share."""

    weights: str
    threshold: float = Field(default=0.1, ge=0, lt=1, description="probability of a match")


PairOptions = TypeVar("PairOptions", bound=PairNetworkOptions)


class PairNetwork(Checkpointed[PairOptions]):
    """A matcher that is a network of LightGlue's kind.

    Raises
    ------
    OptionError : kornia is not installed.
    MissingWeightsError : the checkpoint is not there.
    """

    _load: Any  # of a checkpoint's tensors and the file's name

    def __init__(self, options: PairOptions | None = None) -> None:
        require_kornia()
        super().__init__(options)

    def match(self, a: ImageFeatures, b: ImageFeatures) -> Matches:
        """Matches int64 (K, 2), rows of a and b, sorted by a, and their probabilities (K,)."""
        return self.match_many(a, [b])[0]

    def match_many(self, a: ImageFeatures, others: Sequence[ImageFeatures]) -> list[Matches]:
        """The matches of one image with each of several, in their order, of one batch.

        Pairs are padded to the keypoints of the largest; what is padding is masked out of attention
        and assignment, so that scores are as one by one but for rounding. Raises DataError where
        the checkpoint or the descriptors do not fit, OptionError where the device is not there.
        """
        network, device = self.network(self._load)
        for image in (a, *others):
            _check(image, network.descriptor_size, self._weights)
        none: Matches = (np.zeros((0, 2), np.int64), np.zeros(0, np.float32))
        found = [none for _ in others]
        rows = [at for at, b in enumerate(others) if len(a.keypoints_px) and len(b.keypoints_px)]
        if not rows:
            return found
        with inference(device, self.options.half_precision):
            assignment = network(
                _batch([a] * len(rows), device), _batch([others[row] for row in rows], device)
            )
            matched = mutual_matches(assignment, self.options.threshold)
            for row, (matches, scores) in zip(rows, matched, strict=True):
                found[row] = matches.cpu().numpy(), scores.cpu().numpy()
        return found


def _check(image: ImageFeatures, expected: int, file: WeightsFile) -> None:
    if len(image.descriptors) and image.descriptors.shape[1] != expected:
        raise DataError(
            f"these weights match descriptors of {expected} values, the features' have "
            f"{image.descriptors.shape[1]}",
            path=file.path,
        )


def normalised_points(image: ImageFeatures) -> NDArray[np.float32]:
    """Keypoints (N, 2) float32 as the networks know them: the image's longer side is -1 to 1.

    They were trained with the first pixel's centre at (0, 0) and the middle at half the size. A
    keypoint of the first row or column may then be less than -1, by half a pixel at most, and is
    clamped: no position outside was seen in training.
    """
    size = np.array([image.width, image.height], np.float64)
    xy = image.keypoints_px[:, :2].astype(np.float64) - 0.5
    return np.clip((xy - size / 2) / (size.max() / 2), -1, 1).astype(np.float32)


def _batch(images: Sequence[ImageFeatures], device: torch.device) -> KeypointBatch:
    points = [torch.from_numpy(normalised_points(image)) for image in images]
    descriptors = [
        torch.from_numpy(np.ascontiguousarray(image.descriptors, np.float32)) for image in images
    ]
    lengths = torch.tensor([len(rows) for rows in points])
    present = torch.arange(int(lengths.max()))[None] < lengths[:, None]
    return KeypointBatch(
        pad_sequence(points, batch_first=True).to(device),
        pad_sequence(descriptors, batch_first=True).to(device),
        None if bool(present.all()) else present[..., None].to(device),
    )


class LightGlueOptions(PairNetworkOptions):
    """Options of LightGlue."""

    weights: str = Field(
        default="superpoint_lightglue",
        description="superpoint_lightglue, aliked_lightglue, or a file: those of the features",
    )


class LightGlue(PairNetwork[LightGlueOptions]):
    """The matcher ``lightglue``, for SuperPoint's features or ALIKED's; needs kornia."""

    Options = LightGlueOptions
    _load = staticmethod(load_lightglue)


class LighterGlueOptions(PairNetworkOptions):
    """Options of LighterGlue."""

    weights: str = Field(default="xfeat-lighterglue", description="name in the registry, or a file")


class LighterGlue(PairNetwork[LighterGlueOptions]):
    """The matcher ``lighterglue`` for features of type ``xfeat``; needs kornia."""

    Options = LighterGlueOptions
    _load = staticmethod(load_lighterglue)
