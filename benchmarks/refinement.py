"""What refining poses does to recall: twins and scenes, several seeds, paired by query.

    .venv/bin/python benchmarks/refinement.py --dataset synthetic-inloc --by rendering
    .venv/bin/python benchmarks/refinement.py --scene DIR --by icp --by rendering --by icp,rendering

A dataset is run as ``megloc eval`` runs it, without refinement, once for every seed; ``megloc
refine-poses`` then refines the very same poses by each of the chains, by rendering whatever the
map's own images say (``consistency.py`` has that). A seed changes all that draws random numbers,
but not what a twin shows. Where neither map nor queries have depth nothing can change, and the
table shows that nothing does. Seconds are the refiners' own, per query.

The comparison is paired by query: of every query the mean over the seeds, and a bootstrap over the
queries of the difference of these means; thresholds are those of the dataset.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scenes import SEEDED, errors_of, interval, megloc

from megloc_kapture.evaluation.report.reports import RECALL_JSON
from megloc_kapture.io.tables import REFINEMENT_FILE, read_refinement

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

NONE = "none"
REGARDLESS = 'pose_refinement.by=[{name="rendering",options={require_consistent_map=false}}]'
TWINS = ("synthetic-aachen", "synthetic-robotcar", "synthetic-4seasons", "synthetic-inloc")


@dataclass(frozen=True)
class Thresholds:
    """Of a dataset's recall: metres and degrees (infinite where none is asked for)."""

    pairs: tuple[tuple[float, float], ...]

    @classmethod
    def read(cls, evaluation: Path) -> Thresholds:
        """As an evaluation used them."""
        rows = json.loads((evaluation / RECALL_JSON).read_text(encoding="utf-8"))["rows"]
        told = [at["threshold"] for at in rows[-1]["recall"]]
        return cls(
            tuple(
                (at["position_m"], np.inf if (a := at["angle_deg"]) is None else a) for at in told
            )
        )

    def hits(self, errors: pd.DataFrame) -> pd.DataFrame:
        """Percent, 0 or 100, per query and threshold."""
        return pd.DataFrame(
            {
                f"{m:g} m" + ("" if np.isinf(deg) else f", {deg:g} deg"): 100.0
                * ((errors.error_m <= m) & (errors.error_deg <= deg))
                for m, deg in self.pairs
            }
        )


def measure(
    name: str,
    root: Path | None,
    seed: int,
    workspace: Path,
    chains: Sequence[str],
    more: Sequence[str],
) -> tuple[pd.DataFrame, Thresholds]:
    """Errors of every query of one seed: without refinement, and behind each chain."""
    seeds = [part for key in SEEDED for part in ("--set", f"{key}={seed}")]
    place = [] if root is None else ["--root", str(root)]
    off = ["--set", "pose_refinement.by=[]"]
    megloc("eval", name, *place, "--workspace", str(workspace), *seeds, *off, *more)
    evaluation = workspace / "evaluation"
    thresholds = Thresholds.read(evaluation)
    same = {"chain": NONE, "seed": seed, "accepted": False, "seconds": 0.0}
    parts = [errors_of(evaluation).assign(**same)]
    parts += [refined(chain, seed, workspace, REGARDLESS) for chain in chains]
    return pd.concat(parts), thresholds


def refined(chain: str, seed: int, workspace: Path, setting: str) -> pd.DataFrame:
    """Errors of a run's queries behind a chain of refiners, with an option of theirs."""
    found, report = workspace / f"refined-{chain}-{seed}", workspace / f"report-{chain}-{seed}"
    steps = [part for step in chain.split(",") for part in ("--by", step)]
    folders = ("-i", workspace / "map", "--query", workspace / "query")
    inputs = [str(part) for part in (*folders, "--poses", workspace / "localized")]
    started = time.perf_counter()
    megloc("refine-poses", *inputs, *steps, "--set", setting, "-o", str(found), "-f")
    seconds = time.perf_counter() - started
    truth = ("--gt", str(workspace / "query_gt"), "--side-tables", str(workspace / "megloc"))
    megloc("evaluate", "-i", str(found), *truth, "-o", str(report), "-f")
    rows = read_refinement(found / REFINEMENT_FILE)
    accepted = {row.image for row in rows if row.accepted}
    errors = errors_of(report).assign(chain=chain, seed=seed)
    per_query = seconds / max(len({row.image for row in rows}), 1)
    return errors.assign(accepted=errors["query"].isin(accepted), seconds=per_query)


def comparison(name: str, errors: pd.DataFrame, thresholds: Thresholds) -> str:
    """Recall behind each chain against that of the poses it was given."""
    before = errors[errors.chain == NONE]
    rows: list[tuple[str, ...]] = [
        (name, "threshold", "before", "after", "difference", "verdict", "")
    ]
    for chain in [c for c in errors.chain.unique() if c != NONE]:
        after = errors[errors.chain == chain]
        means = [
            thresholds.hits(each).groupby(each["query"]).mean().sort_index()
            for each in (before, after)
        ]
        difference = (means[1] - means[0]).to_numpy()
        low, high = interval(difference)
        for column, threshold in enumerate(means[0].columns):
            worse, better = high[column] < 0, low[column] > 0
            change = difference[:, column].mean()
            rows.append(
                (
                    chain,
                    str(threshold),
                    f"{means[0][threshold].mean():.1f}",
                    f"{means[1][threshold].mean():.1f}",
                    f"{change:+.1f} [{low[column]:+.1f}, {high[column]:+.1f}]",
                    "worse"
                    if worse
                    else "better"
                    if better
                    else "lower"
                    if change < 0
                    else "equal",
                    "",
                )
            )
        medians = [
            each.groupby("seed")[["error_m", "error_deg"]].median().mean()
            for each in (before, after)
        ]
        rows.append(
            (
                chain,
                "median",
                *(f"{1e3 * m.error_m:.1f} mm, {m.error_deg:.3f} deg" for m in medians),
                "",
                f"{100 * after.accepted.mean():.0f} % accepted",
                f"{after.seconds.mean():.2f} s",
            )
        )
    return table(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dataset", action="append", default=[], help=f"such as {TWINS[0]}")
    parser.add_argument(
        "--scene", type=lambda text: Path(text).resolve(), action="append", default=[]
    )
    parser.add_argument("--by", action="append", help="a chain of refiners; may be repeated")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    parser.add_argument("--workspace", type=Path, help="keep the runs here")
    parser.add_argument("-o", "--output", type=Path, help="write the errors of every query here")
    options, more = parser.parse_known_args()
    chains = options.by or ["rendering"]
    runs: list[tuple[str, Path | None]] = [(name, None) for name in options.dataset]
    runs += [("kapture", scene) for scene in options.scene]
    if not runs:
        runs = [(name, None) for name in TWINS]
    with tempfile.TemporaryDirectory(prefix="megloc-refinement-") as temporary:
        base = options.workspace or Path(temporary)
        kept = []
        for name, root in runs:
            label = name if root is None else root.name
            parts = [
                measure(name, root, seed, base / label, chains, more) for seed in options.seeds
            ]
            errors = pd.concat([part for part, _ in parts])
            print(f"{comparison(label, errors, parts[0][1])}{os.linesep}", flush=True)
            kept.append(errors.assign(dataset=label))
            if options.output is not None:
                pd.concat(kept).to_csv(options.output, index=False)


if __name__ == "__main__":
    main()
