"""pycolmap itself, and what it knows of cameras: projection, undistortion, focal lengths.

pycolmap changes its names between releases and has traps of its own (see docs/architecture.md);
this module, ``colmap.py`` and those beside it keep both away from the rest of the package.
"""

from __future__ import annotations

import signal
import tempfile
import threading
import zlib  # noqa: F401  pycolmap 4.1.1 to 4.2.1 corrupt the heap when imported before zlib
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.files import owned_name
from megloc_kapture.values import Camera


@lru_cache(maxsize=1)
def load_pycolmap() -> Any:
    """pycolmap, imported when it is first needed; for the modules of ``io`` alone."""
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    # its import takes SIGTERM over, and would end a run that is asked to end with a stack trace
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    pycolmap.logging.minloglevel = 2  # its INFO lines are no concern of our users
    return pycolmap


def new_colmap_camera(camera: Camera) -> Any:
    """COLMAP's camera; a new one, which may be written to."""
    return load_pycolmap().Camera(
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
    )


colmap_camera = lru_cache(maxsize=4096)(new_colmap_camera)


def normalized_from_px(camera: Camera, points_px: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Undistorted normalised image coordinates (x/z, y/z) of pixels; (N, 2) to (N, 2) float64."""
    points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 2)
    if len(points) == 0:
        return np.zeros((0, 2))
    return np.asarray(colmap_camera(camera).cam_from_img(points), dtype=np.float64)


def px_from_cam(camera: Camera, points_in_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of points in the camera frame; (N, 3) to (N, 2) float64, NaN behind the camera."""
    points = np.ascontiguousarray(points_in_cam, dtype=np.float64).reshape(-1, 3)
    out = np.full((len(points), 2), np.nan)
    front = points[:, 2] > 0
    if front.any():
        out[front] = colmap_camera(camera).img_from_cam(points[front])
    return out


def undistorted_pinhole(camera: Camera, *, blank_pixels: float = 0.0) -> Camera:
    """The PINHOLE camera with the same focal lengths that COLMAP undistorts an image to.

    Parameters
    ----------
    blank_pixels : 0: no pixel that the distorted image does not show; 1: all that it shows; in
        between, in between. The sides stay between 0.2 and 2 times the old ones.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = blank_pixels
    found = pycolmap.undistort_camera(options, colmap_camera(camera))
    return replace(Camera.from_colmap(found), focal_deviation=camera.focal_deviation)


def focal_from_exif(jpeg: bytes) -> float | None:
    """Focal length in pixels that COLMAP finds in the EXIF of a JPEG file; None without one."""
    pycolmap = load_pycolmap()
    with tempfile.TemporaryDirectory(prefix=f".{owned_name()}") as folder:
        path = Path(folder) / "blank.jpg"
        path.write_bytes(jpeg)
        camera = pycolmap.infer_camera_from_image(str(path))
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else None


def focal_from_matches(
    points_px: NDArray[np.float64],
    points: NDArray[np.float64],
    camera: Camera,
    max_error_px: float,
    seed: int,
) -> float | None:
    """Focal length in pixels of a camera of which the rest is known: P4Pf in a RANSAC.

    None where no pose agrees with enough matches.

    Parameters
    ----------
    points_px, points : (N, 2) and (N, 3), matched; not finite ones count as none.
    """
    usable = np.isfinite(points_px).all(axis=1) & np.isfinite(points).all(axis=1)
    if np.count_nonzero(usable) < 4:
        return None
    pycolmap = load_pycolmap()
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = True
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = seed
    changed = new_colmap_camera(camera)  # the RANSAC writes into it
    found = pycolmap.estimate_absolute_pose(points_px[usable], points[usable], changed, options)
    return None if found is None else float(changed.mean_focal_length())
