"""One image of pre-processing: the new image or a link to the old one, and its mask."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import link_file
from megloc_kapture.io.images import image_as_read_back, image_size, write_image
from megloc_kapture.preprocessing.frames import (
    FramePlan,
    processed_image,
    processed_mask,
    reached_region,
)
from megloc_kapture.stages.class_masks import ClassMasks
from megloc_kapture.stages.image_masks import Mask, MaskFiles
from megloc_kapture.stages.local_features import read_image_of

CLASSES = "classes"
# a JPEG stays one: at this quality half of the keypoints move by less than 0.03 px, at a third of
# the size that it would have as PNG
_JPEG_QUALITY = 98


@dataclass(frozen=True)
class FrameJob:
    """One image to process.

    Parameters
    ----------
    source : where it is; output : the new kapture.
    link : it does not change and has no place in the new kapture yet.
    files, standing : masks in original pixels, of the image and of its camera.
    """

    image: str
    source: Path
    output: Path
    plan: FramePlan
    link: bool
    files: MaskFiles
    standing: Mapping[str, Mask]
    classes: ClassMasks | None


def process_frame(job: FrameJob) -> dict[str, float]:
    """Write what becomes of one image and its mask.

    Returns
    -------
    The share of its pixels masked by each source of masks, and by ``all`` of them; empty where
    there is none.

    Raises
    ------
    DataError : the image or a mask is absent, broken, or not of the camera's size.
    """
    image = _image(job)
    masks = _masks(job, image)
    if not masks:
        return {}
    masks["all"] = np.logical_and.reduce(list(masks.values()))
    content = masks["all"].astype(np.uint8) * 255
    write_image(job.output / "sensors" / "masks" / f"{job.image}.png", content)
    return {source: float((~mask).mean()) for source, mask in masks.items()}


def _image(job: FrameJob) -> NDArray[np.uint8] | None:
    """The new image, written or linked; None where nobody needs its pixels."""
    place = job.output / "sensors" / "records_data" / job.image
    camera = job.plan.original
    if job.plan.changes_pixels:
        image = processed_image(read_image_of(job.source, camera), job.plan)
        write_image(place, _grey_if_grey(image), jpeg_quality=_JPEG_QUALITY)
        return image
    size = image_size(job.source)
    if size != (camera.width, camera.height):
        raise DataError(
            f"the image is {size[0]}x{size[1]}, its camera says {camera.width}x{camera.height}",
            path=job.source,
        )
    if job.link:
        link_file(job.source, place)
    return None if job.classes is None else read_image_of(job.source, camera)


def _masks(job: FrameJob, image: NDArray[np.uint8] | None) -> dict[str, Mask]:
    """The masks of the new image by source."""
    shape = (job.plan.original.height, job.plan.original.width)
    original = {**job.files.read(shape), **job.standing}
    masks = {source: processed_mask(mask, job.plan) for source, mask in original.items()}
    if job.classes is not None and image is not None:
        labels = job.classes.labels(image, job.image)
        write_image(job.output / "sensors" / CLASSES / f"{job.image}.png", labels)
        masks["classes"] = job.classes.mask(labels)
    reached = reached_region(job.plan)
    if reached is not None:
        masks["unseen"] = reached
    return masks


def frame_as_stored(image: NDArray[np.uint8], plan: FramePlan, name: str) -> NDArray[np.uint8]:
    """A processed image as it is read from the new kapture: a JPEG has lost a little.

    Parameters
    ----------
    name : of the image, whose suffix says how it is stored.
    """
    if not plan.changes_pixels:
        return image
    read = image_as_read_back(_grey_if_grey(image), name, jpeg_quality=_JPEG_QUALITY)
    return read if read.ndim == 3 else image


def _grey_if_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """One channel of a grey image: a third of the size, and the same pixels when read."""
    red = image[..., 0]
    grey = np.array_equal(red, image[..., 1]) and np.array_equal(red, image[..., 2])
    return np.ascontiguousarray(red) if grey else image
