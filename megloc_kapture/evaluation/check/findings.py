"""Findings of a check: problems, each with a severity, and their text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

# error: the server would refuse the file, or its figures would be wrong as a whole; warning: single
# poses cannot be right, or queries are lost; note: good to know
Severity = Literal["error", "warning", "note"]
_RANK: dict[Severity, int] = {"error": 0, "warning": 1, "note": 2}

# findings of one kind that are printed one by one; JSON has all of them
_SHOWN_OF_A_KIND = 10
_NAMES_SHOWN = 3


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
        shown = []
        counts: Counter[tuple[str, str]] = Counter()
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
        errors = sum(finding.severity == "error" for finding in self.findings)
        warnings = sum(finding.severity == "warning" for finding in self.findings)
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
    listed: Sequence[str] = list(names)
    text = ", ".join(listed[:_NAMES_SHOWN])
    return text if len(listed) <= _NAMES_SHOWN else f"{text} and {len(listed) - _NAMES_SHOWN} more"
