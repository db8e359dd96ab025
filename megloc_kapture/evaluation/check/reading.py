"""Data of a check: findings, rows of a pose file, however broken, and the import they are about."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import compress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation import pose_files
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.io.dataset_tables import (
    MAX_QUATERNION_NORM_ERROR,
    SIDE_TABLES,
    ImageGroup,
    PoseFileFormat,
    Protocol,
    RelocalizationPair,
    World,
    read_groups,
    read_names,
    read_priors,
    read_protocol,
    read_relocalization,
    read_world,
)
from megloc_kapture.io.files import read_text
from megloc_kapture.io.kapture import KaptureFolder

# error: the server would refuse the file, or its figures would be wrong as a whole; warning: single
# poses cannot be right, or queries are lost; note: good to know
Severity = Literal["error", "warning", "note"]
_RANK: dict[Severity, int] = {"error": 0, "warning": 1, "note": 2}

# findings of one kind that are printed one by one; JSON has all of them
_SHOWN_OF_A_KIND = 10
_NAMES_SHOWN = 3

_MAPPING, _QUERY = "mapping", "query"
_KEYS: dict[PoseFileFormat, int] = {"ltvl": 1, "mlad": 2}
_COLUMNS = {"ltvl": pose_files.COLUMNS, "mlad": pose_files.MLAD_COLUMNS}
# where the quaternion begins among the seven numbers
_QUATERNION_AT: dict[PoseFileFormat, int] = {"ltvl": 0, "mlad": 3}


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem.

    Parameters
    ----------
    kind : a short name that programs can rely on (``inverted``, ``missing``).
    message : one line; names what is wrong and, where it can, what to do.
    file : the pose file, where there are several.
    line : of the file, from 1; None where it is about the file as a whole.
    names : what it is about, as the file or the challenge's list call it.
    """

    severity: Severity
    kind: str
    message: str
    file: str = ""
    line: int | None = None
    names: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = self.file if self.line is None else f"{self.file or 'line'}:{self.line}"
        return f"{self.severity}: {where}{': ' if where else ''}{self.message}"


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """Everything a check found.

    Parameters
    ----------
    poses : rows with a pose that can be used.
    expected : queries, or rows, that the challenge counts; None where that is not known.
    reference : what the file was compared with; empty: nothing.
    findings : in no particular order; :attr:`sorted_findings` has them by severity.
    """

    dataset: str
    file: str
    reference: str
    poses: int
    expected: int | None
    findings: tuple[Finding, ...]

    @property
    def has_problems(self) -> bool:
        """True where anything found is an error."""
        return any(finding.severity == "error" for finding in self.findings)

    @property
    def sorted_findings(self) -> list[Finding]:
        """By severity, what is about whole files first, then by file and line."""
        return sorted(
            self.findings,
            key=lambda f: (_RANK[f.severity], f.line is not None, f.file, f.line or 0),
        )

    def lines(self) -> list[str]:
        """The report as text, a problem per line; the last line is the outcome."""
        shown, counts = [], Counter[tuple[str, str]]()
        for finding in self.sorted_findings:
            counts[finding.severity, finding.kind] += 1
            if counts[finding.severity, finding.kind] <= _SHOWN_OF_A_KIND:
                shown.append(str(finding))
        shown += [
            f"{severity}: {count - _SHOWN_OF_A_KIND} more of kind {kind!r}; --json lists all"
            for (severity, kind), count in counts.items()
            if count > _SHOWN_OF_A_KIND
        ]
        of = "" if self.expected is None else f" of {self.expected} queries"
        errors, warnings = (
            sum(finding.severity == severity for finding in self.findings)
            for severity in ("error", "warning")
        )
        outcome = plural(errors, "problem") + " found" if errors else "no problem found"
        also = f", {plural(warnings, 'warning')}" if warnings else ""
        return [*shown, f"{self.poses} poses{of}: {outcome}{also}"]

    def to_json(self) -> dict[str, Any]:
        """The report as plain JSON data."""
        return {
            "dataset": self.dataset,
            "file": self.file,
            "reference": self.reference or None,
            "poses": self.poses,
            "expected": self.expected,
            "ok": not self.has_problems,
            "findings": [{**asdict(f), "file": f.file or None} for f in self.sorted_findings],
        }


def plural(count: int, noun: str) -> str:
    """``1 pose``, ``2 poses``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def some(names: Iterable[str]) -> str:
    """The first few names, and how many more there are."""
    listed = list(names)
    text = ", ".join(listed[:_NAMES_SHOWN])
    return text if len(listed) <= _NAMES_SHOWN else f"{text} and {len(listed) - _NAMES_SHOWN} more"


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of one pose file that have a name and a pose.

    Parameters
    ----------
    keys : per row its name, or its two timestamps with a blank between.
    quats : float64 (N, 4), unit length, in the order of the file's columns.
    translations : float64 (N, 3).
    named : keys of all rows with the line of their first, those without a usable pose included.
    findings : what is wrong with the rows.
    """

    keys: tuple[str, ...]
    quats: NDArray[np.float64]
    translations: NDArray[np.float64]
    named: dict[str, int]
    findings: tuple[Finding, ...]


def read_rows(path: Path, kind: PoseFileFormat) -> Rows:
    """Read what can be read of a pose file; DataError: nothing can, or it is no text in UTF-8."""
    scan = _Scan(kind)
    lines = read_text(path).split("\n")
    if lines[-1] and kind == "ltvl":
        message = "the last line is not ended: the file may be cut short"
        scan.problem(len(lines), "cut", message, severity="warning")
    for number, line in enumerate(lines, start=1):
        if line.strip():
            scan.add(number, line)
    numbers = np.array(scan.numbers, dtype=np.float64).reshape(-1, 7)
    at = _QUATERNION_AT[kind]
    norms, off = _norms(numbers[:, at : at + 4])
    other_norms, other_off = _norms(numbers[:, 3 - at : 7 - at])
    if len(numbers) and off.mean() > 0.5 and (~other_off).mean() > 0.5:
        there, first = ("translation", "quaternion")[:: -1 if at else 1]
        message = (
            f"the {there} stands before the {first} in {plural(int(off.sum()), 'row')}; "
            f"the columns are {_COLUMNS[kind]}"
        )
        scan.findings.append(Finding("error", "column-order", message))
        at, norms, off = 3 - at, other_norms, other_off
    for position in np.flatnonzero(off).tolist():
        key = scan.keys[position]
        message = f"{key}: quaternion of length {norms[position]:g}, not 1"
        scan.problem(scan.named[key], "quaternion", message)
    usable = np.isfinite(norms) & (norms > 1e-6)
    return Rows(
        keys=tuple(compress(scan.keys, usable)),
        quats=numbers[usable, at : at + 4] / norms[usable, None],
        translations=numbers[usable][:, (4, 5, 6) if at == 0 else (0, 1, 2)],
        named=scan.named,
        findings=tuple(scan.findings),
    )


class _Scan:
    """Collects rows and problems."""

    def __init__(self, kind: PoseFileFormat) -> None:
        self.kind = kind
        self.num_keys = _KEYS[kind]
        self.keys: list[str] = []
        self.numbers: list[list[float]] = []
        self.named: dict[str, int] = {}
        self.findings: list[Finding] = []

    def problem(self, line: int, kind: str, message: str, severity: Severity = "error") -> None:
        self.findings.append(Finding(severity, kind, message, line=line))

    def add(self, number: int, line: str) -> None:
        """Take one line."""
        fields = line.split()
        wanted = self.num_keys + 7
        if "," in line and len(fields) != wanted or any(field.endswith(",") for field in fields):
            separated = [field.strip() for field in line.split(",")]
            if len(separated) != wanted:
                separated = line.replace(",", " ").split()
            if len(separated) == wanted:
                self.problem(number, "separator", "commas; the format has single spaces")
                fields = separated
        if len(fields) != wanted:
            if line.lstrip().startswith("#"):
                return self.problem(
                    number, "comment", "a comment; the format has none, and no header"
                )
            message = f"{plural(len(fields), 'column')} instead of {wanted} ({_COLUMNS[self.kind]})"
            self.problem(number, "columns", message)
            if len(fields) < self.num_keys:
                return None
        key, numbers = " ".join(fields[: self.num_keys]), fields[self.num_keys :]
        try:
            for stamp in fields[:2] if self.kind == "mlad" else ():
                pose_files.parse_timestamp(stamp)
        except DataError:
            message = f"{key} are not two timestamps (whole numbers)"
            return self.problem(number, "timestamp", message)
        if key in self.named:
            message = f"{key} is given twice, first on line {self.named[key]}"
            return self.problem(number, "duplicate", message)
        self.named[key] = number
        if len(fields) != wanted:
            return None
        try:
            values = [pose_files.parse_number(field) for field in numbers]
        except DataError as error:
            return self.problem(number, "number", f"{key}: {error.message}")
        if not all(math.isfinite(value) for value in values):
            return self.problem(number, "not-finite", f"{key}: the pose is not finite")
        self.keys.append(key)
        self.numbers.append(values)
        return None


def _norms(quats: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Lengths (N,), and whether each is off 1."""
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quats, axis=1)
    return norms, np.abs(norms - 1.0) >= MAX_QUATERNION_NORM_ERROR


@dataclass(frozen=True, eq=False)
class MapCameras:
    """The map's images that have a pose, in the workspace's local frame.

    Parameters
    ----------
    images : names, sorted.
    quats : float64 (M, 4), w x y z, of ``cam_from_local``.
    centers : float64 (M, 3).
    """

    images: tuple[str, ...]
    quats: NDArray[np.float64]
    centers: NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """An imported dataset, which a pose file is compared with.

    Parameters
    ----------
    folder : its path, as it is told to people.
    expected : what each scored query is called in the pose file -> the query; in the order of the
        challenge's list where it has one (``listed``).
    queries : all query images, also those that are not scored; None where they are not known.
    relocalization : the pairs of an MLAD challenge.
    cameras : of the map; None where there is no map.
    """

    folder: str
    protocol: Protocol = field(default_factory=Protocol)
    world: World = field(default_factory=World)
    groups: Mapping[str, ImageGroup] = field(default_factory=dict)
    priors: Mapping[str, Sequence[str]] = field(default_factory=dict)
    expected: Mapping[str, str] = field(default_factory=dict)
    listed: bool = False
    queries: frozenset[str] | None = None
    relocalization: Sequence[RelocalizationPair] = ()
    cameras: MapCameras | None = None


def read_reference(folder: Path) -> Reference:
    """Read what is there of an import or workspace: ``mapping/``, ``query/``, ``megloc/``.
    DataError: none of the three is there, or one is broken."""
    tables = folder / SIDE_TABLES
    parts = [folder / name for name in (_MAPPING, _QUERY)]
    there = [part for part in parts if (part / "sensors" / "sensors.txt").is_file()]
    if not there and not tables.is_dir():
        raise DataError(
            "no imported dataset: it has none of mapping/, query/ and megloc/", path=folder
        )
    protocol, groups, names = read_protocol(tables), read_groups(tables), read_names(tables)
    listed = bool(names)
    queries: frozenset[str] | None = None
    if folder / _QUERY in there:
        queries = frozenset(KaptureFolder(folder / _QUERY).read().records_camera.values())
        if not listed:
            scored = [image for image in queries if groups.get(image, ImageGroup()).scored]
            names = pose_files.names_in_pose_file(scored, protocol.pose_file_names)
    cameras = None
    if folder / _MAPPING in there and (poses := KaptureFolder(folder / _MAPPING).read().poses()):
        quats, translations = stack_poses(poses.values())
        cameras = MapCameras(tuple(poses), quats, camera_centers(quats, translations))
    return Reference(
        folder=str(folder),
        protocol=protocol,
        world=read_world(tables),
        groups=groups,
        priors=read_priors(tables),
        expected={name: image for image, name in names.items()},
        listed=listed,
        queries=queries,
        relocalization=read_relocalization(tables),
        cameras=cameras,
    )


@dataclass(frozen=True, eq=False)
class CameraSets:
    """Sets of the map's cameras, and for each pose the one it is compared with.

    Parameters
    ----------
    members : positions of cameras, int64 (K,) each, K > 0.
    own : int64 (N,), each pose's set: what its prior permits, else the cameras of its frame, else
        all cameras.
    other : int64 (N,), the set of the frames that are not the pose's own; its own where there is
        none, or where nothing says which frame is its own.
    labels : per set, its frames or locations in words.
    """

    members: tuple[NDArray[np.int64], ...]
    own: NDArray[np.int64]
    other: NDArray[np.int64]
    labels: tuple[str, ...]

    @property
    def has_other(self) -> NDArray[np.bool_]:
        """(N,) whether a pose has other frames that it could stand in by mistake."""
        return self.other != self.own


def camera_sets(
    reference: Reference, cameras: MapCameras, queries: Sequence[str | None]
) -> CameraSets:
    """The sets that poses of these queries are compared with; None: the query is unknown.

    A prior that names single images permits, for this purpose, all cameras of their frames: a pose
    has to be near some of the map, not near the very images that retrieval was allowed.
    """
    default = ImageGroup()
    groups = [reference.groups.get(image, default) for image in cameras.images]
    by_frame: dict[str, list[int]] = {}
    by_name: dict[str, list[int]] = {}
    for position, group in enumerate(groups):
        by_frame.setdefault(group.frame, []).append(position)
        for name in {group.location, group.frame} - {""}:
            by_name.setdefault(name, []).append(position)
    frames = sorted(by_frame)
    frame_of = {image: group.frame for image, group in zip(cameras.images, groups, strict=True)}
    # whether the names are of frames, names -> number of the set
    numbers: dict[tuple[bool, tuple[str, ...]], int] = {}

    def number_of(names: tuple[str, ...], *, of_frames: bool) -> int:
        return numbers.setdefault((of_frames, names), len(numbers))

    own, other = [], []
    for query in queries:
        permitted = () if query is None else reference.priors.get(query, ())
        names = tuple(sorted(name for name in permitted if name in by_name))
        of_query = {groups[i].frame for name in names for i in by_name[name]}
        of_query |= {frame_of[name] for name in permitted if name in frame_of}
        if not of_query and query is not None:
            group = reference.groups.get(query, default)
            of_query = ({group.frame, group.condition} & set(frames)) - {""}
        known = tuple(sorted(of_query)) or tuple(frames)
        own.append(number_of(names or known, of_frames=not names))
        rest = tuple(frame for frame in frames if frame not in known)
        other.append(number_of(rest, of_frames=True) if rest else own[-1])
    members = [
        sorted({i for name in names for i in (by_frame if of_frames else by_name)[name]})
        for of_frames, names in numbers
    ]
    return CameraSets(
        tuple(np.array(one, dtype=np.int64) for one in members),
        np.array(own, np.int64),
        np.array(other, np.int64),
        tuple(", ".join(filter(None, names)) for _, names in numbers),
    )
