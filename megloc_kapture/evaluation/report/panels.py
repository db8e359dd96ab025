"""Images in panels side by side: their masks and classes, their depth, what a pose shows."""

from __future__ import annotations

import colorsys
import contextlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.report.document import Block, Paragraph, Picture, Pictures
from megloc_kapture.evaluation.report.pictures import (
    dotted,
    encoded,
    image_tag,
    read_small,
    shrunk,
)
from megloc_kapture.evaluation.report.queries import ShownQuery, spread
from megloc_kapture.evaluation.report.wording import counted
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.io.files import read_json_model
from megloc_kapture.io.images import read_depth_map, read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import DepthRow, read_depth_rows, read_mask_counts
from megloc_kapture.values import Options

_MASK_BOX = (340, 280)
_SHOWN_PER_FOLDER = 3
_MAX_DOTS = 2000  # the best; more are a blot, and lengthen the page
_SHADE, _SHADE_SHARE = np.array([214.0, 32.0, 120.0]), 0.62
# where a mask is all that is known
_HIDDEN, _USED = np.array([58, 58, 66], np.uint8), np.array([226, 228, 232], np.uint8)
_DOT = "#16f09a"
_NO_CLASS = (0, 0, 0)

MAX_IMAGES = 12
_DEPTH_BOX = (256, 256)
_UNKNOWN = np.array([46, 50, 58], np.uint8)
# what a colour scale spans, as quantiles: a few wrong depths would take all of it
_SPAN = 0.02, 0.98
_TOLD = (
    "Of each the image; its depth, yellow near to purple far; the standard deviation as a share of "
    "depth, purple small to yellow large; normals of the surface, as colours (red to the right, "
    "green up, blue towards the camera). Dark: nothing is known."
)
# 15 kB each, so that the page stays below 3 MB
MAX_QUERIES = 40
_RENDERED_BOX = (240, 240)


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
        for image in _masked(folder):
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
    said = (
        f"Left the image, in the middle its {'classes' if key else 'mask'}, right the keypoints "
        "that are left; what is masked is shaded."
    )
    if any(dynamic for dynamic, _ in key.values()):
        said += " Red to orange: classes that may move, masked unless the options say otherwise."
    ordered = sorted(key, key=lambda name: (not key[name][0], name))
    entry = Markup(
        '<span class="keep"><span class="key" style="background:{}"></span>{}</span>&ensp;'
    )
    colors_told = Markup(" ").join(entry.format(key[name][1], name) for name in ordered)
    return (Paragraph(said), *([Paragraph(colors_told, "small")] if key else []), *images)


def class_colors(classes: SegmentedClasses | None) -> NDArray[np.uint8]:
    """A colour (256, 3) for each label: what moves from red to orange, what stays green to blue."""
    colors = np.full((256, 3), _NO_CLASS, np.uint8)
    moving = [] if classes is None else [n in classes.dynamic for n in classes.classes[:256]]
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


def _mask_path(folder: KaptureFolder, image: str) -> Path:
    return folder.root / "sensors" / "masks" / f"{image}.png"


def _masked(folder: KaptureFolder) -> list[str]:
    masked = [i for i in folder.read().image_names() if _mask_path(folder, i).is_file()]
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
    mask = read_image_rgb(_mask_path(folder, image))[:, :, 0] > 0
    small, scale = shrunk(pixels, _MASK_BOX)
    hidden = ~_resized(mask.astype(np.uint8), small.shape).astype(bool)
    shaded = small.astype(np.float64)
    shaded[hidden] += _SHADE_SHARE * (_SHADE - shaded[hidden])
    flat, what = np.where(hidden[..., None], _HIDDEN, _USED), "mask"
    if labels is not None:
        flat, what = colors[_resized(labels, small.shape)], "classes"
    keypoints_px, facts = _keypoints(folder, image, mask)
    left = encoded(np.round(shaded).astype(np.uint8), scale)
    panels = (
        image_tag(encoded(small, scale), image),
        image_tag(encoded(np.asarray(flat, np.uint8), scale, lossless=True), what),
        dotted(left, keypoints_px[:_MAX_DOTS], _DOT, f"keypoints of {image}"),
    )
    told = ", ".join((f"{100 * (1 - mask.mean()):.1f} % masked", *facts))
    return Pictures(image, (told,), panels=tuple(Picture(panel) for panel in panels))


def _keypoints(
    folder: KaptureFolder, image: str, mask: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], list[str]]:
    """Keypoints (N, 2) of the first type that the image has, and what there is to say of them."""
    for type_name in folder.types("keypoints"):
        with contextlib.suppress(DataError):
            reader = folder.keypoints(type_name)
            if image not in reader:
                continue
            xy = reader.read(image)[:, :2].astype(np.float64)
            facts = [f"{counted(len(xy), 'keypoint', 'keypoints')} of {type_name} kept"]
            removed: dict[str, int] = {}
            for features_dir in folder.features_dirs:
                with contextlib.suppress(DataError):
                    removed = {**read_mask_counts(features_dir, type_name), **removed}
            if image in removed:
                facts.append(f"{removed[image]} removed")
            column, row = np.floor(xy.T).astype(np.int64)
            limit_row, limit_column = mask.shape[0] - 1, mask.shape[1] - 1
            inside = mask[np.clip(row, 0, limit_row), np.clip(column, 0, limit_column)]
            if not inside.all():
                facts.append(f"{int((~inside).sum())} of them on masked pixels")
            return xy, facts
    return np.zeros((0, 2)), ["no keypoints"]


def _resized(values: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    import cv2

    size = (shape[1], shape[0])
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def depth_blocks(context: ResultContext) -> tuple[Block, ...]:
    """Pictures of at most twelve map images with depth by stereo, evenly chosen.

    What is missing or cannot be read is left out.

    Returns
    -------
    Empty where the map has no depth by stereo.
    """
    from megloc_kapture.stages.stereo_depth import DEPTH_FILE

    mapping, rows = context.mapping, []
    if mapping is not None and (mapping.root / DEPTH_FILE).is_file():
        with contextlib.suppress(DataError):
            rows = read_depth_rows(mapping.root / DEPTH_FILE)
    done = sorted((row for row in rows if not row.reason), key=lambda row: row.image)
    if mapping is None or not done:
        return ()
    unit = "m" if context.unit == METRES else context.unit
    pictures = []
    for at in spread(len(done), MAX_IMAGES).tolist():
        # a report without this image is better than none
        with contextlib.suppress(DataError):
            pictures.append(_with_depth(mapping, done[at], unit))
    reasons = Counter(row.reason for row in rows if row.reason).most_common(4)
    said = (
        f"{len(done)} of {counted(len(rows), 'map image', 'map images')} with depth by stereo, on "
        f"{100 * float(np.mean([row.fill for row in done])):.0f} % of their pixels."
        + "".join(f" {count} without: {reason}." for reason, count in reasons)
        + (f" {len(pictures)} are shown." if len(pictures) < len(done) else "")
    )
    return Paragraph(said), Paragraph(_TOLD, "small"), *pictures


def _with_depth(folder: KaptureFolder, row: DepthRow, unit: str) -> Pictures:
    """The panels of an image; raises DataError where it or its depth cannot be read."""
    from megloc_kapture.stages.scene import depth_records, read_depth
    from megloc_kapture.stages.stereo_depth import read_beside

    record = depth_records(folder.read()).get(row.image)
    if record is None:
        raise DataError(f"no depth record of {row.image}", path=folder.root)
    small = read_small(folder.image_path(row.image), _DEPTH_BOX)
    panels = [Picture(image_tag(small, row.image))]

    def show(pixels: NDArray[np.uint8], name: str, caption: str) -> None:
        panels.append(Picture(image_tag(encoded(pixels, 1.0), name), caption))

    depth = _subsampled(read_depth(folder, record), _DEPTH_BOX)
    known = depth > 0
    low, high = np.quantile(depth[known], _SPAN) if known.any() else (0.0, 0.0)
    # of inverse depth, so that what is near keeps its shades
    near = 1 / np.where(known, depth, 1)
    show(_colored(near, known), "depth", f"depth, {low:.2f} to {high:.2f} {unit}")
    sigma, normals = (read_beside(folder.root, row.image, kind) for kind in ("sigma", "normals"))
    size = (record.camera.height, record.camera.width)
    if sigma is not None and sigma.shape == size:
        share = _subsampled(sigma, _DEPTH_BOX) * near
        middle = 100 * float(np.median(share[known])) if known.any() else 0.0
        show(_colored(share, known), "standard deviation", f"deviation, median {middle:.2g} %")
    if normals is not None and normals.shape[:2] == size:
        towards = _subsampled(normals, _DEPTH_BOX) * np.array([1, -1, -1], np.float32)
        colors = np.round(127.5 * (1 + towards)).clip(0, 255).astype(np.uint8)
        colors[~known] = _UNKNOWN
        show(colors, "normals", "normals")
    facts = (f"{100 * row.fill:.0f} % of the pixels; compared with {', '.join(row.sources)}",)
    return Pictures(row.image, facts, panels=tuple(panels))


def _subsampled(values: NDArray[np.float32], box: tuple[int, int]) -> NDArray[np.float32]:
    """Every so many pixels of a map, so that it fits into ``box``, px: between two depths there
    need not be a surface."""
    height, width = values.shape[:2]
    scale = min(box[0] / width, box[1] / height, 1.0)
    rows, columns = (
        ((np.arange(round(size * scale)) + 0.5) / scale).astype(np.int64).clip(0, size - 1)
        for size in (height, width)
    )
    return values[np.ix_(rows, columns)]


def _colored(values: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Values (H, W) as colours from purple (least) to yellow, (H, W, 3) RGB."""
    import cv2  # only a report with images waits for it

    low, high = np.quantile(values[known], _SPAN) if known.any() else (0.0, 1.0)
    share = ((values - low) / max(high - low, 1e-12)).clip(0, 1)
    bgr = cv2.applyColorMap(np.round(255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.where(known[..., None], bgr[:, :, ::-1], _UNKNOWN)


def rendered_queries(
    rendered: KaptureFolder, queries: Sequence[ShownQuery], photographs: KaptureFolder | None
) -> tuple[dict[str, list[tuple[str, str]]], list[str]]:
    """What the poses of queries show, beside their photographs.

    Parameters
    ----------
    rendered : as :func:`megloc_kapture.stages.neural_field.render_along` writes it: an image of a
        query's name, whatever it ends in, and its depth.
    photographs : the queries; what cannot be read of them is left out.

    Returns
    -------
    Query's name -> caption and data address of each picture, of at most 40, in the order of
    ``queries``; and sentences on what is left out.

    Raises
    ------
    DataError : an image or a depth map is broken, or there is none of any query.
    """
    from megloc_kapture.stages.scene import depth_records

    data = rendered.read()
    images = {Path(name).with_suffix(""): name for name in data.image_names()}
    depths, found, notes = depth_records(data), dict[str, list[tuple[str, str]]](), list[str]()
    shown = [q for q in queries if Path(q.image).with_suffix("") in images and q.estimated]
    if not shown:
        raise DataError("no image here is a query of the result with a pose", path=rendered.root)
    if len(shown) > MAX_QUERIES:
        notes.append(f"Renderings are shown of {MAX_QUERIES} of {len(shown)} queries.")
    for query in shown[:MAX_QUERIES]:
        name = images[Path(query.image).with_suffix("")]
        panels = found.setdefault(query.name, [])
        with contextlib.suppress(DataError):
            if photographs is not None:
                path = photographs.image_path(query.image)
                panels.append(("photograph", read_small(path, _RENDERED_BOX).address))
        picture = read_small(rendered.image_path(name), _RENDERED_BOX)
        panels.append(("rendered at the pose", picture.address))
        if (record := depths.get(name)) is not None:
            size = {"width": record.camera.width, "height": record.camera.height}
            depth = read_depth_map(rendered.depth_path(record.path), **size)
            metres = _subsampled(depth, _RENDERED_BOX)
            known = metres > 0
            near = _colored(1 / np.where(known, metres, 1), known)
            panels.append(("its depth", encoded(near, 1.0).address))
    return found, notes
