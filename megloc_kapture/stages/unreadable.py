"""Queries whose image cannot be used: set aside at import, failed with the reason in the end.

One broken photograph must not end the run of all others, and must not be forgotten either: it
stands in ``status.csv`` and counts as a miss.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import read_unreadable, write_unreadable
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.stages.work import FolderSpec, Work
from megloc_kapture.values import Failure


def set_aside_unreadable(query: Path, tables: Path, work: Work) -> Mapping[str, str]:
    """Take images that cannot be read out of a workspace's queries; returns why, by name.

    Their names and reasons go to ``tables``; the image files stay as they are.

    Parameters
    ----------
    query : kapture folder in the workspace, which is written anew where an image is taken out.

    Raises
    ------
    DataError : no image can be read; names the first.
    """
    folder = KaptureFolder(query)
    data = folder.read()
    names = data.image_names()
    spec = FolderSpec(folder)
    faults = work.map(_fault, [(spec, name) for name in names], "reading queries")
    reasons = {name: fault for name, fault in zip(names, faults, strict=True) if fault}
    if not reasons:
        return {}
    if len(reasons) == len(names):
        raise DataError(reasons[names[0]], path=folder.image_path(names[0]))
    records = {key: name for key, name in data.records_camera.items() if name not in reasons}
    write_sensors(query, replace(data, records_camera=records))
    write_unreadable(tables, reasons)
    return reasons


def unreadable_queries(tables: Path) -> Iterator[tuple[str, Failure]]:
    """The queries that were set aside, as results."""
    for name, reason in read_unreadable(tables).items():
        yield name, unreadable_image(name, reason)


def unreadable_image(name: str, reason: str) -> Failure:
    """The result of a query whose image cannot be used."""
    return Failure(f"the image cannot be used: {reason}", name=name)


def _fault(job: tuple[FolderSpec, str]) -> str:
    spec, name = job
    folder = spec.open()
    try:
        read_image_of(folder.image_path(name), folder.read().camera_of(name))
    except DataError as error:
        return error.message
    return ""
