"""Pictures of masks: images, their classes, and the keypoints that are left, side by side."""

from __future__ import annotations

import colorsys
import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.report.document import Block, Paragraph, Picture, Pictures
from megloc_kapture.evaluation.report.pictures import dotted, encoded, image_tag, shrunk
from megloc_kapture.evaluation.report.wording import counted
from megloc_kapture.io.files import read_json_model
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import read_mask_counts
from megloc_kapture.values import Options

_BOX = (340, 280)
_SHOWN_PER_FOLDER = 3
_MAX_DOTS = 2000  # the best; more are a blot, and lengthen the page
_SHADE, _SHADE_SHARE = np.array([214.0, 32.0, 120.0]), 0.62
# where a mask is all that is known
_HIDDEN, _USED = np.array([58, 58, 66], np.uint8), np.array([226, 228, 232], np.uint8)
_DOT = "#16f09a"
_NO_CLASS = (0, 0, 0)


class SegmentedClasses(Options):
    """``sensors/classes/classes.json``: the names behind the labels beside it."""

    classes: tuple[str, ...]
    dynamic: frozenset[str] = frozenset()


def mask_blocks(folders: Sequence[KaptureFolder]) -> tuple[Block, ...]:
    """Pictures of a few images of each folder, evenly chosen from those that have a mask.

    Each shows the image; its classes, or its mask where no classes are known; the keypoints that
    are left. What is missing or cannot be read is left out.

    Parameters
    ----------
    folders : with ``sensors/masks`` (0 = ignored), perhaps ``sensors/classes``, and the keypoints
        in the pixels of their own images.

    Returns
    -------
    Empty where no image has a mask.
    """
    images: list[Pictures] = []
    # name -> whether it may move, and its colour
    key: dict[str, tuple[bool, str]] = {}
    for folder in folders:
        classes = _classes(folder)
        colors = class_colors(classes)
        for image in _chosen(folder):
            # a report without this image is better than none
            with contextlib.suppress(DataError):
                labels = None if classes is None else _labels(folder, image)
                images.append(_masked_image(folder, image, labels, colors))
                if classes is not None and labels is not None:
                    for label in np.unique(labels[labels < len(classes.classes)]).tolist():
                        name = classes.classes[label]
                        color = "#{:02x}{:02x}{:02x}".format(*colors[label].tolist())
                        key[name] = (name in classes.dynamic, color)
    if not images:
        return ()
    moving = any(dynamic for dynamic, _ in key.values())
    said = (
        f"Left the image, in the middle its {'classes' if key else 'mask'}, right the keypoints "
        "that are left; what is masked is shaded."
    )
    if moving:
        said += " Red to orange: classes that may move, masked unless the options say otherwise."
    ordered = sorted(key, key=lambda name: (not key[name][0], name))
    entry = Markup(
        '<span class="keep"><span class="key" style="background:{}"></span>{}</span>&ensp;'
    )
    colors_told = Markup(" ").join(entry.format(key[name][1], name) for name in ordered)
    return (Paragraph(said), *([Paragraph(colors_told, "small")] if key else []), *images)


def mask_path(folder: KaptureFolder, image: str) -> Path:
    """Path of an image's mask."""
    return folder.root / "sensors" / "masks" / f"{image}.png"


def class_colors(classes: SegmentedClasses | None) -> NDArray[np.uint8]:
    """A colour (256, 3) for each label: what moves from red to orange, what stays green to blue."""
    colors = np.full((256, 3), _NO_CLASS, np.uint8)
    names = () if classes is None else classes.classes[:256]
    moving = [name in classes.dynamic for name in names] if classes is not None else []
    for dynamic, (first, last) in ((True, (-0.07, 0.12)), (False, (0.22, 0.72))):
        labels = [label for label, moves in enumerate(moving) if moves == dynamic]
        for number, label in enumerate(labels):
            hue = first + (last - first) * (number + 0.5) / len(labels)
            # neighbours in hue differ in brightness as well
            strength, brightness = (0.85, 1.0) if dynamic else (0.35, 0.88)
            value = brightness if number % 2 == 0 else 0.65 * brightness
            rgb = colorsys.hsv_to_rgb(hue % 1.0, strength, value)
            colors[label] = np.round(np.array(rgb) * 255)
    return colors


def _classes(folder: KaptureFolder) -> SegmentedClasses | None:
    path = folder.root / "sensors" / "classes" / "classes.json"
    with contextlib.suppress(DataError):
        return read_json_model(path, SegmentedClasses) if path.is_file() else None
    return None


def _chosen(folder: KaptureFolder) -> list[str]:
    masked = [i for i in folder.read().image_names() if mask_path(folder, i).is_file()]
    number = min(len(masked), _SHOWN_PER_FOLDER)
    # the middles of equal parts
    return [masked[(2 * part + 1) * len(masked) // (2 * number)] for part in range(number)]


def _labels(folder: KaptureFolder, image: str) -> NDArray[np.uint8] | None:
    path = folder.root / "sensors" / "classes" / f"{image}.png"
    with contextlib.suppress(DataError):
        return read_image_rgb(path)[:, :, 0] if path.is_file() else None
    return None


def _masked_image(
    folder: KaptureFolder,
    image: str,
    labels: NDArray[np.uint8] | None,
    colors: NDArray[np.uint8],
) -> Pictures:
    """The three panels of an image; raises DataError where it or its mask cannot be read."""
    pixels = read_image_rgb(folder.image_path(image))
    mask = read_image_rgb(mask_path(folder, image))[:, :, 0] > 0
    small, scale = shrunk(pixels, width=_BOX[0], height=_BOX[1])
    hidden = ~_resized(mask.astype(np.uint8), small.shape).astype(bool)
    shaded = small.astype(np.float64)
    shaded[hidden] += _SHADE_SHARE * (_SHADE - shaded[hidden])
    if labels is None:
        flat = np.where(hidden[..., None], _HIDDEN, _USED)
        what = "mask"
    else:
        flat = colors[_resized(labels, small.shape)]
        what = "classes"
    keypoints_px, facts = _keypoints(folder, image, mask)
    left = encoded(np.round(shaded).astype(np.uint8), scale)
    panels = (
        image_tag(encoded(small, scale), image),
        image_tag(encoded(np.asarray(flat, np.uint8), scale, lossless=True), what),
        dotted(left, keypoints_px[:_MAX_DOTS], _DOT, f"keypoints of {image}"),
    )
    return Pictures(
        image,
        (", ".join((f"{100 * (1 - mask.mean()):.1f} % masked", *facts)),),
        panels=tuple(Picture(panel) for panel in panels),
    )


def _keypoints(
    folder: KaptureFolder, image: str, mask: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Keypoints (N, 2) of the first type that the image has, and what there is to say of them."""
    for type_name in folder.types("keypoints"):
        with contextlib.suppress(DataError):
            reader = folder.keypoints(type_name)
            if image not in reader:
                continue
            xy = reader.read(image)[:, :2].astype(np.float64)
            facts = [f"{counted(len(xy), 'keypoint', 'keypoints')} of {type_name} kept"]
            removed = _removed(folder, type_name).get(image)
            if removed is not None:
                facts.append(f"{removed} removed")
            column, row = np.floor(xy.T).astype(np.int64)
            limit_row, limit_column = mask.shape[0] - 1, mask.shape[1] - 1
            inside = mask[np.clip(row, 0, limit_row), np.clip(column, 0, limit_column)]
            if not inside.all():
                facts.append(f"{int((~inside).sum())} of them on masked pixels")
            return xy, tuple(facts)
    return np.zeros((0, 2)), ("no keypoints",)


def _removed(folder: KaptureFolder, type_name: str) -> dict[str, int]:
    counts: dict[str, int] = {}
    for features_dir in folder.features_dirs:
        with contextlib.suppress(DataError):
            counts = {**read_mask_counts(features_dir, type_name), **counts}
    return counts


def _resized(values: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    import cv2

    size = (shape[1], shape[0])
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST), np.uint8)
