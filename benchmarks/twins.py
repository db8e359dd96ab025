"""Minimum and maximum recall of the rendered twins over several seeds, per condition.

    .venv/bin/python benchmarks/twins.py --dataset synthetic-aachen --dataset synthetic-4seasons

The rendered images are identical on every processor, but features and networks use
processor-specific instructions, so keypoints differ in their last bits, and a query with barely
enough inliers is localized on one machine and not on another. The seed (of VLAD's vocabulary and of
pose estimation) has an effect of similar size, so the range over seeds predicts the range over
machines. Unknown arguments are passed to ``megloc eval``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from scenes import SEEDED, megloc  # also adds speed/ to the import path
from timing import table

from megloc_kapture.evaluation.report.reports import RECALL_JSON

Recalls = Mapping[str, tuple[float, ...]]  # condition -> percent at each threshold


def measure(dataset: str, seed: int, workspace: Path, arguments: Sequence[str]) -> Recalls:
    """Measure the recall of a twin with one seed; unaffected stages are reused."""
    seeds = [part for key in SEEDED for part in ("--set", f"{key}={seed}")]
    megloc("eval", dataset, "--workspace", str(workspace), *seeds, *arguments)
    recall = json.loads((workspace / "evaluation" / RECALL_JSON).read_text())
    return {
        row["name"]: tuple(100 * at["recall"] for at in row["recall"]) for row in recall["rows"]
    }


def summary(recalls: Mapping[str, Sequence[Recalls]]) -> str:
    """Tabulate the range of the recall at each threshold per twin and condition."""
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
