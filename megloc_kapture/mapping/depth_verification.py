"""Points of a map against the depth that a sensor measured at the same moment.

An observation says that an image sees a point. Where the image has a depth map, the point must then
lie on the surface that the sensor saw there. A surface is not known better than the sensor's noise,
and near an edge not better than to some pixels; a triangulated point not better than its images
determine it. So the point's depth is compared with the least and the greatest depth in a small
window, widened by some standard deviations of both. Where the sensor has no depth, nothing is said.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from megloc_kapture.geometry.cameras import px_from_cam
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]

# coefficients of z^0, z^1, z^2 of 0.0012 + 0.0019 (z - 0.4)^2
_STRUCTURED_LIGHT = (0.001504, -0.00152, 0.0019)


class DepthVerificationOptions(Options):
    """When a point contradicts a depth map, and what a depth sensor's noise is.

    The default noise is that of a structured-light sensor (Kinect): 0.0012 + 0.0019 (z - 0.4)^2,
    Nguyen, Izadi and Lovell, Modeling Kinect Sensor Noise for Improved 3D Reconstruction and
    Tracking, 3DIMPVT 2012, eq. 4; Khoshelham and Elberink, Sensors 12(2), 2012, find 0.0014 z^2. A
    laser scan has about ``[0.003, 0, 0]``.
    """

    max_sigmas: float | None = Field(
        default=3.0,
        gt=0,
        description="distance from the sensor's depth, in standard deviations, beyond which an "
        "observation is dropped; none: depth maps are not looked at",
    )
    noise: tuple[float, float, float] = Field(
        default=_STRUCTURED_LIGHT,
        description="a, b, c of the noise a + b z + c z^2 at depth z, in the map's unit",
    )
    keypoint_noise_px: float = Field(
        default=2.0,
        ge=0,
        description="noise of keypoints, and of poses as seen in the images: times a point's "
        "deviation, what it may be off by itself; 0: only the sensor's noise counts",
    )
    window_px: int = Field(
        default=3,
        ge=0,
        description="a point agrees with any depth that lies this near, in pixels of the depth "
        "map: allows for edges, and for what image and depth are registered by",
    )

    @field_validator("noise")
    @classmethod
    def _positive(cls, noise: tuple[float, float, float]) -> tuple[float, float, float]:
        a, b, c = noise
        # least where z = -b / 2c, if that lies before the sensor, else at the sensor itself
        lowest = a - b * b / (4.0 * c) if c > 0 and b < 0 else a
        if not np.isfinite(noise).all() or lowest <= 0 or c < 0 or (c == 0 and b < 0):
            raise ValueError("noise is not positive at every depth")
        return noise


def depth_noise(depth: Floats, noise: tuple[float, float, float]) -> Floats:
    """Standard deviation of a sensor's depth (...), in its unit, by a + b z + c z^2."""
    a, b, c = noise
    return a + depth * (b + depth * c)


def contradicted_by_depth(
    points_in_image: Floats,
    depth_m: NDArray[np.float32],
    depth_camera: Camera,
    image_from_depth: RigidTransform,
    options: DepthVerificationOptions | None = None,
    *,
    deviations: Floats | None = None,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points do not lie where a depth map has a surface.

    Parameters
    ----------
    points_in_image : float64 (N, 3) in the image camera's frame, metres.
    depth_m : float32 (H, W) along the depth camera's axis, 0 or less or not finite where unknown.
    image_from_depth : from the depth camera's frame to the image camera's, metres.
    deviations : float64 (N,), standard deviations of the points along the depth camera's axis for a
        noise of 1 px; NaN where unknown, which counts as none.

    Returns
    -------
    contradicted : bool (N,); never where there is no depth.
    checked : bool (N,), where there is depth to compare with.
    """
    options = options or DepthVerificationOptions()
    points = image_from_depth.inverse().apply(np.asarray(points_in_image, np.float64))
    contradicted, checked = np.zeros(len(points), bool), np.zeros(len(points), bool)
    if options.max_sigmas is None or not len(points):
        return contradicted, checked
    height, width = depth_m.shape
    pixels = px_from_cam(depth_camera, points)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    rows = np.flatnonzero(inside)
    # the centre of the first pixel is (0.5, 0.5): the whole part is the pixel
    column, line = np.floor(pixels[rows]).astype(np.int64).T
    reach = np.arange(-options.window_px, options.window_px + 1)
    columns = np.clip(column[:, None, None] + reach[None, None, :], 0, width - 1)
    lines = np.clip(line[:, None, None] + reach[None, :, None], 0, height - 1)
    window = depth_m[lines, columns].reshape(len(rows), len(reach) ** 2).astype(np.float64)
    known = np.isfinite(window) & (window > 0)
    # beside a hole the surface may be the one that the sensor has not seen
    whole = known.all(axis=1)
    rows, window = rows[whole], window[whole]
    z, low, high = points[rows, 2], window.min(axis=1), window.max(axis=1)
    own = np.zeros(len(rows)) if deviations is None else np.nan_to_num(deviations[rows])
    own = own * options.keypoint_noise_px
    checked[rows] = True
    contradicted[rows] = z < low - options.max_sigmas * np.hypot(
        depth_noise(low, options.noise), own
    )
    contradicted[rows] |= z > high + options.max_sigmas * np.hypot(
        depth_noise(high, options.noise), own
    )
    return contradicted, checked
