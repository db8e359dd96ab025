"""The text files of 4Seasons and of the MLAD challenges on it.

Fields stand between commas or blanks, ``#`` begins a comment line. Timestamps are integer
nanoseconds and never pass through a float, which would lose their last digits. Rotations are
x y z w, distances metres unless it is said that they are in a recording's own unit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.text_lines import (
    MAX_DISTANCE_M,
    Line,
    read_lines,
    read_rigid_matrix,
    shown,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import read_text
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import Camera, RigidTransform

CAMERA_FILES = ("undistorted_calib_0.txt", "undistorted_calib_1.txt")
STEREO_FILE = "undistorted_calib_stereo.txt"

_TIMESTAMP = re.compile(r"[1-9][0-9]{0,18}")
_MAX_SIZE = 1 << 14
_MAX_SCALE = 1e6
_POSE = "timestamp tx ty tz qx qy qz qw"

# Transformations.txt
_S_AS, _W_GPSW, _E_GPSW = "transform_S_AS", "transform_w_gpsw", "transform_e_gpsw"
_SCALE = "GNSS scale"

# the tags of a keyframe's file
_TIME_TAG, _CAMERA_TAG, _POSE_TAG, _CLOUD_TAG = "timestamp", "fx", "camToWorld", "Point Cloud"
_TAGS = (_TIME_TAG, _CAMERA_TAG, _POSE_TAG, _CLOUD_TAG)

# relocalization files of 2021, 2020 and 2022; that of 2020 lies in its source's folder
_RELOCALIZATION_NAMES = (
    re.compile(r"relocalizationFile_(?P<source>.+)_to_(?P<target>.+)\.txt"),
    re.compile(r"relocalizationFile_(?P<target>.+?)(?:_(?:easy|moderate|hard))?\.txt"),
    re.compile(r"reloc_(?P<source>.+)_to_(?P<target>.+)\.txt"),
)

Row = TypeVar("Row")


@dataclass(frozen=True, slots=True)
class StereoCalibration:
    """The cameras of the undistorted images.

    Parameters
    ----------
    cam0, cam1 : left and right, PINHOLE.
    cam1_from_cam0 : metres. The dataset's page words it "from the right to the left camera"; its
        camchain.yaml, its sign and every user of the data say cam1 from cam0.
    """

    cam0: Camera
    cam1: Camera
    cam1_from_cam0: RigidTransform


def read_calibration(folder: Path) -> StereoCalibration:
    """Read the three files of a calibration folder; DataError names file and line."""
    cam0, cam1 = (read_pinhole(folder / name) for name in CAMERA_FILES)
    return StereoCalibration(cam0, cam1, read_rigid_matrix(folder / STEREO_FILE, comments=True))


def read_pinhole(path: Path) -> Camera:
    """Read ``undistorted_calib_N.txt``: ``Pinhole fx fy cx cy 0 0 0 0``, the size, twice.

    DataError names file and line, also of another camera model, distortion and other sizes.
    """
    lines = read_lines(path, comments=True)
    if len(lines) not in (2, 4):
        raise DataError(
            "expected the lines 'Pinhole fx fy cx cy 0.0 0.0 0.0 0.0', 'width height', 'crop', "
            f"'width height', got {len(lines)}",
            path=path,
            line=lines[-1].number if lines else 1,
        )
    first = lines[0]
    model, *values = first.comma_fields
    if model != "Pinhole" or len(values) not in (4, 8):
        raise first.error(
            "expected 'Pinhole fx fy cx cy 0.0 0.0 0.0 0.0', the calibration of undistorted images"
        )
    params = first.numbers_of(values, "camera parameter")
    if any(params[4:]):
        raise first.error("undistorted images cannot have distortion")
    sizes = [_size(line) for line in lines[1::2]]
    if sizes[0] != sizes[-1]:
        raise lines[3].error(f"the image's size is {sizes[0]} first and {sizes[-1]} then")
    return _pinhole(first, *sizes[0], params[:4])


def _size(line: Line) -> tuple[int, int]:
    line.expect(line.comma_fields, 2, "width height, in pixels")
    width, height = (line.count_of(text, "size") for text in line.comma_fields)
    if max(width, height) > _MAX_SIZE:
        raise line.error(f"no camera takes images of {width}x{height}")
    return width, height


def _pinhole(line: Line, width: int, height: int, params: Sequence[float]) -> Camera:
    with line.named():
        return Camera("PINHOLE", width, height, tuple(params))


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


def read_times(path: Path) -> list[int]:
    """Read ``times.txt``: timestamps (ns) of a recording's frames, published or not, in its order.

    The seconds and the exposure that follow are checked and left: a float of seconds has lost the
    last digits of the nanoseconds. DataError names file and line.
    """

    def parse(line: Line) -> None:
        line.expect(line.comma_fields, (2, 3), "timestamp seconds exposure")
        line.numbers_of(line.comma_fields[1:], "time or exposure")

    return list(_by_timestamp(path, "frame", parse))


def read_gnss_poses(path: Path) -> dict[int, GnssPose]:
    """Read ``GNSSPoses.txt``: rows by their timestamps (ns), in the file's order.

    A row has 8 to 11 fields, ``timestamp tx ty tz qx qy qz qw [scale [fusion_quality [v3]]]``; the
    published header announces 11, the published rows have 10. DataError names file and line.
    """
    counts: list[int] = []

    def parse(line: Line) -> GnssPose:
        fields = line.comma_fields
        line.expect(fields, range(8, 12), f"{_POSE} scale fusion_quality v3")
        counts.append(len(fields))
        scale = _scale(line, fields[8]) if len(fields) > 8 else None
        quality = line.number_of(fields[9], "fusion_quality") if fields[9:] else None
        return GnssPose(_transform(line, fields[1:8]), scale, quality, line.number)

    poses = _by_timestamp(path, "pose", parse)
    # one that ends within a number would be read with another one
    if counts[-1] < max(counts) and not read_text(path).endswith("\n"):
        *_, last = poses.values()
        message = "has fewer fields and is not ended: the file may be cut short"
        raise DataError(message, path=path, line=last.line)
    return poses


def read_poses(path: Path) -> dict[int, RigidTransform]:
    """Read ``poses.txt`` of the ECCV 2020 challenge: ``world_from_cam`` by timestamp (ns), metres.

    Rows are ``timestamp tx ty tz qx qy qz qw``; DataError names file and line.
    """
    return _by_timestamp(path, "pose", lambda line: _transform(line, line.comma_fields[1:]))


def read_keyframe_accuracy(path: Path) -> set[int]:
    """Read ``keyframe_accuracy.txt``: timestamps (ns) of keyframes known to better than 0.05 m.

    Text after a timestamp is not documented and not looked at. DataError names file and line.
    """
    return {_timestamp(line, line.comma_fields[0]) for line in read_lines(path, comments=True)}


def timestamp_of_name(stem: str) -> int | None:
    """The time in nanoseconds that a file is called by; None where it is another name."""
    return int(stem) if _TIMESTAMP.fullmatch(stem) else None


def _by_timestamp(path: Path, what: str, parse: Callable[[Line], Row]) -> dict[int, Row]:
    """Rows by the timestamps they begin with; a file has at least one."""
    rows: dict[int, Row] = {}
    for line in read_lines(path, comments=True):
        timestamp = _timestamp(line, line.comma_fields[0])
        if timestamp in rows:
            raise line.error(f"timestamp {timestamp} is given twice")
        rows[timestamp] = parse(line)
    if not rows:
        raise DataError(f"no {what} in the file", path=path)
    return rows


def _timestamp(line: Line, text: str) -> int:
    if not _TIMESTAMP.fullmatch(text):
        raise line.error(f"{shown(text)} is not a timestamp, a whole number of nanoseconds")
    return int(text)


def _transform(line: Line, fields: Sequence[str]) -> RigidTransform:
    """The transform of seven fields ``tx ty tz qx qy qz qw``."""
    line.expect(fields, 7, "tx ty tz qx qy qz qw")
    tx, ty, tz = line.numbers_of(fields[:3], "translation")
    qx, qy, qz, qw = line.numbers_of(fields[3:], "rotation")
    if max(abs(tx), abs(ty), abs(tz)) > MAX_DISTANCE_M:
        raise line.error(f"the translation {tx:g} {ty:g} {tz:g} leads beyond the earth")
    with line.named():
        return RigidTransform(unit_quaternion((qw, qx, qy, qz)), (tx, ty, tz))


def _scale(line: Line, text: str) -> float:
    """Metres per unit of a SLAM world: a positive number."""
    scale = line.number_of(text, "scale")
    if not 1 / _MAX_SCALE < scale < _MAX_SCALE:
        raise line.error(f"scale {text} is no factor between units of length")
    return scale


@dataclass(frozen=True, slots=True)
class Transformations:
    """The way from a recording's SLAM world to the earth.

    Parameters
    ----------
    s_from_as : the SLAM world, scaled to metres, made level; also called w, the visual world.
    w_from_gpsw : from the scene's east-north-up frame to the visual world.
    e_from_gpsw : from the scene's east-north-up frame to the earth (ECEF).
    gnss_scale : metres per unit of the SLAM world; None where the file does not say.
    """

    s_from_as: RigidTransform
    w_from_gpsw: RigidTransform
    e_from_gpsw: RigidTransform
    gnss_scale: float | None


def read_transformations(path: Path) -> Transformations:
    """Read ``Transformations.txt``: pairs of a line ``# name: ...`` and one of numbers.

    Names that are not needed are passed over. Blank lines between the pairs are there in some
    releases and not in others. DataError names file and line.
    """
    found: dict[str, Line] = {}
    name: str | None = None
    lines = read_lines(path)
    for line in lines:
        if line.text.startswith("#"):
            name = line.text[1:].partition(":")[0].strip(" \t")
            continue
        if name is None:
            raise line.error("numbers without a line '# name: ...' before them")
        if name in found:
            raise line.error(f"{name!r} is given twice")
        found[name], name = line, None
    names = (_S_AS, _W_GPSW, _E_GPSW)
    absent = [name for name in names if name not in found]
    if absent:
        number = lines[-1].number if lines else 1
        raise DataError(f"there is no {', '.join(absent)}", path=path, line=number)
    s_from_as, w_from_gpsw, e_from_gpsw = (
        _transform(found[name], found[name].comma_fields) for name in names
    )
    scale = None
    if _SCALE in found:
        line = found[_SCALE]
        line.expect(line.comma_fields, 1, "one scale")
        scale = _scale(line, line.comma_fields[0])
    return Transformations(s_from_as, w_from_gpsw, e_from_gpsw, scale)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A keyframe's file, ``KeyFrameData/KeyFrame_<timestamp>.txt``, as its odometry left it.

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
    """Read ``KeyFrame_<timestamp>.txt``; DataError names file and line."""
    lines = read_lines(path, blank=True)
    first = _first_lines(lines, path)
    timestamp = _timestamp(lines[first[_TIME_TAG]], lines[first[_TIME_TAG]].text)
    line = lines[first[_POSE_TAG]]
    world_from_cam = _transform(line, line.comma_fields)
    line = lines[first[_CAMERA_TAG]]
    line.expect(line.comma_fields, 7, "fx, fy, cx, cy, width, height, npoints")
    params = line.numbers_of(line.comma_fields[:4], "camera parameter")
    width, height, num_points = (
        line.count_of(text, "size or number of points") for text in line.comma_fields[4:]
    )
    camera = _pinhole(line, width, height, params)
    points = _points(lines[first[_CLOUD_TAG] :])
    if len(points) != num_points:
        raise lines[-1].error(f"{len(points)} points, {num_points} are announced")
    return Keyframe(timestamp, camera, world_from_cam, points)


def _first_lines(lines: Sequence[Line], path: Path) -> dict[str, int]:
    """Index of the first line behind each tag."""
    first: dict[str, int] = {}
    tag = ""
    for index, line in enumerate(lines):
        if line.text.startswith("#"):
            title = line.text[1:].lstrip()
            known = [one for one in _TAGS if title.startswith(one)]
            # the cloud's columns stand in more comment lines below its tag
            tag = known[0] if known else tag if tag == _CLOUD_TAG else ""
        elif tag and tag not in first and (line.text or tag == _CLOUD_TAG):
            first[tag] = index
    if tag == _CLOUD_TAG:
        first.setdefault(_CLOUD_TAG, len(lines))  # a cloud without points, and the file ends
    for tag in _TAGS:
        if tag not in first:
            raise DataError(
                f"no line '# {tag}' with what belongs to it below",
                path=path,
                line=max(len(lines), 1),
            )
    return first


def _points(lines: Sequence[Line]) -> NDArray[np.float64]:
    """Points (P, 3) of pairs of lines, up to the next blank one."""
    points = []
    end = next((index for index, line in enumerate(lines) if not line.text), len(lines))
    for index in range(0, end, 2):
        line = lines[index]
        form = "u,v,idepth_scaled,idepth_hessian,maxRelBaseline,numGoodRes,status"
        line.expect(line.comma_fields, 7, form)
        points.append(line.numbers_of(line.comma_fields[:3], "u, v or depth"))
        colours = lines[index + 1] if index + 1 < len(lines) else None
        if colours is None or len(colours.comma_fields) != 8:
            message = "expected 8 colours between commas"
            raise DataError(message, path=line.path, line=line.number + 1)
    return np.array(points, dtype=np.float64).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class RelocalizationRow:
    """A pair of keyframes.

    Parameters
    ----------
    reference, query : timestamps, ns.
    query_from_reference : between their left cameras, metres; None where it is withheld.
    """

    reference: int
    query: int
    query_from_reference: RigidTransform | None


def parse_relocalization_name(name: str) -> tuple[str | None, str] | None:
    """Source (None where the name leaves it out) and target recording of a file's name.

    None for a name that is none of a relocalization file.
    """
    for pattern in _RELOCALIZATION_NAMES:
        found = pattern.fullmatch(name)
        if found is not None:
            parts = found.groupdict()
            return parts.get("source"), parts["target"]
    return None


def read_relocalization(path: Path) -> list[RelocalizationRow]:
    """Read the pairs of a relocalization file, in its order, each once, as a pose file has it.

    DataError names file and line.
    """
    rows: dict[tuple[int, int], RelocalizationRow] = {}
    for line in read_lines(path, comments=True):
        fields = line.comma_fields
        line.expect(fields, (2, 9), "reference query [tx ty tz qx qy qz qw]")
        reference, query = (_timestamp(line, field) for field in fields[:2])
        pose = _transform(line, fields[2:]) if len(fields) == 9 else None
        rows.setdefault((reference, query), RelocalizationRow(reference, query, pose))
    if not rows:
        raise DataError("no pair in the file", path=path)
    return list(rows.values())
