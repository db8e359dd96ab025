"""Peak memory of one worker in each stage of a preset, at the size of the benchmarks' images.

    .venv/bin/python benchmarks/stage_memory.py [--preset megloc] [--images 4] [--most 6]

A rendered scene with depth, 1600x1200 as Aachen's and InLoc's images, and networks with seeded
random weights in the official containers (``whole_preset_weights.py``). Each stage runs in a
process of its own, on the processor, with ``--executor inline``: what it takes at most is what a
worker takes, with Python and all libraries. Few images tell as much as many, for a worker holds
those of an item and a cache of bounded size. Above ``--most`` GiB it fails.

Arguments that are not known here go to ``megloc eval``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from megloc_twins.options import SyntheticWorldOptions
from whole_preset_scene import Scene, write_scene
from whole_preset_weights import write_random_weights

from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.run import choose_run

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

MEGLOC = str(Path(sys.executable).with_name("megloc"))
CONFIG = """\
dataset = "kapture"
preset = "{preset}"

[options.mapping_pairs]
top_k = 2

[options.query_pairs]
top_k = 2

[options.triangulation]
two_view_tracks = true
min_angle_deg = 0.5

[options.localization.pose]
min_inliers = 6

[options.pose_refinement]
by = ["icp", "rendering"]
"""


def peak_of(command: list[str], log: Path) -> tuple[float, float]:
    """Peak GiB and processor seconds of a command; a failure ends this run with what it said."""
    with log.open("wb") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        tail = log.read_text(errors="replace").splitlines()[-15:]
        sys.exit("\n".join([*tail, f"{' '.join(command)} failed with {process.returncode}"]))
    return used.ru_maxrss / (1 << 20), used.ru_utime + used.ru_stime


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--preset", default="megloc")
    parser.add_argument("--images", type=int, default=4, help="stops of the map's cameras")
    parser.add_argument("--most", type=float, default=6.0, metavar="GIB")
    parser.add_argument("--workspace", type=Path, help="keep weights, scene and run here")
    options, arguments = parser.parse_known_args()
    with tempfile.TemporaryDirectory(prefix="megloc-memory-") as temporary:
        place = (options.workspace or Path(temporary)).resolve()
        weights, scene, workspace = (place / name for name in ("weights", "scene", "run"))
        os.environ |= {"MEGLOC_WEIGHTS": str(weights), "OMP_NUM_THREADS": "1"}
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
        if not weights.is_dir():
            for name, path in write_random_weights(place / "made").items():
                added = ["weights", "add", str(path), "--name", name, "--unverified"]
                subprocess.run([MEGLOC, *added], check=True, stdout=subprocess.DEVNULL)
        if not (scene / "megloc").is_dir():
            world = SyntheticWorldOptions(
                num_places=1,
                stations_per_place=max(3, options.images),
                day_queries=2,
                night_queries=0,
                width=1600,
                height=1200,
                supersampling=1,
            )
            write_scene(scene, Scene(world))
        config = place / "config.toml"
        config.write_text(CONFIG.format(preset=options.preset))
        chosen = choose_run("kapture", scene, config=config)
        stages = [stage.name for stage in plan_evaluation(chosen)]
        command = [MEGLOC, "eval", "kapture", "--root", str(scene), "--config", str(config), "-q"]
        command += ["--workspace", str(workspace), "--executor", "inline", *arguments]
        idle, _ = peak_of([MEGLOC, "options", "localization.pose.seed"], place / "idle.log")
        rows = [("stage", "peak GiB", "cpu s"), ("megloc alone", f"{idle:.2f}", "")]
        missed = False
        for name in stages:
            gib, spent = peak_of([*command, "--until", name], place / f"{name}.log")
            missed |= gib > options.most
            rows.append((name, f"{gib:.2f}", f"{spent:.0f}"))
            print("  ".join(rows[-1]), file=sys.stderr, flush=True)
        print(table(rows))
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
