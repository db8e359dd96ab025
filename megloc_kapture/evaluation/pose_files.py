"""Pose files: the text formats that challenges take, their numbers checked, and their provenance.

visuallocalization.net (LTVL) has one line ``name qw qx qy qz tx ty tz`` per query. The pose is
``cam_from_world`` and ``t`` its translation, not the camera centre. Single spaces, no header, every
line ended by a newline; a query without a pose has no line.

The MLAD challenges (4Seasons) have ``src_ts tgt_ts tx ty tz qx qy qz qw`` per pair. The pose is
``query_from_reference`` of the rectified left cameras: ``x_query = R x_ref + t``. The translation
stands first and the quaternion's w last, unlike everywhere else here. A file has the name of the
relocalization file it answers, and every pair of that one; the relocalization file has the same
rows without poses, or, for training recordings, with the true ones.

Beside a pose file stands where it comes from: versions, options, counts; no dates.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import MAX_QUATERNION_NORM_ERROR, PoseFileNames
from megloc_kapture.io.files import (
    read_content,
    read_json_model,
    read_text,
    write_bytes,
    write_json,
)
from megloc_kapture.io.kapture.format import FLOAT_PATTERN
from megloc_kapture.values import RigidTransform

_log = logging.getLogger(__name__)

COLUMNS = "name qw qx qy qz tx ty tz"

Poses = Mapping[str, RigidTransform]
# how images are called: by a rule, or by a table in the order of the challenge's list
Names = PoseFileNames | Mapping[str, str]


def name_by_rule(image: str, rule: PoseFileNames) -> str:
    """Return the name of an image in a pose file by the challenge's rule."""
    return image if rule == "full" else image.rsplit("/", 1)[-1]


def is_name(text: str) -> bool:
    """Whether a row can begin with it: it has no white space, and is not empty."""
    return text.split() == [text]


def names_in_pose_file(images: Iterable[str], names: Names) -> dict[str, str]:
    """Image -> the name it bears in a pose file, in the order of the file.

    By a rule that is the order of the names; by a table (image -> name) the table's, and images
    that are not in it have no name.
    """
    wanted = set(images)
    if isinstance(names, str):
        called = {image: name_by_rule(image, names) for image in sorted(wanted)}
    else:
        called = {image: name for image, name in names.items() if image in wanted}
    bearer: dict[str, str] = {}
    for image, name in called.items():
        if not is_name(name):
            raise DataError(f"image {image!r}: a pose file cannot hold the name {name!r}")
        if name in bearer:
            raise DataError(
                f"images {bearer[name]!r} and {image!r} would both be called {name!r} in the pose "
                "file; use full names"
            )
        bearer[name] = image
    if isinstance(names, str):
        called = dict(sorted(called.items(), key=lambda item: item[1]))
    return called


def format_pose_file(poses: Poses, *, names: Names = "full") -> str:
    """The text of a pose file.

    Numbers have the fewest digits that read back to the same float64, so nothing is lost.

    Parameters
    ----------
    poses : image -> ``cam_from_world``.
    names : a rule, and the rows are sorted by name; or the challenge's list as image -> name, and
        the rows stand in its order: images that are not in it are left out.
    """
    lines = []
    for image, name in names_in_pose_file(poses, names).items():
        pose = checked_pose(poses[image].quat_wxyz, poses[image].translation, f"image {image!r}")
        numbers = " ".join(repr(float(v)) for v in (*pose.quat_wxyz, *pose.translation))
        lines.append(f"{name} {numbers}\n")
    return "".join(lines)


def write_pose_file(path: Path | str, poses: Poses, *, names: Names = "full") -> None:
    """Write a pose file atomically; see :func:`format_pose_file`."""
    write_bytes(path, format_pose_file(poses, names=names).encode("utf-8"))


def read_pose_file(path: Path | str) -> dict[str, RigidTransform]:
    """Read a pose file or COLMAP's ``images.txt``: name -> ``cam_from_world``, in the file's order.

    Runs of spaces, tabs and CRLF line ends are taken; empty lines and comments are passed over. A
    row of nan, or with a quaternion of zeros, is how other tools write a query that failed: it is
    left out, and a warning is logged.
    """
    text = read_text(path)
    rows = (_colmap_rows if is_colmap_images(text) else _rows)(text)
    poses: dict[str, RigidTransform | None] = {}
    for number, fields in rows:
        name = fields[0]
        try:
            if len(fields) != 8:
                raise DataError(f"{len(fields)} columns instead of 8 ({COLUMNS})")
            if name in poses:
                raise DataError(f"{name!r} is given twice")
            qw, qx, qy, qz, tx, ty, tz = values = [parse_number(field) for field in fields[1:]]
            failed = not np.isfinite(values).all() or not any(values[:4])
            poses[name] = (
                None if failed else checked_pose((qw, qx, qy, qz), (tx, ty, tz), repr(name))
            )
        except DataError as error:
            raise DataError(error.message, path=path, line=number) from error
    if failures := [name for name, pose in poses.items() if pose is None]:
        message = "%s: rows of nan or zeros are queries without a pose: %d, the first is %s"
        _log.warning(message, path, len(failures), failures[0])
    return {name: pose for name, pose in poses.items() if pose is not None}


def is_colmap_images(text: str) -> bool:
    """Whether a text is COLMAP's ``images.txt``: ID QW QX QY QZ TX TY TZ CAMERA_ID NAME."""
    _, fields = next(_rows(text), (0, []))
    return len(fields) >= 10 and fields[0].isdecimal() and fields[8].isdecimal()


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(text.split("\n"), start=1):
        if (fields := line.split()) and not fields[0].startswith("#"):
            yield number, fields


def _colmap_rows(text: str) -> Iterator[tuple[int, list[str]]]:
    lines = iter(enumerate(text.split("\n"), start=1))
    for number, line in lines:
        if (fields := line.split(maxsplit=9)) and not fields[0].startswith("#"):
            next(lines, None)  # the image's keypoints
            name = fields.pop().strip() if len(fields) == 10 else ""
            yield number, [name, *fields[1:8]]


def poses_by_image(
    poses: Poses,
    images: Iterable[str],
    names: Mapping[str, str] | None = None,
) -> dict[str, RigidTransform]:
    """Give the poses of a pose file the names that ``images`` bear in kapture.

    A name of the challenge's list becomes its image. Of the others, one that is an image stays;
    one that ends exactly one image's path becomes that image, and so does one that ends with an
    image's path; where none fits also with another ending (``.jpg`` for ``.png``, as servers take
    it); any other stays as it is, unknown, for the evaluation to report.

    ``names`` is the challenge's list, image -> name in the pose file.
    """
    known = set(images)
    listed = {name: image for image, name in (names or {}).items()}
    by_end: dict[str, list[str]] = {}
    for image in sorted(known):
        for end in _ends(image):
            by_end.setdefault(end, []).append(image)
    by_stem: dict[str, set[str]] = {}
    for name, image in (*listed.items(), *((end, i) for end, all_ in by_end.items() for i in all_)):
        by_stem.setdefault(_stem(name), set()).add(image)
    renamed: dict[str, RigidTransform] = {}
    for name, pose in poses.items():
        fitting = [name] if name in known else by_end.get(name, [])
        if name in listed:
            fitting = [listed[name]]
        if not fitting:
            longer = (end for end in _ends(name)[1:] if end in known and end not in poses)
            fitting = list(islice(longer, 1))
        if not fitting:
            alike = by_stem.get(_stem(name), {name})
            fitting = list(alike) if len(alike) == 1 else [name]
        if len(fitting) > 1:
            raise DataError(f"{name!r} may be {fitting[0]!r} or {fitting[1]!r}; use full names")
        if fitting[0] in renamed:
            raise DataError(f"the pose file names image {fitting[0]!r} in two ways")
        renamed[fitting[0]] = pose
    return renamed


def _ends(image: str) -> list[str]:
    parts = image.split("/")
    return ["/".join(parts[start:]) for start in range(len(parts))]


def _stem(name: str) -> str:
    stem, _, ending = name.rpartition(".")
    return stem if ending.lower() in ("jpg", "jpeg", "png") else name


def parse_number(text: str) -> float:
    """A decimal number; "nan" and the like become one that :func:`checked_pose` refuses."""
    if FLOAT_PATTERN.fullmatch(text):
        return float(text)
    if text.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return math.nan
    raise DataError(f"{text!r} is not a number")


def checked_pose(
    quat_wxyz: tuple[float, float, float, float],
    translation: tuple[float, float, float],
    whose: str,
) -> RigidTransform:
    """Return the pose with a unit quaternion; an almost unit quaternion is unchanged."""
    # beyond, squares overflow
    if not all(abs(v) < 1e100 for v in (*quat_wxyz, *translation)):
        raise DataError(f"{whose}: the pose is not finite")
    norm = math.sqrt(sum(q * q for q in quat_wxyz))
    if not abs(norm - 1.0) < MAX_QUATERNION_NORM_ERROR:
        raise DataError(f"{whose}: quaternion of length {norm:g}, not 1")
    if abs(norm - 1.0) > 1e-12:
        w, x, y, z = (q / norm for q in quat_wxyz)
        quat_wxyz = (w, x, y, z)
    return RigidTransform(quat_wxyz, translation)


MLAD_COLUMNS = "src_ts tgt_ts tx ty tz qx qy qz qw"
# as an int it must be written again as it is, so there is no leading zero
_TIMESTAMP = re.compile("0|[1-9][0-9]{0,29}")


@dataclass(frozen=True, slots=True)
class RelativePose:
    """One row: a pair of keyframes by their timestamps, and the pose where the row has one."""

    reference: int
    query: int
    query_from_reference: RigidTransform | None = None


def timestamp_of(image: str) -> int:
    """The timestamp that an image of 4Seasons is named after (``.../1600000000000000000.png``)."""
    stem = PurePosixPath(image).stem
    if not _TIMESTAMP.fullmatch(stem):
        raise DataError(f"image {image!r} is not named after a timestamp, as MLAD's rows need")
    return int(stem)


def relative_pose(
    query_from_world: RigidTransform, reference_from_world: RigidTransform, *, scale: float = 1.0
) -> RigidTransform:
    """``query_from_reference`` of two cameras; ``scale`` is metres per unit of the world."""
    # taken in the local frame: from ECEF, millions of metres would have to cancel
    pose = query_from_world @ reference_from_world.inverse()
    if scale == 1.0:
        return pose
    x, y, z = (float(v) for v in scale * np.array(pose.translation))
    return RigidTransform(pose.quat_wxyz, (x, y, z))


def format_mlad_file(rows: Iterable[RelativePose]) -> str:
    """The text of a pose file, in the order of ``rows``.

    Numbers have the fewest digits that read back to the same float64.
    """
    lines = []
    for row in rows:
        pair = f"{row.reference} {row.query}"
        if row.query_from_reference is None:
            raise DataError(f"pair {pair} has no pose; MLAD wants every row")
        given = row.query_from_reference
        pose = checked_pose(given.quat_wxyz, given.translation, f"pair {pair}")
        qw, *vector = pose.quat_wxyz
        lines.append(" ".join([pair, *(repr(float(v)) for v in (*pose.translation, *vector, qw))]))
    return "".join(f"{line}\n" for line in lines)


def read_mlad_file(path: Path | str) -> list[RelativePose]:
    """Read a pose file or a relocalization file, ours or foreign, in its order.

    Runs of spaces, tabs and CRLF line ends are taken; empty lines are passed over. The last line
    may be without its end, as common tools write it.
    """
    rows: list[RelativePose] = []
    known: set[tuple[int, int]] = set()
    columns = 0
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        fields = line.split()
        if not fields:
            continue
        columns = columns or (2 if len(fields) == 2 else 9)
        try:
            row = _row(fields, columns)
            pair = (row.reference, row.query)
            if pair in known:
                raise DataError(f"pair {pair[0]} {pair[1]} is given twice")
        except DataError as error:
            raise DataError(error.message, path=path, line=number) from error
        known.add(pair)
        rows.append(row)
    return rows


def parse_timestamp(text: str) -> int:
    if not _TIMESTAMP.fullmatch(text):
        raise DataError(f"{text!r} is not a timestamp (a whole number)")
    return int(text)


def _row(fields: list[str], columns: int) -> RelativePose:
    if len(fields) != columns:
        wanted = "9 (" + MLAD_COLUMNS + ")" if columns == 9 else "2, as in the rows before"
        raise DataError(f"{len(fields)} columns instead of {wanted}")
    reference, query = (parse_timestamp(field) for field in fields[:2])
    if columns == 2:
        return RelativePose(reference, query)
    tx, ty, tz, qx, qy, qz, qw = (parse_number(field) for field in fields[2:])
    pose = checked_pose((qw, qx, qy, qz), (tx, ty, tz), f"pair {reference} {query}")
    return RelativePose(reference, query, pose)


# what can change a pose or a figure of the report
_PACKAGES = (
    "megloc-kapture",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pycolmap",
    "poselib",
    "torch",
    "matplotlib",
)


@cache  # parsing a package's metadata takes 2 ms, and every stage writes nine
def installed_version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def package_versions() -> dict[str, str]:
    found = ((package, installed_version(package)) for package in _PACKAGES)
    return {package: version for package, version in found if version is not None}


def provenance_path(target: Path | str) -> Path:
    """Path of the provenance: ``x.txt.json`` of a file ``x.txt``, ``x.json`` of a folder ``x``."""
    path = Path(target)
    return path.with_name(f"{path.name}.json")


def write_provenance(
    target: Path | str,
    provenance: Mapping[str, Any],
    *,
    counts: Mapping[str, int],
    files: Sequence[str] | None = None,
) -> Path:
    """Write the provenance of a pose file that has been written; returns its path.

    The JSON holds the SHA-256 of each file, so that they can be told to belong together, the
    package versions, ``counts`` and the entries of ``provenance`` (options, preset, inputs). It
    holds no date and no duration: the same run gives the same bytes.

    Parameters
    ----------
    target : the pose file, or the folder of a challenge that takes several.
    files : names of the pose files below the folder ``target``; None: it is a file.
    """
    target = Path(target)
    paths = {target.name: target} if files is None else {name: target / name for name in files}
    ours: dict[str, Any] = {
        "files": {
            name: hashlib.sha256(read_content(path)).hexdigest()
            for name, path in sorted(paths.items())
        },
        "versions": package_versions(),
        "counts": dict(counts),
    }
    taken = sorted(ours.keys() & provenance.keys())
    if taken:
        raise ValueError(f"provenance entries are already ours: {', '.join(taken)}")
    path = provenance_path(target)
    write_json(path, ours | dict(provenance))
    return path


class _Beside(BaseModel):
    files: dict[str, str] = {}
    confidence: Any = None


class _Scores(BaseModel):
    confidence: dict[str, Annotated[float, Field(ge=0, le=1)]] = {}


def read_confidences(target: Path | str) -> dict[str, float]:
    """Image -> confidence of its pose, as the JSON beside a pose file has it under ``confidence``.

    Empty where there is none, where the JSON is about something else, and, with a warning, where
    it tells the SHA-256 of another pose file.
    """
    target, path = Path(target), provenance_path(target)
    try:
        beside = read_json_model(path, _Beside) if path.is_file() else _Beside()
    except DataError:
        return {}
    if beside.confidence is None:
        return {}
    known = beside.files.get(target.name)
    if known is not None and known != hashlib.sha256(read_content(target)).hexdigest():
        _log.warning("%s is of another pose file; its confidences are left out", path)
        return {}
    return read_json_model(path, _Scores).confidence
