"""Image distance ``structure``: locally normalised correlation, which needs no weights."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.values import Options

_NOISE_VARIANCE = 9.0  # grey levels squared: what varies less is no structure
_MIN_FILLED = 0.5  # of a window, the share that must be valid

Float32 = NDArray[np.float32]


class StructureOptions(Options):
    """Options of the image distance ``structure``."""

    window: float = Field(
        default=0.02,
        gt=0,
        le=0.5,
        description="deviation of the Gaussian windows, share of the image's longer side",
    )


class StructureDistance:
    """Plugin ``structure``: one minus the local correlation of two images' brightness.

    The correlation is SSIM's structure term with its contrast (Wang et al., "Image quality
    assessment", IEEE TIP 2004, eq. 10): in a window, ``(cov + c) / (s_a s_b + c)``. Means and
    deviations are the window's own, so that neither exposure nor shading counts. Windows are taken
    of the valid pixels alone.
    """

    name = "structure"
    Options = StructureOptions

    def __init__(self, options: StructureOptions | None = None) -> None:
        self.options = options or StructureOptions()

    def distance(
        self, a: NDArray[np.uint8], b: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> float:
        """Distance of two RGB images uint8 (H, W, 3) over the valid pixels (H, W), 0 to 2.

        Infinite where no window is at least half valid.
        """
        sigma = self.options.window * max(valid.shape)
        weight = valid.astype(np.float32)

        def blurred(values: Float32) -> Float32:
            # beyond the border nothing is valid
            found = cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
            return np.asarray(found, np.float32)

        filled = blurred(weight)
        used = valid & (filled >= _MIN_FILLED)
        if not used.any():
            return float("inf")
        filled = np.maximum(filled, np.float32(1e-6))
        grey_a, grey_b = (_grey(image, valid) for image in (a, b))

        def mean(values: Float32) -> Float32:
            return np.asarray(blurred(values * weight) / filled)

        mean_a, mean_b = mean(grey_a), mean(grey_b)
        variance_a = np.maximum(mean(grey_a * grey_a) - mean_a * mean_a, 0.0)
        variance_b = np.maximum(mean(grey_b * grey_b) - mean_b * mean_b, 0.0)
        covariance = mean(grey_a * grey_b) - mean_a * mean_b
        alike = (covariance + _NOISE_VARIANCE) / (
            np.sqrt(variance_a * variance_b) + _NOISE_VARIANCE
        )
        return max(0.0, float((1.0 - alike[used].astype(np.float64)).mean()))


def _grey(image: NDArray[np.uint8], valid: NDArray[np.bool_]) -> Float32:
    """Brightness float32 (H, W), about zero: squares then lose no digits."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(grey - grey[valid].mean(), np.float32)
