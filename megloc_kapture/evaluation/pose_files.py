"""Pose files of the challenges, and their provenance.

visuallocalization.net (LTVL) takes one line ``name qw qx qy qz tx ty tz`` per query: the pose is
``cam_from_world`` and ``t`` its translation. Single spaces, no header, a newline after every line.
A query without a pose has no line.

The MLAD challenges (4Seasons) take ``src_ts tgt_ts tx ty tz qx qy qz qw`` per pair: the pose is
``query_from_reference`` of the rectified left cameras. A pose file has the name and all pairs of
its relocalization file. Relocalization files of training recordings have the same columns; the
others have the timestamps only.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, Field

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap_model import image_rows
from megloc_kapture.io.dataset_tables import PoseFileFormat, PoseFileNames
from megloc_kapture.io.files import named, read_content, read_json_model, read_text, write_json
from megloc_kapture.io.kapture.format import FLOAT_PATTERN
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.io.text_lines import fields_of, reading_lines
from megloc_kapture.values import RigidTransform

_log = logging.getLogger(__name__)

COLUMNS = "name qw qx qy qz tx ty tz"

Value = TypeVar("Value")
Poses = Mapping[str, RigidTransform]
# a rule, or the challenge's list: image -> name in the pose file, in the list's order
Names = PoseFileNames | Mapping[str, str]


def name_by_rule(image: str, rule: PoseFileNames) -> str:
    return image if rule == "full" else image.rsplit("/", 1)[-1]


def is_name(text: str) -> bool:
    """Return whether ``text`` can be a name in a pose file: not empty, no white space."""
    return text.split() == [text]


def names_in_pose_file(images: Iterable[str], names: Names) -> dict[str, str]:
    """Return image -> name, sorted by name or in the order of the challenge's list.

    Images that are not in the challenge's list are left out.
    """
    wanted = set(images)
    if isinstance(names, str):
        by_image = {image: name_by_rule(image, names) for image in sorted(wanted)}
        by_image = dict(sorted(by_image.items(), key=lambda item: item[1]))
    else:
        by_image = {image: name for image, name in names.items() if image in wanted}
    by_name: dict[str, str] = {}
    for image, name in by_image.items():
        require(is_name(name), f"image {image!r}: a pose file cannot hold the name {name!r}")
        if name in by_name:
            raise DataError(
                f"images {by_name[name]!r} and {image!r} would both be called {name!r} in the pose "
                "file; use full names"
            )
        by_name[name] = image
    return by_image


def format_pose_file(poses: Poses, *, names: Names = "full") -> str:
    """Return the text of a pose file; reading it gives exactly the same float64 numbers."""
    lines = []
    for image, name in names_in_pose_file(poses, names).items():
        pose = checked_pose(poses[image].quat_wxyz, poses[image].translation, f"image {image!r}")
        numbers = " ".join(repr(float(v)) for v in (*pose.quat_wxyz, *pose.translation))
        lines.append(f"{name} {numbers}\n")
    return "".join(lines)


def read_pose_file(path: Path | str) -> dict[str, RigidTransform]:
    """Read name -> ``cam_from_world`` from a pose file or COLMAP's ``images.txt``, in file order.

    Rows with a number that is not finite or with a zero quaternion, which other tools write for
    failed queries, are left out with a warning. Tabs, commas, CRLF, backslashes in names, empty
    lines, comments, a header that names the columns, and up to three columns after the pose are
    accepted: 7-Scenes' pseudo ground truth has a focal length there, ACE has errors and inliers.
    """
    text = read_text(path)
    if text.startswith("# kapture format"):
        raise DataError("is a file of a kapture folder; give the folder", path=path)
    if not is_colmap_images(text):
        rows = _in_column_order(_rows(text))
    else:
        rows = ((number, [*fields[9:], *fields[1:8]]) for number, fields, _ in image_rows(text))
    poses: dict[str, RigidTransform | None] = {}
    for number, fields in rows:
        with named(path, number):
            # MLAD's rows begin with two timestamps
            further = 8 < len(fields) <= 11 and not "".join(fields[:2]).isdecimal()
            require(
                len(fields) == 8 or further,
                f"{len(fields)} columns instead of 8 ({COLUMNS}); convert other formats "
                "(KITTI, 7-Scenes, Cambridge Landmarks) to such rows of cam_from_world",
            )
            name = fields[0].replace("\\", "/")
            require(name not in poses, f"{name!r} is given twice")
            poses[name] = _pose_or_none(fields[1:8], "ltvl", repr(name))
    if failures := [name for name, pose in poses.items() if pose is None]:
        message = "%s: %d rows of nan or zeros are read as queries without a pose, such as %s"
        _log.warning(message, path, len(failures), failures[0])
    return {name: pose for name, pose in poses.items() if pose is not None}


def is_colmap_images(text: str) -> bool:
    """Return whether row 1 is ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, as in ``images.txt``."""
    _, fields = next(_rows(text), (0, []))
    return len(fields) >= 10 and fields[0].isdecimal() and fields[8].isdecimal()


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(text.split("\n"), start=1):
        if (fields := _fields(line)) and not fields[0].startswith("#"):
            yield number, fields


def _fields(line: str) -> list[str]:
    """Split a row at white space, or at commas or semicolons, as spreadsheets write."""
    for separator in ";,":
        fields = [field.strip(' \t\r"') for field in line.split(separator)]
        if len(fields) >= 8 and not any(len(field.split()) > 1 for field in fields[1:]):
            return fields
    return line.split()


def _in_column_order(rows: Iterable[tuple[int, list[str]]]) -> Iterator[tuple[int, list[str]]]:
    """Choose the columns that a header names, as in ``poses.csv``; without one, keep all.

    Names are in the first column with a title: pandas may write an untitled index before it.
    """
    header: list[str] = []
    for number, fields in rows:
        names = [field.lower().replace("_", "") for field in fields]
        if set(COLUMNS.split()[1:]) <= set(names):
            header = names
        elif len(fields) == len(header):
            titles = (next(filter(None, header)), *COLUMNS.split()[1:])
            yield number, [fields[header.index(title)] for title in titles]
        else:
            yield number, fields


def poses_by_image(
    poses: Mapping[str, Value], images: Iterable[str], names: Mapping[str, str] | None = None
) -> dict[str, Value]:
    """Rename the poses of a pose file to the images of a kapture folder.

    A name is looked up in this order: in the challenge's list ``names`` (image -> name), as an
    image, as the end of one image's path, as a path that ends with an image, and with another
    suffix (servers accept ``.jpg`` for ``.png``). Names that fit no image are kept.
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

    def images_called(name: str) -> list[str]:
        if name in listed:
            return [listed[name]]
        if name in known:
            return [name]
        if name in by_end:
            return by_end[name]
        longer = [end for end in _ends(name)[1:] if end in known and end not in poses]
        alike = longer[:1] or [*by_stem.get(_stem(name), ())]
        return alike if len(alike) == 1 else [name]

    named: dict[str, str] = {}
    for name in poses:
        image, *others = images_called(name)
        if others:
            raise DataError(f"{name!r} may be {image!r} or {others[0]!r}; use full names")
        if other := named.get(image):
            raise DataError(
                f"image {image!r} is named in two ways: {other!r}, {name!r}; use full names"
            )
        named[image] = name
    return {image: poses[name] for image, name in named.items()}


def _ends(image: str) -> list[str]:
    parts = image.split("/")
    return ["/".join(parts[start:]) for start in range(len(parts))]


def _stem(name: str) -> str:
    stem, _, ending = name.rpartition(".")
    return stem if ending.lower() in ("jpg", "jpeg", "png") else name


def parse_number(text: str) -> float:
    if FLOAT_PATTERN.fullmatch(text):
        return float(text)
    if text.lower().lstrip("+-") in ("nan", "inf", "infinity", "none", ""):
        return math.nan
    raise DataError(f"{text!r} is not a number")


def checked_pose(
    quat_wxyz: tuple[float, float, float, float],
    translation: tuple[float, float, float],
    whose: str,
) -> RigidTransform:
    # callers in Python may give arrays
    numbers = [*np.ravel(quat_wxyz).tolist(), *np.ravel(translation).tolist()]
    # the squares of larger numbers may overflow
    require(all(abs(v) < 1e100 for v in numbers), f"{whose}: the pose is not finite")
    qw, qx, qy, qz, tx, ty, tz = numbers
    with named(about=whose):
        return RigidTransform(unit_quaternion((qw, qx, qy, qz)), (tx, ty, tz))


def parse_pose(values: Sequence[str], kind: PoseFileFormat, whose: str) -> RigidTransform:
    """Parse the seven numbers of a row."""
    numbers = [parse_number(value) for value in values]
    if kind == "mlad":
        tx, ty, tz, qx, qy, qz, qw = numbers
    else:
        qw, qx, qy, qz, tx, ty, tz = numbers
        first, last = (abs(math.hypot(*quat) - 1) for quat in (numbers[:4], numbers[3:]))
        require(
            first < 0.01 or not last <= 0.01,  # also if they are nan
            f"{whose}: the quaternion is last, as in world_from_cam trajectories (TUM, EuRoC: use "
            "`megloc export tum` and evo) and in Cambridge Landmarks (camera centre, then "
            "w x y z); a pose file needs cam_from_world with the quaternion first, w x y z",
        )
    return checked_pose((qw, qx, qy, qz), (tx, ty, tz), whose)


def _pose_or_none(fields: Sequence[str], kind: PoseFileFormat, whose: str) -> RigidTransform | None:
    """Return None for nan or a zero quaternion, which other tools write for failed queries."""
    numbers = [parse_number(field) for field in fields]
    quaternion = numbers[3:] if kind == "mlad" else numbers[:4]
    failed = not np.isfinite(numbers).all() or not any(quaternion)
    return None if failed else parse_pose(fields, kind, whose)


MLAD_COLUMNS = "src_ts tgt_ts tx ty tz qx qy qz qw"
# without leading zeros, so that writing the parsed int gives the same text
_TIMESTAMP = re.compile("0|[1-9][0-9]{0,29}")


def timestamp_of(image: str) -> int:
    """Return the timestamp in an image name of 4Seasons (``.../1600000000000000000.png``)."""
    stem = PurePosixPath(image).stem
    if not _TIMESTAMP.fullmatch(stem):
        raise DataError(f"image {image!r} is not named after a timestamp, as MLAD requires")
    return int(stem)


def relative_pose(
    query_from_world: RigidTransform, reference_from_world: RigidTransform, *, scale: float = 1.0
) -> RigidTransform:
    """Return ``query_from_reference``; ``scale`` is metres per unit of the (local) world."""
    return (query_from_world @ reference_from_world.inverse()).scaled(scale)


def format_mlad_file(poses: Mapping[tuple[int, int], RigidTransform]) -> str:
    """Return the text of a pose file from ``query_from_reference`` by timestamps.

    Reading it gives exactly the same float64 numbers.
    """
    lines = []
    for (reference, query), given in poses.items():
        pair = f"{reference} {query}"
        pose = checked_pose(given.quat_wxyz, given.translation, f"pair {pair}")
        qw, *vector = pose.quat_wxyz
        lines.append(" ".join([pair, *(repr(float(v)) for v in (*pose.translation, *vector, qw))]))
    return "".join(f"{line}\n" for line in lines)


def read_mlad_file(path: Path | str) -> dict[tuple[int, int], RigidTransform]:
    """Read ``query_from_reference`` by timestamps of reference and query, in file order.

    Rows of nan or zeros, which other tools write for failed queries, become the identity, the mark
    of a missing pose. Commas, CRLF, empty lines and comments are accepted.
    """
    poses: dict[tuple[int, int], RigidTransform] = {}
    with reading_lines(Path(path), comments=True) as lines:
        for fields in map(fields_of, lines):
            require(
                len(fields) == 9,
                f"{len(fields)} columns instead of 9 ({MLAD_COLUMNS}); relocalization files of "
                "test recordings have no poses",
            )
            reference, query = (parse_timestamp(field) for field in fields[:2])
            whose = f"pair {reference} {query}"
            require((reference, query) not in poses, f"{whose} is given twice")
            pose = _pose_or_none(fields[2:], "mlad", whose)
            poses[reference, query] = pose or RigidTransform.identity()
    return poses


def parse_timestamp(text: str) -> int:
    require(_TIMESTAMP.fullmatch(text), f"{text!r} is not a timestamp (a whole number)")
    return int(text)


# packages whose version can change a pose or a number in a report
PACKAGES = (
    "megloc-kapture",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pycolmap",
    "poselib",
    "torch",
    "matplotlib",
)


@cache  # parsing a package's metadata takes 2 ms, and every stage writes all versions
def installed_version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def package_versions() -> dict[str, str]:
    versions = {package: installed_version(package) for package in PACKAGES}
    return {package: version for package, version in versions.items() if version is not None}


def provenance_path(target: Path | str) -> Path:
    """Return ``x.txt.json`` for a file ``x.txt`` and ``x.json`` for a folder ``x``."""
    path = Path(target)
    return path.with_name(f"{path.name}.json")


def write_provenance(
    target: Path | str,
    provenance: Mapping[str, Any],
    *,
    counts: Mapping[str, int],
    files: Sequence[str] | None = None,
) -> None:
    """Write the provenance of a pose file, or of ``files`` in a folder.

    The JSON has the SHA-256 of each file, package versions, ``counts`` and the entries of
    ``provenance`` (options, preset, inputs), but no date: the same run gives the same bytes.
    """
    target = Path(target)
    paths = {target.name: target} if files is None else {name: target / name for name in files}
    ours: dict[str, Any] = {
        "files": {name: _sha256(path) for name, path in sorted(paths.items())},
        "versions": package_versions(),
        "counts": dict(counts),
    }
    write_json(provenance_path(target), ours | dict(provenance))


def _sha256(path: Path) -> str:
    return hashlib.sha256(read_content(path)).hexdigest()


class _Provenance(BaseModel):
    files: dict[str, str] = {}
    confidence: dict[str, Annotated[float, Field(ge=0, le=1)]] = {}


def read_confidences(target: Path | str) -> dict[str, float]:
    """Read image -> confidence from the JSON file of a pose file.

    Empty if the JSON file is missing; also, with a warning, if it does not have the expected
    content or belongs to another pose file.
    """
    target, path = Path(target), provenance_path(target)
    if not path.is_file():
        return {}
    try:
        provenance = read_json_model(path, _Provenance)
    except DataError as error:
        _log.warning("%s; its confidences are left out", error)
        return {}
    if provenance.files.get(target.name, "") not in ("", _sha256(target)):
        _log.warning("%s belongs to another pose file; its confidences are left out", path)
        return {}
    return provenance.confidence
