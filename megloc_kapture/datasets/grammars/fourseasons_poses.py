"""4Seasons' poses of keyframes: ``GNSSPoses.txt``, and the challenge's ``poses.txt``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.grammars.fourseasons_lines import (
    data_lines,
    parse_timestamp,
    parse_transform,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_csv import parse_float
from megloc_kapture.values import RigidTransform

_MAX_SCALE = 1e6


@dataclass(frozen=True, slots=True)
class GnssPose:
    """A row of ``GNSSPoses.txt``.

    Parameters
    ----------
    slam_from_cam : pose of the undistorted left camera in the recording's SLAM world. Its
        translation is in that world's unit: metres are ``scale`` times as many.
    scale : metres per unit; None where the row ends before it.
    fusion_quality : 2 fused with GNSS, 1 interpolated, 0 none; None where the row ends before it.
    line : of the file.
    """

    slam_from_cam: RigidTransform
    scale: float | None
    fusion_quality: float | None
    line: int


def read_gnss_poses(path: Path) -> dict[int, GnssPose]:
    """Read ``GNSSPoses.txt``: rows by their timestamps (ns), in the file's order.

    A row has 8 to 11 fields, ``timestamp tx ty tz qx qy qz qw [scale [fusion_quality [v3]]]``; the
    published header announces 11, the published rows have 10.

    Raises
    ------
    DataError : a row that is none, a timestamp given twice, no row; names file and line.
    """
    rows: dict[int, GnssPose] = {}
    for number, fields in data_lines(path):
        if not 8 <= len(fields) <= 11:
            raise DataError(
                "expected 8 to 11 fields, timestamp tx ty tz qx qy qz qw scale fusion_quality v3, "
                f"got {len(fields)}",
                path=path,
                line=number,
            )
        timestamp = parse_timestamp(fields[0], path, number)
        if timestamp in rows:
            raise DataError(f"timestamp {timestamp} is given twice", path=path, line=number)
        scale = parse_scale(fields[8], path, number) if len(fields) > 8 else None
        quality = parse_float(fields[9], "fusion_quality", path, number) if fields[9:] else None
        pose = parse_transform(fields[1:8], path, number)
        rows[timestamp] = GnssPose(pose, scale, quality, number)
    if not rows:
        raise DataError("no pose in the file", path=path)
    return rows


def read_poses(path: Path) -> dict[int, RigidTransform]:
    """Read ``poses.txt`` of the ECCV 2020 challenge: ``world_from_cam`` by timestamp (ns), metres.

    Raises
    ------
    DataError : a row other than ``timestamp tx ty tz qx qy qz qw``, a timestamp given twice, no
        row; names file and line.
    """
    poses: dict[int, RigidTransform] = {}
    for number, fields in data_lines(path):
        timestamp = parse_timestamp(fields[0], path, number)
        if timestamp in poses:
            raise DataError(f"timestamp {timestamp} is given twice", path=path, line=number)
        poses[timestamp] = parse_transform(fields[1:], path, number)
    if not poses:
        raise DataError("no pose in the file", path=path)
    return poses


def read_keyframe_accuracy(path: Path) -> set[int]:
    """Read ``keyframe_accuracy.txt``: timestamps (ns) of keyframes known to better than 0.05 m.

    What may follow a timestamp in its line is not documented and not looked at.

    Raises
    ------
    DataError : a line that does not begin with a timestamp; names file and line.
    """
    return {parse_timestamp(fields[0], path, number) for number, fields in data_lines(path)}


def parse_scale(text: str, path: Path, line: int) -> float:
    """Metres per unit of a SLAM world: a positive number."""
    scale = parse_float(text, "scale", path, line)
    if not 1 / _MAX_SCALE < scale < _MAX_SCALE:
        raise DataError(f"scale {text} is no factor between units of length", path=path, line=line)
    return scale
