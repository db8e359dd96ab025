"""When rendering may be trusted: what maps' own images say, beside what rendering does to recall.

    .venv/bin/python benchmarks/consistency.py --scene DIR --scene DIR
    .venv/bin/python benchmarks/consistency.py --twin 0,0 --twin 0.02,0.5

A scene is a folder of kapture folders whose map has depth. A twin is InLoc's, rendered, with noise
of so many metres and degrees, in a random direction, on the pose of each scan. Each is run as
``megloc eval`` runs it, without refinement; ``megloc refine-poses`` then refines the poses by
rendering, once as it is, which tests the map, and once without the test.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from megloc_twins.model_files import write_transformation
from refinement import REGARDLESS, Thresholds
from scenes import errors_of, megloc
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.inloc import read_transformation
from megloc_kapture.io.tables import (
    CONSISTENCY_FILE,
    REFINEMENT_FILE,
    read_consistency,
    read_refinement,
)
from megloc_kapture.values import RigidTransform

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

HEAD = ("map", "frame", "images", "contradict", "held out move by", "claimed", "verdict")
RECALL = ("map", "poses", "recall (%)", "median error", "accepted")
ASKED = 'pose_refinement.by=["rendering"]'


def displace_scans(root: Path, noise_m: float, noise_deg: float) -> None:
    """Displace and turn each scan of a twin of InLoc by that much, in random directions."""
    rng = np.random.default_rng(0)
    for path in sorted(root.rglob("*_trans_*.txt")):
        before = read_transformation(path)
        axis, shift = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        turn = Rotation.from_rotvec(np.radians(noise_deg) * axis).as_matrix()
        after = RigidTransform.from_matrix(
            turn @ before.rotation_matrix(), np.array(before.translation) + noise_m * shift
        )
        write_transformation(path, before, after)


def recall_of(evaluation: Path, thresholds: Thresholds) -> tuple[str, str]:
    """Recall at each threshold, and median errors."""
    errors = errors_of(evaluation)
    shares = " / ".join(f"{share:.1f}" for share in thresholds.hits(errors).mean())
    medians = errors[["error_m", "error_deg"]].median()
    return shares, f"{1e3 * medians.error_m:.1f} mm, {medians.error_deg:.3f} deg"


def measure(
    name: str, dataset: str, root: Path, workspace: Path
) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]]:
    """Rows of the verdicts and of recall."""
    off = ("--set", "pose_refinement.by=[]")
    megloc("eval", dataset, "--root", str(root), "--workspace", str(workspace), *off)
    thresholds = Thresholds.read(workspace / "evaluation")
    recall: list[tuple[str, ...]] = [
        (name, "as localized", *recall_of(workspace / "evaluation", thresholds), "")
    ]
    tested = workspace / "tested"
    verdicts: list[tuple[str, ...]] = []
    for label, chosen in (("refined, map tested", ASKED), ("refined, untested", REGARDLESS)):
        found = tested if chosen == ASKED else workspace / "untested"
        report = workspace / f"report-{found.name}"
        inputs = ("-i", workspace / "map", "--query", workspace / "query")
        poses = ("--poses", workspace / "localized", "-o", found, "-f", "--set", chosen)
        megloc("refine-poses", *map(str, (*inputs, *poses)))
        truth = ("--gt", workspace / "query_gt", "--side-tables", workspace / "megloc")
        megloc("evaluate", *map(str, ("-i", found, *truth, "-o", report, "-f")))
        rows = read_refinement(found / REFINEMENT_FILE)
        share = f"{sum(row.accepted for row in rows)} of {len(rows)}"
        recall.append((name, label, *recall_of(report, thresholds), share))
    for row in read_consistency(tested / CONSISTENCY_FILE):
        moved = f"{1e3 * row.moved_m:.0f} mm, {row.turned_deg:.2f} deg, {row.moved_px:.2f} px"
        claimed = f"{1e3 * row.claimed_m:.0f} mm, {row.claimed_deg:.2f} deg"
        counts = (str(row.images), str(row.contradicting))
        verdicts.append((name, row.frame, *counts, moved, claimed, "no" if row.reason else "yes"))
    return verdicts, recall


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--scene", type=lambda text: Path(text).resolve(), action="append", default=[]
    )
    parser.add_argument("--twin", action="append", default=[], help="noise of scans, M,DEG")
    parser.add_argument("--workspace", type=Path, help="keep the runs here")
    options = parser.parse_args()
    twins = options.twin or ([] if options.scene else ["0,0", "0.02,0.5"])
    with tempfile.TemporaryDirectory(prefix="megloc-consistency-") as temporary:
        base = options.workspace or Path(temporary)
        runs = [(scene.name, "kapture", scene) for scene in options.scene]
        exact = base / "inloc-root"
        if twins and not exact.is_dir():
            megloc("synth", "inloc", "-o", str(exact))
        for twin in twins:
            noise_m, noise_deg = (float(text) for text in twin.split(","))
            root = exact if noise_m == noise_deg == 0.0 else base / f"inloc-root-{twin}"
            if not root.is_dir():
                shutil.copytree(exact, root)
                displace_scans(root, noise_m, noise_deg)
            runs.append((f"inloc's twin, {noise_m:g} m, {noise_deg:g} deg", "inloc", root))
        verdicts: list[tuple[str, ...]] = [HEAD]
        recalls: list[tuple[str, ...]] = [RECALL]
        for name, dataset, root in runs:
            found = measure(name, dataset, root, base / f"run-{root.name}")
            verdicts += found[0]
            recalls += found[1]
        print(table(verdicts))
        print()
        print(table(recalls))


if __name__ == "__main__":
    main()
