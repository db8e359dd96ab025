"""Recall of the rendered twins over several seeds: the least and the greatest of each condition.

    .venv/bin/python benchmarks/twins.py --dataset synthetic-aachen --dataset synthetic-4seasons

A twin's images are the same bytes on every processor; what is computed from them is not. Features
and networks use what instructions a processor has, so keypoints differ in their last bits, and a
query whose inliers hardly suffice is found on one and lost on another. A seed changes as much: the
vocabulary, triangulation, pose estimation. The range over seeds is therefore what to expect
elsewhere. Arguments that are not known here go to ``megloc eval``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from scenes import SEEDED, megloc  # which knows the way to timing
from timing import table

from megloc_kapture.evaluation.report.reports import RECALL_JSON

Recalls = Mapping[str, tuple[float, ...]]  # of each condition at each threshold, percent


def measure(dataset: str, seed: int, workspace: Path, arguments: Sequence[str]) -> Recalls:
    """Recall of a twin with one seed; the workspace keeps what no seed changes."""
    seeds = [part for key in SEEDED for part in ("--set", f"{key}={seed}")]
    megloc("eval", dataset, "--workspace", str(workspace), *seeds, *arguments)
    found = json.loads((workspace / "evaluation" / RECALL_JSON).read_text())
    return {row["name"]: tuple(100 * at["recall"] for at in row["recall"]) for row in found["rows"]}


def summary(recalls: Mapping[str, Sequence[Recalls]]) -> str:
    """One row per twin and condition: least to greatest recall at each threshold."""
    rows: list[tuple[str, ...]] = [("twin", "condition", "seeds", "recall (%)")]
    for dataset, of_seeds in recalls.items():
        for condition in of_seeds[0]:
            at_thresholds = zip(*(recall[condition] for recall in of_seeds), strict=True)
            cells = (
                f"{min(at):.1f}" if min(at) == max(at) else f"{min(at):.1f} to {max(at):.1f}"
                for at in at_thresholds
            )
            rows.append((dataset, condition, str(len(of_seeds)), " / ".join(cells)))
    return table(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dataset", action="append", required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    parser.add_argument("--workspace", type=Path, help="keep the runs here")
    options, arguments = parser.parse_known_args()
    with tempfile.TemporaryDirectory(prefix="megloc-twins-") as temporary:
        root = options.workspace or Path(temporary)
        recalls: dict[str, list[Recalls]] = {}
        for dataset in options.dataset:
            for seed in options.seeds:
                recalls.setdefault(dataset, []).append(
                    measure(dataset, seed, root / dataset, arguments)
                )
                print(f"{summary(recalls)}\n", flush=True)


if __name__ == "__main__":
    main()
