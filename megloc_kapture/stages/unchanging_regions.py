"""The unchanging region of each camera of a kapture, from its images along their sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.preprocessing.masks import (
    MAX_IMAGES,
    MIN_IMAGES,
    UnchangingRegion,
    edge_directions,
    find_unchanging_region,
)
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera


@dataclass(frozen=True)
class _Job:
    path: Path
    camera: Camera


def find_unchanging_regions(
    folder: KaptureFolder,
    sequences: Sequence[KaptureFolder] = (),
    *,
    work: Work = HERE,
) -> dict[str, UnchangingRegion]:
    """The region of every camera of a folder, by sensor id; falsy with a reason where none is.

    Parameters
    ----------
    sequences : folders whose images tell of its cameras as well, where they have a sensor of the
        same id and image size: the map's, for queries.

    Raises
    ------
    DataError : an image is absent, unreadable, or not of its camera's size.
    """
    data = folder.read()
    sensors = sorted({sensor for _, sensor in data.records_camera})
    chosen: dict[str, list[_Job]] = {}
    regions: dict[str, UnchangingRegion] = {}
    for sensor in sensors:
        jobs = _images_of(sensor, [folder, *sequences])
        if len(jobs) < MIN_IMAGES:
            regions[sensor] = UnchangingRegion(
                (), f"it has {len(jobs)} images, and at least {MIN_IMAGES} of a sequence are needed"
            )
        else:
            picked = np.linspace(0, len(jobs) - 1, min(len(jobs), MAX_IMAGES)).round().astype(int)
            chosen[sensor] = [jobs[k] for k in picked]
    everything = [job for jobs in chosen.values() for job in jobs]
    results = iter(work.map(_edges, everything, "unchanging regions"))
    for sensor, jobs in chosen.items():
        regions[sensor] = find_unchanging_region(next(results) for _ in jobs)
    # lets a progress bar see its end
    for _ in results:
        pass
    return regions


def _images_of(sensor: str, folders: Sequence[KaptureFolder]) -> list[_Job]:
    """Images of a sensor in the order they were taken, folder by folder."""
    jobs: list[_Job] = []
    for folder in folders:
        data = folder.read()
        if sensor not in data.sensors or data.sensors[sensor].sensor_type != "camera":
            continue
        taken = sorted((t, image) for (t, s), image in data.records_camera.items() if s == sensor)
        for _, image in taken:
            camera = data.camera_of(image)
            if not jobs or _size(camera) == _size(jobs[0].camera):
                jobs.append(_Job(folder.image_path(image), camera))
    return jobs


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def _edges(job: _Job) -> NDArray[np.float32]:
    return edge_directions(read_image_of(job.path, job.camera))
