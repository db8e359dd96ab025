"""Stage: resized, undistorted and masked images, as a new kapture without features and points.

Names, poses, rigs, records and sensor ids are kept. Unchanged files and depth maps are linked.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.io.files import (
    link_file,
    link_records,
    write_json,
)
from megloc_kapture.io.images import image_size, write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.plugin_loading import Placement, load_chosen
from megloc_kapture.plugins import SEGMENTERS, Segmenter
from megloc_kapture.preprocessing.frames import FrameOptions, FramePlan, plan_frame
from megloc_kapture.preprocessing.masks import UnchangingRegion
from megloc_kapture.stages.image_masks import (
    JPEG_QUALITY,
    ClassMasks,
    Mask,
    MaskOptions,
    ProcessedFrame,
    StandingMasks,
    find_unchanging_regions,
    mask_files,
    read_masks,
)
from megloc_kapture.stages.local_features import check_size, read_image_of
from megloc_kapture.stages.stage import (
    MAPPING,
    PREPROCESSED,
    QUERY,
    PipelineStage,
    StageWork,
    files_fingerprint,
)
from megloc_kapture.stages.work import HERE, Work

CLASSES, CLASSES_FILE = "classes", "classes.json"
_log = logging.getLogger(__name__)


class PreprocessingOptions(FrameOptions):
    masks: MaskOptions = MaskOptions()


def _process(
    output: Path,
    classes: ClassMasks | None,
    job: tuple[str, Path, FramePlan, bool, Mapping[str, Path], Mapping[str, Mask]],
) -> dict[str, float]:
    """Write one image and its mask; return its masked shares by source and ``all``."""
    image, source, plan, link, mask_paths, standing = job
    sensors, camera = output / "sensors", plan.original
    write = partial(write_image, jpeg_quality=JPEG_QUALITY)
    frame = ProcessedFrame(
        image,
        plan,
        lambda: read_image_of(source, camera),
        lambda: {**read_masks(mask_paths, (camera.height, camera.width)), **standing},
        lambda: classes,
    )
    if plan.changes_pixels:
        write(sensors / "records_data" / image, frame.written)
    else:
        check_size(image_size(source), camera, source)
        if link:
            link_file(source, sensors / "records_data" / image)
    if frame.labels is not None:
        write(sensors / CLASSES / f"{image}.png", frame.labels)
    if frame.mask is None:
        return {}
    combined = frame.mask
    write(sensors / "masks" / f"{image}.png", combined.astype(np.uint8) * 255)
    masks = {**frame.masks, "all": combined}
    return {source: float((~mask).mean()) for source, mask in masks.items()}


def preprocess_images(
    folder: KaptureFolder,
    output: Path,
    options: PreprocessingOptions,
    *,
    segmenter: Segmenter | None = None,
    sequences: Sequence[KaptureFolder] = (),
    work: Work = HERE,
) -> dict[str, float]:
    """Write a kapture with pre-processed images, cameras and masks.

    Return counts for the log, including the share of pixels masked by each source.

    ``sensors/masks/IMAGE.png`` (0 = ignore) exists for images with masked or invalid pixels,
    ``sensors/classes`` has the segmenter's labels. ``sequences`` are more folders in which to find
    static regions: for queries, the map.
    """
    output = Path(output)
    if output.resolve().is_relative_to(folder.root.resolve()):
        raise OutputError(f"{output}: is inside the input kapture folder, which is not modified")
    classes = _class_masks(options.masks, segmenter, work.placement)
    data = folder.read()
    plans = _plans(data, options)
    images = data.image_names()
    files = mask_files(folder, images, options.masks.user_masks)
    regions: dict[str, UnchangingRegion] = {}
    if options.masks.unchanging:
        regions = find_unchanging_regions(folder, sequences, work=work)
    remarks = _remarks(regions, any(fixed.fallback for fixed in options.masks.fixed))
    standing = StandingMasks(options.masks.fixed, regions)

    _unlink_folders(output)
    write_sensors(output, _with_cameras(data, plans))
    linked = _link_records(folder, output, plans)
    if classes is not None:
        what = {"classes": list(classes.segmenter.classes), "dynamic": list(classes.dynamic)}
        write_json(output / "sensors" / CLASSES / CLASSES_FILE, what)

    def standing_of(image: str) -> Mapping[str, Mask]:
        sensor_id = data.record_of(image)[1]
        return standing.of(sensor_id, image, plans[sensor_id].original)

    def jobs() -> Iterator[tuple[str, Path, FramePlan, bool, dict[str, Path], Mapping[str, Mask]]]:
        for image in images:
            plan = plans[data.record_of(image)[1]]
            link = not (linked or plan.changes_pixels)
            yield image, folder.image_path(image), plan, link, files[image], standing_of(image)

    plugins = () if classes is None else (classes.segmenter,)
    process = partial(_process, output, classes)
    results = work.map(process, jobs(), "pre-processing", len(images), plugins=plugins)
    shares: Counter[str] = Counter()
    num_masked = 0
    for image_shares in results:
        num_masked += bool(image_shares)
        shares.update(image_shares)
    remarks += [f"a fixed mask fits no image: {mask.camera}" for mask in standing.unused()]
    for remark in remarks:
        _log.warning("%s", remark)
    return {
        "images": len(images),
        "images_changed": sum(plans[s].changes_pixels for _, s in data.records_camera),
        "images_masked": num_masked,
        **{f"masked_{source}": shares[source] / len(images) for source in sorted(shares)},
    }


def _class_masks(
    options: MaskOptions, segmenter: Segmenter | None, placement: Placement
) -> ClassMasks | None:
    if segmenter is None and options.segmenter is not None:
        segmenter = load_chosen(SEGMENTERS, options.segmenter, placement)
    if segmenter is not None:
        return ClassMasks.of(segmenter, options.dynamic)
    if options.dynamic is not None:
        raise OptionError("dynamic classes need a segmenter")
    return None


def _plans(data: KaptureData, options: FrameOptions) -> dict[str, FramePlan]:
    plans: dict[str, FramePlan] = {}
    for (_, sensor_id), image in sorted(data.records_camera.items()):
        if sensor_id not in plans:
            plans[sensor_id] = plan_frame(data.camera_of(image), options)
    return plans


def _remarks(regions: Mapping[str, UnchangingRegion], have_fallback: bool) -> list[str]:
    """Report cameras without a static region; if all lack it, a fallback is required."""
    remarks = [f"camera {name}: {r.reason}" for name, r in sorted(regions.items()) if not r]
    if regions and not (have_fallback or any(region.frontier for region in regions.values())):
        raise OptionError(f"no unchanging region can be found: {remarks[0]}")
    return remarks


def _with_cameras(data: KaptureData, plans: Mapping[str, FramePlan]) -> KaptureData:
    """Replace the processed cameras; unchanged ones keep their exact digits."""
    sensors = dict(data.sensors)
    for sensor_id, plan in plans.items():
        if plan.processed != plan.original:
            name = data.sensors[sensor_id].name
            sensors[sensor_id] = Sensor.from_camera(plan.processed, name=name)
    return replace(data, sensors=sensors)


def _unlink_folders(output: Path) -> None:
    """Remove linked folders, so that user data behind the links is not overwritten."""
    for name in ("records_data", "masks", CLASSES):
        path = output / "sensors" / name
        if path.is_symlink():
            path.unlink()


def _link_records(folder: KaptureFolder, output: Path, plans: Mapping[str, FramePlan]) -> bool:
    """Link all records if no image changes, else only depth maps; return True if all."""
    records = folder.root / "sensors" / "records_data"
    if records.is_dir() and not any(plan.changes_pixels for plan in plans.values()):
        link_records(output, {"": records})
        return True
    for name in sorted(folder.read().records_depth.values()):
        source = folder.depth_path(name)
        if not source.is_file():
            raise DataError("no such depth map", path=source)
        link_file(source, output / "sensors" / "records_data" / name)
    return False


class Preprocess(PipelineStage):
    """Resize, undistort and mask the images of map and queries."""

    name = "preprocess"
    uses = ("preprocessing",)
    explained_by = (
        "preprocessing.max_size_px",
        "preprocessing.undistort",
        "preprocessing.masks.segmenter",
    )
    inputs = (MAPPING, QUERY)
    outputs = (PREPROCESSED,)

    def is_wanted(self) -> bool:
        return self.options.preprocesses()

    def plugins(self) -> Sequence[object]:
        chosen = self.options.preprocessing.masks.segmenter
        return () if chosen is None else (load_chosen(SEGMENTERS, chosen),)

    def external(self) -> Mapping[str, str]:
        masks = self.options.preprocessing.masks
        drawn = [fixed.file for fixed in masks.fixed if fixed.file is not None]
        fingerprints = {
            f"mask {path}": files_fingerprint(Path("/"), [path.resolve()]) for path in drawn
        }
        if masks.user_masks is not None:
            root = masks.user_masks.resolve()
            fingerprints["user masks"] = files_fingerprint(root, root.rglob("*.png"))
        return fingerprints

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping, *queries = work.folders((MAPPING, QUERY))
        options, counts = self.options.preprocessing, dict[str, float]()
        for folder in (mapping, *queries):
            name, out = folder.root.name, work.out / PREPROCESSED / folder.root.name
            # a camera may have few queries, or only night queries
            others = [] if folder is mapping else [mapping]
            found = preprocess_images(folder, out, options, sequences=others, work=work)
            counts |= {f"{name}_{key}": count for key, count in found.items()}
        return counts
