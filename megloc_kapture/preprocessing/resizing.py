"""Images of another size, and the cameras that took them.

COLMAP puts the corner of the first pixel at (0, 0). Scaling an image therefore multiplies pixel
coordinates, focal lengths and principal point by the same factors and adds nothing; and what is
cut off at the right and at the bottom moves nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, ONE_FOCAL_MODELS, Camera

# the model with two focal lengths that has each one's distortion among its own, in the same order
_TWO_FOCAL_MODEL = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
}


def fitted_size(
    width: int, height: int, max_size_px: int, *, upscale: bool = False
) -> tuple[int, int]:
    """Size whose larger side is ``max_size_px``, the ratio kept as whole pixels allow.

    Parameters
    ----------
    upscale : enlarge smaller images too, which adds pixels but nothing that can be seen.
    """
    larger = max(width, height)
    if larger <= max_size_px and not upscale:
        return width, height
    # in whole numbers, half up: no rounding of a float can make two machines differ
    smaller = max(1, (2 * min(width, height) * max_size_px + larger) // (2 * larger))
    return (max_size_px, smaller) if width >= height else (smaller, max_size_px)


def cropped_size(width: int, height: int, multiple_of: int) -> tuple[int, int]:
    """The largest size within an image both of whose sides are multiples of a number.

    Raises
    ------
    OptionError : a side is smaller than that number.
    """
    if min(width, height) < multiple_of:
        raise OptionError(
            f"an image of {width}x{height} cannot be cropped to multiples of {multiple_of}"
        )
    return width - width % multiple_of, height - height % multiple_of


def with_two_focals(camera: Camera) -> Camera:
    """The same camera in a model with two focal lengths; itself where it has them already."""
    if camera.model not in ONE_FOCAL_MODELS:
        return camera
    model = _TWO_FOCAL_MODEL[camera.model]
    params = (camera.params[0], *camera.params)
    rest = (0.0,) * (CAMERA_MODEL_NUM_PARAMS[model] - len(params))
    return replace(camera, model=model, params=params + rest)


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The camera of an image that was resized as a whole to ``width`` x ``height``.

    Rounded to whole pixels the two sides may be scaled differently; a model with one focal
    length then becomes the one with two that has the same distortion.
    """
    scale_x, scale_y = width / camera.width, height / camera.height
    # compared as whole numbers: equal ratios may round to different floats
    if width * camera.height != height * camera.width:
        camera = with_two_focals(camera)
    else:
        scale_y = scale_x
    if camera.model in ONE_FOCAL_MODELS:
        focal, cx, cy, *distortion = camera.params
        params = (focal * scale_x, cx * scale_x, cy * scale_y, *distortion)
    else:
        fx, fy, cx, cy, *distortion = camera.params
        params = (fx * scale_x, fy * scale_y, cx * scale_x, cy * scale_y, *distortion)
    return Camera(camera.model, width, height, params)


def resized(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """The image (H, W, ...) scaled as a whole to ``height`` x ``width``.

    Smaller pixels are the means of what they cover, so that nothing is aliased; larger ones are
    interpolated by cubics.
    """
    import cv2

    old_height, old_width = image.shape[:2]
    if (old_width, old_height) == (width, height):
        return image
    shrinks = width <= old_width and height <= old_height
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation))
