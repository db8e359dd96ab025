"""Whether matches that agree with a two-view model do so by chance.

Of matches that are all wrong some lie near the epipolar lines of any model, and RANSAC finds the
model with most of them. The number of false alarms (Moisan and Stival, A probabilistic criterion to
detect rigid point matches between two images, IJCV 2004) is how many models as good as this one are
expected among wrong matches.
"""

from __future__ import annotations

import math

from scipy.special import gammaln
from scipy.stats import binom

from megloc_kapture.values import Camera

_SAMPLE = 5  # matches that a relative pose of calibrated cameras is made of
_MAX_FALSE_ALARMS = 1e-3


def agree_by_chance(
    num_inliers: int, num_matches: int, camera: Camera, other: Camera, max_error_px: float
) -> bool:
    """Whether wrong matches of two images may agree with a relative pose as well as these do.

    Parameters
    ----------
    num_inliers, num_matches : within a Sampson error of ``max_error_px``, and altogether.
    """
    if num_inliers <= _SAMPLE:
        return True
    # a wrong match falls anywhere in the image: the share of it that is near a line; a Sampson
    # error is of both images together
    near = max(
        2 * math.sqrt(2) * max_error_px * math.hypot(c.width, c.height) / (c.width * c.height)
        for c in (camera, other)
    )
    samples = gammaln(num_matches + 1) - gammaln(num_matches - _SAMPLE + 1) - gammaln(_SAMPLE + 1)
    tail = binom.logsf(num_inliers - _SAMPLE - 1, num_matches - _SAMPLE, min(near, 1.0))
    return bool(samples + tail > math.log(_MAX_FALSE_ALARMS))
