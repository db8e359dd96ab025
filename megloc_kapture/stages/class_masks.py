"""Masks from a segmenter: the classes of an image's pixels, and which of them are ignored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError, PluginError
from megloc_kapture.plugins import Segmenter


@dataclass(frozen=True)
class ClassMasks:
    """A segmenter and the classes whose pixels are ignored, in the order of their labels."""

    segmenter: Segmenter
    dynamic: tuple[str, ...]

    @classmethod
    def of(cls, segmenter: Segmenter, dynamic: Sequence[str] | None = None) -> ClassMasks:
        """Of the classes asked for; without, of those the segmenter names itself.

        Raises
        ------
        OptionError : a class it does not have; lists those it has.
        """
        wanted = segmenter.dynamic if dynamic is None else dynamic
        unknown = sorted(set(wanted) - set(segmenter.classes))
        if unknown:
            raise OptionError(
                f"segmenter {segmenter.name!r} has no class {unknown[0]!r}; "
                f"it has: {', '.join(segmenter.classes)}"
            )
        return cls(segmenter, tuple(name for name in segmenter.classes if name in wanted))

    def labels(self, image: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
        """The label of each pixel, uint8 (H, W), of an image (H, W, 3) called ``name``.

        Raises
        ------
        PluginError : the segmenter returns something else.
        """
        found = self.segmenter.segment(image)
        shape, dtype = getattr(found, "shape", None), getattr(found, "dtype", None)
        told = ""
        if shape != image.shape[:2] or dtype != np.uint8:
            told = f"segment returned {dtype} {shape}, not uint8 {image.shape[:2]}"
        elif found.max() >= len(self.segmenter.classes):
            told = f"label {found.max()}, but there are {len(self.segmenter.classes)} classes"
        if told:
            raise PluginError(f"plugin {self.segmenter.name!r} on image {name}: {told}")
        return found

    def mask(self, labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """True where a pixel is used, bool (H, W)."""
        used = np.array([name not in self.dynamic for name in self.segmenter.classes])
        return np.asarray(used[labels])
