"""Plans that make a map without queries, from posed images, photographs or COLMAP models.

Photographs are matched, verified by a two-view model and reconstructed by COLMAP's mapper; with
the resulting poses, the map is made as for posed images. COLMAP models are imported into the user's
cache, and imported again if a file changes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from megloc_kapture.datasets.colmap_map import (
    ColmapFolders,
    ColmapReconstruction,
    find_colmap,
    is_colmap,
    naming_lasting_files,
)
from megloc_kapture.datasets.kapture_folders import import_mapping, mapping_files
from megloc_kapture.errors import DataError, OptionError, check_option, require
from megloc_kapture.io.colmap_mapping import MIN_IMAGES, Mapper
from megloc_kapture.io.dataset_tables import (
    NO_METRES,
    SIDE_TABLES,
    UNREGISTERED_FILE,
    Protocol,
    read_unreadable,
    read_world,
    write_protocol,
    write_unit,
    write_unreadable,
)
from megloc_kapture.io.files import output_error, remove, temporary_name, user_cache, write_bytes
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.plan import Workspace, map_of_workspace, run_plan
from megloc_kapture.pipeline.presets import (
    DEFAULT_PRESET,
    PRESETS,
    check_weights,
    options_of_preset,
    options_with,
)
from megloc_kapture.pipeline.query_folders import Photographs
from megloc_kapture.stages.densifying import Densify
from megloc_kapture.stages.global_features import ExtractGlobalFeatures
from megloc_kapture.stages.guided_pyramid import RematchMapping
from megloc_kapture.stages.image_pairs import PairMapping
from megloc_kapture.stages.local_features import ExtractLocalFeatures
from megloc_kapture.stages.localized_folder import set_aside_unreadable
from megloc_kapture.stages.map_points import MakePoints
from megloc_kapture.stages.map_refinement import RefineMap
from megloc_kapture.stages.matches import MatchMapping
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.paths import MAP, MAPPING, QUERY
from megloc_kapture.stages.preprocessing import Preprocess
from megloc_kapture.stages.stage import (
    ROOT,
    PipelineStage,
    Stage,
    StageWork,
    files_fingerprint,
    wanted_stages,
)
from megloc_kapture.stages.structure import FindPoses, MatchPhotographs, StructureOptions
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Options

_log = logging.getLogger(__name__)

# each stage runs only if the options request it
_WITHOUT_POSES: tuple[type[PipelineStage], ...] = (
    Preprocess,
    ExtractLocalFeatures,
    ExtractGlobalFeatures,
    PairMapping,
)
_WITH_POSES: tuple[type[PipelineStage], ...] = (MatchMapping, RematchMapping, MakePoints, RefineMap)
MAP_STAGES: tuple[type[PipelineStage], ...] = (*_WITHOUT_POSES, *_WITH_POSES, Densify)


def plan_map(mapping: KaptureFolder, options: PipelineOptions) -> list[Stage]:
    check_weights(options)
    options.retrieval()
    check_option(
        not options.pairs_by_points(),
        "mapping_pairs.by covisibility needs a reference model, which images with poses lack",
    )
    return [ImportMapping(mapping), *wanted_stages(MAP_STAGES, options)]


class ImportMapping(Stage):
    """Import posed images, with coordinate frames from the side tables next to their folder."""

    name = "import"
    version = 3
    writes = (MAPPING, QUERY, SIDE_TABLES)  # QUERY is declared for later stages, never written

    def __init__(self, mapping: KaptureFolder) -> None:
        super().__init__(Options())
        self._mapping, self.root = mapping, mapping.root

    def external(self) -> Mapping[str, str]:
        root = self._mapping.root.resolve()
        return {"images": files_fingerprint(root, mapping_files(self._mapping)), ROOT: str(root)}

    def run(self, work: StageWork) -> Mapping[str, float]:
        return import_mapping(self._mapping, work.out)


GPS = "gps"
_BY_POSES = frozenset({"poses", "covisibility"})


class ImportPhotographs(Stage):
    """Import photographs: upright images with cameras from EXIF (unless given), and no poses."""

    name = "import"
    writes = (MAPPING, QUERY, SIDE_TABLES)  # QUERY is declared for later stages, never written

    def __init__(self, photographs: Photographs) -> None:
        super().__init__(Options())
        self._photographs, self.root = photographs, photographs.root

    def external(self) -> Mapping[str, str]:
        data, files = self._photographs.data(), self._photographs.files()
        root = self._photographs.root.resolve()
        content = {
            "files": [sorted(files), files_fingerprint(root, map(Path.resolve, files.values()))],
            "sensors": {name: sensor.params for name, sensor in data.sensors.items()},
            "images": [[sensor, name] for (_, sensor), name in data.records_camera.items()],
            "unreadable": self._photographs.unreadable,
        }
        text = json.dumps(content, sort_keys=True, default=str)
        fingerprint = hashlib.sha256(text.encode()).hexdigest()
        return {"photographs": fingerprint, ROOT: str(root)}

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
            raise _too_few(number, unreadable)
        cameras = len(KaptureFolder(work.out / MAPPING).read().sensors)
        return {"photographs": number, "cameras": cameras, "unreadable": len(unreadable)}


def options_of_photographs(
    preset: str, assignments: Sequence[str] | Mapping[str, Any] = ()
) -> PipelineOptions:
    """Return a preset's options without those that need poses or calibrated cameras."""
    by = PRESETS[preset].mapping_pairs.by if preset in PRESETS else ()
    changes: list[dict[str, Any]] = [
        {"preprocessing": {"undistort": False}},
        {"mapping_pairs": {"by": [method for method in by if method not in _BY_POSES]}},
    ]
    options = options_of_preset(preset, changes=changes, assignments=assignments)
    if without := sorted(_BY_POSES.intersection(options.mapping_pairs.by)):
        raise OptionError(f"mapping_pairs.by {without[0]}: photographs have no poses yet")
    check_option(
        not options.preprocessing.undistort,
        "preprocessing.undistort: the distortion of photographs is unknown; it is estimated "
        "with the map's cameras",
    )
    check_option(
        options.map == "triangulate", f"map = {options.map}: photographs need triangulated points"
    )
    return options


def _structure_options(
    photographs: Photographs, mapper: Mapper, scale: Sequence[str]
) -> StructureOptions:
    gps, distance = None, None
    if tuple(scale) == (GPS,):
        gps = photographs.gps()
        require(
            len(gps) >= MIN_IMAGES,
            f"--scale gps: {len(gps)} photographs have a GPS position, but at least {MIN_IMAGES} "
            "are needed",
        )
    elif len(scale) == 3:
        try:
            distance = scale[0], scale[1], float(scale[2])
        except ValueError:
            distance = "", "", math.nan
        if not 0 < distance[2] < math.inf:
            raise OptionError(
                f"--scale {' '.join(scale)}: {scale[2]!r} is not a distance in metres"
            )
        for name in scale[:2]:
            require(name in photographs.names, f"--scale: there is no photograph {name!r}")
    elif scale:
        raise OptionError(
            f"--scale takes {GPS}, or two photographs and their distance in metres, got "
            f"{' '.join(scale)!r}"
        )
    known = {"known_cameras": photographs.has_known_cameras(), "distance": distance, "gps": gps}
    return options_with(StructureOptions, {"mapper": mapper, **known})


def plan_photographs(
    photographs: Photographs, options: PipelineOptions, mapper: Mapper, scale: Sequence[str] = ()
) -> list[Stage]:
    """Return the stages that map photographs.

    ``scale`` is empty, ``gps``, or two photographs and the distance of their cameras in metres.
    """
    structure = _structure_options(photographs, mapper, scale)
    check_weights(options)
    options.retrieval()
    if len(photographs.names) < MIN_IMAGES:
        raise _too_few(len(photographs.names), photographs.unreadable)
    stages: list[Stage] = [ImportPhotographs(photographs)]
    stages += wanted_stages((*_WITHOUT_POSES, MatchPhotographs), options)
    stages.append(FindPoses(options, structure))
    with_poses = wanted_stages((*_WITH_POSES, Densify), options)
    for stage in with_poses:
        stage.posed = True
    return [*stages, *with_poses]


def describe_map(workspace: Path, photographs: Photographs) -> list[str]:
    tables = workspace / SIDE_TABLES
    missing = read_unreadable(tables, UNREGISTERED_FILE)
    everything = len(photographs.names) + len(photographs.unreadable)
    lines = [f"map of {everything - len(missing)} of {everything} photographs: {workspace / MAP}"]
    for reason in dict.fromkeys(missing.values()):
        names = [name for name, other in missing.items() if other == reason]
        shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
        lines.append(f"not in the map: {shown}: {reason}")
    if missing:
        lines.append(f"full list: {tables / UNREGISTERED_FILE}")
    world = read_world(tables)
    if world.unit == NO_METRES:
        hint = "--scale gps sets the scale" if len(photographs.gps()) >= MIN_IMAGES else ""
        hint = hint or "--scale IMAGE IMAGE METRES sets the scale"
        lines.append(f"the map is in arbitrary units, not metres; {hint}")
    if world.geo_origin is not None:
        at = ", ".join(f"{value:.7g}" for value in world.geo_origin)
        lines.append(f"its axes are East, North and Up at {at}")
    return lines


def _too_few(number: int, unreadable: Mapping[str, str]) -> DataError:
    message = f"{number} photographs are too few for a map; give {MIN_IMAGES} or more"
    if unreadable:
        name, reason = min(unreadable.items())
        message += f" ({len(unreadable)} more cannot be used, the first is {name}: {reason})"
    return DataError(message)


_STAMP = "colmap.txt"
_VERSION = 4  # version of the import; a change rebuilds all maps


def import_colmap(
    source: ColmapFolders, output: Path, *, unit: str = NO_METRES, work: Work = HERE
) -> dict[str, float]:
    """Write a COLMAP reconstruction as a kapture map into an empty folder and return counts.

    The unit is unknown unless given. A model of poses alone becomes a kapture folder of poses. If
    a model has no points, or too few of its keypoints are detected again in its images, the images
    are mapped again with the model's poses and the default preset.
    """
    read = ColmapReconstruction.read(source)
    write_unit(output, unit)
    if source.images is None and source.database is None and not len(read.model.points):
        _log.warning(
            "%s has no points, no images and no database: it becomes a kapture folder of poses, "
            "not a map (`megloc import colmap` with --images or --database gives it features)",
            source.model,
        )
        read.write_images(output)
        return {"images": len(read.names), "points": 0}
    if (counts := read.write_map(output, work=work)) is not None:
        return counts
    with tempfile.TemporaryDirectory(prefix=".megloc-", dir=output) as scratch:
        images = Path(scratch) / "images"
        read.write_images(images)
        workspace = Workspace(Path(scratch) / "workspace")
        stages = plan_map(KaptureFolder(images), options_of_preset(DEFAULT_PRESET))
        with naming_lasting_files(output, source.model), workspace.lock(), single_threaded():
            run_plan(stages, workspace, work)
        for made in workspace.path(MAP).iterdir():
            made.rename(output / made.name)
    read.link_images(output)
    folder = KaptureFolder(output)
    seen = sum(len(observed) for observed in folder.observations().values())
    return {"images": len(read.names), "points": len(folder.points3d()), "observations": seen}


def kapture_of(path: Path | str, *, work: Work = HERE) -> Path:
    """Return the kapture folder of a map or workspace, or import a COLMAP model."""
    path = map_of_workspace(Path(path))
    if not is_colmap(path):
        return path
    source = find_colmap(path)
    stamp = _stamp(source).encode()
    place = Path(os.path.realpath(source.model))
    digest = hashlib.sha256(os.fsencode(place)).hexdigest()[:16]
    folder = user_cache() / "maps"
    kept = folder / f"{place.name[:40]}-{digest}"
    if _has_stamp(kept, stamp):
        return kept
    made = folder / temporary_name()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        made.mkdir()
        import_colmap(source, made, work=work)
        write_bytes(made / _STAMP, stamp)
        # with the stamp, another process has imported it meanwhile and may be reading it
        if not _has_stamp(kept, stamp):
            remove(kept)
            made.rename(kept)
    except OSError as error:
        remedy = "; XDG_CACHE_HOME sets another cache folder"
        raise output_error(folder, error, remedy=remedy) from error
    finally:
        with contextlib.suppress(OSError):
            remove(made)
    return kept


def _has_stamp(folder: Path, stamp: bytes) -> bool:
    path = folder / _STAMP
    return path.is_file() and path.read_bytes() == stamp


def _stamp(source: ColmapFolders) -> str:
    files = files_fingerprint(Path("/"), [file.resolve() for file in source.files()])
    images = source.images and source.images.resolve()
    return f"import {_VERSION}\nimages {images}\nfiles {files}"
