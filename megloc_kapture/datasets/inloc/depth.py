"""InLoc's scanned points as depth maps of the cutouts' cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.inloc_files import Cutout, read_cutout_points
from megloc_kapture.errors import DataError
from megloc_kapture.io.images import write_depth_map
from megloc_kapture.values import Camera

# the points of another image are off by a good part of its width, those of its own by little
_MAX_OFFSET = 0.03
_CHECKED_EVERY = 8  # rows and columns


@dataclass(frozen=True)
class DepthJob:
    """One depth map to make.

    Parameters
    ----------
    points : the cutout's ``.mat`` file.
    cutout : what its name says.
    camera : of the cutout's image.
    record : path of the depth map below ``records_data``.
    """

    points: Path
    cutout: Cutout
    camera: Camera
    record: str


def depth_camera(camera: Camera, step: int) -> Camera:
    """The SIMPLE_PINHOLE camera of every ``step``-th pixel of each row and column, from the first.

    The centre of a kept pixel is that of the pixel it was: (0.5, 0.5) stays where it is.
    """
    focal, cx, cy = camera.params
    return Camera(
        "SIMPLE_PINHOLE",
        -(-camera.width // step),
        -(-camera.height // step),
        (focal / step, (cx - 0.5) / step + 0.5, (cy - 0.5) / step + 0.5),
    )


def cutout_depth(job: DepthJob, step: int) -> NDArray[np.float32]:
    """Depth of a cutout's measured points along its camera's axis.

    Returns
    -------
    float32 (H, W) of :func:`depth_camera`, metres; 0 where nothing came back.

    Raises
    ------
    DataError : the file is broken, or its points are not those of this cutout.
    """
    camera = job.camera
    points = read_cutout_points(job.points, camera.width, camera.height)
    rotation = job.cutout.cam_from_scan().rotation_matrix()
    _check_place(job, points[::_CHECKED_EVERY, ::_CHECKED_EVERY] @ rotation.T)
    z = points[::step, ::step] @ rotation[2]
    return np.where(np.isfinite(z) & (z > 0), z, 0.0).astype(np.float32)


def write_depth_maps(jobs: Sequence[DepthJob], step: int, records: Path) -> None:
    """Write depth maps below ``records``, one after the other.

    Raises
    ------
    DataError : see :func:`cutout_depth`.
    OutputError : a depth map cannot be written.
    """
    for job in jobs:
        write_depth_map(records / job.record, cutout_depth(job, step))


def _check_place(job: DepthJob, in_camera: NDArray[np.float64]) -> None:
    """Refuse points that are not seen where they stand in the file."""
    focal, cx, cy = job.camera.params
    rows, columns = (np.arange(n) * _CHECKED_EVERY + 0.5 for n in in_camera.shape[:2])
    seen = np.isfinite(in_camera).all(axis=2)
    if not seen.any():
        return
    x, y, z = in_camera[seen].T
    at_x = np.broadcast_to(columns, seen.shape)[seen] - cx
    at_y = np.broadcast_to(rows[:, None], seen.shape)[seen] - cy
    with np.errstate(all="ignore"):
        offset = np.hypot(focal * x / z - at_x, focal * y / z - at_y)
    offset_px = float(np.median(np.where((z > 0) & np.isfinite(offset), offset, np.inf)))
    if offset_px > _MAX_OFFSET * job.camera.width:
        raise DataError(
            f"its points lie {offset_px:.0f} px (median) from their pixels in {job.cutout.image}: "
            "not the scan of this image",
            path=job.points,
        )
