"""Time one photograph in a warm ``Localizer``: all candidates, or candidates in turn.

    .venv/bin/python benchmarks/speed/one_query.py --map WORKSPACE/map --scene SCENE

The map is created by ``megloc eval kapture --root SCENE --workspace WORKSPACE``; the scene has
query/ and query_gt/. Times are CPU seconds of one thread, after a first query as warm-up.
"""

from __future__ import annotations

import os

# has no effect after the import of numpy
os.environ["OMP_NUM_THREADS"] = "1"

import argparse  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
from timing import table  # noqa: E402

import megloc_kapture as megloc  # noqa: E402
from megloc_kapture.evaluation.metrics import Threshold, pose_errors, within  # noqa: E402
from megloc_kapture.io.kapture import KaptureFolder  # noqa: E402
from megloc_kapture.pipeline.presets import options_of_preset  # noqa: E402

THRESHOLDS = [Threshold.parse(text) for text in ("0.05,5", "0.25,2", "0.5,5", "5,10")]


def measure(name: str, map_folder: Path, scene: Path, preset: str, sure: str) -> list[str]:
    """Localize all queries of a scene; return a row of the table."""
    options = options_of_preset(
        preset,
        assignments=["localization.min_confidence=0", f"localization.sure_confidence={sure}"],
    )
    localizer = megloc.Localizer(megloc.KaptureMap.open(map_folder), options=options)
    query = KaptureFolder(scene / "query")
    cameras, truth = query.read(), KaptureFolder(scene / "query_gt").read().poses()
    names = cameras.image_names()
    poses, seconds = {}, []
    for image in (names[0], *names):
        started = time.process_time()
        result = localizer.localize(query.image_path(image), cameras.camera_of(image))
        seconds.append(time.process_time() - started)
        if result:
            poses[image] = result.cam_from_world
    errors = pose_errors(poses, truth)
    recall = [100 * within(errors, threshold).mean() for threshold in THRESHOLDS]
    return [
        name,
        " / ".join(f"{share:.1f}" for share in recall),
        f"{1000 * np.median(errors.position_m):.1f} mm, {np.median(errors.angle_deg):.2f} deg",
        f"{np.median(seconds[1:]):.2f} s ({min(seconds[1:]):.2f} to {max(seconds[1:]):.2f})",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--map", type=Path, required=True)
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--preset", default="classic")
    arguments = parser.parse_args()
    rows = [["candidates", "recall (%)", "median error", "processor time, median (range)"]]
    for name, sure in (("all", "none"), ("in turn", "0.9")):
        rows.append(measure(name, arguments.map, arguments.scene, arguments.preset, sure))
    print(table(rows))


if __name__ == "__main__":
    main()
