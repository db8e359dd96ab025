"""Small images as data addresses in a page, dots on them, lines between two of them."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from megloc_kapture.io.images import read_image_rgb

_QUALITY = 72
_GAP = 6


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
