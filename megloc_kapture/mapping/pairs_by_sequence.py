"""Pairs of images that follow each other, for each camera by itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.mapping.pairs import unique_pairs
from megloc_kapture.values import Options


class PairsBySequenceOptions(Options):
    """Options of pairs by temporal sequence."""

    window: int = Field(default=5, gt=0, description="images that each is paired with after it")
    loop: bool = Field(default=False, description="the first image follows the last one")


def pairs_by_sequence(
    cameras: Sequence[str], timestamps: Sequence[int], options: PairsBySequenceOptions | None = None
) -> NDArray[np.int64]:
    """Pairs of each image with the next ones of its camera.

    Parameters
    ----------
    cameras, timestamps : (N,), which camera took an image and when; images of one camera at the
        same time follow each other as they are given.

    Returns
    -------
    int64 (P, 2), indices i < j, sorted, each pair once.
    """
    options = options or PairsBySequenceOptions()
    sequences: dict[str, list[int]] = {}
    for image in sorted(range(len(cameras)), key=lambda image: timestamps[image]):
        sequences.setdefault(cameras[image], []).append(image)
    found = [np.zeros((0, 2), dtype=np.int64)]
    for sequence in sequences.values():
        images = np.array(sequence, dtype=np.int64)
        for step in range(1, min(options.window, len(images) - 1) + 1):
            found.append(np.stack([images[:-step], images[step:]], axis=1))
            if options.loop:
                found.append(np.stack([images[-step:], images[:step]], axis=1))
    return unique_pairs(np.concatenate(found))
