"""The depth maps of a map as one cloud: every surface once, from the image that comes first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder, write_ply
from megloc_kapture.mvs.views import AgreementOptions, agreeing_views, pinhole_matrix, stereo_view
from megloc_kapture.plugins import StereoView
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.stages.rigs import depth_records
from megloc_kapture.stages.stereo_depth import (
    DEPTH_FILE,
    read_beside,
    read_stereo_depth,
    stereo_images,
)
from megloc_kapture.stages.work import HERE, FolderSpec, Work


class Cloud(NamedTuple):
    """Points of depth maps in the world: coordinates (N, 3), colours (N, 3) from 0 to 255, unit
    normals (N, 3), standard deviations (N,), and the rows of their images (N,), all float64."""

    xyz: NDArray[np.float64]
    colours: NDArray[np.float64]
    normals: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    image_ids: NDArray[np.float64]


@dataclass(frozen=True)
class _Job:
    folder: FolderSpec
    row: int
    image: str
    earlier: tuple[str, ...]
    agreement: AgreementOptions
    share: float


def fused_cloud(
    densified: KaptureFolder,
    images: dict[str, tuple[str, ...]],
    agreement: AgreementOptions,
    *,
    max_points: int | None = None,
    work: Work = HERE,
) -> Cloud:
    """The depth maps of images as one cloud.

    A pixel is left out where one of the sources that come before its image, by name, agrees with
    it: its surface is in the cloud.

    Parameters
    ----------
    images : some of :func:`stereo_images`.
    max_points : about so many pixels are looked at, the same ones each time; None: all.

    Raises
    ------
    DataError : something is broken; names the file.
    """
    spec, records = FolderSpec(densified), depth_records(densified.read())
    cameras = [records[image].camera for image in images if image in records]
    total = sum(camera.width * camera.height for camera in cameras)
    share = 1.0 if max_points is None else min(1.0, max_points / max(total, 1))
    jobs = [
        _Job(spec, row, image, tuple(o for o in own if o < image and o in images), agreement, share)
        for row, (image, own) in enumerate(images.items())
    ]
    parts = list(work.map(_points, jobs, "cloud"))
    nothing = Cloud(*(np.zeros(shape) for shape in ((0, 3), (0, 3), (0, 3), (0,), (0,))))
    return Cloud(*(np.concatenate(column) for column in zip(nothing, *parts, strict=True)))


def fuse_depth(
    densified: KaptureFolder, cloud: Path, agreement: AgreementOptions, *, work: Work = HERE
) -> int:
    """Write the depth maps of :mod:`.densifying` as a PLY cloud with normals and deviations.

    Returns
    -------
    Number of points.

    Raises
    ------
    DataError : no densified map, or something broken; names the file.
    """
    path = densified.root / DEPTH_FILE
    if not path.is_file():
        raise DataError("no densified map: reconstruction/depth.csv is missing", path=path)
    found = fused_cloud(densified, stereo_images(densified), agreement, work=work)
    nx, ny, nz = found.normals.T
    write_ply(cloud, found.xyz, found.colours, nx=nx, ny=ny, nz=nz, deviation=found.sigma_m)
    return len(found.xyz)


def _points(job: _Job) -> Cloud:
    folder = job.folder.open()
    view, depth = _view_with_depth(folder, job.image)
    others = [_view_with_depth(folder, other) for other in job.earlier]
    new = (depth > 0) & (agreeing_views(view, depth, others, job.agreement) == 0)
    if job.share < 1:
        new &= np.random.default_rng(job.row).random(new.shape) < job.share
    rows, columns = np.nonzero(new)
    pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1)
    in_camera = pixels @ np.linalg.inv(pinhole_matrix(view.camera)).T * depth[new][:, None]
    sigma = read_beside(folder.root, job.image, "sigma")
    normals = read_beside(folder.root, job.image, "normals")
    if sigma is None or normals is None or not sigma.shape == normals.shape[:2] == depth.shape:
        raise DataError(
            f"no deviations and normals of {job.image}, of the size of its depth", path=folder.root
        )
    return Cloud(
        view.cam_from_world.inverse().apply(in_camera),
        view.image[new].astype(np.float64),
        normals[new].astype(np.float64) @ view.cam_from_world.rotation_matrix(),
        sigma[new].astype(np.float64),
        np.full(len(rows), float(job.row)),
    )


def _view_with_depth(folder: KaptureFolder, image: str) -> tuple[StereoView, NDArray[np.float32]]:
    data = folder.read()
    record = depth_records(data)[image]
    pixels = read_image_of(folder.image_path(image), data.camera_of(image))
    longer = max(record.camera.width, record.camera.height)
    view = stereo_view(pixels, data.camera_of(image), data.poses()[image], None, longer)
    return view, read_stereo_depth(folder, record)
