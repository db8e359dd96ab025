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
from megloc_kapture.evaluation.protocols import Benchmark, benchmark_of
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.io.dataset_tables import (
    MAX_QUATERNION_NORM_ERROR,
    SIDE_TABLES,
    ImageGroup,
    PoseFileFormat,
    read_priors,
)
from megloc_kapture.io.files import read_content, read_text
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.kapture.format import BYTE_ORDER_MARK

# error: the server would refuse the file, or its figures would be wrong as a whole; warning: single
# poses cannot be right, or queries are lost; note: good to know
Severity = Literal["error", "warning", "note"]
_RANK: dict[Severity, int] = {"error": 0, "warning": 1, "note": 2}

# findings of one kind that are printed one by one; JSON has all of them
_SHOWN_OF_A_KIND = 10
_NAMES_SHOWN = 3

# columns before the pose, all columns, and where the quaternion begins among the seven numbers
_FORMATS: dict[PoseFileFormat, tuple[int, str, int]] = {
    "ltvl": (1, pose_files.COLUMNS, 0),
    "mlad": (2, pose_files.MLAD_COLUMNS, 3),
}


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
    reference : what the file was compared with; empty: nothing.
    poses : rows with a pose that can be used.
    expected : queries, or rows, that the challenge counts; None where that is not known.
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
        by_kind: dict[tuple[str, str], list[Finding]] = {}
        shown = []
        for finding in self.sorted_findings:
            alike = by_kind.setdefault((finding.severity, finding.kind), [])
            alike.append(finding)
            if len(alike) <= _SHOWN_OF_A_KIND:
                shown.append(str(finding))
        shown += [
            f"{severity}: {len(alike) - _SHOWN_OF_A_KIND} more of kind {kind!r}; --json lists all"
            for (severity, kind), alike in by_kind.items()
            if len(alike) > _SHOWN_OF_A_KIND
        ]
        counts = Counter(finding.severity for finding in self.findings)
        of = "" if self.expected is None else f" of {self.expected} queries"
        outcome = "no problem found"
        if any(finding.kind == "undecided" for finding in self.findings):
            outcome += ", but not every mistake is ruled out"
        if counts["error"]:
            outcome = f"{plural(counts['error'], 'problem')} found"
        also = f", {plural(counts['warning'], 'warning')}" if counts["warning"] else ""
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


def about(
    severity: Severity, kind: str, names: Sequence[str], noun: str, said: str, advice: str = ""
) -> Finding:
    """The finding that something is the matter with so many names, the first of them told."""
    message = f"{plural(len(names), noun)} {said}: {some(names)}{advice}"
    return Finding(severity, kind, message, names=tuple(names))


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
    named: Mapping[str, int] = field(default_factory=dict)
    findings: Sequence[Finding] = ()

    def only(self, chosen: NDArray[np.int64]) -> Rows:
        """The keys and poses of some rows, int64 (K,)."""
        keys = tuple(self.keys[row] for row in chosen.tolist())
        return Rows(keys, self.quats[chosen], self.translations[chosen])


def read_rows(path: Path, kind: PoseFileFormat) -> Rows:
    """Read what can be read of a pose file; DataError: nothing can, or it is no text in UTF-8."""
    _, columns, at = _FORMATS[kind]
    text = read_text(path)
    if pose_files.is_colmap_images(text):
        raise DataError(
            "this is COLMAP's images.txt, not a pose file; `megloc import colmap` of its folder "
            "and `megloc submit` make one",
            path=path,
        )
    poses, named, findings = _scan(text.split("\n"), kind)
    if read_content(path).startswith(BYTE_ORDER_MARK):
        message = "a byte order mark stands before the first name: a server may not find that query"
        findings.append(Finding("warning", "byte-order-mark", message, line=1))
    keys = tuple(poses)
    numbers = np.array(list(poses.values()), dtype=np.float64).reshape(-1, 7)
    norms, off = _norms(numbers[:, at : at + 4])
    other_norms, other_off = _norms(numbers[:, 3 - at : 7 - at])
    if len(numbers) and off.mean() > 0.5 and (~other_off).mean() > 0.5:
        there, first = ("translation", "quaternion")[:: -1 if at else 1]
        message = (
            f"the {there} stands before the {first} in {plural(int(off.sum()), 'row')}; "
            f"the columns are {columns}"
        )
        findings.append(Finding("error", "column-order", message))
        at, norms, off = 3 - at, other_norms, other_off
    for row in np.flatnonzero(off).tolist():
        message = f"{keys[row]}: quaternion of length {norms[row]:g}, not 1"
        findings.append(Finding("error", "quaternion", message, line=named[keys[row]]))
    usable = np.isfinite(norms) & (norms > 1e-6)
    return Rows(
        keys=tuple(compress(keys, usable)),
        quats=numbers[usable, at : at + 4] / norms[usable, None],
        translations=numbers[usable][:, (4, 5, 6) if at == 0 else (0, 1, 2)],
        named=named,
        findings=findings,
    )


def _scan(
    lines: Sequence[str], kind: PoseFileFormat
) -> tuple[dict[str, list[float]], dict[str, int], list[Finding]]:
    """Key -> the seven numbers of its pose, key -> its line, and what is wrong with the lines."""
    num_keys, columns, _ = _FORMATS[kind]
    wanted = num_keys + 7
    poses, named, findings = dict[str, list[float]](), dict[str, int](), list[Finding]()

    def problem(line: int, kind: str, message: str, severity: Severity = "error") -> None:
        findings.append(Finding(severity, kind, message, line=line))

    if lines[-1] and kind == "ltvl":
        message = "the last line is not ended: the file may be cut short"
        problem(len(lines), "cut", message, "warning")
    for number, line in enumerate(lines, start=1):
        fields = line.split()
        if "," in line and (len(fields) != wanted or any(f.endswith(",") for f in fields)):
            separated = [field.strip() for field in line.split(",")]
            if len(separated) != wanted:
                separated = line.replace(",", " ").split()
            if len(separated) == wanted:
                problem(number, "separator", "commas; the format has single spaces")
                fields = separated
        if not fields:
            continue
        if len(fields) != wanted:
            if fields[0].startswith("#"):
                problem(number, "comment", "a comment; the format has none, and no header")
                continue
            told = f"{plural(len(fields), 'column')} instead of {wanted} ({columns})"
            problem(number, "columns", told)
            if len(fields) < num_keys:
                continue
        key = " ".join(fields[:num_keys])
        try:
            for stamp in fields[:2] if kind == "mlad" else ():
                pose_files.parse_timestamp(stamp)
        except DataError:
            problem(number, "timestamp", f"{key} are not two timestamps (whole numbers)")
            continue
        if key in named:
            told = f"{key} is given twice, first on line {named[key]}"
            problem(number, "duplicate", told)
            continue
        named[key] = number
        if len(fields) != wanted:
            continue
        try:
            values = [pose_files.parse_number(field) for field in fields[num_keys:]]
        except DataError as error:
            problem(number, "number", f"{key}: {error.message}")
            continue
        if all(map(math.isfinite, values)):
            poses[key] = values
        else:
            problem(number, "not-finite", f"{key}: the pose is not finite")
    return poses, named, findings


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference(Benchmark):
    """An imported dataset, which a pose file is compared with, and the rules of its benchmark.

    Parameters
    ----------
    folder : its path, as it is told to people; empty: there is none.
    priors : query -> what it may be matched with.
    expected : what each scored query is called in the pose file -> the query; in the order of the
        challenge's list where it has one.
    queries : all query images, also those that are not scored.
    cameras : of the map; None where there is no map.
    """

    folder: str = ""
    priors: Mapping[str, Sequence[str]] = field(default_factory=dict)
    expected: Mapping[str, str] = field(default_factory=dict)
    queries: frozenset[str] = frozenset()
    cameras: MapCameras | None = None


def read_reference(folder: Path) -> Reference:
    """Read what is there of an import or workspace: ``mapping/``, ``query/``, ``megloc/``.
    DataError: none of the three is there, or one is broken."""
    tables = folder / SIDE_TABLES
    mapping, query = (
        KaptureFolder(path) if (path / "sensors" / "sensors.txt").is_file() else None
        for path in (folder / "mapping", folder / "query")
    )
    if mapping is None and query is None and not tables.is_dir():
        raise DataError(
            "no imported dataset: it has none of mapping/, query/ and megloc/", path=folder
        )
    rules = benchmark_of(tables)
    queries = frozenset[str]()
    names = rules.names
    if query is not None:
        queries = frozenset(query.read().records_camera.values())
        if not names:
            scored = rules.scored(queries)
            names = pose_files.names_in_pose_file(scored, rules.protocol.pose_file_names)
    cameras = None
    if mapping is not None and (poses := mapping.read().poses()):
        quats, translations = stack_poses(poses.values())
        cameras = MapCameras(tuple(poses), quats, camera_centers(quats, translations))
    return Reference(
        **vars(rules),
        folder=str(folder),
        priors=read_priors(tables),
        expected={name: image for image, name in names.items()},
        queries=queries,
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
