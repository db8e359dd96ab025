"""Ranking of clusters by pictures, in a corridor of rooms that are alike.

    .venv/bin/python benchmarks/perceptual.py                       # the table, seeds 0 to 2
    .venv/bin/python benchmarks/perceptual.py --lpips alex          # and by LPIPS, with its weights

The scenes, maps, matches and clusters are those of corridor.py, with depth. Every ranker chooses
among the same poses, so what differs is the choice alone. Recovered: of the queries for which
counting inliers chooses a wrong room though a cluster in the right one has a pose, the share for
which a ranker chooses the right one. Lost: of those that counting has right, the share that a
ranker has wrong.

Scenes and maps are kept in the workspace, so that a second run only ranks.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from corridor import (
    CHOSEN,
    THRESHOLDS,
    Method,
    hypotheses,
    judged,
    prepare,
    read_scene,
)
from numpy.typing import NDArray

from megloc_kapture.localization.distinctive_inliers import DistinctiveInliers
from megloc_kapture.localization.ranking import InlierCount
from megloc_kapture.plugins import PluginChoice, PoseRanker
from megloc_kapture.stages.perceptual_ranking import PerceptualRanker

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

CLUSTERS: Method = CHOSEN[2]  # by poses
INLIERS, TRUTH = "inliers", "(the best by the truth)"
ROOM = len(THRESHOLDS)  # of what judged() says, the place of the right room

# of each ranker, by query: hits at the thresholds, the right room, seconds
Found = Mapping[str, NDArray[np.float64]]


def rankers(lpips: str, trunk: str) -> dict[str, PoseRanker]:
    """Rankers by their names in the table."""
    found: dict[str, PoseRanker] = {
        INLIERS: InlierCount(),
        "distinctive": DistinctiveInliers(),
        "perceptual, structure": PerceptualRanker(),
    }
    if lpips:
        choice = PluginChoice(name="lpips", options={"net": lpips, "trunk": trunk})
        ranker = PerceptualRanker(PerceptualRanker.Options(distance=choice))
        like = "-like" if trunk else ""
        found[f"perceptual, lpips{like} {lpips}"] = ranker
    return found


def measure(workspace: Path, lpips: str, trunk: str, seed: int) -> Found:
    """What every ranker makes of the clusters of each query of a seed."""
    run, _ = prepare(workspace, seed)
    scene = read_scene(run)
    compared = rankers(lpips, trunk)
    rows: dict[str, list[list[float]]] = {name: [] for name in (*compared, TRUTH)}
    for query in scene.queries:
        poses = hypotheses(scene, query, CLUSTERS)
        hits = [judged(each.views[0].cam_from_world, query.truth) for each in poses]
        nothing = judged(None, query.truth)
        for name, ranker in compared.items():
            started = time.perf_counter()
            scores = ranker.score(poses, scene.pixels)
            seconds = time.perf_counter() - started
            rows[name].append([*(hits[int(np.argmax(scores))] if poses else nothing), seconds])
        rows[TRUTH].append([*max(hits, default=nothing, key=lambda hit: hit[::-1]), 0.0])
    return {name: np.array(values) for name, values in rows.items()}


def compare(workspace: Path, lpips: str, trunk: str, seeds: Sequence[int], workers: int) -> str:
    """The table."""
    with ProcessPoolExecutor(workers) as pool:
        found = list(pool.map(partial(measure, workspace, lpips, trunk), seeds))
    head = [f"{m:g} m, {deg:g} deg" for m, deg in THRESHOLDS]
    rows: list[tuple[str, ...]] = [
        ("ranked by", *head, "right room", "recovered", "lost", "s per query")
    ]
    for name in found[0]:
        cells = []
        for column in range(ROOM + 1):
            of_seeds = [each[name][:, column].mean() for each in found]
            cells.append(f"{np.mean(of_seeds):.3f} +- {np.std(of_seeds):.3f}")
        room, counted, possible = (
            np.concatenate([each[which][:, ROOM] for each in found]) > 0
            for which in (name, INLIERS, TRUTH)
        )
        wrong = possible & ~counted
        seconds = np.concatenate([each[name][:, -1] for each in found]).mean()
        cells += [
            f"{(room & wrong).sum()} of {wrong.sum()}",
            f"{(~room & counted).sum()} of {counted.sum()}",
            "" if name == TRUTH else f"{seconds:.2f}",
        ]
        rows.append((name, *cells))
    scene = (
        f"seeds {' '.join(map(str, seeds))}, {sum(len(each[INLIERS]) for each in found)} queries; "
        f"{CLUSTERS.name}, inliers within {CLUSTERS.max_error_px:g} px"
    )
    return os.linesep.join([scene, "", table(rows)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(3)))
    parser.add_argument("--lpips", choices=("alex", "vgg", "squeeze"), default="")
    parser.add_argument("--trunk", default="", help="weights of that network, not the published")
    parser.add_argument("--workspace", type=Path, help="keep scenes, maps and matches here")
    parser.add_argument("--workers", type=int, default=2, help="scenes at a time")
    options = parser.parse_args()
    # one scene per process: more threads would only fight each other
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with tempfile.TemporaryDirectory(prefix="megloc-perceptual-") as temporary:
        workspace = (options.workspace or Path(temporary)).resolve()
        trunk = str(Path(options.trunk).resolve()) if options.trunk else ""
        print(compare(workspace, options.lpips, trunk, options.seeds, options.workers))


if __name__ == "__main__":
    main()
