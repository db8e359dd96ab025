"""The depth maps of a map as one cloud: every surface once, from the image that comes first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.ply import write_ply
from megloc_kapture.io.tables import read_depth_rows
from megloc_kapture.mvs.consistency import AgreementOptions, agreeing_views
from megloc_kapture.mvs.views import pinhole_matrix, stereo_view
from megloc_kapture.plugins import StereoView
from megloc_kapture.stages.densifying import DEPTH_FILE, read_sigma, side_file
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.stages.rigs import depth_records
from megloc_kapture.stages.work import HERE, FolderSpec, Work


@dataclass(frozen=True)
class _Job:
    folder: FolderSpec
    image: str
    earlier: tuple[str, ...]
    agreement: AgreementOptions


def fuse_depth(
    densified: KaptureFolder, cloud: Path, agreement: AgreementOptions, *, work: Work = HERE
) -> int:
    """Write the depth maps of :mod:`.densifying` as a PLY cloud with normals and deviations.

    A pixel is left out where one of the sources that come before its image, by name, agrees with
    it: its surface is in the cloud.

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
    rows = {row.image: row for row in read_depth_rows(path) if not row.reason}
    spec = FolderSpec(densified)
    jobs = [
        _Job(spec, image, tuple(o for o in row.sources if o < image and o in rows), agreement)
        for image, row in sorted(rows.items())
    ]
    parts = list(work.map(_points, jobs, "cloud"))
    xyz, colours, normals, sigma = (
        np.concatenate([np.zeros(shape), *column])
        for shape, column in zip(
            ((0, 3), (0, 3), (0, 3), (0,)), zip(*parts, strict=True), strict=True
        )
    )
    nx, ny, nz = normals.T
    write_ply(cloud, xyz, colours, nx=nx, ny=ny, nz=nz, deviation=sigma)
    return len(xyz)


def _points(job: _Job) -> tuple[NDArray[np.float64], ...]:
    folder = job.folder.open()
    view, depth = _view_with_depth(folder, job.image)
    others = [_view_with_depth(folder, other) for other in job.earlier]
    new = (depth > 0) & (agreeing_views(view, depth, others, job.agreement) == 0)
    rows, columns = np.nonzero(new)
    pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1)
    in_camera = pixels @ np.linalg.inv(pinhole_matrix(view.camera)).T * depth[new][:, None]
    normals = np.load(side_file(folder.root, job.image, "normals"), allow_pickle=False)[new] / 127.0
    sigma = read_sigma(folder.root, job.image)
    return (
        view.cam_from_world.inverse().apply(in_camera),
        view.image[new].astype(np.float64),
        normals @ view.cam_from_world.rotation_matrix(),
        np.zeros(len(rows)) if sigma is None else sigma[new].astype(np.float64),
    )


def _view_with_depth(folder: KaptureFolder, image: str) -> tuple[StereoView, NDArray[np.float32]]:
    data = folder.read()
    record = depth_records(data)[image]
    size = record.camera.width, record.camera.height
    pixels = read_image_of(folder.image_path(image), data.camera_of(image))
    view = stereo_view(pixels, data.camera_of(image), data.poses()[image], None, max(size))
    depth = read_depth_map(folder.depth_path(record.path), width=size[0], height=size[1])
    return view, depth
