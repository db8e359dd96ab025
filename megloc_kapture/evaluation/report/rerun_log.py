"""A scene as a recording of Rerun's viewer (extra ``rerun``), https://rerun.io."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.evaluation.report.pictures import shrunk
from megloc_kapture.evaluation.report.scene import Scene
from megloc_kapture.evaluation.report.shown_queries import spread
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.geometry.cameras import focal_px, principal_point_px
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera, RigidTransform

# images that are put in, of map and queries each: about 20 kB
MAX_IMAGES = 200
_WIDTH = 480
_Image = tuple[KaptureFolder | None, str] | None
_GREY, _WHITE = "#8fa6bf", "#ffffff"


def write_recording(path: Path, scene: Scene, context: ResultContext) -> None:
    """Write what a scene shows as ``.rrd``: points, map cameras, queries coloured as in the view.

    Below ``map``: ``points``, ``depth`` and ``cameras/NAME``; below ``queries/NAME``: ``estimate``
    with the image, ``truth``, and ``inliers``, lines to their points. Coordinates are relative to
    the scene's origin, which stands in ``origin``. Cameras are drawn without their distortion.

    Parameters
    ----------
    context : of the scene: images, cameras and poses.

    Raises
    ------
    ModuleNotFoundError : rerun-sdk is not installed; names the extra.
    OutputError : the file cannot be written.
    """
    import rerun as rr

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
        where: list[str], pose: RigidTransform, of: Camera | None, color: str, image: _Image
    ) -> None:
        center = pose.center() - scene.origin
        log(where, rr.Transform3D(translation=center, mat3x3=pose.rotation_matrix().T))
        of = of or Camera.pinhole(4, 3, 4)  # as in the view where it is not known
        scale, pixels = 1.0, None
        with contextlib.suppress(DataError):  # a frustum without its image is better than none
            if image is not None and image[0] is not None:
                read = read_image_rgb(image[0].image_path(image[1]))
                pixels, scale = shrunk(read, width=_WIDTH, height=_WIDTH)
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
    with_image = {scene.cameras[at] for at in spread(len(scene.cameras), MAX_IMAGES)}
    for name in scene.cameras:
        image = (context.mapping, name) if name in with_image else None
        of = _camera(context.mapping, name)
        camera(["map", "cameras", name], poses[name], of, _GREY, image)
    first = 0
    for row, (query, number) in enumerate(zip(scene.queries, scene.num_inliers, strict=True)):
        where = ["queries", query.name]
        log(where, rr.TextDocument(", ".join(query.facts())))
        of = context.cameras.get(query.image) or _camera(context.queries, query.image)
        if query.truth is not None:
            camera([*where, "truth"], query.truth, of, _WHITE, None)
        if query.estimated is not None:
            image = (context.queries, query.image) if row < MAX_IMAGES else None
            camera([*where, "estimate"], query.estimated, of, query.color, image)
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
