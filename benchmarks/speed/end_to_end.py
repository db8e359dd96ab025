"""Time each stage from the images of a scene to poses and recall.

    .venv/bin/python benchmarks/speed/end_to_end.py --scene ../shared/data/scenes/redkitchen_rgbd

The scene has mapping/, query/ and query_gt/ in kapture. Without ``--workspace`` the run starts from
scratch in a temporary folder.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from timing import table


def scene_folder(text: str) -> Path:
    """Resolve and check the scene folder of a command line."""
    scene = Path(text).resolve()
    for name in ("mapping", "query"):
        if not (scene / name).is_dir():
            raise argparse.ArgumentTypeError(f"no folder {scene / name} (make bench SCENE=folder)")
    return scene


def megloc_command(
    scene: Path, workspace: Path, threads: int, arguments: Sequence[str]
) -> list[str]:
    """Return the command line of a run with the ``megloc`` of this environment."""
    megloc = Path(sys.executable).with_name("megloc")
    options = ["--root", str(scene), "--workspace", str(workspace), "--workers", str(threads)]
    return [str(megloc), "eval", "kapture", *options, *arguments]


def stage_seconds(workspace: Path) -> dict[str, float]:
    """Read the seconds of each stage from the manifests, in the order of completion."""
    manifests = sorted(
        (workspace / "stages").glob("[!.]*.json"), key=lambda path: path.stat().st_mtime_ns
    )
    return {path.stem: float(json.loads(path.read_text())["seconds"]) for path in manifests}


def stage_table(seconds: dict[str, float]) -> str:
    rows = [("stage", "seconds"), *((name, f"{s:.1f}") for name, s in seconds.items())]
    return table([*rows, ("all stages", f"{sum(seconds.values()):.1f}")])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=scene_folder, required=True)
    parser.add_argument("--workspace", type=Path, help="keep the run here")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    options, arguments = parser.parse_known_args()

    with tempfile.TemporaryDirectory(prefix="megloc-speed-") as temporary:
        workspace = options.workspace or Path(temporary) / "workspace"
        start = time.perf_counter()
        done = subprocess.run(
            megloc_command(options.scene, workspace, options.threads, arguments), check=False
        )
        wall_s = time.perf_counter() - start
        if done.returncode != 0:
            sys.exit(done.returncode)
        print(f"\n{options.scene.name}, {options.threads} threads")
        print(stage_table(stage_seconds(workspace)))
        print(f"whole command, including startup: {wall_s:.1f} s")


if __name__ == "__main__":
    main()
