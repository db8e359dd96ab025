"""Local features by networks: images one by one or several at once, the best of their keypoints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.image_bound import BoundedOptions
from megloc_kapture.nets.runtime import Checkpointed, NetworkOptions
from megloc_kapture.nets.score_maps import select_keypoints
from megloc_kapture.values import LocalFeatures

Images = Sequence[NDArray[np.uint8]]
Masks = Sequence[NDArray[np.bool_] | None]
Level = tuple[NDArray[np.float32], NDArray[np.float32], torch.Tensor]
"""Keypoints (N, 3), scores (N,) and descriptors (N, D) of one scale of an image."""


class LocalNetworkOptions(NetworkOptions, BoundedOptions):
    """Options that networks of local features share."""

    weights: str
    max_keypoints: int = Field(default=1500, gt=0, description="best scores kept")


LocalOptions = TypeVar("LocalOptions", bound=LocalNetworkOptions)


class LocalNetwork(Checkpointed[LocalOptions], ABC):
    """Local features by a network."""

    descriptor_dtype = "float32"
    metric = "L2"

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image, uint8 (H, W, 3).

        Keypoints on False pixels of the mask (H, W) are removed after non-maximum suppression,
        before the best are selected. Raises DataError where the checkpoint does not fit,
        OptionError where the device is not there.
        """
        return self.extract_many([image], [mask])[0]

    @abstractmethod
    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        """Extract from RGB images of one size, in one batch; see :meth:`extract`.

        As one by one but for rounding.
        """

    def _best(
        self,
        table: NDArray[np.float32],
        scores: NDArray[np.float32],
        describe: Callable[[torch.Tensor], torch.Tensor],
        size: tuple[int, ...],
        mask: NDArray[np.bool_] | None,
    ) -> LocalFeatures:
        """The best of an image's keypoints (N, 3): x and y in its pixels, and a third column.

        ``describe`` gives descriptors (K, D) of rows of the table; ``size`` is (H, W) and perhaps
        more.
        """
        rows, num_masked = select_keypoints(
            table[:, :2],
            scores,
            size=(size[0], size[1]),
            mask=mask,
            max_keypoints=self.options.max_keypoints,
        )
        descriptors = describe(torch.from_numpy(rows)).cpu().numpy()
        return LocalFeatures(table[rows], scores[rows], descriptors, num_masked)

    def _best_of_levels(
        self, levels: Sequence[Level], size: tuple[int, ...], mask: NDArray[np.bool_] | None
    ) -> LocalFeatures:
        """The same of the keypoints of several scales."""
        tables, scores, descriptors = zip(*levels, strict=True)
        rows_of = torch.cat(descriptors).cpu().__getitem__
        return self._best(np.concatenate(tables), np.concatenate(scores), rows_of, size, mask)
