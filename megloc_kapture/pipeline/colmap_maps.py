"""COLMAP models where a kapture map is expected: imported once, kept in the user's cache.

A model is imported again when one of its files, or its database, has another size or time. Weights
lie in the same cache, see :mod:`megloc_kapture.io.weights`.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from pydantic import BaseModel

from megloc_kapture.datasets.colmap_map import (
    ColmapFolders,
    ColmapReconstruction,
    OtherFeaturesError,
    find_colmap,
    is_colmap,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import (
    clear_leftovers,
    output_error,
    read_json_model,
    remove,
    temporary_name,
    user_cache,
    write_json_model,
)
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import replace_directory
from megloc_kapture.pipeline.evaluation_plan import plan_map
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, options_of_preset
from megloc_kapture.pipeline.workspace import LOCK, Workspace
from megloc_kapture.stages.stage import MAP
from megloc_kapture.stages.work import HERE, Work

_log = logging.getLogger(__name__)

_STAMP = "colmap.json"
_VERSION = 1  # of the import: another one makes all maps anew


class _Stamp(BaseModel):
    """What a map was imported from: paths, and size and time of each file."""

    version: int
    images: str | None
    files: dict[str, tuple[int, int]]


def colmap_maps_folder() -> Path:
    """The folder of the imported maps; it need not be there, and may be deleted."""
    return user_cache() / "maps"


def import_colmap(source: ColmapFolders, output: Path, *, work: Work = HERE) -> dict[str, float]:
    """Write a COLMAP reconstruction as a kapture map; ``output`` is empty.

    Where the model's features cannot be had (no points; no database, and no SIFT), its images are
    mapped anew with its poses, by the default preset, and a warning is logged.

    Returns
    -------
    Counts for the log.

    Raises
    ------
    DataError : see :class:`~megloc_kapture.datasets.colmap_map.ColmapReconstruction`.
    """
    read = ColmapReconstruction.read(source)
    try:
        return read.write_map(output, work=work)
    except OtherFeaturesError as error:
        _log.warning("%s; its images are mapped anew with its poses", error)
    with tempfile.TemporaryDirectory(prefix=".megloc-", dir=output) as scratch:
        images = Path(scratch) / "images"
        read.write_images(images)
        workspace = Workspace(Path(scratch) / "workspace")
        stages = plan_map(KaptureFolder(images), options_of_preset(DEFAULT_PRESET))
        with workspace.lock(), single_threaded():
            run_plan(stages, workspace, work)
        for made in workspace.path(MAP).iterdir():
            made.rename(output / made.name)
    read.link_images(output)
    folder = KaptureFolder(output)
    seen = sum(len(found) for found in folder.observations().values())
    return {"images": len(read.names), "points": len(folder.points3d()), "observations": seen}


def kapture_of(path: Path | str, *, work: Work = HERE) -> Path:
    """The kapture folder of a map: the path itself, the map of a workspace of ours, or where a
    COLMAP model is imported to.

    Parameters
    ----------
    path : kapture folder, workspace, or a COLMAP model or workspace, see
        :func:`~megloc_kapture.datasets.colmap_map.find_colmap`.
    work : where features are extracted, if they have to be.

    Raises
    ------
    DataError : it is a COLMAP model that cannot be imported.
    OutputError : the cache cannot be written.
    """
    path = Path(path)
    if (path / LOCK).is_file() and (path / MAP).is_dir():
        return path / MAP
    if not is_colmap(path):
        return path
    source = find_colmap(path)
    stamp = _stamp(source.images, source.files())
    place = Path(os.path.realpath(source.model))
    digest = hashlib.sha256(os.fsencode(place)).hexdigest()[:16]
    folder = colmap_maps_folder()
    kept = folder / f"{place.name[:40]}-{digest}"
    if _read_stamp(kept) == stamp:
        return kept
    made = folder / temporary_name()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        clear_leftovers(folder)
        made.mkdir()
        import_colmap(source, made, work=work)
        write_json_model(made / _STAMP, stamp)
        replace_directory(made, kept)
    except OSError as error:
        raise output_error(folder, error) from error
    finally:
        with contextlib.suppress(OSError):
            remove(made)
    return kept


def _stamp(images: Path | None, files: Iterable[Path]) -> _Stamp:
    found = {}
    for file in files:
        try:
            status = file.stat()
        except OSError as error:
            raise DataError(f"cannot read: {error.strerror}", path=file) from error
        found[os.path.realpath(file)] = (status.st_size, status.st_mtime_ns)
    where = None if images is None else os.path.realpath(images)
    return _Stamp(version=_VERSION, images=where, files=found)


def _read_stamp(folder: Path) -> _Stamp | None:
    """The stamp of an imported map; None where there is none that can be read."""
    try:
        return read_json_model(folder / _STAMP, _Stamp)
    except DataError:
        return None
