"""Base of networks for local features, with batches and keypoint selection."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.image_bound import BoundedOptions, on_mask
from megloc_kapture.nets.runtime import Checkpointed, NetworkOptions
from megloc_kapture.values import LocalFeatures

Images = Sequence[NDArray[np.uint8]]
Masks = Sequence[NDArray[np.bool_] | None]
Level = tuple[NDArray[np.float32], NDArray[np.float32], torch.Tensor]
"""Keypoints (N, 3), scores (N,) and descriptors (N, D) of one scale of an image."""


class LocalNetworkOptions(NetworkOptions, BoundedOptions):
    weights: str
    max_keypoints: int = Field(default=1500, gt=0, description="number of best keypoints kept")


LocalOptions = TypeVar("LocalOptions", bound=LocalNetworkOptions)


class LocalNetwork(Checkpointed[LocalOptions], ABC):
    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image, uint8 (H, W, 3).

        Keypoints on False pixels of the mask (H, W) are removed after non-maximum suppression,
        before the best are selected.
        """
        return self.extract_many([image], [mask])[0]

    @abstractmethod
    def extract_many(self, images: Images, masks: Masks) -> list[LocalFeatures]:
        """Batch :meth:`extract` over RGB images of equal size; results are equal up to rounding."""

    def _best(
        self,
        table: NDArray[np.float32],
        scores: NDArray[np.float32],
        describe: Callable[[torch.Tensor], torch.Tensor],
        mask: NDArray[np.bool_] | None,
    ) -> LocalFeatures:
        """Apply the mask and select the best keypoints (N, 3); ties are sorted by y, then x."""
        x, y = table[:, 0], table[:, 1]
        usable = np.arange(len(table))
        if mask is not None:
            usable = np.flatnonzero(on_mask(mask, table[:, :2]))
        order = np.lexsort((x[usable], y[usable], -scores[usable]))
        rows = usable[order[: self.options.max_keypoints]]
        descriptors = describe(torch.from_numpy(rows)).cpu().numpy()
        return LocalFeatures(table[rows], scores[rows], descriptors, len(table) - len(usable))

    def _best_of_levels(
        self, levels_of: Sequence[Sequence[Level]], masks: Masks
    ) -> list[LocalFeatures]:
        features = []
        for levels, mask in zip(levels_of, masks, strict=True):
            tables, scores, descriptors = zip(*levels, strict=True)
            rows_of = torch.cat(descriptors).cpu().__getitem__
            features.append(
                self._best(np.concatenate(tables), np.concatenate(scores), rows_of, mask)
            )
        return features


def in_image_px(
    xy: NDArray[Any], size: Sequence[int], image_size: Sequence[int]
) -> NDArray[np.float32]:
    """Convert positions (N, 2) in a score map to image pixels.

    The centre of the first pixel is (0, 0) in the map, (0.5, 0.5) in the image.
    """
    ratio = np.array([image_size[1] / size[1], image_size[0] / size[0]])
    return ((xy + 0.5) * ratio).astype(np.float32)
