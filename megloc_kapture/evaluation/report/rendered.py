"""Pictures of queries in the 3D view: photograph, what was rendered at the pose, its depth."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.report.depth import colored, subsampled
from megloc_kapture.evaluation.report.pictures import SmallImage, encoded, read_small
from megloc_kapture.evaluation.report.shown_queries import ShownQuery
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureFolder

# 15 kB each, so that the page stays below 3 MB
MAX_QUERIES = 40
_BOX = (240, 240)


@dataclass(frozen=True)
class RenderedQuery:
    """What a query's pose shows.

    Attributes
    ----------
    photograph : of the query; None where the images are not known.
    rendering : of the map at the query's pose.
    depth : of the rendering, yellow near to purple far; None without.
    """

    photograph: SmallImage | None
    rendering: SmallImage
    depth: SmallImage | None

    def panels(self) -> list[tuple[str, str]]:
        """Caption and address of each picture there is."""
        named = (("photograph", self.photograph), ("rendered at the pose", self.rendering))
        every = (*named, ("its depth", self.depth))
        return [(caption, each.address) for caption, each in every if each is not None]


def rendered_queries(
    rendered: KaptureFolder, queries: Sequence[ShownQuery], photographs: KaptureFolder | None
) -> tuple[dict[str, RenderedQuery], list[str]]:
    """The pictures of queries by their names, of at most 40, in the order of ``queries``; and
    sentences on what is left out.

    Parameters
    ----------
    rendered : as :func:`megloc_kapture.stages.neural_field.render_along` writes it: an image of a
        query's name, whatever it ends in, and its depth.
    photographs : the queries; what cannot be read of them is left out.

    Raises
    ------
    DataError : an image or a depth map is broken, or there is none of any query.
    """
    from megloc_kapture.stages.rigs import depth_records

    data = rendered.read()
    images = {Path(name).with_suffix(""): name for name in data.image_names()}
    depths, found, notes = depth_records(data), dict[str, RenderedQuery](), list[str]()
    shown = [q for q in queries if Path(q.image).with_suffix("") in images and q.estimated]
    if not shown:
        raise DataError("no image here is a query of the result with a pose", path=rendered.root)
    if len(shown) > MAX_QUERIES:
        notes.append(f"Renderings are shown of {MAX_QUERIES} of {len(shown)} queries.")
    width, height = _BOX
    for query in shown[:MAX_QUERIES]:
        name, photograph, depth = images[Path(query.image).with_suffix("")], None, None
        if photographs is not None:
            with contextlib.suppress(DataError):
                path = photographs.image_path(query.image)
                photograph = read_small(path, width=width, height=height)
        if (record := depths.get(name)) is not None:
            size = {"width": record.camera.width, "height": record.camera.height}
            metres = subsampled(read_depth_map(rendered.depth_path(record.path), **size), _BOX)
            known = metres > 0
            # of inverse depth, so that what is near keeps its shades
            depth = encoded(colored(1 / np.where(known, metres, 1), known), 1.0)
        picture = read_small(rendered.image_path(name), width=width, height=height)
        found[query.name] = RenderedQuery(photograph, picture, depth)
    return found, notes
