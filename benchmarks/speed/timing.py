"""Wall-clock and processor time of commands, and tables of both."""

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
    """One step. ``cpu_s`` (user and system, all processes) tells a busy machine from slow code."""

    name: str
    wall_s: float
    cpu_s: float


def timed_command(
    name: str, command: Sequence[str], environment: Mapping[str, str], log: Path
) -> Timed:
    """Run a command, its output in ``log``; exits with the log's end when the command fails."""
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


def peak_gib(*, reset: bool = False) -> float:
    """Most memory since it was reset (Linux)."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / (1 << 20)


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of text as aligned columns, the first to the left and the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        first, *others = row
        cells = [first.ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)
