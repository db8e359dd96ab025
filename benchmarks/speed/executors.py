"""What the executors cost: one whole run in this process, with a pool, and with dask.

    python benchmarks/speed/executors.py --scene DIR [--workers 2] [--rounds 1] [arguments of eval]

Each run is a ``megloc eval`` of its own in an empty workspace, the executors by turns. Processor
seconds are those of all its processes, also of workers that outlive the process that started them:
this script adopts orphans and waits for them. ``--most 1.15`` fails above that many times the
processor seconds of ``processes``.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from end_to_end import scene_folder
from timing import table

KINDS = ("inline", "processes", "dask")
_SET_CHILD_SUBREAPER = 36  # prctl(2)


@dataclass(frozen=True)
class Spent:
    """Of one run: processor and clock seconds, recall in percent by threshold, files it wrote."""

    cpu_s: float
    wall_s: float
    recall: tuple[float, ...]
    files: dict[str, bytes]


def adopt_orphans() -> None:
    """Become the parent of processes whose own has gone, so that their seconds count (Linux)."""
    ctypes.CDLL(None, use_errno=True).prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def processor_s() -> float:
    """Seconds of all that this process has waited for, which it does first."""
    with suppress(ChildProcessError):
        while True:
            os.wait()
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def contents(workspace: Path) -> dict[str, bytes]:
    """The files of a workspace but for those that have times in them."""
    with_times = {"stages", "evaluation", "submissions", "timing.csv"}
    return {
        str(path.relative_to(workspace)): path.read_bytes()
        for path in sorted(workspace.rglob("*"))
        if path.is_file() and not with_times & set(path.relative_to(workspace).parts)
    }


def evaluated(scene: Path, kind: str, workers: int, arguments: list[str]) -> Spent:
    """Run ``megloc eval`` with an executor; a failure ends this script with its exit code."""
    many = [] if kind == "inline" else ["--workers", str(workers)]
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder) / "workspace"
        command = [str(Path(sys.executable).with_name("megloc")), "eval", "kapture", "-q"]
        command += ["--root", str(scene), "--workspace", str(workspace)]
        command += ["--submissions", str(Path(folder) / "submissions")]
        before, start = processor_s(), time.perf_counter()
        command += ["--executor", kind, *many, *arguments]
        run = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
        wall_s = time.perf_counter() - start
        if run.returncode:
            sys.exit(run.returncode)
        rows = json.loads((workspace / "evaluation" / "recall.json").read_text())["rows"]
        overall = next(row for row in rows if row["name"] == "all")["recall"]
        recall = tuple(round(100 * one["recall"], 1) for one in overall)
        return Spent(processor_s() - before, wall_s, recall, contents(workspace))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scene", type=scene_folder, required=True)
    parser.add_argument("--executors", nargs="+", choices=KINDS, default=["processes", "dask"])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--most", type=float, help="times the processor seconds of processes")
    given, arguments = parser.parse_known_args()
    adopt_orphans()
    found: dict[str, list[Spent]] = {kind: [] for kind in given.executors}
    for _ in range(given.rounds):
        for kind, runs in found.items():
            runs.append(evaluated(given.scene, kind, given.workers, arguments))
    best = {kind: min(run.cpu_s for run in runs) for kind, runs in found.items()}
    first = found[given.executors[0]][0]
    base = best.get("processes", best[given.executors[0]])
    rows = [("", "cpu s", "clock s", "cpu, times", "recall, %", "equal bytes")]
    for kind, runs in found.items():
        equal = all(run.files == first.files for run in runs)
        recall = " / ".join(map(str, runs[0].recall))
        clock = min(run.wall_s for run in runs)
        times = f"{best[kind] / base:.3f}"
        rows.append(
            (kind, f"{best[kind]:.1f}", f"{clock:.1f}", times, recall, "yes" if equal else "NO")
        )
    print(f"{len(first.files)} files, {given.workers} workers, least of {given.rounds} rounds")
    print(table(rows))
    missed = given.most is not None and best.get("dask", 0.0) > given.most * base
    return int(missed or any("NO" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
