"""A 3D view of a map, and of a result in it: one HTML file, and a recording of Rerun's viewer."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.evaluation.evaluate import (
    Localized,
    benchmark_beside,
    evaluate_results,
    results_without_truth,
)
from megloc_kapture.evaluation.results import Poses, ResultContext
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.without_truth import ResultWithoutTruth
from megloc_kapture.geometry.cameras import focal_px, principal_point_px
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.images import read_depth_map, read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera, RigidTransform

if TYPE_CHECKING:
    from megloc_kapture.evaluation.report.queries import ShownQuery
    from megloc_kapture.evaluation.report.scene import Scene

# what the files begin with, or have near their beginning
_OURS, _RECORDING = b'content="megloc view"', b"RRF"
_HEAD_BYTES = 1000
# images that are put into a recording, of map and queries each: about 20 kB
_MAX_IMAGES, _WIDTH = 200, 480
# 15 kB each, so that the page stays below 3 MB
_MAX_RENDERED, _RENDERED_BOX = 40, (240, 240)
_GREY, _WHITE = "#8fa6bf", "#ffffff"


def write_view(
    path: Path | str,
    mapping: KaptureFolder | Path | str,
    result: Localized | None = None,
    truth: Path | str | Poses | None = None,
    *,
    cameras: Mapping[str, Camera] | None = None,
    force: bool = False,
    rerun: Path | str | None = None,
    rendered: KaptureFolder | Path | str | None = None,
) -> str:
    """Write a page that shows a map in 3D, and the queries of a result in it.

    The page holds everything itself and needs no network. Click or tap a query to fly to it.

    Parameters
    ----------
    path : of the file; another view is overwritten, anything else only with ``force``.
    mapping : kapture folder with points, or with the poses of images alone.
    result, truth : as in :func:`megloc_kapture.evaluation.evaluate.evaluate`; queries are coloured
        by their error where the truth is known, else by their confidence.
    cameras : of the queries of a result in memory, where they are known.
    rerun : file (.rrd) to write the same to as a recording of Rerun's viewer, with the images; an
        existing one is overwritten only where it is a recording, or with ``force``.
    rendered : kapture folder that ``megloc render --along`` wrote of the result; the page shows
        rendering and depth beside the photograph of the query that is chosen.

    Returns
    -------
    What is left out of the page, in words; empty where nothing is.

    Raises
    ------
    DataError : map, result, truth or renderings are missing or broken, or no camera has a pose.
    OptionError : a truth, or renderings, without a result.
    OutputError : a file cannot be written, or is another one than a view.
    ModuleNotFoundError : for ``rerun``, where the extra of that name is not installed.
    """
    from megloc_kapture.evaluation.report.queries import StoredInliers, shown_queries
    from megloc_kapture.evaluation.report.scene import render_view, scene_of

    path = Path(path)
    _check_output(path, _OURS, force=force)
    if rerun is not None:
        _check_output(Path(rerun), _RECORDING, force=force)
    folder = mapping if isinstance(mapping, KaptureFolder) else KaptureFolder(mapping)
    title = folder.root.resolve().name
    context, queries = ResultContext(mapping=folder), []
    if result is not None:
        found = _judged(result, truth, folder)
        context, queries = found.context, shown_queries(found)
        # those that were estimated with the poses come first
        context = replace(context, cameras={**(cameras or {}), **context.cameras})
        title = found.label or title
    elif truth is not None:
        raise OptionError("a truth needs a result to be compared with")
    elif rendered is not None:
        raise OptionError("renderings need the result along which they were made")
    scene = scene_of(title, StoredInliers(context), queries)
    if scene is None:
        raise DataError("no image has a pose, so there is nothing to see", path=folder.root)
    if rendered is not None:
        views = rendered if isinstance(rendered, KaptureFolder) else KaptureFolder(rendered)
        pictures, notes = _rendered_queries(views, scene.queries, context.queries)
        scene = replace(scene, rendered=pictures, notes=(*scene.notes, *notes))
    if rerun is not None:
        _write_recording(Path(rerun), scene, context)
    write_bytes(path, render_view(scene).encode("utf-8"))
    return " ".join(scene.notes)


def _judged(
    result: Localized, truth: Path | str | Poses | None, folder: KaptureFolder
) -> Evaluation | ResultWithoutTruth:
    benchmark = benchmark_beside([truth, result])
    labels = [""] if isinstance(result, Mapping) else None
    if truth is None:
        judged = results_without_truth([result], benchmark, mapping=folder.root, labels=labels)
        return judged.results[0]
    return evaluate_results([result], truth, benchmark, mapping=folder.root, labels=labels)[0]


def _rendered_queries(
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
    from megloc_kapture.evaluation.report.pictures import colored, encoded, read_small, subsampled
    from megloc_kapture.stages.scene import depth_records

    data = rendered.read()
    images = {Path(name).with_suffix(""): name for name in data.image_names()}
    depths, found, notes = depth_records(data), dict[str, list[tuple[str, str]]](), list[str]()
    shown = [q for q in queries if Path(q.image).with_suffix("") in images and q.estimated]
    if not shown:
        raise DataError("no image here is a query of the result with a pose", path=rendered.root)
    if len(shown) > _MAX_RENDERED:
        notes.append(f"Renderings are shown of {_MAX_RENDERED} of {len(shown)} queries.")
    for query in shown[:_MAX_RENDERED]:
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
            metres = subsampled(depth, _RENDERED_BOX)
            known = metres > 0
            near = colored(1 / np.where(known, metres, 1), known)
            panels.append(("its depth", encoded(near, 1.0).address))
    return found, notes


def _check_output(path: Path, mark: bytes, *, force: bool) -> None:
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file, such as view.html")
    if force or not path.exists():
        return
    try:
        with open(path, "rb") as file:
            ours = mark in file.read(_HEAD_BYTES)
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    if not ours:
        raise OutputError(f"{path}: exists and is no view; -f overwrites it")


def _write_recording(path: Path, scene: Scene, context: ResultContext) -> None:
    """Write what a scene shows as ``.rrd`` (extra ``rerun``, https://rerun.io).

    Below ``map``: ``points``, ``depth`` and ``cameras/NAME``; below ``queries/NAME``: ``estimate``
    with the image, ``truth``, and ``inliers``, lines to their points. Coordinates are relative to
    the scene's origin, which stands in ``origin``. Cameras are drawn without their distortion.
    """
    import rerun as rr

    from megloc_kapture.evaluation.report.pictures import shrunk
    from megloc_kapture.evaluation.report.queries import query_facts, spread

    stream = rr.RecordingStream("megloc", recording_id=scene.title, send_properties=False)

    def log(where: list[str], *what: Any) -> None:
        stream.log([*where], *what, static=True)

    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        stream.save(path)
    except RuntimeError as error:
        raise OutputError(f"{path}: cannot be written: {error}") from error
    x, y, z = scene.origin.tolist()
    log(["origin"], rr.TextDocument(f"coordinates are relative to {x!r} {y!r} {z!r}"))
    own = len(scene.points) - scene.num_dense
    for name, rows in (("points", slice(0, own)), ("depth", slice(own, None))):
        if len(scene.points[rows]):
            log(["map", name], rr.Points3D(scene.points[rows], colors=scene.colors[rows]))
    size = 0.04 * scene.radius

    def camera(
        where: list[str],
        pose: RigidTransform,
        of: Camera | None,
        color: str,
        folder: KaptureFolder | None = None,
        image: str = "",
    ) -> None:
        center = pose.center() - scene.origin
        log(where, rr.Transform3D(translation=center, mat3x3=pose.rotation_matrix().T))
        of = of or Camera.pinhole(4, 3, 4)  # as in the view where it is not known
        scale, pixels = 1.0, None
        with contextlib.suppress(DataError):  # a frustum without its image is better than none
            if folder is not None:
                read = read_image_rgb(folder.image_path(image))
                pixels, scale = shrunk(read, (_WIDTH, _WIDTH))
        log(
            where,
            rr.Pinhole(
                focal_length=focal_px(of) * scale,
                principal_point=np.array(principal_point_px(of)) * scale,
                resolution=[round(of.width * scale), round(of.height * scale)],
                image_plane_distance=size,
                color=int(f"{color[1:]}ff", 16),
            ),
        )
        if pixels is not None:
            log(where, rr.Image(pixels).compress(jpeg_quality=75))

    poses = context.map_poses()
    with_image = {scene.cameras[at] for at in spread(len(scene.cameras), _MAX_IMAGES)}
    for name in scene.cameras:
        folder = context.mapping if name in with_image else None
        of = _camera(context.mapping, name)
        camera(["map", "cameras", name], poses[name], of, _GREY, folder, name)
    first = 0
    for row, (query, number) in enumerate(zip(scene.queries, scene.num_inliers, strict=True)):
        where = ["queries", query.name]
        log(where, rr.TextDocument(", ".join(query_facts(query))))
        of = context.cameras.get(query.image) or _camera(context.queries, query.image)
        if query.truth is not None:
            camera([*where, "truth"], query.truth, of, _WHITE)
        if query.estimated is not None:
            folder = context.queries if row < _MAX_IMAGES else None
            camera([*where, "estimate"], query.estimated, of, query.color, folder, query.image)
            ends = scene.inliers[first : first + number]
            starts = np.broadcast_to(scene.frusta[row, 0], ends.shape)
            color = int(f"{query.color[1:]}40", 16)
            lines = rr.LineStrips3D(np.stack([starts, ends], axis=1), colors=color)
            log([*where, "inliers"], lines)
        first += number
    stream.flush()
    stream.disconnect()


def _camera(folder: KaptureFolder | None, image: str) -> Camera | None:
    with contextlib.suppress(DataError):
        return None if folder is None else folder.read().camera_of(image)
    return None
