"""Whether a query is a mirror image: the same features, matched as they are and reflected.

The scene in a mirror looks like itself: of a symmetric facade or a room hundreds of features match
their like on the other side, and their pose fits nearly as well as a right one. But reflected back
the image matches far better, and an image that is not mirrored far worse.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.plugins import RankingScene

# small images are enough to tell, and quick
_LARGER_SIDE_PX, _MAX_FEATURES = 480, 1000
_MAX_RATIO = 0.7
# map images that are looked at: so many that agree most with the pose, and as many of the others;
# and by how many deviations of their sum counts differ that decide
_OF_EACH, _DECIDED = 4, 4.0
Float32 = NDArray[np.float32]


def reflected(descriptors: Float32) -> Float32:
    """SIFT descriptors (N, 128) of a mirrored image, by those of the image; each its own inverse.

    A descriptor is a grid of 4 x 4 histograms of 8 directions that is turned to the keypoint's own
    (Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004, section 6.1). A
    reflection across that direction swaps the rows of the grid, and turns to minus each direction.
    """
    grid = descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
    return np.ascontiguousarray(grid[..., (8 - np.arange(8)) % 8]).reshape(-1, 128)


def mirror_matches(
    queries: Iterable[tuple[str, Sequence[str]]], scene: RankingScene
) -> tuple[int, int]:
    """How many features match a map image as they are, and how many reflected: of the best each.

    Map images are looked at until one of the two is clearly more, at most 8: the four that agree
    most with the pose, and four spread over the others. In a mirror the first of a symmetric facade
    show its other side, from where it looks as different reflected as not.

    Parameters
    ----------
    queries : query images that are mirrored all or none, with map images each, those that agree
        most with its pose first. What has no pixels counts nothing.
    """
    as_it_is = mirrored = 0
    for query, images in queries:
        found = _best_matches(query, images, scene)
        as_it_is, mirrored = as_it_is + found[0], mirrored + found[1]
    return as_it_is, mirrored


def is_mirrored(as_it_is: int, mirrored: int) -> bool:
    """Whether clearly more features match reflected than as they are."""
    return mirrored > as_it_is and _decided(as_it_is, mirrored)


def chance_of(as_it_is: int, mirrored: int) -> float:
    """The probability that so many more match reflected where either way is as likely, 0 to 1."""
    from scipy.special import bdtrc

    return float(bdtrc(mirrored - 1, as_it_is + mirrored, 0.5))


def _best_matches(query: str, images: Sequence[str], scene: RankingScene) -> tuple[int, int]:
    best = np.zeros(2, np.int64)
    first, others = images[:_OF_EACH], images[_OF_EACH:]
    try:
        own = _descriptors(scene.query_image(query))
        ways = own, reflected(own)
        for image in (*first, *others[:: max(1, math.ceil(len(others) / _OF_EACH))]):
            other = _descriptors(scene.map_image(image))
            best = np.maximum(best, [_num_matches(way, other) for way in ways])
            if _decided(*best.tolist()):
                break
    except DataError:
        pass
    return int(best[0]), int(best[1])


def _decided(as_it_is: int, mirrored: int) -> bool:
    return abs(as_it_is - mirrored) > _DECIDED * math.sqrt(as_it_is + mirrored)


def _descriptors(pixels: NDArray[np.uint8]) -> Float32:
    share = min(1.0, _LARGER_SIDE_PX / max(pixels.shape[:2]))
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    if share < 1:
        size = [max(round(side * share), 1) for side in grey.shape[::-1]]
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    # without precise upscaling the first octave is shifted to one side
    sift = cv2.SIFT.create(_MAX_FEATURES, contrastThreshold=0.02, enable_precise_upscale=True)
    found = sift.detectAndCompute(grey, None)[1]
    return np.zeros((0, 128), np.float32) if found is None else np.asarray(found, np.float32)


def _num_matches(a: Float32, b: Float32) -> int:
    """Features of b that are the clear nearest of one of a."""
    if len(a) < 2 or len(b) < 2:
        return 0
    nearest = cv2.BFMatcher.create(cv2.NORM_L2).knnMatch(a, b, k=2)
    return len(
        {best.trainIdx for best, second in nearest if best.distance < _MAX_RATIO * second.distance}
    )
