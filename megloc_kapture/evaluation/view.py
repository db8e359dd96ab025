"""The 3D view of a map and of queries in it: one self-contained HTML page, drawn with WebGL 2.

Coordinates are float32 relative to an origin in full precision. Large maps and results are shown in
part, with a note on the page.
"""

from __future__ import annotations

import base64
import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError, OutputError, require
from megloc_kapture.evaluation.evaluate import (
    Localized,
    benchmark_near,
    evaluate_results,
    results_without_truth,
)
from megloc_kapture.evaluation.report.queries import (
    NO_POSE_COLOR,
    frame_of_query,
    inlier_sources,
    inliers_of,
    legend,
    query_facts,
    shown_queries,
    spread,
    top_view,
)
from megloc_kapture.evaluation.report.reports import plain, template
from megloc_kapture.evaluation.results import Poses, ResultContext
from megloc_kapture.evaluation.scoring import Evaluation, QueryResult
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.kapture.points import rows_by_id
from megloc_kapture.values import Camera, RigidTransform

MAX_POINTS, MAX_CAMERAS, MAX_QUERIES = 60_000, 4_000, 2_000
# largest number of drawn inliers, in total and per query
_MAX_INLIERS, _MAX_INLIERS_OF_ONE = 40_000, 300
# reading the inliers of a query takes 20 ms or more
_MAX_QUERIES_WITH_INLIERS = 300
_MAX_FRAMES = 255  # indices are uint8
_MAX_COLOR_IMAGES = 150
_SEED = 0
# tan(80 degrees): wider frusta hide everything
_WIDEST = 5.7
# quantiles of points and cameras that are initially in view
_SEEN_AT_FIRST = 0.02, 0.98
# marker in the first bytes of a view
_OURS, _HEAD_BYTES = b'content="megloc view"', 1000
_ANY_CAMERA = Camera.pinhole(4, 3, 4)  # for unknown intrinsics


def write_view(
    path: Path | str,
    mapping: KaptureFolder | Path | str,
    result: Localized | None = None,
    truth: Path | str | Poses | None = None,
    *,
    cameras: Mapping[str, Camera] | None = None,
    force: bool = False,
) -> str:
    """Write a self-contained 3D page of a map and of the queries of a result.

    An existing view at ``path`` is overwritten, another file only with ``force``. ``result`` and
    ``truth`` are as in :func:`megloc_kapture.evaluation.evaluate.evaluate`. Queries are coloured by
    their error, or by their confidence if there is no truth. Returns sentences about omitted data.
    """
    path = Path(path)
    _check_output(path, force=force)
    folder = mapping if isinstance(mapping, KaptureFolder) else KaptureFolder(mapping)
    title = folder.root.resolve().name
    context, queries = ResultContext(mapping=folder), []
    if result is not None:
        evaluation = _evaluate(result, truth, folder)
        context, queries = evaluation.context, shown_queries(evaluation)
        # cameras that were estimated with the poses take precedence
        context = replace(context, cameras={**(cameras or {}), **context.cameras})
        title = evaluation.label or title
    elif truth is not None:
        raise OptionError("true poses need a result to compare with")
    data, notes = view_data(context, queries)
    write_bytes(path, render_view(title, data, queries, notes).encode("utf-8"))
    return " ".join(notes)


def _evaluate(
    result: Localized, truth: Path | str | Poses | None, folder: KaptureFolder
) -> Evaluation:
    benchmark = benchmark_near([truth, result])
    labels = [""] if isinstance(result, Mapping) else None
    if truth is None:
        reported = results_without_truth([result], benchmark, mapping=folder.root, labels=labels)
        return reported.evaluations[0]
    return evaluate_results([result], truth, benchmark, mapping=folder.root, labels=labels)[0]


def _check_output(path: Path, *, force: bool) -> None:
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file, such as view.html")
    if force or not path.exists():
        return
    with open(path, "rb") as file:
        is_view = _OURS in file.read(_HEAD_BYTES)
    if not is_view:
        raise OutputError(f"{path}: exists and is not a view; -f overwrites it")


def view_data(
    context: ResultContext, queries: Sequence[QueryResult] = ()
) -> tuple[dict[str, Any], list[str]]:
    """Return the data of the page's script, and sentences about what they omit.

    Raise DataError if no camera has a pose. ``queries`` are ranked, worst first. Coordinates are
    float32, relative to ``origin``. A frustum (5, 3) has the camera's centre, then rays at depth 1
    through the upper left, upper right, lower right and lower left corner of the image; NaN without
    a pose. ``inliers`` (K, 3) are those of all queries, one after the other; ``drawn`` counts them
    per query. Frames of points, cameras and queries are indices into ``frames``, of which one is
    shown at a time. ``radius`` is that of the content initially in view.
    """
    notes = list[str]()
    rng = np.random.default_rng(_SEED)
    mapping = context.mapping
    map_poses = context.map_poses()
    points = np.zeros((0, 6))
    if mapping is not None and mapping.has_points():
        points = mapping.points3d()
    frame_of = {name: context.frames.get(name, "") for name in map_poses}
    frames = sorted(set(frame_of.values()))[:_MAX_FRAMES] or [""]
    point_frames = _point_frames(mapping, frame_of, frames, len(points))
    kept = np.flatnonzero(np.isfinite(points[:, :3]).all(axis=1))
    if len(kept) > MAX_POINTS:
        notes.append(f"{MAX_POINTS} of the map's {len(kept)} points are drawn.")
        kept = np.sort(rng.choice(kept, MAX_POINTS, replace=False))
    points, point_frames = points[kept], point_frames[kept]
    names = list(map_poses)
    if len(names) > MAX_CAMERAS:
        notes.append(f"{MAX_CAMERAS} of the map's {len(names)} cameras are drawn.")
        names = [names[at] for at in spread(len(names), MAX_CAMERAS)]
    if len(queries) > MAX_QUERIES:
        notes.append(f"The worst {MAX_QUERIES} of {len(queries)} queries are drawn and listed.")
        queries = queries[:MAX_QUERIES]
    poses = [map_poses[name] for name in names]
    true = [query.truth for query in queries if query.truth is not None]
    spanning = poses + true or [q.cam_from_world for q in queries if q.cam_from_world is not None]
    root = None if mapping is None else mapping.root
    require(spanning, "no image has a pose, so there is nothing to show", path=root)
    quats, translations = stack_poses(spanning)
    centers = camera_centers(quats, translations)
    axes, _ = top_view(quats, centers)
    # cameras and points separately, so that a thousand points do not outweigh ten cameras
    ends = [np.quantile(a, _SEEN_AT_FIRST, axis=0) for a in (centers, points[:, :3]) if len(a)]
    low, high = np.min(ends, axis=0)[0], np.max(ends, axis=0)[1]
    # rounded, to keep the JSON short
    origin = np.round((low + high) / 2, 3)
    rays = _rays(context.queries, [query.image for query in queries], context.cameras)
    with_inliers = min(max(len(queries), 1), _MAX_QUERIES_WITH_INLIERS)
    most = min(_MAX_INLIERS // with_inliers, _MAX_INLIERS_OF_ONE)
    sources = inlier_sources(context)
    if (sources or context.localized) and len(queries) > _MAX_QUERIES_WITH_INLIERS:
        notes.append(f"Inliers are drawn for the worst {_MAX_QUERIES_WITH_INLIERS} queries.")
    inliers = [
        inliers_of(query, context, sources) if query.num_inliers else np.zeros((0, 3))
        for query in queries[:_MAX_QUERIES_WITH_INLIERS]
    ]
    inliers += [np.zeros((0, 3))] * (len(queries) - len(inliers))
    if any(len(xyz) > most for xyz in inliers):
        notes.append(f"At most {most} inliers per query are drawn.")
    inliers = [xyz[spread(len(xyz), most)] for xyz in inliers]
    up = np.cross(*axes)
    data = {
        "origin": origin.tolist(),
        "up": np.round(up, 9).tolist(),
        "radius": max(float(np.linalg.norm(high - low)) / 2, 1e-3),
        "points": (points[:, :3] - origin).astype(np.float32),
        "colors": _colors(points, up, mapping, kept),
        "cameras": names,
        "cameraFrusta": _frusta(poses, _rays(mapping, names, {}), origin),
        "queries": [
            {
                "name": query.name,
                "condition": query.condition,
                "facts": query_facts(query),
                "color": query.color,
                "meaning": query.meaning,
                "error": query.position_m,
                "confidence": query.confidence,
                "inliers": query.num_inliers,
                "drawn": len(xyz),
            }
            for query, xyz in zip(queries, inliers, strict=True)
        ],
        "frusta": _frusta([query.cam_from_world for query in queries], rays, origin),
        "trueFrusta": _frusta([query.truth for query in queries], rays, origin),
        "inliers": (np.concatenate([np.zeros((0, 3)), *inliers]) - origin).astype(np.float32),
        "frames": frames,
        "pointFrames": point_frames,
        "cameraFrames": _positions([frame_of[name] for name in names], frames),
        "queryFrames": _positions([frame_of_query(q, context.frames) for q in queries], frames),
    }
    return data, notes


def render_view(
    title: str, data: Mapping[str, Any], queries: Sequence[QueryResult], notes: Sequence[str]
) -> str:
    """Render the page from the results of :func:`view_data`; self-contained and deterministic."""
    return template("view.html").render(
        title=title,
        data=_script_data(data),
        legend=legend(queries[: len(data["queries"])]),
        counts={
            "points": len(data["points"]),
            "cameras": len(data["cameras"]),
            "queries": len(data["queries"]),
            "failed": sum(query["color"] == NO_POSE_COLOR for query in data["queries"]),
        },
        frames=data["frames"],
        has_truth=bool(np.isfinite(data["trueFrusta"]).any()),
        notes=notes,
    )


def corner_rays(camera: Camera) -> NDArray[np.float64]:
    """Return rays (4, 3) at depth 1 through the corners of an image, clockwise from upper left.

    Corners beyond 80 degrees or the range of the lens model are moved towards the middle.
    """
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (camera.width, camera.height)
    middle = np.array([camera.width, camera.height]) / 2
    for share in np.linspace(1.0, 0.1, 10):
        rays = bearing_rays(camera, middle + share * (corners - middle))
        if np.isfinite(rays).all() and np.abs(rays).max() < _WIDEST:
            return rays
    return bearing_rays(_ANY_CAMERA, np.array([[0.0, 0], [4, 0], [4, 3], [0, 3]]))


def _rays(
    folder: KaptureFolder | None, images: Sequence[str], cameras: Mapping[str, Camera]
) -> NDArray[np.float64]:
    rays_of: dict[Camera, NDArray[np.float64]] = {}
    rays = []
    for image in images:
        camera = cameras.get(image, _ANY_CAMERA)
        with contextlib.suppress(DataError):
            if folder is not None and image not in cameras:
                camera = folder.read().camera_of(image)
        if camera not in rays_of:
            rays_of[camera] = corner_rays(camera)
        rays.append(rays_of[camera])
    return np.array(rays).reshape(-1, 4, 3)


def _frusta(
    poses: Sequence[RigidTransform | None], rays: NDArray[np.float64], origin: NDArray[np.float64]
) -> NDArray[np.float32]:
    frusta = np.full((len(poses), 5, 3), np.nan, np.float32)
    for frustum, pose, of_camera in zip(frusta, poses, rays, strict=True):
        if pose is not None:
            frustum[0] = pose.center() - origin
            frustum[1:] = of_camera @ pose.rotation_matrix()  # R^T x per row
    return frusta


def _positions(frames: Sequence[str], known: Sequence[str]) -> NDArray[np.uint8]:
    at = {name: position for position, name in enumerate(known)}
    return np.array([at.get(name, 0) for name in frames], np.uint8)


def _point_frames(
    mapping: KaptureFolder | None, frame_of: Mapping[str, str], frames: Sequence[str], number: int
) -> NDArray[np.uint8]:
    of_point = np.zeros(number, np.uint8)
    if mapping is not None and number and len(frames) > 1:
        for seen in mapping.observations().values():
            of_image = _positions([frame_of.get(name, "") for name in seen.image_names], frames)
            of_point[seen.point_ids] = of_image[seen.image_ids]
    return of_point


def _colors(
    points: NDArray[np.float64],
    up: NDArray[np.float64],
    mapping: KaptureFolder | None,
    rows: NDArray[np.int64],
) -> NDArray[np.uint8]:
    """Return colours (P, 3): the map's, else those of its images, else lighter with height.

    ``rows`` are the indices of the points in the map.
    """
    if points[:, 3:].any():
        return np.asarray(np.clip(np.round(points[:, 3:]), 0, 255), np.uint8)
    heights = points[:, :3] @ up
    low, high = np.quantile(heights, _SEEN_AT_FIRST) if len(heights) else (0.0, 1.0)
    share = np.clip((heights - low) / max(high - low, 1e-9), 0, 1)[:, None]
    dark, light = np.array([70, 96, 128]), np.array([226, 230, 222])
    colors = np.asarray(np.round(dark + share * (light - dark)), np.uint8)
    if mapping is not None and len(points):
        position = np.full(int(rows.max()) + 1, -1)
        position[rows] = np.arange(len(rows))
        with contextlib.suppress(DataError):
            _color_from_images(colors, position, mapping)
    return colors


def _color_from_images(
    colors: NDArray[np.uint8], position: NDArray[np.int64], mapping: KaptureFolder
) -> None:
    for name, seen in mapping.observations().items():
        keypoints = mapping.keypoints(name)
        rows_of = rows_by_id(seen.image_ids, len(seen.image_names))
        for at in spread(len(seen.image_names), _MAX_COLOR_IMAGES).tolist():
            rows = rows_of[at]
            rows = rows[seen.point_ids[rows] < len(position)]
            drawn = position[seen.point_ids[rows]]
            rows, drawn = rows[drawn >= 0], drawn[drawn >= 0]
            if not len(rows):
                continue
            image = seen.image_names[at]
            pixels = read_image_rgb(mapping.image_path(image))
            x, y = np.floor(keypoints.read(image)[seen.keypoint_ids[rows], :2]).astype(int).T
            height, width = pixels.shape[:2]
            colors[drawn] = pixels[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]


def _encoded(value: Any) -> Any:
    """Encode an array in base64, little-endian; leave other values as they are."""
    if not isinstance(value, np.ndarray):
        return value
    little = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode("ascii")


def _script_data(data: Mapping[str, Any]) -> Markup:
    """Return JSON that is safe in a script element, whatever names it contains."""
    encoded = {name: _encoded(value) for name, value in data.items()}
    text = json.dumps(plain(encoded), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))
