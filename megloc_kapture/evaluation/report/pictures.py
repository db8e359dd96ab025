"""Small images as data addresses in a page: with dots, joined by lines, and in panels side by side
(masks and classes of an image, its depth)."""

from __future__ import annotations

import base64
import colorsys
import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.report.document import Block, Paragraph, Picture, Pictures
from megloc_kapture.evaluation.report.queries import spread
from megloc_kapture.evaluation.report.wording import counted
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.io.files import read_json_model
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import DepthRow, read_depth_rows, read_mask_counts
from megloc_kapture.values import Options

_QUALITY = 72
_GAP = 6

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


@dataclass(frozen=True)
class SmallImage:
    """An image made small.

    Attributes
    ----------
    width, height : of the small image, pixels.
    scale : small pixels per pixel of the original.
    address : ``data:image/jpeg;base64,...`` or the same of a PNG.
    """

    width: int
    height: int
    scale: float
    address: str


def read_small(path: Path, box: tuple[int, int]) -> SmallImage:
    """An image as :func:`shrunk`; DataError: it is missing or broken."""
    return encoded(*shrunk(read_image_rgb(path), box))


def shrunk(pixels: NDArray[np.uint8], box: tuple[int, int]) -> tuple[NDArray[np.uint8], float]:
    """Pixels (H, W, 3) made to fit into a width and height, never larger; and the scale."""
    import cv2  # only a report with images waits for it

    scale = min(box[0] / pixels.shape[1], box[1] / pixels.shape[0], 1.0)
    size = (max(round(pixels.shape[1] * scale), 1), max(round(pixels.shape[0] * scale), 1))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8), scale


def encoded(pixels: NDArray[np.uint8], scale: float, *, lossless: bool = False) -> SmallImage:
    """Pixels (H, W, 3) RGB as a JPEG, or as a PNG where they are to stay as they are."""
    import cv2

    bgr = np.ascontiguousarray(pixels[:, :, ::-1])
    options = [] if lossless else [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    kind = "png" if lossless else "jpeg"
    encoded = cv2.imencode(f".{kind}", bgr, options)[1]
    text = base64.b64encode(encoded.tobytes()).decode("ascii")
    return SmallImage(pixels.shape[1], pixels.shape[0], scale, f"data:image/{kind};base64,{text}")


def image_tag(picture: SmallImage, name: str) -> Markup:
    """``<img>`` of a picture; ``name`` is read out where images are not shown."""
    return Markup('<img src="{}" width="{}" height="{}" alt="{}">').format(
        picture.address, picture.width, picture.height, name
    )


def side_by_side(
    left: SmallImage,
    right: SmallImage,
    points_px: tuple[NDArray[np.float64], NDArray[np.float64]],
    colors: list[str],
    name: str,
) -> Markup:
    """Two pictures in one ``<svg>``, matched points joined by lines.

    Parameters
    ----------
    points_px : (M, 2) and (M, 2), matched pixels of the two original images.
    colors : of the M lines.
    name : read out where images are not shown.
    """
    width, height = left.width + _GAP + right.width, max(left.height, right.height)
    first = points_px[0] * left.scale
    second = points_px[1] * right.scale + np.array([left.width + _GAP, 0.0])
    parts = [
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(name)}">',
        _placed(left, 0),
        _placed(right, left.width + _GAP),
    ]
    # one path per colour: a line of its own for every match would make the page three times longer
    for color in dict.fromkeys(colors):
        mine = [index for index, own in enumerate(colors) if own == color]
        lines = "".join(
            f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}"
            for (x0, y0), (x1, y1) in zip(first[mine].tolist(), second[mine].tolist(), strict=True)
        )
        parts.append(
            f'<path d="{lines}" stroke="{color}" stroke-width="0.9" stroke-opacity="0.8" '
            'fill="none"/>'
        )
    return Markup("".join([*parts, "</svg>"]))


def dotted(picture: SmallImage, points_px: NDArray[np.float64], color: str, name: str) -> Markup:
    """A picture in an ``<svg>`` with a dot for each point (N, 2), pixels of the original image."""
    # a line of no length with round ends is a dot; as one path it is half as long as circles
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in (points_px * picture.scale).tolist())
    return Markup(
        f'<svg viewBox="0 0 {picture.width} {picture.height}" width="{picture.width}" '
        f'height="{picture.height}" role="img" aria-label="{escape(name)}">'
        # as style: the figures of the same page say for every element that ends are cut
        f'{_placed(picture, 0)}<path d="{dots}" stroke="{color}" stroke-width="2" '
        'style="stroke-linecap:round" fill="none"/></svg>'
    )


def _placed(picture: SmallImage, x: int) -> str:
    return (
        f'<image x="{x}" y="0" width="{picture.width}" height="{picture.height}" '
        f'href="{picture.address}"/>'
    )


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

    depth = subsampled(read_depth(folder, record), _DEPTH_BOX)
    known = depth > 0
    low, high = np.quantile(depth[known], _SPAN) if known.any() else (0.0, 0.0)
    # of inverse depth, so that what is near keeps its shades
    near = 1 / np.where(known, depth, 1)
    show(colored(near, known), "depth", f"depth, {low:.2f} to {high:.2f} {unit}")
    sigma, normals = (read_beside(folder.root, row.image, kind) for kind in ("sigma", "normals"))
    size = (record.camera.height, record.camera.width)
    if sigma is not None and sigma.shape == size:
        share = subsampled(sigma, _DEPTH_BOX) * near
        middle = 100 * float(np.median(share[known])) if known.any() else 0.0
        show(colored(share, known), "standard deviation", f"deviation, median {middle:.2g} %")
    if normals is not None and normals.shape[:2] == size:
        towards = subsampled(normals, _DEPTH_BOX) * np.array([1, -1, -1], np.float32)
        colors = np.round(127.5 * (1 + towards)).clip(0, 255).astype(np.uint8)
        colors[~known] = _UNKNOWN
        show(colors, "normals", "normals")
    facts = (f"{100 * row.fill:.0f} % of the pixels; compared with {', '.join(row.sources)}",)
    return Pictures(row.image, facts, panels=tuple(panels))


def subsampled(values: NDArray[np.float32], box: tuple[int, int]) -> NDArray[np.float32]:
    """Every so many pixels of a map, so that it fits into ``box``, px: between two depths there
    need not be a surface."""
    height, width = values.shape[:2]
    scale = min(box[0] / width, box[1] / height, 1.0)
    rows, columns = (
        ((np.arange(round(size * scale)) + 0.5) / scale).astype(np.int64).clip(0, size - 1)
        for size in (height, width)
    )
    return values[np.ix_(rows, columns)]


def colored(values: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Values (H, W) as colours from purple (least) to yellow, (H, W, 3) RGB."""
    import cv2  # only a report with images waits for it

    low, high = np.quantile(values[known], _SPAN) if known.any() else (0.0, 1.0)
    share = ((values - low) / max(high - low, 1e-12)).clip(0, 1)
    bgr = cv2.applyColorMap(np.round(255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.where(known[..., None], bgr[:, :, ::-1], _UNKNOWN)
