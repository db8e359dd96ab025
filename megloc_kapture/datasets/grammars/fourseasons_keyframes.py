"""4Seasons' ``KeyFrameData``: pose and point cloud of one keyframe, as its odometry left them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.grammars.fourseasons_lines import (
    parse_timestamp,
    parse_transform,
    split_fields,
    text_lines,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_csv import parse_float, parse_integer
from megloc_kapture.values import Camera, RigidTransform

_TIMESTAMP, _CAMERA, _POSE, _CLOUD = "timestamp", "fx", "camToWorld", "Point Cloud"
_TAGS = (_TIMESTAMP, _CAMERA, _POSE, _CLOUD)
_POINT_FIELDS = 7
_COLOURS = 8


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A keyframe's file.

    Parameters
    ----------
    timestamp : nanoseconds.
    camera : PINHOLE, the undistorted left camera.
    world_from_cam : in the odometry's own world and unit, not the one of ``GNSSPoses.txt``;
        motions between keyframes are the same in both.
    points : float64 (P, 3): u and v in pixels, inverse depth per unit of the odometry's world.
    """

    timestamp: int
    camera: Camera
    world_from_cam: RigidTransform
    points: NDArray[np.float64]


def read_keyframe(path: Path) -> Keyframe:
    """Read ``KeyFrame_<timestamp>.txt``.

    Raises
    ------
    DataError : one of timestamp, camera, pose and point cloud is absent or broken, or the cloud
        has another number of points than announced; names file and line.
    """
    lines = text_lines(path)
    blocks = _blocks(lines, path)
    number = blocks[_TIMESTAMP]
    timestamp = parse_timestamp(lines[number - 1], path, number)
    number = blocks[_POSE]
    world_from_cam = parse_transform(split_fields(lines[number - 1]), path, number)
    number = blocks[_CAMERA]
    camera, num_points = _camera(lines[number - 1], path, number)
    points = _points(lines, blocks[_CLOUD], path)
    if len(points) != num_points:
        raise DataError(
            f"{len(points)} points, {num_points} are announced", path=path, line=len(lines)
        )
    return Keyframe(timestamp, camera, world_from_cam, points)


def _blocks(lines: list[str], path: Path) -> dict[str, int]:
    """Number of the first line behind each tag."""
    blocks: dict[str, int] = {}
    tag = ""
    for number, text in enumerate(lines, start=1):
        if text.startswith("#"):
            title = text[1:].lstrip()
            known = [one for one in _TAGS if title.startswith(one)]
            # the cloud's columns stand in more comment lines below its tag
            tag = known[0] if known else tag if tag == _CLOUD else ""
        elif tag and tag not in blocks and (text or tag == _CLOUD):
            blocks[tag] = number
    if tag == _CLOUD:
        blocks.setdefault(_CLOUD, len(lines) + 1)  # a cloud without points, and the file ends
    for tag in _TAGS:
        if tag not in blocks:
            raise DataError(
                f"no line '# {tag}' with what belongs to it below", path=path, line=len(lines)
            )
    return blocks


def _camera(text: str, path: Path, line: int) -> tuple[Camera, int]:
    fields = split_fields(text)
    if len(fields) != 7:
        raise DataError(
            f"expected fx, fy, cx, cy, width, height, npoints, got {len(fields)} fields",
            path=path,
            line=line,
        )
    params = tuple(parse_float(field, "camera parameter", path, line) for field in fields[:4])
    width, height, num_points = (
        parse_integer(field, "size or number of points", path, line) for field in fields[4:]
    )
    try:
        return Camera("PINHOLE", width, height, params), num_points
    except DataError as error:
        raise DataError(error.message, path=path, line=line) from error


def _points(lines: list[str], first: int, path: Path) -> NDArray[np.float64]:
    """Points of the pairs of lines from line ``first`` on, to the next empty line."""
    points = []
    number = first
    while number <= len(lines) and lines[number - 1]:
        fields = split_fields(lines[number - 1])
        if len(fields) != _POINT_FIELDS:
            raise DataError(
                "expected u,v,idepth_scaled,idepth_hessian,maxRelBaseline,numGoodRes,status, got "
                f"{len(fields)} fields",
                path=path,
                line=number,
            )
        points.append([parse_float(field, "u, v or depth", path, number) for field in fields[:3]])
        colours = lines[number] if number < len(lines) else ""
        if len(split_fields(colours)) != _COLOURS:
            raise DataError(
                f"expected {_COLOURS} colours between commas", path=path, line=number + 1
            )
        number += 2
    return np.array(points, dtype=np.float64).reshape(-1, 3)
