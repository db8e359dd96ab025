"""Localizing many queries in a pool of threads, beside one thread: processor seconds and results.

    python benchmarks/speed/threads.py MAP QUERY [--preset classic] [--threads 1 2] [--rounds 5]

MAP and QUERY are kapture folders, for example those of ../shared/data/foreign_maps/virtual_gallery,
whose queries bring their features, or what `make eval` leaves: the map of its workspace and the
query folder, whose features are extracted.

Every line is the same queries with the same Localizer, after a round that is not counted. Where the
libraries of a thread had more than one thread of their own, they would wait for each other and cost
processor time; where they had another number than in one thread, last bits would differ.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from timing import table

from megloc_kapture import Failure, KaptureMap, Localizer, Pose

Results = list[Pose | Failure]


def localize(
    localizer: Localizer, query: Path, executor: Executor | None, rounds: int
) -> tuple[float, float, Results]:
    """Seconds of the processor and of the clock of one round, and its results."""
    results = [found for _, found in localizer.localize_kapture(query, executor)]
    cpu, wall = time.process_time(), time.perf_counter()
    for _ in range(rounds):
        results = [found for _, found in localizer.localize_kapture(query, executor)]
    return (time.process_time() - cpu) / rounds, (time.perf_counter() - wall) / rounds, results


def same_bytes(first: Pose | Failure, second: Pose | Failure) -> bool:
    """Whether poses, inliers and covariances are equal to the last bit, or the failures are."""
    if isinstance(first, Failure) or isinstance(second, Failure):
        return first == second
    return (
        first.cam_from_world == second.cam_from_world
        and first.candidates == second.candidates
        and np.array_equal(np.asarray(first.inliers), np.asarray(second.inliers))
        and np.asarray(first.covariance).tobytes() == np.asarray(second.covariance).tobytes()
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("map", type=Path)
    parser.add_argument("query", type=Path)
    parser.add_argument("--preset", default="classic")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()

    localizer = Localizer(KaptureMap.open(given.map), preset=given.preset)
    alone_s, wall_s, alone = localize(localizer, given.query, None, given.rounds)
    rows = [("", "cpu s", "clock s", "cpu, times", "localized", "equal bytes")]
    share = f"{sum(map(bool, alone))} of {len(alone)}"
    rows.append(("no pool", f"{alone_s:.2f}", f"{wall_s:.2f}", "1.00", share, ""))
    for number in given.threads:
        with ThreadPoolExecutor(number) as pool:
            cpu_s, wall_s, found = localize(localizer, given.query, pool, given.rounds)
        equal = sum(map(same_bytes, alone, found))
        times, share = f"{cpu_s / alone_s:.2f}", f"{sum(map(bool, found))} of {len(found)}"
        name = f"pool of {number}"
        rows.append(
            (name, f"{cpu_s:.2f}", f"{wall_s:.2f}", times, share, f"{equal} of {len(found)}")
        )
    print(table(rows))


if __name__ == "__main__":
    main()
