"""Stage: resized, undistorted and masked images, as a new kapture without features and points.

Names, poses, rigs, records and sensor ids are kept. Unchanged images and depth maps are linked. The
masks of all sources are combined: a pixel is used if all masks use it.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from operator import attrgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError, OptionError, OutputError, PluginError, require
from megloc_kapture.io.files import link_file, link_records, write_json
from megloc_kapture.io.images import image_as_read_back, image_size, write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.plugin_loading import NetworkOptions, checked_array, load_chosen
from megloc_kapture.plugins import SEGMENTERS, PluginChoice, Segmenter
from megloc_kapture.preprocessing.frames import (
    FramePlan,
    plan_frame,
    processed_image,
    processed_mask,
    reached_region,
)
from megloc_kapture.preprocessing.masks import (
    MAX_IMAGES,
    MIN_IMAGES,
    FixedMask,
    UnchangingRegion,
    edge_directions,
    find_unchanging_region,
)
from megloc_kapture.stages import paths
from megloc_kapture.stages.local_features import check_size, mask_path, read_image_of, read_mask
from megloc_kapture.stages.stage import PipelineStage, StageWork, files_fingerprint
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, Options

# the loss shifts detected keypoints by 0.022 px (median); files have 28 % of the size of PNG
JPEG_QUALITY = 98

Mask = NDArray[np.bool_]
_SIZE = attrgetter("width", "height")


class MaskOptions(Options):
    """Mask sources in addition to the kapture's masks; by default none."""

    segmenter: PluginChoice | None = Field(
        default=None, description="network that predicts the class of each pixel"
    )
    dynamic: tuple[str, ...] | None = Field(
        default=None, description="classes to mask; unset: the segmenter's dynamic classes"
    )
    fixed: tuple[FixedMask, ...] = Field(default=(), description="static masks per camera")
    unchanging: bool = Field(
        default=False,
        description="detect and mask the static ego-vehicle region of each camera",
    )
    user_masks: Path | None = Field(
        default=None, description="folder of masks IMAGE.png, 0 for ignored pixels"
    )

    def make_classes(self, placement: NetworkOptions) -> ClassMasks | None:
        if self.segmenter is None:
            return None
        segmenter: Segmenter = load_chosen(SEGMENTERS, self.segmenter, placement)
        wanted = segmenter.dynamic if self.dynamic is None else self.dynamic
        if unknown := sorted(set(wanted) - set(segmenter.classes)):
            raise OptionError(
                f"segmenter {segmenter.name!r} has no class {unknown[0]!r}; "
                f"it has: {', '.join(segmenter.classes)}"
            )
        return ClassMasks(segmenter, tuple(name for name in segmenter.classes if name in wanted))


def mask_files(
    folder: KaptureFolder, images: Iterable[str], user_masks: Path | None
) -> dict[str, dict[str, Path]]:
    """Find mask files by image and source: ``own`` in the kapture, ``user`` in ``user_masks``."""
    if user_masks is not None and not user_masks.is_dir():
        raise DataError("no such folder of masks", path=user_masks)
    files_of = {}
    for image in images:
        places = {"own": mask_path(folder, image)}
        if user_masks is not None:
            places["user"] = user_masks / f"{image}.png"
        files_of[image] = {source: path for source, path in places.items() if path.is_file()}
    if user_masks is not None and not any("user" in files for files in files_of.values()):
        example = next(iter(files_of), "a/b.jpg")
        raise DataError(
            f"no mask of any image in this folder; the mask of {example} would be {example}.png",
            path=user_masks,
        )
    return files_of


def _standing_masks(
    fixed: Sequence[FixedMask], region: UnchangingRegion | None, camera: Camera
) -> dict[str, Mask]:
    """Return the masks of a camera by source, bool (H, W), in original pixels."""
    masks, size = {}, (camera.width, camera.height)
    drawn = [each.drawn(*size) if each.file is None else _mask(each.file, camera) for each in fixed]
    if drawn:
        masks["fixed"] = np.logical_and.reduce(drawn)
    if region:
        masks["unchanging"] = region.mask(*size)
    return masks


def _mask(path: Path, camera: Camera) -> Mask:
    mask = read_mask(path, (camera.height, camera.width))
    if mask is None:
        raise DataError("no such mask", path=path)
    return mask


@dataclass(frozen=True)
class ClassMasks:
    """A segmenter with the classes to mask, ``dynamic``, in the order of their labels."""

    segmenter: Segmenter
    dynamic: tuple[str, ...]

    def labels(self, image: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
        """Return the label of each pixel, uint8 (H, W), of an image (H, W, 3)."""
        who = f"plugin {self.segmenter.name!r} on image {name}"
        labels = checked_array(who, self.segmenter.segment(image), image.shape[:2], "uint8")
        if labels.max() >= len(self.segmenter.classes):
            raise PluginError(
                f"{who}: label {labels.max()}, but there are {len(self.segmenter.classes)} classes"
            )
        return labels

    def mask(self, labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return the mask bool (H, W), True = use."""
        used = np.array([name not in self.dynamic for name in self.segmenter.classes])
        return np.asarray(used[labels])


def find_unchanging_regions(
    folder: KaptureFolder, sequences: Sequence[KaptureFolder] = (), *, work: Work = HERE
) -> dict[str, UnchangingRegion]:
    """Find the static region of each camera by sensor id; a missing region is falsy, with a reason.

    ``sequences`` are folders with more images of these cameras: for queries, the map.
    """
    regions: dict[str, UnchangingRegion] = {}
    for sensor in sorted({sensor for _, sensor in folder.read().records_camera}):
        images = _images_of(sensor, [folder, *sequences])
        if len(images) < MIN_IMAGES:
            reason = f"it has {len(images)} images; at least {MIN_IMAGES} of a sequence are needed"
            regions[sensor] = UnchangingRegion((), reason)
            continue
        number = min(len(images), MAX_IMAGES)
        rows = np.linspace(0, len(images) - 1, number).round().astype(int)
        edges = work.map(_edges, [images[k] for k in rows], "unchanging regions")
        regions[sensor] = find_unchanging_region(edges)
    return regions


def _images_of(sensor: str, folders: Sequence[KaptureFolder]) -> list[tuple[Path, Camera]]:
    images: list[tuple[Path, Camera]] = []
    for folder in folders:
        data = folder.read()
        records = sorted((t, image) for (t, s), image in data.records_camera.items() if s == sensor)
        for _, image in records:
            camera = data.camera_of(image)
            if not images or _SIZE(camera) == _SIZE(images[0][1]):
                images.append((folder.image_path(image), camera))
    return images


def _edges(image: tuple[Path, Camera]) -> NDArray[np.float32]:
    return edge_directions(read_image_of(*image))


class ProcessedFrame:
    """An image after pre-processing, with lazily computed pixels and masks.

    ``read`` returns the original image, uint8 (H, W, 3) RGB; ``masks`` the original masks by
    source, bool (H, W), True = use.
    """

    def __init__(
        self,
        name: str,
        plan: FramePlan,
        read: Callable[[], NDArray[np.uint8]],
        masks: Callable[[], Mapping[str, Mask]],
        classes: Callable[[], ClassMasks | None],
    ) -> None:
        self.name, self.plan = name, plan
        self._read, self._original_masks, self._classes = read, masks, classes

    @cached_property
    def _exact(self) -> NDArray[np.uint8]:
        """Return the new image, uint8 (H, W, 3) RGB, before it is written."""
        image = self._read()
        return processed_image(image, self.plan) if self.plan.changes_pixels else image

    @property
    def written(self) -> NDArray[np.uint8]:
        """Return the pixels to write; a grey image has only one channel."""
        red = self._exact[..., 0]
        grey = all(np.array_equal(red, self._exact[..., channel]) for channel in (1, 2))
        return np.ascontiguousarray(red) if grey else self._exact

    @cached_property
    def pixels(self) -> NDArray[np.uint8]:
        """Return the new image as it reads back from its file, with JPEG loss."""
        if not self.plan.changes_pixels:
            return self._exact
        read = image_as_read_back(self.written, self.name, jpeg_quality=JPEG_QUALITY)
        return read if read.ndim == 3 else self._exact

    @cached_property
    def labels(self) -> NDArray[np.uint8] | None:
        """Return the class of each pixel, uint8 (H, W), if there is a segmenter."""
        classes = self._classes()
        return None if classes is None else classes.labels(self._exact, self.name)

    @cached_property
    def masks(self) -> dict[str, Mask]:
        """Return the masks of the new image by source, bool (H, W), True = use."""
        original = self._original_masks()
        masks = {source: processed_mask(mask, self.plan) for source, mask in original.items()}
        classes = self._classes()
        if classes is not None and self.labels is not None:
            masks["classes"] = classes.mask(self.labels)
        reached = reached_region(self.plan)
        if reached is not None:
            masks["unseen"] = reached
        return masks

    @cached_property
    def mask(self) -> Mask | None:
        """Return the combined mask; None means no mask."""
        return np.logical_and.reduce(list(self.masks.values())) if self.masks else None


CLASSES, CLASSES_FILE = "classes", "classes.json"
_log = logging.getLogger(__name__)


class PreprocessingOptions(Options):
    """Options for size, projection and masks of the images, which by default do not change."""

    max_size_px: int | None = Field(
        default=None,
        gt=0,
        description="longer side of reduced images; unset: original size",
    )
    upscale: bool = Field(
        default=False, description="also enlarge images with a longer side below max_size_px"
    )
    undistort: bool = Field(default=False, description="remove lens distortion")
    masks: MaskOptions = MaskOptions()

    def plan(self, camera: Camera) -> FramePlan:
        return plan_frame(
            camera,
            max_size_px=self.max_size_px,
            upscale=self.upscale,
            undistort=self.undistort,
        )


def _process(
    output: Path,
    classes: ClassMasks | None,
    job: tuple[str, Path, FramePlan, bool, Mapping[str, Path], Mapping[str, Mask]],
) -> dict[str, float]:
    """Write one image and its mask; return the share of masked pixels by source and overall."""
    image, source, plan, link, mask_paths, standing = job
    sensors, camera = output / "sensors", plan.original
    write = partial(write_image, jpeg_quality=JPEG_QUALITY)
    frame = ProcessedFrame(
        image,
        plan,
        lambda: read_image_of(source, camera),
        lambda: {**{key: _mask(path, camera) for key, path in mask_paths.items()}, **standing},
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
    sequences: Sequence[KaptureFolder] = (),
    work: Work = HERE,
) -> dict[str, float]:
    """Write a kapture with pre-processed images, cameras and masks.

    Return counts for the log, including the proportion of pixels masked by each source.

    ``sensors/masks/IMAGE.png`` (0 = ignore) is written for images that have a mask of any source,
    or pixels outside the original. ``sensors/classes`` has the segmenter's labels. ``sequences``
    are more folders in which to find static regions: for queries, the map.
    """
    if output.resolve().is_relative_to(folder.root.resolve()):
        raise OutputError(f"{output}: is inside the input kapture folder, which is not modified")
    classes = options.masks.make_classes(work.placement)
    data = folder.read()
    records = sorted(data.records_camera.items(), reverse=True)
    first_image = {sensor: image for (_, sensor), image in records}
    plans = {sensor: options.plan(data.camera_of(image)) for sensor, image in first_image.items()}
    images = data.image_names()
    files = mask_files(folder, images, options.masks.user_masks)
    regions: dict[str, UnchangingRegion] = {}
    if options.masks.unchanging:
        regions = find_unchanging_regions(folder, sequences, work=work)
    fixed = options.masks.fixed
    remarks = _remarks(regions, any(mask.fallback for mask in fixed))
    sensor_of = {image: data.record_of(image)[1] for image in images}
    for mask in fixed:
        if not any(mask.is_for(sensor, image) for image, sensor in sensor_of.items()):
            remarks.append(f"a fixed mask matches no image: {mask.camera}")

    write_sensors(output, _with_cameras(data, plans))
    linked = _link_records(folder, output, plans)
    if classes is not None:
        what = {"classes": list(classes.segmenter.classes), "dynamic": list(classes.dynamic)}
        write_json(output / "sensors" / CLASSES / CLASSES_FILE, what)

    standing_masks = lru_cache(maxsize=64)(_standing_masks)

    def jobs() -> Iterator[tuple[str, Path, FramePlan, bool, dict[str, Path], Mapping[str, Mask]]]:
        for image in images:
            sensor = sensor_of[image]
            plan, region = plans[sensor], regions.get(sensor)
            link = not (linked or plan.changes_pixels)
            applied = tuple(
                mask
                for mask in fixed
                if mask.is_for(sensor, image) and not (mask.fallback and region)
            )
            standing = standing_masks(applied, region, plan.original)
            yield image, folder.image_path(image), plan, link, files[image], standing

    plugins = () if classes is None else (classes.segmenter,)
    process = partial(_process, output, classes)
    results = work.map(process, jobs(), "pre-processing", len(images), plugins=plugins)
    shares: Counter[str] = Counter()
    num_masked = 0
    for image_shares in results:
        num_masked += bool(image_shares)
        shares.update(image_shares)
    for remark in remarks:
        _log.warning("%s", remark)
    return {
        "images": len(images),
        "images_changed": sum(plans[s].changes_pixels for _, s in data.records_camera),
        "images_masked": num_masked,
        **{f"masked_{source}": shares[source] / len(images) for source in sorted(shares)},
    }


def _remarks(regions: Mapping[str, UnchangingRegion], have_fallback: bool) -> list[str]:
    """Report cameras without a static region.

    If all cameras have too few images, a fixed fallback mask is required.
    """
    remarks = [f"camera {name}: {r.reason}" for name, r in sorted(regions.items()) if not r]
    if regions and not (have_fallback or any(region.frontier for region in regions.values())):
        raise OptionError(f"no static region is found: {remarks[0]}")
    return remarks


def _with_cameras(data: KaptureData, plans: Mapping[str, FramePlan]) -> KaptureData:
    """Replace the cameras that change; unchanged cameras keep their exact digits."""
    sensors = dict(data.sensors)
    for sensor_id, plan in plans.items():
        if plan.processed != plan.original:
            name = data.sensors[sensor_id].name
            sensors[sensor_id] = Sensor.from_camera(plan.processed, name=name)
    return replace(data, sensors=sensors)


def _link_records(folder: KaptureFolder, output: Path, plans: Mapping[str, FramePlan]) -> bool:
    """Link all records if no image changes, else only depth maps; return whether all are."""
    records = folder.root / "sensors" / "records_data"
    if records.is_dir() and not any(plan.changes_pixels for plan in plans.values()):
        link_records(output, {"": records})
        return True
    for name in sorted(folder.read().records_depth.values()):
        source = folder.depth_path(name)
        require(source.is_file(), "no such depth map", path=source)
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
    inputs = (paths.MAPPING, paths.QUERY)
    outputs = (paths.PREPROCESSED,)

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
        mapping, *queries = work.folders((paths.MAPPING, paths.QUERY))
        options, counts = self.options.preprocessing, dict[str, float]()
        for folder in (mapping, *queries):
            name, out = folder.root.name, work.out / paths.PREPROCESSED / folder.root.name
            # static regions of queries also use the map's images, as a camera may have few queries
            # or only night queries
            others = [] if folder is mapping else [mapping]
            counted = preprocess_images(folder, out, options, sequences=others, work=work)
            counts |= {f"{name}_{key}": count for key, count in counted.items()}
        return counts
