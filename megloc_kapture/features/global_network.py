"""What the global features of image networks share: a checkpoint, and a name that tells it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.weights import find_weights, sha256_of


class GlobalNetwork(ABC):
    """A plugin of group ``megloc_kapture.global_features`` with a checkpoint.

    Parameters
    ----------
    method : the name of the method; the type's name carries the model as well, since vectors of
        different ones cannot be compared.
    weights : name in the registry, or a file.

    Raises
    ------
    MissingWeightsError : the checkpoint is not there.
    """

    def __init__(self, method: str, weights: str) -> None:
        self._weights = find_weights(weights)
        stem = Path(self._weights.name.removesuffix(".gz")).stem
        self.name = stem if method in stem else f"{method}-{stem}"

    def weights(self) -> dict[str, str]:
        """sha256 of the checkpoint by its file's name."""
        return {self._weights.path.name: sha256_of(self._weights)}

    def describe(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The vector of an RGB image, uint8 (H, W, 3): float32 (D,), unit length.

        Raises
        ------
        DataError : the checkpoint does not fit, or the image is too small.
        OptionError : the device is not there.
        """
        return self.describe_many([image])[0]

    @abstractmethod
    def describe_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The vectors of images of one size, float32 (B, D); raises as :meth:`describe`."""
