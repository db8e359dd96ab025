"""``megloc info`` and ``options``: contents of a kapture folder, and the list of options."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from pydantic.fields import FieldInfo

from megloc_kapture.cli.common import Common, ReadingMap
from megloc_kapture.cli.maps import report_lines
from megloc_kapture.datasets.kapture_folders import cameras_of_folder
from megloc_kapture.errors import DataError, MeglocError, OptionError
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.kapture.folder import ARRAY_KINDS
from megloc_kapture.io.kapture.points import read_point_covariances
from megloc_kapture.io.kapture.sensors import UNKNOWN_CAMERA
from megloc_kapture.mapping.uncertainty import point_deviations
from megloc_kapture.pipeline.kapture_map import KaptureMap, MapKeypoints
from megloc_kapture.pipeline.live_source import MapMatching
from megloc_kapture.pipeline.presets import (
    BASIC_OPTIONS,
    DEFAULT_PRESET,
    options_of,
    options_of_preset,
)
from megloc_kapture.plugin_loading import load_chosen, plugin_class, plugin_names
from megloc_kapture.plugins import LOCAL_FEATURES, PROTOCOLS, RENDERED_DATASETS, PluginChoice
from megloc_kapture.stages.global_features import VLAD
from megloc_kapture.stages.scene import depth_records
from megloc_kapture.values import Options

_COLUMN = 18
_QUANTILES = (0.1, 0.5, 0.9)
# without twins, which have the same names as their datasets
_GROUPS = [group for group in PROTOCOLS if group != RENDERED_DATASETS]


@dataclass(frozen=True, kw_only=True)
class Info(ReadingMap, Common):
    """Describe a kapture folder and its use as a map."""

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="KAPTURE")]
    """Kapture folder, or a COLMAP model."""
    deep: bool = False
    """Also read all images and matches."""

    def run(self) -> None:
        folder = self.kapture(self.opened_map(self.input))
        describe_content(folder)
        folder.validate(deep=self.deep)
        faults = list(describe_sizes(folder))
        for text in faults:
            line("FAULT", text)
        if not faults:
            checked = "all files and images" if self.deep else "files"
            line("checked", f"{checked}: no fault found")
        if folder.has_points():
            self._describe_map(folder.root)
        else:
            line("localizing", "not possible: no points3d and observations")

    def _describe_map(self, root: Path) -> None:
        try:
            opened = self.open_map(root)
        except DataError as error:
            line("localizing", f"not possible: {error}")
            return
        unknown = "units of the map, of unknown scale"
        line("unit", "metres" if opened.unit == METRES else unknown)
        if fault := opened.fault():
            line("FAULT", fault)
        for local_type, keypoints in opened.keypoints.items():
            origin = keypoints.pixel_origin
            errors = ", ".join(f"{name} {value:.3f} px" for name, value in origin.error_px.items())
            extractor = keypoints.extractor()
            line("localizing with", local_type)
            line("pixel origin", f"{origin.intrinsics}: {origin.reason}")
            line("", f"median reprojection error by origin: {errors}")
            line("map descriptors", describe_descriptors(opened, keypoints, extractor))
            line("query features", describe_extraction(local_type, extractor))
        describe_retrieval(opened)


def describe_content(folder: KaptureFolder) -> None:
    data = folder.read()
    # counts uncalibrated cameras too
    devices = (data.sensors[device] for _, device in data.records_camera)
    models = Counter("".join(sensor.params[:1]) or UNKNOWN_CAMERA for sensor in devices)
    cameras = ", ".join(f"{count} {model}" for model, count in sorted(models.items()))
    line("kapture", str(folder.root))
    line("sensors", f"{len(data.sensors)}, rigs {len(data.rigs)}")
    images = data.image_names()
    line("images", f"{len(images)} ({cameras}), {len(data.poses())} with a pose")
    if missing := [image for image in images if not folder.image_path(image).is_file()]:
        line("missing files", f"{len(missing)} of the images, such as {missing[0]}")
    if data.records_depth:
        joined = len(depth_records(data))
        # a depth map belongs to an image if a rig links their sensors
        use = "" if joined else ": ignored, as no rig links their sensor to a camera"
        line("depth maps", f"{len(data.records_depth)}, for {joined} images{use}")
    for kind in ARRAY_KINDS:
        for name in folder.types(kind):
            reader = folder.features(kind, name)
            stored = f"{reader.config.dtype.name} x {reader.config.dsize}"
            text = f"{name}: {len(reader.names)} images, {stored}"
            line(kind.replace("_", " "), text)
    for name in folder.types("matches"):
        line("matches", f"{name}: {len(folder.matches(name).pairs)} pairs")
    if folder.has_points():
        line("points", str(len(folder.points3d())))
        for name, seen in sorted(folder.observations().items()):
            line("observations", f"{name}: {len(seen.point_ids)}")
        describe_refinement(folder)


def describe_sizes(folder: KaptureFolder) -> Iterator[str]:
    """Describe images whose size differs from their camera's, from headers only."""
    scaled, errors = cameras_of_folder(folder)
    for sensor_id, camera in scaled.items():
        known = folder.read().sensors[sensor_id].camera()
        yield (
            f"the images of camera {sensor_id} are {camera.width}x{camera.height}, scaled from the "
            f"{known.width}x{known.height} to which the camera and keypoints refer"
        )
    if errors:
        yield f"{len(errors)} images differ in size from their cameras, the first: {errors[0]}"


def describe_refinement(folder: KaptureFolder) -> None:
    for row, text in enumerate(report_lines(folder.root)):
        line("" if row else "refinement", text)
    covariances = read_point_covariances(folder.root, len(folder.points3d()))
    if covariances is None:
        return
    largest = point_deviations(covariances)[:, 2]
    known = largest[np.isfinite(largest)]
    line("uncertainty", f"known for {len(known)} points")
    if len(known):
        at = np.quantile(known, _QUANTILES)
        text = ", ".join(f"{100 * q:g} %: {d:.3g}" for q, d in zip(_QUANTILES, at, strict=True))
        line("", f"worst-axis standard deviation for 1 px noise, percentiles: {text}")


def describe_extraction(local_type: str, extractor: PluginChoice | None) -> str:
    if extractor is None:
        return f"must be in the query's kapture folder: no extractor for {local_type} is installed"
    try:
        load_chosen(LOCAL_FEATURES, extractor)
    except MeglocError as error:
        absent = f"plugin {extractor.name} could extract them, but {error}"
        return f"must be in the query's kapture folder; {absent}"
    return f"extracted by plugin {extractor.name}, or read from the query's kapture folder"


def describe_descriptors(
    opened: KaptureMap, keypoints: MapKeypoints, extractor: PluginChoice | None
) -> str:
    lacking = keypoints.without_descriptors(opened.images)
    if not lacking:
        return "present"
    of_images = f"missing for {len(lacking)} images, such as {lacking[0]}"
    if extractor is None:
        return f"{of_images}; no extractor for the type is installed: localization is not possible"
    if not opened.has_images():
        return f"{of_images}; no images to extract them from: localization is not possible"
    return f"{of_images}; all will be extracted again by plugin {extractor.name}"


def describe_retrieval(opened: KaptureMap) -> None:
    for keypoints in opened.keypoints.values():
        missing = keypoints.without_descriptors(opened.images)
        if missing and not (keypoints.extractor() and opened.has_images()):
            line("retrieval", "not possible without the map's descriptors")
            return
    retrieval = MapMatching(opened, options_of_preset(DEFAULT_PRESET))
    line("retrieval", retrieval.describe_candidates(()))
    if brought := opened.global_types:
        text = retrieval.describe_candidates(brought)
        line("", f"if queries have {', '.join(brought)}: {text}")


def line(name: str, text: str) -> None:
    print(f"{name:{_COLUMN}s}{text}")


@dataclass(frozen=True, kw_only=True)
class OptionsCommand(Common):
    """List the options that --set takes, with value, type and meaning."""

    key: tyro.conf.Positional[str] = ""
    """Options of a step (localization.pose), a single option, or options of a plugin (aliked)."""
    preset: str = DEFAULT_PRESET
    """Show the values of this preset."""
    basic: bool = False
    """Without KEY: show only the ten options that are changed most often."""

    def run(self) -> None:
        every = list(options_of(options_of_preset(self.preset)))
        selected = [
            option for option in every if not self.key or f"{option[0]}.".startswith(f"{self.key}.")
        ]
        if self.basic and not self.key:
            selected = [option for option in selected if option[0] in BASIC_OPTIONS]
        plugins = {VLAD, *(name for group in _GROUPS for name in plugin_names(group))}
        if not selected and self.key in plugins:
            selected = list(_options_of_plugin(self.key))
            if not selected:
                print(f"{self.key} has no options")
        elif not selected:
            keys = [key for key, _, _ in every]
            steps = {key.rpartition(".")[0] for key in keys} - {""}
            known = sorted({*keys, *steps, *plugins})
            near = get_close_matches(self.key, known, n=3)
            hint = f"did you mean {' or '.join(near)}? " if near else ""
            raise OptionError(
                f"no option, step or plugin {self.key!r}; {hint}`megloc options` lists all options"
            )
        for key, value, field in selected:
            print(f"{key} = {shown(value)}")
            meaning = f"; {field.description}" if field.description else ""
            print(f"    {_type_name(field.annotation)}{meaning}")


def shown(value: Any) -> str:
    """Format a value as ``--set`` takes it; floats have four significant digits."""
    text = _inline(value)
    return text[1:-1] if text.startswith('"') else text


def _inline(value: Any) -> str:
    """Format as inline TOML, which equals JSON except for tables."""
    if isinstance(value, Options):
        table = value.model_dump(mode="json", exclude_defaults=True)
        if isinstance(value, PluginChoice):
            table = {"name": value.name, **table}
        return _inline(table["name"] if table.keys() == {"name"} else table)
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_inline(item)}' for key, item in value.items())}}}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_inline, value))}]"
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps("none" if value is None else value, ensure_ascii=False)


def _type_name(annotation: Any) -> str:
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    text = re.sub(r"[A-Za-z_]\w*\.(?=[A-Za-z_])", "", text)
    return re.sub(r"Literal\[(.*?)\]", lambda m: m[1].replace("', '", "' | '"), text)


def _options_of_plugin(name: str) -> Iterator[tuple[str, Any, FieldInfo]]:
    groups = [group for group in _GROUPS if name in plugin_names(group)]
    models = [getattr(plugin_class(group, name), "Options", None) for group in groups]
    for model in [VladOptions] if name == VLAD else filter(None, models):
        yield from options_of(model(), f"{name}: options.")
