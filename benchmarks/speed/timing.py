"""Wall-clock and CPU time of commands, and text tables."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Timed:
    """Times of a step. ``cpu_s`` (user and system, all processes) is unaffected by other load."""

    name: str
    wall_s: float
    cpu_s: float


def timed_command(
    name: str, command: Sequence[str], environment: Mapping[str, str], log: Path
) -> Timed:
    """Run a command with its output in ``log``; on failure exit with the end of the log."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    with log.open("wb") as stream:
        done = subprocess.run(command, env=dict(environment), stdout=stream, stderr=stream)
    wall_s = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        tail = log.read_text(errors="replace").splitlines()[-15:]
        sys.exit("\n".join([*tail, f"{name} failed with {done.returncode}: {' '.join(command)}"]))
    cpu_s = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return Timed(name, wall_s, cpu_s)


def table(rows: Sequence[Sequence[str]]) -> str:
    """Align rows of text in columns, the first to the left and the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        first, *others = row
        cells = [first.ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)
