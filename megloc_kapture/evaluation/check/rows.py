"""Pose files read row by row, however broken: what can be used of them, and what is wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation import mlad_file, pose_file
from megloc_kapture.evaluation.check.findings import Finding, Severity, plural
from megloc_kapture.io.side_tables import MAX_QUATERNION_NORM_ERROR, PoseFileFormat
from megloc_kapture.io.text import read_text

_KEYS: dict[PoseFileFormat, int] = {"ltvl": 1, "mlad": 2}
_COLUMNS: dict[PoseFileFormat, str] = {"ltvl": pose_file.COLUMNS, "mlad": mlad_file.COLUMNS}
# where the quaternion begins among the seven numbers
_QUATERNION_AT: dict[PoseFileFormat, int] = {"ltvl": 0, "mlad": 3}


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of one pose file that have a name and a pose.

    Parameters
    ----------
    keys : per row its name, or its two timestamps with a blank between.
    lines : int64 (N,), line of each row, from 1.
    quats : float64 (N, 4), unit length, in the order of the file's columns.
    translations : float64 (N, 3).
    named : keys of all rows with the line of their first, those without a usable pose included.
    findings : what is wrong with the rows.
    """

    keys: tuple[str, ...]
    lines: NDArray[np.int64]
    quats: NDArray[np.float64]
    translations: NDArray[np.float64]
    named: dict[str, int]
    findings: tuple[Finding, ...]


def read_rows(path: Path, kind: PoseFileFormat) -> Rows:
    """Read what can be read of a pose file.

    Raises
    ------
    DataError : it cannot be read at all, or is no text in UTF-8; names file and line.
    """
    text = read_text(path)
    scan = _Scan(kind)
    lines = text.split("\n")
    if lines[-1] and kind == "ltvl":
        scan.problem(
            len(lines),
            "cut",
            "the last line is not ended: the file may be cut short",
            severity="warning",
        )
    for number, line in enumerate(lines, start=1):
        if line.strip():
            scan.add(number, line)
    return scan.result()


class _Scan:
    """Collects rows and problems; numbers are looked at together at the end."""

    def __init__(self, kind: PoseFileFormat) -> None:
        self.kind = kind
        self.keys: list[str] = []
        self.lines: list[int] = []
        self.numbers: list[list[float]] = []
        self.named: dict[str, int] = {}
        self.findings: list[Finding] = []

    def problem(self, line: int, kind: str, message: str, severity: Severity = "error") -> None:
        """Remember a problem of a line."""
        self.findings.append(Finding(severity, kind, message, line=line))

    def add(self, number: int, line: str) -> None:
        """Take one line."""
        fields = line.split()
        wanted = _KEYS[self.kind] + 7
        if "," in line and len(fields) != wanted or any(field.endswith(",") for field in fields):
            separated = [field.strip() for field in line.split(",")]
            if len(separated) != wanted:
                separated = line.replace(",", " ").split()
            if len(separated) == wanted:
                self.problem(number, "separator", "commas; the format has single spaces")
                fields = separated
        if len(fields) != wanted:
            if line.lstrip().startswith("#"):
                self.problem(number, "comment", "a comment; the format has none, and no header")
                return
            self.problem(
                number,
                "columns",
                f"{plural(len(fields), 'column')} instead of {wanted} ({_COLUMNS[self.kind]})",
            )
            if len(fields) < _KEYS[self.kind]:
                return
            fields = fields[: _KEYS[self.kind]]
        if self.kind == "mlad" and not all(map(_is_timestamp, fields[:2])):
            problem = f"{' '.join(fields[:2])} are not two timestamps (whole numbers)"
            self.problem(number, "timestamp", problem)
            return
        key = " ".join(fields[: _KEYS[self.kind]])
        if key in self.named:
            self.problem(
                number, "duplicate", f"{key} is given twice, first on line {self.named[key]}"
            )
            return
        self.named[key] = number
        if len(fields) == wanted:
            self._take(number, key, fields[_KEYS[self.kind] :])

    def _take(self, number: int, key: str, fields: Sequence[str]) -> None:
        try:
            values = [pose_file.parse_number(field) for field in fields]
        except DataError as error:
            self.problem(number, "number", f"{key}: {error.message}")
            return
        if not all(math.isfinite(value) for value in values):
            self.problem(number, "not-finite", f"{key}: the pose is not finite")
            return
        self.keys.append(key)
        self.lines.append(number)
        self.numbers.append(values)

    def result(self) -> Rows:
        """The rows whose quaternion is one."""
        numbers = np.array(self.numbers, dtype=np.float64).reshape(-1, 7)
        at = _QUATERNION_AT[self.kind]
        norms = _norms(numbers[:, at : at + 4])
        off = np.abs(norms - 1.0) >= MAX_QUATERNION_NORM_ERROR
        swapped = 3 - at
        if len(numbers) and off.mean() > 0.5:
            others = np.abs(_norms(numbers[:, swapped : swapped + 4]) - 1.0)
            if (others < MAX_QUATERNION_NORM_ERROR).mean() > 0.5:
                self.findings.append(self._swapped(at, int(off.sum())))
                at = swapped
                norms = _norms(numbers[:, at : at + 4])
                off = np.abs(norms - 1.0) >= MAX_QUATERNION_NORM_ERROR
        for position in np.flatnonzero(off).tolist():
            length = f"quaternion of length {norms[position]:g}, not 1"
            self.problem(self.lines[position], "quaternion", f"{self.keys[position]}: {length}")
        with np.errstate(over="ignore"):
            usable = np.isfinite(norms) & (norms > 1e-6)
        return Rows(
            keys=tuple(key for key, good in zip(self.keys, usable, strict=True) if good),
            lines=np.array(self.lines, dtype=np.int64)[usable],
            quats=numbers[usable, at : at + 4] / norms[usable, None],
            translations=numbers[usable][:, (4, 5, 6) if at == 0 else (0, 1, 2)],
            named=self.named,
            findings=tuple(self.findings),
        )

    def _swapped(self, at: int, number: int) -> Finding:
        there, first = ("quaternion", "translation") if at else ("translation", "quaternion")
        return Finding(
            "error",
            "column-order",
            f"the {there} stands before the {first} in {plural(number, 'row')}; the columns are "
            f"{_COLUMNS[self.kind]}",
        )


def _norms(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(over="ignore"):
        return np.linalg.norm(quats, axis=1)


def _is_timestamp(text: str) -> bool:
    try:
        mlad_file.parse_timestamp(text)
    except DataError:
        return False
    return True
