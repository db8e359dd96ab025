"""Pictures of estimated depth: map images with their depth, its deviation and normals."""

from __future__ import annotations

import contextlib
from collections import Counter

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.report.document import Block, Paragraph, Picture, Pictures
from megloc_kapture.evaluation.report.pictures import encoded, image_tag, shrunk
from megloc_kapture.evaluation.report.shown_queries import spread
from megloc_kapture.evaluation.report.wording import counted
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import DepthRow, read_depth_rows

MAX_IMAGES = 12
_BOX = (256, 256)
_UNKNOWN = np.array([46, 50, 58], np.uint8)
# what a colour scale spans, as quantiles: a few wrong depths would take all of it
_SPAN = 0.02, 0.98
_TOLD = (
    "Of each the image; its depth, yellow near to purple far; the standard deviation as a share of "
    "depth, purple small to yellow large; normals of the surface, as colours (red to the right, "
    "green up, blue towards the camera). Dark: nothing is known."
)


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
            pictures.append(_pictured(mapping, done[at], unit))
    reasons = Counter(row.reason for row in rows if row.reason).most_common(4)
    said = (
        f"{len(done)} of {counted(len(rows), 'map image', 'map images')} with depth by stereo, on "
        f"{100 * float(np.mean([row.fill for row in done])):.0f} % of their pixels."
        + "".join(f" {count} without: {reason}." for reason, count in reasons)
        + (f" {len(pictures)} are shown." if len(pictures) < len(done) else "")
    )
    return Paragraph(said), Paragraph(_TOLD, "small"), *pictures


def _pictured(folder: KaptureFolder, row: DepthRow, unit: str) -> Pictures:
    """The panels of an image; raises DataError where it or its depth cannot be read."""
    from megloc_kapture.stages.rigs import depth_records, read_depth
    from megloc_kapture.stages.stereo_depth import read_beside

    record = depth_records(folder.read()).get(row.image)
    if record is None:
        raise DataError(f"no depth record of {row.image}", path=folder.root)
    pixels = read_image_rgb(folder.image_path(row.image))
    depth = subsampled(read_depth(folder, record))
    known = depth > 0
    low, high = np.quantile(depth[known], _SPAN) if known.any() else (0.0, 0.0)
    # of inverse depth, so that what is near keeps its shades
    near = 1 / np.where(known, depth, 1)
    panels = [
        Picture(image_tag(encoded(*shrunk(pixels, width=_BOX[0], height=_BOX[1])), row.image)),
        Picture(_tag(colored(near, known), "depth"), f"depth, {low:.2f} to {high:.2f} {unit}"),
    ]
    sigma, normals = (read_beside(folder.root, row.image, kind) for kind in ("sigma", "normals"))
    if sigma is not None and sigma.shape == (record.camera.height, record.camera.width):
        share = subsampled(sigma) * near
        middle = 100 * float(np.median(share[known])) if known.any() else 0.0
        picture = _tag(colored(share, known), "standard deviation")
        panels.append(Picture(picture, f"deviation, median {middle:.2g} %"))
    if normals is not None and normals.shape[:2] == (record.camera.height, record.camera.width):
        towards = subsampled(normals) * np.array([1, -1, -1], np.float32)
        colors = np.round(127.5 * (1 + towards)).clip(0, 255).astype(np.uint8)
        colors[~known] = _UNKNOWN
        panels.append(Picture(_tag(colors, "normals"), "normals"))
    against = ", ".join(row.sources)
    facts = (f"{100 * row.fill:.0f} % of the pixels; compared with {against}",)
    return Pictures(row.image, facts, panels=tuple(panels))


def subsampled(values: NDArray[np.float32], box: tuple[int, int] = _BOX) -> NDArray[np.float32]:
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


def _tag(pixels: NDArray[np.uint8], name: str) -> Markup:
    return image_tag(encoded(pixels, 1.0), name)
