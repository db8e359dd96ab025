"""SuperGlue (Sarlin et al., CVPR 2020) as a matcher of keypoints that carry a score."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.nets.runtime import Checkpointed, NetworkOptions, inference
from megloc_kapture.nets.superglue import (
    ImageKeypoints,
    mutual_matches,
    normalise_keypoints,
    superglue,
)
from megloc_kapture.values import ImageFeatures

Matches = tuple[NDArray[np.int64], NDArray[np.float32]]


class SuperGlueOptions(NetworkOptions):
    """Options of SuperGlue; threshold and iterations are the authors' own."""

    weights: str = Field(
        default="superglue_outdoor",
        description="name or file: superglue_outdoor, superglue_indoor or one of the same layout",
    )
    match_threshold: float = Field(default=0.2, ge=0, lt=1, description="scores kept are larger")
    sinkhorn_iterations: int = Field(default=100, gt=0)


class SuperGlue(Checkpointed[SuperGlueOptions]):
    """The matcher plugin ``superglue``.

    Takes keypoints whose third column is the detector's score, and descriptors of the size that
    the weights were trained with: 256, SuperPoint's, for the official ones.
    """

    Options = SuperGlueOptions

    def match(self, a: ImageFeatures, b: ImageFeatures) -> Matches:
        """Match two images: int64 (K, 2), rows sorted by a, each once; float32 (K,) in (0, 1].

        Raises DataError for keypoints without scores in (0, 1], or descriptors of another size.
        """
        return self.match_many(a, [b])[0]

    def match_many(self, a: ImageFeatures, others: Sequence[ImageFeatures]) -> list[Matches]:
        """Match one image with each of several, in one batch; see :meth:`match`."""
        options = self.options
        net, device = self.network(superglue)
        found: list[Matches] = [
            (np.zeros((0, 2), np.int64), np.zeros(0, np.float32)) for _ in others
        ]
        with inference(device, options.half_precision):
            side, *sides = (
                network_input(image, net.descriptor_size, self._weights.name, device)
                for image in (a, *others)
            )
            usable = [k for k, b in enumerate(sides) if len(side.scores) and len(b.scores)]
            if usable:
                pairs = [(side, sides[k]) for k in usable]
                assignments = net(pairs, options.sinkhorn_iterations)
                for k, assignment in zip(usable, assignments, strict=True):
                    matches, scores = mutual_matches(assignment, options.match_threshold)
                    found[k] = matches.cpu().numpy(), scores.cpu().numpy()
        return found


def network_input(
    image: ImageFeatures, descriptor_size: int, where: str, device: torch.device
) -> ImageKeypoints:
    """Keypoints of an image as the network takes them; ``where`` names the weights in messages.

    Raises DataError for keypoints without scores in (0, 1], or descriptors of another size.
    """
    table = np.asarray(image.keypoints_px, dtype=np.float32)
    descriptors = np.asarray(image.descriptors, dtype=np.float32)
    if table.ndim != 2 or table.shape[1] < 3:
        raise DataError(
            f"SuperGlue takes keypoints of x, y, score; these have the shape {table.shape}"
        )
    scores = table[:, 2]
    if not ((scores > 0) & (scores <= 1)).all():
        worst = scores[~((scores > 0) & (scores <= 1))][0]
        raise DataError(
            "SuperGlue takes the detector's score as third column of the keypoints, above 0 "
            f"and up to 1; this one has {worst:g}"
        )
    if len(table) and descriptors.shape != (len(table), descriptor_size):
        raise DataError(
            f"{where} takes descriptors of {descriptor_size} dimensions, one "
            f"for each of {len(table)} keypoints; these have the shape {descriptors.shape}"
        )
    xy = torch.from_numpy(table[:, :2] - np.float32(0.5)).to(device)  # its first pixel is (0, 0)
    return ImageKeypoints(
        normalise_keypoints(xy, image.width, image.height),
        torch.from_numpy(scores.copy()).to(device),
        torch.from_numpy(np.array(descriptors, order="C")).to(device),
    )
