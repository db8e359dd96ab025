"""Pictures of a report: the worst queries next to map images."""

from __future__ import annotations

import base64
import contextlib
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.report.content import counted
from megloc_kapture.evaluation.report.queries import query_facts, spread
from megloc_kapture.evaluation.results import Poses, ResultContext
from megloc_kapture.evaluation.scoring import QueryResult
from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import FeatureReader, KaptureFolder, MatchesReader
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.values import Camera, RigidTransform

Pixels = NDArray[np.uint8]
Points = NDArray[np.float64]

_BOX = (400, 300)
_GAP_PX, _MAX_LINES = 6, 120
# number of candidates compared to find the one with the most matches
_CANDIDATES_COMPARED = 50
# largest distance of an agreeing match from its epipolar line
_MAX_ERROR_PX = 8.0
AGREES, DISAGREES, UNKNOWN = "#12a150", "#e02424", "#f2b705"


# name, facts, and an ``<img>`` or ``<svg>`` element
Picture = tuple[str, str, Markup]


def worst_pictures(
    queries: Sequence[QueryResult], context: ResultContext, map_poses: Poses
) -> list[Picture]:
    """Draw queries next to the candidate with the most matches, else the nearest map image.

    Queries whose images are missing or broken are left out: a report without a picture is better
    than no report.
    """
    pictures = []
    readers = _open_matches(context)
    for query in queries:
        with contextlib.suppress(DataError):
            if context.queries is not None:
                pictures.append(_draw_pair(query, context, context.queries, map_poses, readers))
    return pictures


# keypoints of the queries, keypoints of the map, and matches between them
_Readers = tuple[FeatureReader, FeatureReader, MatchesReader]


def _open_matches(context: ResultContext) -> _Readers | None:
    queries, mapping = context.queries, context.mapping
    if queries is None or mapping is None:
        return None
    with contextlib.suppress(DataError):
        drawn = set(queries.types("keypoints")) & set(mapping.types("keypoints"))
        if known := [name for name in queries.types("matches") if name in drawn]:
            # prefer a guided pyramid, which includes the matches of its base type
            chosen = min(known, key=lambda name: (base_type(name) == name, name))
            return queries.keypoints(chosen), mapping.keypoints(chosen), queries.matches(chosen)
    return None


def _stored_matches(
    readers: _Readers | None, query: str, images: Sequence[str]
) -> dict[str, tuple[Points, Points]]:
    matches: dict[str, tuple[Points, Points]] = {}
    if readers is None or query not in readers[0]:
        return matches
    keypoints = np.asarray(readers[0].read(query)[:, :2], np.float64)
    for image in images:
        if (query, image) in readers[2] and image in readers[1]:
            ids = readers[2].read(query, image)[0]
            map_keypoints = np.asarray(readers[1].read(image)[:, :2], np.float64)
            max_ids = ids.max(axis=0, initial=-1)
            if len(ids) and max_ids[0] < len(keypoints) and max_ids[1] < len(map_keypoints):
                matches[image] = keypoints[ids[:, 0]], map_keypoints[ids[:, 1]]
    return matches


def _draw_pair(
    query: QueryResult,
    context: ResultContext,
    folder: KaptureFolder,
    map_poses: Poses,
    readers: _Readers | None,
) -> Picture:
    left, scale = _read(folder, query.image)
    matches = _stored_matches(readers, query.image, query.candidates[:_CANDIDATES_COMPARED])
    best = max(matches, key=lambda image: len(matches[image][0]), default="")
    pose, kind = (query.truth, "true") if query.truth else (query.cam_from_world, "estimated")
    if not best and pose is not None and map_poses:
        center = pose.center()
        best = min(map_poses, key=lambda i: float(np.linalg.norm(map_poses[i].center() - center)))
    facts = query_facts(query)
    if context.mapping is None or not best:
        return query.name, ", ".join(facts), image_tag(left, query.image)
    right, right_scale = _read(context.mapping, best)
    query_px, map_px = matches.get(best, (np.zeros((0, 2)), np.zeros((0, 2))))
    facts.append(f"right: {best}, {counted(len(query_px), 'match', 'matches')}")
    colors = np.full(len(query_px), UNKNOWN)
    if pose is not None and best in map_poses and len(query_px):
        cameras = folder.read().camera_of(query.image), context.mapping.read().camera_of(best)
        agree = fits_poses(query_px, map_px, *cameras, map_poses[best] @ pose.inverse())
        colors = np.where(agree, AGREES, DISAGREES)
        facts.append(f"{int(agree.sum())} of them agree with the {kind} pose")
    if pose is not None and best in map_poses:
        distance = float(np.linalg.norm(pose.center() - map_poses[best].center()))
        facts.append(f"{distance:.1f} {context.unit} from the {kind} position")
    drawn = spread(len(query_px), _MAX_LINES)
    points = query_px[drawn] * scale, map_px[drawn] * right_scale
    element = side_by_side(left, right, points, colors[drawn].tolist(), query.image)
    return query.name, ", ".join(facts), element


def fits_poses(
    query_px: Points,
    map_px: Points,
    query_camera: Camera,
    map_camera: Camera,
    map_from_query: RigidTransform,
) -> NDArray[np.bool_]:
    """Return a mask (M,) of matches within 8 pixels of their epipolar line in the query.

    If the cameras have the same centre, every match fits.
    """
    rays, map_rays = bearing_rays(query_camera, query_px), bearing_rays(map_camera, map_px)
    # x_map^T [t] R x_query = 0
    t = np.array(map_from_query.translation)
    normals = np.cross(map_rays, t) @ map_from_query.rotation_matrix()
    with np.errstate(invalid="ignore", divide="ignore"):
        errors = np.abs(np.einsum("ij,ij->i", normals, rays)) / np.linalg.norm(
            normals[:, :2], axis=1
        )
    return np.asarray(~(errors * focal_px(query_camera) > _MAX_ERROR_PX))


def image_tag(pixels: Pixels, name: str) -> Markup:
    height, width = pixels.shape[:2]
    return Markup('<img src="{}" width="{}" height="{}" alt="{}">').format(
        _jpeg(pixels), width, height, name
    )


def side_by_side(
    left: Pixels, right: Pixels, points: tuple[Points, Points], colors: list[str], name: str
) -> Markup:
    """Draw two images in one ``<svg>``, matched pixels (M, 2) and (M, 2) joined by lines."""
    shift = left.shape[1] + _GAP_PX
    width, height = shift + right.shape[1], max(left.shape[0], right.shape[0])
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(name)}">']
    for x, pixels in ((0, left), (shift, right)):
        size = f'width="{pixels.shape[1]}" height="{pixels.shape[0]}"'
        parts.append(f'<image x="{x}" {size} href="{_jpeg(pixels)}"/>')
    # one path per colour: an element per match makes the page three times longer
    for color in dict.fromkeys(colors):
        lines = "".join(
            f"M{x0:.1f} {y0:.1f}L{x1 + shift:.1f} {y1:.1f}"
            for (x0, y0), (x1, y1), c in zip(*points, colors, strict=True)
            if c == color
        )
        parts.append(f'<path d="{lines}" stroke="{color}" stroke-width="0.9" fill="none"/>')
    return Markup("".join([*parts, "</svg>"]))


def _read(folder: KaptureFolder, image: str) -> tuple[Pixels, float]:
    import cv2  # slow import

    pixels = read_image_rgb(folder.image_path(image))
    scale = min(_BOX[0] / pixels.shape[1], _BOX[1] / pixels.shape[0], 1.0)
    size = (max(round(pixels.shape[1] * scale), 1), max(round(pixels.shape[0] * scale), 1))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8), scale


def _jpeg(pixels: Pixels) -> str:
    import cv2

    bgr = np.ascontiguousarray(pixels[:, :, ::-1])
    content = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 72])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(content).decode('ascii')}"
