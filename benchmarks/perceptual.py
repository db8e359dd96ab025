"""Ranking of clusters by pictures, where rooms are alike.

    .venv/bin/python benchmarks/perceptual.py corridor              # the table, seeds 0 to 2
    .venv/bin/python benchmarks/perceptual.py inloc                 # floors of the InLoc twin
    .venv/bin/python benchmarks/perceptual.py inloc --set modules=2 --top-k 40  # as by default
    .venv/bin/python benchmarks/perceptual.py corridor --lpips alex # and by LPIPS, with its weights

``corridor`` are the scenes of corridor.py, with depth; ``inloc`` those of inloc_rooms.py. LPIPS by
another trunk than the published, e.g. of squeezenet_trunk.py: ``--lpips squeeze --trunk FILE``.

Every ranker chooses among the same poses, so what differs is the choice alone. Recovered: of the
queries for which counting inliers chooses a wrong room though a cluster in the right one has a
pose, the share for which a ranker chooses the right one. Lost: of those that counting has right,
the share that a ranker has wrong. Seconds are processor time of ranking alone.

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
from typing import Protocol

import numpy as np
from corridor import CorridorRooms
from inloc_rooms import HARDER, InLocRooms
from mapped_scene import Query, Scene, read_scene
from numpy.typing import NDArray

from megloc_kapture.localization.ranking import DistinctiveInliers, InlierCount, PerceptualRanker
from megloc_kapture.plugins import PluginChoice, PoseHypothesis, PoseRanker

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

INLIERS, TRUTH = "inliers", "(the best by the truth)"
ROOM = -2  # of a row of Found, the place of the right room

# of each ranker, by query: hits at the thresholds, the right room, seconds
Found = Mapping[str, NDArray[np.float64]]


class Rooms(Protocol):
    """Scenes in which rankers are compared, one per seed."""

    @property
    def thresholds(self) -> tuple[tuple[float, float], ...]:
        """Metres and degrees."""
        ...

    def told(self) -> str:
        """What they are, in words."""
        ...

    def run(self, workspace: Path, seed: int) -> Path:
        """Map and match the scene of a seed."""
        ...

    def hypotheses(self, scene: Scene, query: Query) -> Sequence[PoseHypothesis]:
        """The poses of a query's clusters."""
        ...

    def judged(self, scene: Scene, query: Query, found: PoseHypothesis | None) -> list[float]:
        """1 or 0 for each threshold, and for the right room."""
        ...


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


def measure(rooms: Rooms, workspace: Path, lpips: str, trunk: str, seed: int) -> Found:
    """What every ranker makes of the clusters of each query of a seed."""
    scene = read_scene(rooms.run(workspace, seed))
    compared = rankers(lpips, trunk)
    rows: dict[str, list[list[float]]] = {name: [] for name in (*compared, TRUTH)}
    for query in scene.queries:
        poses = rooms.hypotheses(scene, query)
        hits = [rooms.judged(scene, query, each) for each in poses]
        nothing = rooms.judged(scene, query, None)
        for name, ranker in compared.items():
            started = time.process_time()
            scores = ranker.score(poses, scene.pixels)
            seconds = time.process_time() - started
            rows[name].append([*(hits[int(np.argmax(scores))] if poses else nothing), seconds])
        rows[TRUTH].append([*max(hits, default=nothing, key=lambda hit: hit[::-1]), 0.0])
    return {name: np.array(values) for name, values in rows.items()}


def compared_table(rooms: Rooms, found: Sequence[Found]) -> str:
    """The table, of what was measured on each seed."""
    head = [f"{m:g} m, {deg:g} deg" for m, deg in rooms.thresholds]
    rows: list[tuple[str, ...]] = [
        ("ranked by", *head, "right room", "recovered", "lost", "s per query")
    ]
    for name in found[0]:
        cells = []
        for column in range(len(rooms.thresholds) + 1):
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
    return table(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", choices=("corridor", "inloc"))
    parser.add_argument(
        "--set", nargs="+", default=HARDER, help="options of the InLoc twin, key=value"
    )
    parser.add_argument("--top-k", type=int, default=10, help="candidates of a query, InLoc twin")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(3)))
    parser.add_argument("--lpips", choices=("alex", "vgg", "squeeze"), default="")
    parser.add_argument("--trunk", default="", help="weights of that network, not the published")
    parser.add_argument("--workspace", type=Path, help="keep scenes, maps and matches here")
    parser.add_argument("--workers", type=int, default=2, help="scenes at a time")
    options = parser.parse_args()
    # one scene per process: more threads would only fight each other
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    rooms: Rooms = CorridorRooms()
    if options.scene == "inloc":
        rooms = InLocRooms(tuple(options.set), options.top_k)
    trunk = str(Path(options.trunk).resolve()) if options.trunk else ""
    with (
        tempfile.TemporaryDirectory(prefix="megloc-perceptual-") as temporary,
        ProcessPoolExecutor(options.workers) as pool,
    ):
        workspace = (options.workspace or Path(temporary)).resolve()
        of_seed = partial(measure, rooms, workspace, options.lpips, trunk)
        found = list(pool.map(of_seed, options.seeds))
    about = f"seeds {' '.join(map(str, options.seeds))}, {sum(len(f[INLIERS]) for f in found)}"
    print(os.linesep.join([f"{rooms.told()}; {about} queries", "", compared_table(rooms, found)]))


if __name__ == "__main__":
    main()
