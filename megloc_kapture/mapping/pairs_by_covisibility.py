"""Pairs of images that observe the same points of a map."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.mapping.chunks import in_chunks
from megloc_kapture.mapping.pairs import each_once, unique_pairs
from megloc_kapture.values import Options

# of a point that more images than this see, an image counts only those that near it
_TRACK_WINDOW = 512
_CHUNK = 256  # images; each is worked out by itself, so that chunks change nothing


class PairsByCovisibilityOptions(Options):
    """Options of pairs by co-visibility."""

    top_k: int = Field(default=20, gt=0, description="images taken that share most points")
    min_shared_points: int = Field(default=15, gt=0, description="points both images observe")


def pairs_by_covisibility(
    num_images: int,
    point_ids: NDArray[np.integer[Any]],
    image_ids: NDArray[np.integer[Any]],
    options: PairsByCovisibilityOptions | None = None,
) -> NDArray[np.int64]:
    """Pairs of each image with those that share most points with it; of equals the first.

    The sparse product of the observations with themselves, row by row, of which only the best of
    each row are kept. Its time is the number of observations times the length of a track, which is
    bounded: of a point that very many images see, an image counts as seeing it only the 512 before
    and the 512 after it in the order of the images.

    Parameters
    ----------
    point_ids, image_ids : (O,), the observations; in any order, repeated ones count once.

    Returns
    -------
    int64 (P, 2), indices i < j, sorted, each pair once.
    """
    from megloc_kapture.mapping import pairs_kernels

    options = options or PairsByCovisibilityOptions()
    if len(point_ids) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    # an observation in one number, sorted by point, then image
    keys = each_once(np.asarray(point_ids, dtype=np.int64) * num_images + image_ids)
    points, images = np.divmod(keys, num_images)
    track_ends = np.flatnonzero(np.append(points[1:] != points[:-1], True)) + 1
    track = np.repeat(np.arange(len(track_ends)), np.diff(track_ends, prepend=0))
    track_starts = np.append(0, track_ends)
    of_image = np.argsort(images, kind="stable")
    starts = np.append(0, np.cumsum(np.bincount(images, minlength=num_images)))
    best = np.full((num_images, options.top_k), -1, dtype=np.int64)
    arguments = (starts, of_image, images, track, track_starts, _TRACK_WINDOW)
    in_chunks(
        num_images,
        _CHUNK,
        lambda first, last: pairs_kernels.most_shared(
            first, last, *arguments, options.min_shared_points, best
        ),
    )
    rows, columns = np.nonzero(best >= 0)
    return unique_pairs(np.stack([rows, best[rows, columns]], axis=1))
