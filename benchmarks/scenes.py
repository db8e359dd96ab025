"""Recall and median errors of real scenes over several seeds, and a comparison of two results.

    .venv/bin/python benchmarks/scenes.py --scene DIR --scene DIR -o now.csv
    .venv/bin/python benchmarks/scenes.py --read now.csv --against before.csv

A scene is a folder with mapping/, query/ and query_gt/ in kapture, or with map/ (a
prebuilt map), query/ and query_gt/. The seed affects VLAD's vocabulary and pose estimation. Unknown
arguments are passed to ``megloc eval`` and ``megloc localize``.

The comparison is paired by query: errors are averaged over the seeds, and the difference of these
means is bootstrapped over the queries.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from megloc_kapture.evaluation.report.reports import PER_QUERY_CSV

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

SEEDED = ("global_features.options.seed", "localization.pose.seed")
THRESHOLDS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
COLUMNS = ("scene", "seed", "query", "error_m", "error_deg")
DRAWS = 10_000


def megloc(*arguments: str) -> None:
    """Run the ``megloc`` command of this environment; exit with its status on failure."""
    program = str(Path(sys.executable).with_name("megloc"))
    quiet = subprocess.DEVNULL
    done = subprocess.run([program, *arguments, "-q"], stdout=quiet, check=False)
    if done.returncode != 0:
        sys.exit(done.returncode)


def measure(scene: Path, seed: int, workspace: Path, arguments: Sequence[str]) -> pd.DataFrame:
    """Return the errors of every query of a scene; infinite without a pose."""
    seeds = [part for key in SEEDED for part in ("--set", f"{key}={seed}")]
    if (scene / "map").is_dir():
        localized, report = workspace / f"localized-{seed}", workspace / f"evaluation-{seed}"
        paths = ("-i", str(scene / "map"), "--query", str(scene / "query"), "-o", str(localized))
        benchmark = ("--set", "localization.sure_confidence=none")
        megloc("localize", *paths, "-f", *benchmark, *seeds, *arguments)
        truth = ("--gt", str(scene / "query_gt"))
        megloc("evaluate", "-i", str(localized), *truth, "-o", str(report), "-f")
    else:
        folders = ("--root", str(scene), "--workspace", str(workspace))
        megloc("eval", "kapture", *folders, *seeds, *arguments)
        report = workspace / "evaluation"
    return errors_of(report).assign(scene=scene.name, seed=seed)[list(COLUMNS)]


def errors_of(report: Path) -> pd.DataFrame:
    """Read the errors of every query of an evaluation; infinite without a pose."""
    rows = pd.read_csv(report / PER_QUERY_CSV)
    return pd.DataFrame(
        {
            "query": rows["image"],
            "error_m": rows["position_error_m"].fillna(np.inf),
            "error_deg": rows["angle_error_deg"].fillna(np.inf),
        }
    )


def hits(errors: pd.DataFrame) -> pd.DataFrame:
    """Return a column per threshold: 100 if the query is within it, else 0."""
    return pd.DataFrame(
        {
            f"{m:g} m, {deg:g} deg": 100.0
            * ((errors.error_m <= m) & (errors.error_deg <= deg)).astype(float)
            for m, deg in THRESHOLDS
        }
    )


def summary(errors: pd.DataFrame) -> str:
    """Tabulate the mean and standard deviation of the recall, and the mean median errors."""
    rows: list[tuple[str, ...]] = []
    for scene, of_scene in errors.groupby("scene", sort=False):
        recall = hits(of_scene).groupby(of_scene.seed).mean()
        medians = of_scene.groupby("seed")[["error_m", "error_deg"]].median()
        queries = of_scene["query"].nunique()
        if not rows:
            rows.append(("scene", "queries", "seeds", *recall.columns, "median m", "median deg"))
        cells = [f"{recall[c].mean():.1f} +- {recall[c].std(ddof=0):.1f}" for c in recall.columns]
        m, deg = medians.error_m.mean(), medians.error_deg.mean()
        rows.append((str(scene), str(queries), str(len(recall)), *cells, f"{m:.4f}", f"{deg:.4f}"))
    return table(rows)


def interval(difference: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the 95 % bootstrap interval of the mean of each column of a (Q, C) array."""
    draws = np.random.default_rng(0).integers(0, len(difference), (DRAWS, len(difference)))
    low, high = np.quantile(difference[draws].mean(axis=1), (0.025, 0.975), axis=0)
    return low, high


def comparison(now: pd.DataFrame, before: pd.DataFrame) -> str:
    """Tabulate the differences (now minus before) with their 95 % bootstrap intervals."""
    rows: list[tuple[str, ...]] = [("scene", "figure", "before", "now", "difference", "verdict")]
    for scene in now.scene.unique():
        ours, theirs = (d[d.scene == scene] for d in (now, before))
        if theirs.empty:
            continue
        means = [hits(d).groupby(d["query"]).mean().sort_index() for d in (ours, theirs)]
        if not means[0].index.equals(means[1].index):
            sys.exit(f"{scene}: the two results have different queries")
        difference = (means[0] - means[1]).to_numpy()
        low, high = interval(difference)
        for column, name in enumerate(means[0].columns):
            verdict = "better" if low[column] > 0 else "worse" if high[column] < 0 else "equal"
            rows.append(
                (
                    scene,
                    name,
                    f"{means[1][name].mean():.1f}",
                    f"{means[0][name].mean():.1f}",
                    f"{difference[:, column].mean():+.1f} "
                    f"[{low[column]:+.1f}, {high[column]:+.1f}]",
                    verdict,
                )
            )
        for name in ("error_m", "error_deg"):
            a, b = (float(d.groupby("seed")[name].median().mean()) for d in (theirs, ours))
            ratio = b / a
            verdict = "worse" if ratio > 1.03 else "better" if ratio < 0.97 else "within 3 %"
            rows.append(
                (scene, f"median {name}", f"{a:.4f}", f"{b:.4f}", f"{ratio - 1:+.1%}", verdict)
            )
    return table(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=lambda text: Path(text).resolve(), action="append")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    parser.add_argument("--workspace", type=Path, help="keep the runs here")
    parser.add_argument("--read", type=Path, help="CSV file of an earlier run, instead of scenes")
    parser.add_argument("--against", type=Path, help="compare with this result")
    parser.add_argument("-o", "--output", type=Path, help="write the errors of every query here")
    options, arguments = parser.parse_known_args()
    if (options.read is None) == (options.scene is None):
        parser.error("either --scene or --read is required")
    if options.read is not None:
        errors = pd.read_csv(options.read)
    else:
        with tempfile.TemporaryDirectory(prefix="megloc-scenes-") as temporary:
            root = options.workspace or Path(temporary)
            parts = []
            for scene in options.scene:
                for seed in options.seeds:
                    parts.append(measure(scene, seed, root / scene.name, arguments))
                    if options.output is not None:
                        pd.concat(parts).to_csv(options.output, index=False)
            errors = pd.concat(parts)
    print(f"{os.linesep}{summary(errors)}")
    if options.against is not None:
        print(f"{os.linesep}{comparison(errors, pd.read_csv(options.against))}")


if __name__ == "__main__":
    main()
