"""Photographs without poses become a map: the plan of ``megloc map``.

Photographs are matched with each other, verified by a two-view model, and COLMAP's mapper finds
their poses and cameras. From there they are map images as any others: matched again with the known
poses, triangulated and refined by the stages that make every map.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.colmap_mapping import MIN_IMAGES, Mapper
from megloc_kapture.io.dataset_tables import (
    NO_METRES,
    SIDE_TABLES,
    UNREGISTERED_FILE,
    Protocol,
    read_unreadable,
    read_world,
    write_protocol,
    write_unreadable,
)
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.pipeline.photographs import Photographs
from megloc_kapture.pipeline.presets import PRESETS, check_weights, options_of_preset
from megloc_kapture.stages.global_features import ExtractGlobalFeatures
from megloc_kapture.stages.image_pairs import PairMapping
from megloc_kapture.stages.local_features import ExtractLocalFeatures
from megloc_kapture.stages.localized_folder import set_aside_unreadable
from megloc_kapture.stages.map_points import TriangulatePoints
from megloc_kapture.stages.map_refinement import RefineMap
from megloc_kapture.stages.matches import MatchMapping
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.preprocessing import Preprocess
from megloc_kapture.stages.pyramid_mapping import PyramidMapping
from megloc_kapture.stages.stage import (
    MAP,
    MAPPING,
    QUERY,
    Hashes,
    PipelineStage,
    Stage,
    StageWork,
    wanted_stages,
)
from megloc_kapture.stages.structure import FindPoses, MatchPhotographs, StructureOptions
from megloc_kapture.values import Options

GPS = "gps"
# the options that making a map of photographs uses
MAPPING_OPTIONS = (
    *("device", "precision", "preprocessing", "local_features", "mask_margin_px"),
    *("global_features", "fusion", "mapping_pairs", "matching", "mapping_verification"),
    *("query_verification", "guided_pyramid", "triangulation", "refinement"),
)
_WITHOUT_POSES: tuple[type[PipelineStage], ...] = (
    Preprocess,
    ExtractLocalFeatures,
    ExtractGlobalFeatures,
    PairMapping,
    MatchPhotographs,
)
_WITH_POSES: tuple[type[PipelineStage], ...] = (
    MatchMapping,
    PyramidMapping,
    TriangulatePoints,
    RefineMap,
)
_BY_POSES = frozenset({"poses", "covisibility"})


class ImportPhotographs(Stage):
    """Bring photographs into a workspace: cameras by EXIF, images upright, no poses."""

    name = "import"
    writes = (MAPPING, QUERY, SIDE_TABLES)  # no queries: what stages read of them is nothing

    def __init__(self, photographs: Photographs) -> None:
        super().__init__(Options())
        self._photographs = photographs

    def external(self, hashes: Hashes) -> Mapping[str, str]:
        data, files = self._photographs.data(), self._photographs.files()
        content = {
            "files": {name: hashes.of_file(path.resolve()) for name, path in files.items()},
            "sensors": {name: sensor.params for name, sensor in data.sensors.items()},
            "images": [[sensor, name] for (_, sensor), name in data.records_camera.items()],
            "unreadable": self._photographs.unreadable,
        }
        text = json.dumps(content, sort_keys=True, default=str)
        return {"photographs": hashlib.sha256(text.encode()).hexdigest()}

    def run(self, work: StageWork) -> Mapping[str, float]:
        write_sensors(work.out / MAPPING, self._photographs.data())
        self._photographs.write_images(work.out / MAPPING)
        tables = work.out / SIDE_TABLES
        write_protocol(tables, Protocol())
        broken = set_aside_unreadable(work.out / MAPPING, tables, work)
        unreadable = {
            name: f"cannot be read: {reason}"
            for name, reason in {**self._photographs.unreadable, **broken}.items()
        }
        if unreadable:
            write_unreadable(tables, unreadable)
        number = len(self._photographs.names) - len(broken)
        if number < MIN_IMAGES:
            raise _too_few(number)
        cameras = len(KaptureFolder(work.out / MAPPING).read().sensors)
        return {"photographs": number, "cameras": cameras, "unreadable": len(unreadable)}


def options_of_photographs(
    preset: str,
    assignments: Sequence[str] | Mapping[str, Any] = (),
    *,
    used: Sequence[str] | None = None,
) -> PipelineOptions:
    """A preset's options, without those that would need poses or a known lens.

    Raises
    ------
    OptionError : of :func:`options_of_preset`; or one that would need them was typed.
    """
    by = PRESETS[preset].mapping_pairs.by if preset in PRESETS else ()
    changes: list[dict[str, Any]] = [
        {"preprocessing": {"undistort": False}},
        {"mapping_pairs": {"by": [method for method in by if method not in _BY_POSES]}},
    ]
    options = options_of_preset(preset, changes=changes, assignments=assignments, used=used)
    if without := sorted(_BY_POSES.intersection(options.mapping_pairs.by)):
        raise OptionError(f"mapping_pairs.by {without[0]}: photographs have no poses yet")
    if options.preprocessing.undistort:
        raise OptionError(
            "preprocessing.undistort: of photographs the distortion is not known; it is estimated, "
            "and the map's cameras have it"
        )
    if options.map != "triangulate":
        raise OptionError(f"map = {options.map}: of photographs points are triangulated")
    return options


def structure_options(
    photographs: Photographs, mapper: Mapper, scale: Sequence[str], *, known_cameras: bool
) -> StructureOptions:
    """How poses are found.

    Parameters
    ----------
    scale : nothing; ``gps``; or two photographs and the metres between them.

    Raises
    ------
    OptionError : the scale is none of these.
    DataError : a photograph is not there, or none has a position.
    """
    gps, distance = None, None
    if tuple(scale) == (GPS,):
        gps = photographs.gps()
        if len(gps) < MIN_IMAGES:
            raise DataError(
                f"--scale gps: {len(gps)} photographs have a GPS position; it takes {MIN_IMAGES}"
            )
    elif len(scale) == 3:
        try:
            distance = scale[0], scale[1], float(scale[2])
        except ValueError:
            distance = "", "", math.nan
        if not 0 < distance[2] < math.inf:
            raise OptionError(f"--scale {' '.join(scale)}: {scale[2]!r} is no distance in metres")
        for name in scale[:2]:
            if name not in photographs.names:
                raise DataError(f"--scale: there is no photograph {name!r}")
    elif scale:
        raise OptionError(
            f"--scale takes {GPS}, or two photographs and the metres between them, got "
            f"{' '.join(scale)!r}"
        )
    return StructureOptions(mapper=mapper, known_cameras=known_cameras, distance=distance, gps=gps)


def plan_photographs(
    photographs: Photographs, options: PipelineOptions, structure: StructureOptions
) -> list[Stage]:
    """The stages from photographs to a map.

    Raises
    ------
    DataError : too few photographs.
    MeglocError : the options cannot be used.
    """
    check_weights(options)
    options.retrieval()
    options.check()
    if len(photographs.names) < MIN_IMAGES:
        raise _too_few(len(photographs.names))
    stages: list[Stage] = [ImportPhotographs(photographs)]
    stages += wanted_stages(_WITHOUT_POSES, options)
    stages.append(FindPoses(options, structure))
    with_poses = wanted_stages(_WITH_POSES, options)
    for stage in with_poses:
        stage.layout = replace(stage.layout, posed=True)
    return [*stages, *with_poses]


def describe_map(workspace: Path, photographs: Photographs) -> list[str]:
    """What became of the photographs, in lines for people."""
    tables = workspace / SIDE_TABLES
    missing = read_unreadable(tables, UNREGISTERED_FILE)
    everything = len(photographs.names) + len(photographs.unreadable)
    lines = [f"map of {everything - len(missing)} of {everything} photographs: {workspace / MAP}"]
    for reason in dict.fromkeys(missing.values()):
        names = [name for name, other in missing.items() if other == reason]
        shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
        lines.append(f"not in the map: {shown}: {reason}")
    if missing:
        lines.append(f"all of them: {tables / UNREGISTERED_FILE}")
    world = read_world(tables)
    if world.unit == NO_METRES:
        hint = "--scale gps would tell it" if len(photographs.gps()) >= MIN_IMAGES else ""
        hint = hint or "--scale IMAGE IMAGE METRES tells it"
        lines.append(f"the map has no metres, but units of its own; {hint}")
    if world.geo_origin is not None:
        at = ", ".join(f"{value:.7g}" for value in world.geo_origin)
        lines.append(f"its axes are East, North and Up at {at}")
    return lines


def _too_few(number: int) -> DataError:
    return DataError(f"{number} photographs are too few for a map; give {MIN_IMAGES} or more")
