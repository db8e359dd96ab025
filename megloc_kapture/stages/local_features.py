"""Stage: local features of every image, as kapture keypoints and descriptors."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, PluginError, require
from megloc_kapture.features.image_bound import (
    Frame,
    bounded_size,
    extract_bounded,
    max_megapixels_of,
)
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import FeatureConfig, FeatureReader, FeatureWriter, KaptureFolder
from megloc_kapture.io.kapture.features import feature_folder, has_features
from megloc_kapture.plugin_loading import checked_array
from megloc_kapture.plugins import LocalFeatureExtractor
from megloc_kapture.preprocessing.masks import with_margin
from megloc_kapture.stages import paths
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, Batched, Work, in_batches
from megloc_kapture.values import Camera, LocalFeatures

_log = logging.getLogger(__name__)

_MIN_COMPARED = 100
Job = tuple[str, KaptureFolder]  # an image and its folder


def extract_local_features(
    folders: Sequence[KaptureFolder],
    extractor: LocalFeatureExtractor,
    output: Path,
    *,
    mask_margin_px: float = 0.0,
    work: Work = HERE,
) -> dict[str, int]:
    """Write features of all images (orphan layout) without masked keypoints; return counts."""
    folder_of = images_of(folders, "extract features from")
    is_written = partial(has_features, output, "descriptors", extractor.name)
    images, label = work.unfinished(folder_of, is_written, f"{extractor.name} features")
    # images of equal size can share a batch
    todo = sorted(((image, folder_of[image]) for image in images), key=size_of)
    steps: Batched[Job, LocalFeatures] = Batched(
        partial(_read, mask_margin_px),
        partial(_extract, extractor),
        extractor,
        "extract_many",
        size_of,
    )
    writers: tuple[FeatureWriter, FeatureWriter] | None = None
    masked = 0
    for (image, _), features in zip(todo, work.map(steps, todo, label), strict=True):
        writers = writers or _writers(output, extractor, features)
        masked += features.num_masked
        writers[0].write(image, features.keypoints_px)
        writers[1].write(image, features.descriptors)  # last: it marks the image as finished
    place = feature_folder(output, "keypoints", extractor.name, orphan=True)
    keypoints = FeatureReader("keypoints", extractor.name, [place])
    counts = {"images": len(folder_of), "keypoints": sum(map(keypoints.length, folder_of))}
    bound, sizes = max_megapixels_of(extractor), map(size_of, folder_of.items())
    if reduced := sum(bounded_size(*size, bound) != size for size in sizes):
        counts["images_reduced"] = reduced
    if with_mask := sum(mask_path(folder, image).is_file() for image, folder in folder_of.items()):
        counts |= {"images_with_mask": with_mask, "keypoints_masked": masked}
    return counts


def images_of(folders: Sequence[KaptureFolder], purpose: str) -> dict[str, KaptureFolder]:
    named = [(image, folder) for folder in folders for image in folder.read().image_names()]
    named.sort(key=itemgetter(0))
    for (image, _), (other, _) in pairwise(named):
        require(image != other, f"image {image} is in two kapture folders")
    require(named, f"there are no images to {purpose}")
    return dict(named)


def _writers(
    output: Path, extractor: LocalFeatureExtractor, features: LocalFeatures
) -> tuple[FeatureWriter, FeatureWriter]:
    name, px, descriptors = extractor.name, features.keypoints_px, features.descriptors
    configs = (
        FeatureConfig(name, np.dtype(px.dtype), px.shape[1]),
        FeatureConfig(name, np.dtype(descriptors.dtype), descriptors.shape[1], name),
    )
    return (
        FeatureWriter(output, "keypoints", name, configs[0], orphan=True),
        FeatureWriter(output, "descriptors", name, configs[1], orphan=True),
    )


def size_of(job: Job) -> tuple[int, int]:
    """Return width and height of a job's image."""
    image, folder = job
    camera = folder.read().camera_of(image)
    return camera.width, camera.height


def _read(margin_px: float, job: Job) -> Frame:
    image, folder = job
    return read_frame(folder, image, margin_px=margin_px)


def _extract(
    extractor: LocalFeatureExtractor, jobs: Sequence[Job], frames: Sequence[Frame]
) -> list[LocalFeatures]:
    names = [image for image, _ in jobs]
    try:
        return extract_all(extractor, frames, names)
    except DataError as error:  # raised by a plugin, which does not know the names
        if error.path is not None:
            raise
        raise DataError(error.message, path=" or ".join(names)) from error


def mask_path(folder: KaptureFolder, image: str) -> Path:
    return folder.root / "sensors" / "masks" / f"{image}.png"


def check_lengths(keypoints: FeatureReader, descriptors: FeatureReader, image: str) -> None:
    """Raise DataError if an image has different numbers of descriptors and keypoints."""
    expected, actual = keypoints.length(image), descriptors.length(image)
    if actual != expected:
        raise DataError(
            f"{actual} descriptors for {expected} keypoints", path=descriptors.where(image)
        )


def read_frame(folder: KaptureFolder, image: str, *, margin_px: float = 0.0) -> Frame:
    """Read an image, uint8 (H, W, 3) RGB, and its mask; see :func:`read_mask`."""
    pixels = read_stored_image(folder, image)
    return pixels, read_mask(mask_path(folder, image), pixels.shape[:2], margin_px=margin_px)


def read_stored_image(folder: KaptureFolder, image: str) -> NDArray[np.uint8]:
    """Read an image of a folder, uint8 (H, W, 3) RGB."""
    return read_image_of(folder.image_path(image), folder.read().camera_of(image))


def read_image_of(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Read an image, uint8 (H, W, 3) RGB, and check that it has the camera's size."""
    image = read_image_rgb(path)
    check_size(image.shape[1::-1], camera, path)
    return image


def check_size(size: tuple[int, ...], camera: Camera, name: Path | str) -> None:
    """Raise DataError if an image size (width, height) differs from its camera's."""
    if size != (camera.width, camera.height):
        raise DataError(
            f"the image is {size[0]}x{size[1]}, its camera says {camera.width}x{camera.height}",
            path=name,
        )


def warn_of_other_size(
    spans: Iterable[tuple[NDArray[np.floating[Any]], Sequence[float | str]]],
    local_type: str,
    root: Path,
) -> None:
    """Warn if the extent of keypoints (N, 2 or more) does not fit their images' (width, height)."""
    reach = [
        float((keypoints_px[:, :2] / np.array(size, np.float64)).max())
        for keypoints_px, size in spans
        if len(keypoints_px) >= _MIN_COMPARED and np.array(size, np.float64).all()
    ]
    if reach and not 0.7 < max(reach) < 1.1:
        message = (
            "%s: keypoints of type %r extend to %.0f %% of the size of the images; scale them if "
            "they were extracted at another image size, or the poses will be wrong"
        )
        _log.warning(message, root, local_type, 100 * max(reach))


def read_mask(
    path: Path, shape: tuple[int, ...], *, margin_px: float = 0.0
) -> NDArray[np.bool_] | None:
    """Read a mask of ``shape`` (H, W), True = use; None if there is no file.

    Pixels closer than ``margin_px`` to an ignored one are ignored as well.
    """
    if not path.is_file():
        return None
    mask = read_image_rgb(path)[:, :, 0] > 0
    if mask.shape != tuple(shape):
        raise DataError(
            f"the mask is {mask.shape[1]}x{mask.shape[0]}, its image {shape[1]}x{shape[0]}",
            path=path,
        )
    return with_margin(np.asarray(mask), margin_px)


def extract_all(
    extractor: LocalFeatureExtractor, frames: Sequence[Frame], names: Sequence[str]
) -> list[LocalFeatures]:
    """Extract features from images of one size; very large images are reduced for extraction."""
    features = in_batches(
        extractor,
        "extract_many",
        partial(extract_bounded, extractor),
        frames,
        name=lambda k: f"image {names[k]}",
    )
    return [_checked(extractor, *each) for each in zip(features, names, frames, strict=True)]


def _checked(
    extractor: LocalFeatureExtractor, features: Any, image: str, frame: Frame
) -> LocalFeatures:
    who = f"plugin {extractor.name!r} on image {image}"
    if not isinstance(features, LocalFeatures):
        raise PluginError(f"{who}: got {type(features).__name__}, expected LocalFeatures")
    checked_array(who, features.keypoints_px, (None, None), "float32")
    checked_array(who, features.descriptors, (len(features.keypoints_px), None), "float32", "uint8")
    xy, (height, width) = features.keypoints_px[:, :2], frame[0].shape[:2]
    # detectors may refine a keypoint slightly beyond the border
    if xy.shape[1] != 2 or (xy < -1).any() or (xy > (width + 1, height + 1)).any():
        raise PluginError(f"{who}: keypoints are not x, y within {width}x{height} pixels")
    return features


class ExtractLocalFeatures(PipelineStage):
    """Extract local features of all images."""

    name = "local_features"
    resumes = True
    uses = ("mask_margin_px", *LOCAL_TYPES)
    explained_by = ("local_features",)
    inputs = (PipelineStage.mapping, PipelineStage.query)
    outputs = (paths.LOCAL_FEATURES,)

    def plugins(self) -> Sequence[object]:
        return self.options.make_extractors()

    def run(self, work: StageWork) -> Mapping[str, float]:
        folders = work.folders((self.mapping(), self.query()))
        counts: Counter[str] = Counter()
        for extractor in self.options.make_extractors():
            margin_px = self.options.mask_margin_px
            type_counts = extract_local_features(
                folders, extractor, work.out, mask_margin_px=margin_px, work=work
            )
            counts.update(type_counts)
        return counts
