"""A map and localized queries, as other tools read them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError, OutputError, suggestion
from megloc_kapture.io.dataset_tables import read_world, tables_of
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import staged_output
from megloc_kapture.pipeline import export_formats as formats
from megloc_kapture.pipeline.colmap_maps import kapture_of
from megloc_kapture.pipeline.export_formats import GeoOrigin, PosedImage, Scene
from megloc_kapture.pipeline.kapture_map import KaptureMap

ExportFormat = Literal["colmap", "nerfstudio", "tum", "kitti", "ply", "geojson"]
_KIND = "export"
_NO_ROWS = np.zeros(0, np.int64)


def export(
    name: ExportFormat,
    output: Path | str,
    *,
    map: KaptureMap | Path | str | None = None,
    query: Path | str | None = None,
    sensor: str | None = None,
    origin: GeoOrigin | None = None,
    force: bool = False,
) -> int:
    """Write a map, localized queries, or both in the format of another tool.

    Parameters
    ----------
    name : colmap and nerfstudio, which are folders; tum, kitti, ply and geojson, which are files.
    map : kapture map, or a kapture folder of images with poses.
    query : kapture folder of localized queries, with the map's world. Trajectories are of the
        queries alone where they are given.
    sensor : images of this camera only.
    origin : of geojson, where the world's origin lies on earth; a map of photographs whose
        positions were known brings it.

    Returns
    -------
    Number of images written.

    Raises
    ------
    DataError : something is missing, broken, or cannot be said in the format.
    OptionError : no such format, or what it needs was not given.
    OutputError : the output is there already, unless ``force``, or cannot be written.
    """
    if name not in get_args(ExportFormat):
        raise OptionError(f"unknown format {name!r}; {suggestion(name, get_args(ExportFormat))}")
    if map is None and query is None:
        raise OptionError("nothing to export: give a map, or localized queries")
    if name == "geojson" and origin is None:
        origin = _origin_of(map)
    if (name == "geojson") != (origin is not None):
        raise OptionError(
            "geojson needs to know where the world's origin lies, and nothing else does "
            "(--geo-origin LATITUDE,LONGITUDE[,HEIGHT]; its axes are East, North, Up); a map of "
            "`megloc map --scale gps` knows it"
        )
    scene = _scene(map, query, sensor, trajectory=name in ("tum", "kitti"))
    if not scene.images:
        raise DataError("no image has a pose" + (f" of camera {sensor!r}" if sensor else ""))
    output = Path(output)
    if name in ("colmap", "nerfstudio"):
        with staged_output(output, kind=_KIND, force=force) as out:
            if name == "colmap":
                formats.export_colmap(scene, out)
            else:
                formats.export_nerfstudio(scene, out, beside=output)
        return len(scene.images)
    if output.exists() and not force:
        raise OutputError(f"{output}: is there already; --force overwrites it")
    if origin is not None:
        formats.export_geojson(scene, output, origin)
    else:
        {"tum": formats.export_tum, "kitti": formats.export_kitti, "ply": formats.export_ply}[name](
            scene, output
        )
    return len(scene.images)


def _origin_of(given: KaptureMap | Path | str | None) -> GeoOrigin | None:
    """Where the origin of a map's world lies on earth; None where it does not say so."""
    if given is None:
        return None
    tables = tables_of(given.folder.root if isinstance(given, KaptureMap) else kapture_of(given))
    known = None if tables is None else read_world(tables).geo_origin
    return None if known is None else GeoOrigin(*known)


def _scene(
    given: KaptureMap | Path | str | None,
    query: Path | str | None,
    sensor: str | None,
    *,
    trajectory: bool,
) -> Scene:
    opened: KaptureMap | None = None
    images: list[PosedImage] = []
    if given is not None and not (trajectory and query is not None):
        if isinstance(given, KaptureMap):
            opened = given
        elif (folder := KaptureFolder(kapture_of(given))).has_points():
            opened = KaptureMap.open(folder.root)
        else:
            images += _posed_images(folder, None, sensor, is_query=False)
        if opened is not None:
            images += _posed_images(opened.folder, opened, sensor, is_query=False)
    if query is not None:
        images += _posed_images(KaptureFolder(query), opened, sensor, is_query=True)
    points = np.zeros((0, 6)) if opened is None else opened.folder.points3d()
    return Scene(images, points)


def _posed_images(
    folder: KaptureFolder, opened: KaptureMap | None, sensor: str | None, *, is_query: bool
) -> list[PosedImage]:
    """The images of a folder that have a pose; those of the map with their observations.

    Parameters
    ----------
    opened : the map, which cameras are described as; None without one.
    """
    data = folder.read()
    found = []
    for image, pose in sorted(data.poses().items()):
        timestamp, device = data.record_of(image)
        if sensor not in (None, device):
            continue
        camera = data.camera_of(image)
        keypoints, rows, points = np.zeros((0, 2)), _NO_ROWS, _NO_ROWS
        if opened is not None and not is_query:
            keypoints, rows, points = _observed(opened, image)
        found.append(
            PosedImage(
                name=image,
                path=folder.image_path(image),
                camera=camera if opened is None else opened.to_colmap(camera),
                cam_from_world=pose,
                timestamp=timestamp,
                sensor=device,
                is_query=is_query,
                keypoints_px=keypoints,
                rows=rows,
                points=points,
            )
        )
    return found


def _observed(
    opened: KaptureMap, image: str
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Keypoints (K, 2) of all types of a map image, one behind the other; rows (M,) of these and
    of the points that they observe."""
    keypoints, rows, points = [np.zeros((0, 2))], [_NO_ROWS], [_NO_ROWS]
    for typed in opened.keypoints.values():
        if image in typed:
            before = sum(map(len, keypoints))
            keypoints.append(typed.keypoints_px(image)[:, :2].astype(np.float64))
            own_rows, own_points = typed.index.observed(image)
            rows.append(own_rows.astype(np.int64) + before)
            points.append(own_points.astype(np.int64))
    return np.concatenate(keypoints), np.concatenate(rows), np.concatenate(points)
