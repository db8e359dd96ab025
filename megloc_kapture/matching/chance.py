"""Whether matches that agree with a two-view model do so by chance.

Of matches that are all wrong some lie near the epipolar lines of any model, and RANSAC finds the
model with most of them. The number of false alarms (Moisan and Stival, A probabilistic criterion to
detect rigid point matches between two images, IJCV 2004) is how many models as good as this one are
expected among wrong matches. There a wrong match falls anywhere in the image; but keypoints stand
where the texture is, and wrong matches are of things that look alike. How often a wrong match is
near its line is therefore counted, on the keypoints themselves: each with the others' partners. Few
keypoints tell little of that, so it is never taken to be less than anywhere.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from scipy.stats import binom

from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.matching.verification import (
    TwoViewOptions,
    ray_slopes,
    relative_pose,
    sampson_error_px,
)
from megloc_kapture.values import Camera

_SAMPLE = 5  # matches that a relative pose of calibrated cameras is made of
# shares of the verification's threshold: the most telling one counts, as in that paper
_THRESHOLDS = (1.0, 0.5, 0.25)
# matches of one thing in two images are not independent of each other, so few must be expected
_MAX_FALSE_ALARMS = 1e-10
_MAX_WRONG_PAIRS = 20_000


def agree_by_chance(
    keypoints_a_px: NDArray[np.floating[Any]],
    camera_a: Camera,
    keypoints_b_px: NDArray[np.floating[Any]],
    camera_b: Camera,
    num_matches: int,
    options: TwoViewOptions,
) -> bool:
    """Whether wrong matches of two images may agree with a relative pose as well as these do.

    Parameters
    ----------
    keypoints_a_px, keypoints_b_px : (N, 2), the matches that two-view verification kept.
    num_matches : of which it kept them.
    options : of that verification.
    """
    number = len(keypoints_a_px)
    if number <= max(_SAMPLE, options.min_matches - 1):
        return True
    rays_a = bearing_rays(camera_a, keypoints_a_px)
    rays_b = bearing_rays(camera_b, keypoints_b_px)
    focal = 0.5 * (focal_px(camera_a) + focal_px(camera_b))
    b_from_a = relative_pose(rays_a, rays_b, focal, options)
    if b_from_a is None:
        return True
    slopes_a = ray_slopes(camera_a, keypoints_a_px, rays_a)
    slopes_b = ray_slopes(camera_b, keypoints_b_px, rays_b)

    def errors_px(a: NDArray[np.integer[Any]], b: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
        return sampson_error_px(rays_a[a], slopes_a[a], rays_b[b], slopes_b[b], b_from_a)

    rows = np.arange(number)
    right_px = errors_px(rows, rows)
    num_shifts = min(number - 1, max(1, _MAX_WRONG_PAIRS // number))
    shifts = 1 + (np.arange(num_shifts) * (number - 1)) // num_shifts
    wrong_px = errors_px(np.tile(rows, num_shifts), ((rows + shifts[:, None]) % number).reshape(-1))
    samples = gammaln(num_matches + 1) - gammaln(num_matches - _SAMPLE + 1) - gammaln(_SAMPLE + 1)
    for share in _THRESHOLDS:
        threshold_px = share * options.max_error_px
        # a wrong match that falls anywhere in the image; a Sampson error is of both together
        anywhere = max(
            2 * math.sqrt(2) * threshold_px * math.hypot(c.width, c.height) / (c.width * c.height)
            for c in (camera_a, camera_b)
        )
        near = min(1.0, max(anywhere, float((wrong_px <= threshold_px).mean())))
        agreeing = int((right_px <= threshold_px).sum())
        tail = binom.logsf(agreeing - _SAMPLE - 1, num_matches - _SAMPLE, near)
        if samples + tail + math.log(len(_THRESHOLDS)) <= math.log(_MAX_FALSE_ALARMS):
            return False
    return True
