"""Compare with kapture-localization on the same images, features and pairs.

    make kloc-env
    .venv/bin/python benchmarks/speed/kloc_side_by_side.py \\
        --kloc-python .venv-kloc/bin/python --scene ../shared/data/scenes/redkitchen_rgbd

Ours runs first, from images to poses. kapture-localization then matches, verifies, triangulates and
localizes with the same features and pairs. The totals contain these steps only; our feature
extraction, retrieval and import are listed separately. The poses of both sides are evaluated with
kapture-localization's tool.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

from end_to_end import megloc_command, scene_folder, stage_seconds
from kloc_pipeline import Inputs, KaptureLocalization, Score, evaluate, localize
from timing import Timed, table, timed_command

# our stages without a counterpart in the run of kapture-localization
NOT_COMPARED = {
    *("render", "import", "local_features", "global_features", "mapping_pairs", "query_pairs"),
    *("submission", "evaluation"),
}
THRESHOLDS = ((0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
OURS, THEIRS = "megloc-kapture", "kapture-localization"


def compared(stages: dict[str, float]) -> dict[str, float]:
    """Return the stages that have a counterpart."""
    return {name: s for name, s in stages.items() if name not in NOT_COMPARED}


def report(stages: dict[str, float], steps: list[Timed], scores: dict[str, Score]) -> str:
    counted = compared(stages)
    ours_s, theirs_s = sum(counted.values()), sum(step.wall_s for step in steps)
    rows = [(OURS, "seconds"), *((name, f"{s:.1f}") for name, s in counted.items())]
    parts = [table([*rows, ("total", f"{ours_s:.1f}")])]
    alone = {name: s for name, s in stages.items() if name not in counted}
    listed = ", ".join(f"{name} {s:.1f}" for name, s in alone.items())
    parts.append(f"not compared, shared by both: {listed}")

    steps_rows = [(step.name, f"{step.wall_s:.1f}", f"{step.cpu_s:.1f}") for step in steps]
    cpu_s = sum(step.cpu_s for step in steps)
    total = ("total", f"{theirs_s:.1f}", f"{cpu_s:.1f}")
    parts.append(table([(THEIRS, "seconds", "cpu seconds"), *steps_rows, total]))

    bins = list(next(iter(scores.values())).recalls)
    recall_rows = [("recall, %", *bins, "median m", "median deg")]
    for label, score in scores.items():
        recalls = [f"{score.recalls[name]:.1f}" for name in bins]
        recall_rows.append((label, *recalls, f"{score.median_m:.4f}", f"{score.median_deg:.3f}"))
    parts.append(table(recall_rows))
    parts.append(f"{OURS} is {theirs_s / max(ours_s, 1e-9):.1f} times as fast as {THEIRS}")
    return "\n\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--kloc-python", type=Path, required=True, help="Python built by make kloc-env"
    )
    parser.add_argument("--scene", type=scene_folder, required=True)
    parser.add_argument(
        "--workspace", type=Path, help="keep our run here, or reuse an existing one"
    )
    parser.add_argument("--features", default="rootsift", help="type of local features")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    options, arguments = parser.parse_known_args()
    if not (options.scene / "query_gt").is_dir():
        parser.error(f"{options.scene} has no query_gt/ folder for the evaluation")
    if not options.kloc_python.exists():
        parser.error(
            f"no Python at {options.kloc_python}; build the environment with: make kloc-env"
        )

    with tempfile.TemporaryDirectory(prefix="megloc-kloc-") as temporary:
        folder = Path(temporary)
        tools = KaptureLocalization(options.kloc_python, folder, options.threads)
        print(f"{THEIRS}: {tools.versions()}")
        print(f"{options.scene.name}, {options.threads} threads, load {os.getloadavg()[0]:.1f}")
        sys.stdout.flush()
        workspace = (options.workspace or folder / "workspace").resolve()
        command = megloc_command(options.scene, workspace, options.threads, arguments)
        timed_command(OURS, command, os.environ, folder / "ours.log")
        theirs = localize(tools, Inputs.of_workspace(workspace, options.features))
        results = {OURS: workspace / "localized", THEIRS: theirs}
        scores = evaluate(tools, results, options.scene / "query_gt", THRESHOLDS)
        print(report(stage_seconds(workspace), tools.steps, scores))


if __name__ == "__main__":
    main()
