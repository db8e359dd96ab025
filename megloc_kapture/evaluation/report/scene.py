"""The 3D view of a map and of queries in it: one self-contained HTML file, drawn by WebGL2.

Everything that is drawn stands in the page as little-endian arrays; coordinates are float32,
relative to an origin that is given in full, so that a frame far from zero loses nothing. What would
make the page large is drawn in part, and the page says so.
"""

from __future__ import annotations

import base64
import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.report.map_view import top_view
from megloc_kapture.evaluation.report.queries import (
    ShownQuery,
    StoredInliers,
    legend,
    query_facts,
    spread,
)
from megloc_kapture.evaluation.report.reports import plain, template
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera, RigidTransform

MAX_POINTS, MAX_CAMERAS, MAX_QUERIES = 60_000, 4_000, 2_000
# points of depth by stereo, and map images that they are read of: 0.2 s each
MAX_DENSE, _MAX_DENSE_IMAGES = 40_000, 40
# points that inliers lead to: of all queries, and of one of them
_MAX_INLIERS, _MAX_INLIERS_OF_ONE = 40_000, 300
# to find a query's inliers takes 20 ms, of many keypoints more
_MAX_QUERIES_WITH_INLIERS = 300
_MAX_FRAMES = 255
_MAX_COLOR_IMAGES = 150
_SEED = 0
# rays further from the axis than this (80 degrees) make a frustum that hides everything
_WIDEST = 5.7
# the share of points and cameras that the first look takes in
_SEEN_AT_FIRST = 0.02, 0.98
_ANY_CAMERA = Camera.pinhole(4, 3, 4)  # stands in for intrinsics that are not known


@dataclass(frozen=True, eq=False)
class Scene:
    """What a view shows.

    Attributes
    ----------
    title : of the page.
    origin : float64 (3,), which the coordinates are relative to.
    up : float64 (3,), unit vector.
    points : float32 (P, 3), and ``colors`` uint8 (P, 3); the last ``num_dense`` are not the map's
        own but of depth by stereo.
    cameras : names of map images, and ``camera_frusta`` float32 (C, 5, 3): the centre, then the
        rays through the image's corners (upper left, upper right, lower right, lower left) at
        depth 1, as vectors of the world.
    queries : in the order of the list, worst first.
    frusta, true_frusta : float32 (Q, 5, 3), of estimates and truths, NaN where there is none.
    inliers : float32 (K, 3), points of the queries' inliers one query after another, and
        ``num_inliers`` (Q,) how many each has here.
    radius : of what there is to see around the origin, unit of the map.
    frames : names of the map's coordinate frames, which share no world and are shown one at a time;
        ``point_frames``, ``camera_frames``, ``query_frames`` uint8 (P,), (C,), (Q,) say which.
    notes : sentences on what is left out.
    """

    title: str
    origin: NDArray[np.float64]
    up: NDArray[np.float64]
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    num_dense: int
    cameras: tuple[str, ...]
    camera_frusta: NDArray[np.float32]
    queries: tuple[ShownQuery, ...]
    frusta: NDArray[np.float32]
    true_frusta: NDArray[np.float32]
    inliers: NDArray[np.float32]
    num_inliers: tuple[int, ...]
    radius: float
    frames: tuple[str, ...]
    point_frames: NDArray[np.uint8]
    camera_frames: NDArray[np.uint8]
    query_frames: NDArray[np.uint8]
    notes: tuple[str, ...]


def scene_of(title: str, stored: StoredInliers, queries: Sequence[ShownQuery] = ()) -> Scene | None:
    """The scene of a map and of queries in it; None where no camera has a pose.

    Parameters
    ----------
    stored : the inliers of the queries; its context says where the map and the queries' cameras
        are, each of which may be absent.
    queries : worst first; what is left out of many are the better ones.
    """
    context, notes = stored.context, list[str]()
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
    spanning = poses + true or [q.estimated for q in queries if q.estimated is not None]
    if not spanning:
        return None
    quats, translations = stack_poses(spanning)
    centers = camera_centers(quats, translations)
    view = top_view(quats, centers)
    # each by itself: of a thousand points and ten cameras the cameras count too
    ends = [
        np.quantile(own, _SEEN_AT_FIRST, axis=0) for own in (centers, points[:, :3]) if len(own)
    ]
    low, high = np.min(ends, axis=0)[0], np.max(ends, axis=0)[1]
    # of few digits, so that the text of the page says exactly what was subtracted
    origin = np.round((low + high) / 2, 3)
    rays = _rays(context.queries, [query.image for query in queries], context.cameras)
    with_inliers = min(max(len(queries), 1), _MAX_QUERIES_WITH_INLIERS)
    most = min(_MAX_INLIERS // with_inliers, _MAX_INLIERS_OF_ONE)
    if stored.known and len(queries) > _MAX_QUERIES_WITH_INLIERS:
        notes.append(f"Inliers are drawn of the worst {_MAX_QUERIES_WITH_INLIERS} queries.")
    inliers = [
        stored.of(query)[1] if query.num_inliers else np.zeros((0, 3))
        for query in queries[:_MAX_QUERIES_WITH_INLIERS]
    ]
    inliers += [np.zeros((0, 3))] * (len(queries) - len(inliers))
    if any(len(own) > most for own in inliers):
        notes.append(f"Of a query's inliers at most {most} are drawn.")
    inliers = [own[spread(len(own), most)] for own in inliers]
    up = np.cross(view.right, view.up)
    colors = _colors(points, up, mapping, kept)
    dense, dense_colors, dense_images = _dense_points(mapping, notes)
    dense_frames = _positions([frame_of.get(image, "") for image in dense_images], frames)
    return Scene(
        title=title,
        origin=origin,
        up=up,
        points=(np.concatenate([points[:, :3], dense]) - origin).astype(np.float32),
        colors=np.concatenate([colors, dense_colors]),
        num_dense=len(dense),
        cameras=tuple(names),
        camera_frusta=_frusta(poses, _rays(mapping, names, {}), origin),
        queries=tuple(queries),
        frusta=_frusta([query.estimated for query in queries], rays, origin),
        true_frusta=_frusta([query.truth for query in queries], rays, origin),
        inliers=(np.concatenate([np.zeros((0, 3)), *inliers]) - origin).astype(np.float32),
        num_inliers=tuple(len(own) for own in inliers),
        radius=max(float(np.linalg.norm(high - low)) / 2, 1e-3),
        frames=tuple(frames),
        point_frames=np.concatenate([point_frames, dense_frames]),
        camera_frames=_positions([frame_of[name] for name in names], frames),
        query_frames=_positions([_frame_of(q, context, frame_of) for q in queries], frames),
        notes=tuple(notes),
    )


def render_view(scene: Scene) -> str:
    """The page of a scene; the same scene gives the same text. It loads nothing."""
    failed = [query for query in scene.queries if query.estimated is None]
    data = {
        "origin": scene.origin.tolist(),
        "up": np.round(scene.up, 9).tolist(),
        "radius": scene.radius,
        "points": _encoded(scene.points),
        "colors": _encoded(scene.colors),
        "numDense": scene.num_dense,
        "cameras": scene.cameras,
        "cameraFrusta": _encoded(scene.camera_frusta),
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
                "drawn": drawn,
            }
            for query, drawn in zip(scene.queries, scene.num_inliers, strict=True)
        ],
        "frusta": _encoded(scene.frusta),
        "trueFrusta": _encoded(scene.true_frusta),
        "inliers": _encoded(scene.inliers),
        "frames": scene.frames,
        "pointFrames": _encoded(scene.point_frames),
        "cameraFrames": _encoded(scene.camera_frames),
        "queryFrames": _encoded(scene.query_frames),
    }
    return template("view.html").render(
        title=scene.title,
        data=_script_data(data),
        legend=legend(scene.queries),
        counts={
            "points": len(scene.points) - scene.num_dense,
            "dense": scene.num_dense,
            "cameras": len(scene.cameras),
            "queries": len(scene.queries),
            "failed": len(failed),
        },
        frames=scene.frames,
        has_truth=bool(np.isfinite(scene.true_frusta).any()),
        notes=scene.notes,
    )


def corner_rays(camera: Camera) -> NDArray[np.float64]:
    """Rays (4, 3) at depth 1 through the corners of an image: upper left, upper right, lower right,
    lower left. Where the lens' model says nothing of a corner, or nothing narrower than 80 degrees,
    they are those of the nearest pixels towards the middle that it does."""
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
    known: dict[Camera, NDArray[np.float64]] = {}
    found = []
    for image in images:
        camera = cameras.get(image, _ANY_CAMERA)
        with contextlib.suppress(DataError):
            if folder is not None and image not in cameras:
                camera = folder.read().camera_of(image)
        if camera not in known:
            known[camera] = corner_rays(camera)
        found.append(known[camera])
    return np.array(found).reshape(-1, 4, 3)


def _frusta(
    poses: Sequence[RigidTransform | None], rays: NDArray[np.float64], origin: NDArray[np.float64]
) -> NDArray[np.float32]:
    found = np.full((len(poses), 5, 3), np.nan, np.float32)
    for own, pose, of_camera in zip(found, poses, rays, strict=True):
        if pose is not None:
            own[0] = pose.center() - origin
            own[1:] = of_camera @ pose.rotation_matrix()  # R^T x of rows
    return found


def _frame_of(query: ShownQuery, context: ResultContext, frame_of: Mapping[str, str]) -> str:
    if query.image in context.frames:
        return context.frames[query.image]
    known = (frame_of[image] for image in query.candidates if image in frame_of)
    return next(known, query.condition)


def _positions(frames: Sequence[str], known: Sequence[str]) -> NDArray[np.uint8]:
    at = {name: position for position, name in enumerate(known)}
    return np.array([at.get(name, 0) for name in frames], np.uint8)


def _point_frames(
    mapping: KaptureFolder | None, frame_of: Mapping[str, str], frames: Sequence[str], number: int
) -> NDArray[np.uint8]:
    found = np.zeros(number, np.uint8)
    if mapping is not None and number and len(frames) > 1:
        for seen in mapping.observations().values():
            of_image = _positions([frame_of.get(name, "") for name in seen.image_names], frames)
            found[seen.point_ids] = of_image[seen.image_ids]
    return found


def _dense_points(
    mapping: KaptureFolder | None, notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.uint8], list[str]]:
    from megloc_kapture.mvs.views import Agreement  # loads more than others wait for
    from megloc_kapture.stages.stereo_depth import fused_cloud, stereo_images

    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.uint8), list[str]()
    if mapping is None:
        return nothing
    images = stereo_images(mapping)
    names = list(images)
    if len(names) > _MAX_DENSE_IMAGES:
        notes.append(f"Depth is shown of {_MAX_DENSE_IMAGES} of {len(names)} images.")
        names = [names[at] for at in spread(len(names), _MAX_DENSE_IMAGES)]
    # a view without depth is better than none
    with contextlib.suppress(DataError):
        chosen = {name: images[name] for name in names}
        # most surfaces are seen by several images, some by none
        cloud = fused_cloud(mapping, chosen, Agreement(), max_points=8 * MAX_DENSE)
        kept = spread(len(cloud.xyz), MAX_DENSE) if len(cloud.xyz) else np.zeros(0, np.int64)
        colors = np.asarray(np.round(cloud.colours[kept]), np.uint8)
        return cloud.xyz[kept], colors, [names[int(row)] for row in cloud.image_ids[kept]]
    return nothing


def _colors(
    points: NDArray[np.float64],
    up: NDArray[np.float64],
    mapping: KaptureFolder | None,
    rows: NDArray[np.int64],
) -> NDArray[np.uint8]:
    """The points' own colours (P, 3); of a map without any those of its images, and where no image
    says one, greys that grow lighter upwards. ``rows`` are the points' in the map."""
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
        # without images, or keypoints, the greys are as good
        with contextlib.suppress(DataError):
            _color_from_images(colors, position, mapping)
    return colors


def _color_from_images(
    colors: NDArray[np.uint8], position: NDArray[np.int64], mapping: KaptureFolder
) -> None:
    for name, seen in mapping.observations().items():
        keypoints = mapping.keypoints(name)
        order = np.argsort(seen.image_ids, kind="stable")
        ends = np.searchsorted(seen.image_ids[order], np.arange(len(seen.image_names) + 1))
        for at in spread(len(seen.image_names), _MAX_COLOR_IMAGES).tolist():
            rows = order[ends[at] : ends[at + 1]]
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


def _encoded(array: NDArray[np.float32] | NDArray[np.uint8]) -> str:
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode("ascii")


def _script_data(data: Mapping[str, Any]) -> Markup:
    """JSON that can stand in a script element whatever names it holds."""
    text = json.dumps(plain(data), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))
