"""Run all speed benchmarks of ``make bench``, each in a separate process.

Each script also runs alone; see benchmarks/README.md.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from end_to_end import scene_folder

HERE = Path(__file__).resolve().parent


def run(script: str, *arguments: str) -> None:
    """Run one script; exit with its status on failure."""
    print(f"\n== {script} {' '.join(arguments)}".rstrip(), flush=True)
    done = subprocess.run([sys.executable, str(HERE / script), *arguments], check=False)
    if done.returncode != 0:
        sys.exit(done.returncode)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=scene_folder, required=True)
    parser.add_argument("--kloc-python", help="also run kapture-localization, with this Python")
    options, arguments = parser.parse_known_args()
    run("map_reading.py")
    run("localization.py")
    run("large_map.py")
    run("uncertainty.py")
    scene = ("--scene", str(options.scene))
    run("end_to_end.py", *scene, *arguments)
    if options.kloc_python:
        kloc = ("--kloc-python", options.kloc_python)
        run("kloc_side_by_side.py", *kloc, *scene, *arguments)


if __name__ == "__main__":
    main()
