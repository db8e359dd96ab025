"""Results of whole runs, kept to compare with: what a change of the code must not change.

    .venv/bin/python benchmarks/golden.py -o before/            # in the old state
    .venv/bin/python benchmarks/golden.py -o after/ --against before/

Each case is one run of ``megloc eval`` (or ``localize`` in somebody else's map): the small rendered
twins and the scenes of ../shared/data, where those are there, with the presets classic and modern,
and the twins with the preset megloc and random weights. Kept are the poses, ``status.csv`` and the
recall table. Compared are bytes; where they differ, how far poses moved and both recalls are
printed, and the exit code is 1. Another processor gives other last digits of SIFT, and from there
other poses: compare what one machine made.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from paper_on_twins import DATASETS, SMALL_NETWORKS, SMALL_WORLDS
from whole_preset import WIRINGS, Megloc, add_weights, program, weights_environment
from whole_preset_weights import write_random_weights

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SCENES = ("fountain_p11", "herzjesu_p25", "herzjesu_wide", "hololens_room", "redkitchen_rgbd")
POSES, STATUS, RECALL = "trajectories.txt", "status.csv", "recall.txt"
# sizes alone: what a run does stays the preset's
SMALL = {
    "classic": [
        "local_features.options.max_keypoints=1500",
        "global_features.options.num_clusters=32",
    ],
    "modern": ["local_features.options.max_keypoints=1000"],
    "megloc": SMALL_NETWORKS["random"],
}


@dataclass(frozen=True)
class Case:
    """One run: ``name`` is its folder's, ``arguments`` those of ``megloc``, paths filled in."""

    name: str
    wiring: str
    arguments: tuple[str, ...]


def cases(place: Path) -> Iterator[Case]:
    """Every case that the data at hand allow, the quick ones first."""
    scenes = DATA / "scenes"
    for preset in ("classic", "modern"):
        sizes = [part for change in SMALL[preset] for part in ("--set", change)]
        for scene in SCENES:
            if (scenes / scene).is_dir():
                yield Case(
                    f"{scene}-{preset}",
                    "free",
                    ("eval", "kapture", "--root", str(scenes / scene), "--preset", preset, *sizes),
                )
    gallery = DATA / "foreign_maps" / "virtual_gallery"
    if gallery.is_dir():
        maps = ("-i", str(gallery / "map"), "--query", str(gallery / "query"))
        yield Case("virtual_gallery-classic", "free", ("localize", *maps))
    for preset in ("classic", "modern", "megloc"):
        sizes = [part for change in SMALL[preset] for part in ("--set", change)]
        wiring = "random" if preset == "megloc" else "free"
        for twin in DATASETS:
            root = ("--root", str(place / "worlds" / wiring / twin))
            yield Case(
                f"{twin}-{preset}",
                wiring,
                ("eval", f"synthetic-{twin}", *root, "--preset", preset, *sizes),
            )


def execute(case: Case, place: Path, output: Path) -> float:
    """Run a case, keep what came out of it, and return its seconds."""
    environment = weights_environment(WIRINGS[case.wiring], place)
    logs = place / "logs" / case.name
    megloc = program(environment, logs)
    workspace = place / "workspaces" / case.name
    shutil.rmtree(workspace, ignore_errors=True)
    if "--root" in case.arguments:
        render(Path(case.arguments[case.arguments.index("--root") + 1]), megloc)
    if case.arguments[0] == "localize":
        seconds = megloc(case.name, [*case.arguments, "-o", str(workspace)])
        localized, recall = workspace, None
    else:
        seconds = megloc(case.name, [*case.arguments, "--workspace", str(workspace)])
        localized, recall = workspace / "localized", workspace / "evaluation" / RECALL
    kept = output / case.name
    kept.mkdir(parents=True)
    # without a pose there are no trajectories
    for file in (localized / "sensors" / POSES, localized / STATUS, recall):
        if file is not None and file.is_file():
            shutil.copyfile(file, kept / file.name)
    shutil.rmtree(workspace)
    return seconds


def render(root: Path, megloc: Megloc) -> None:
    """Render a twin unless its folder is there."""
    worlds = SMALL_WORLDS.get(root.parent.name, {})
    if root.name in worlds and not root.is_dir():
        world = [part for change in worlds[root.name] for part in ("--set", change)]
        megloc("synth", ["synth", root.name, "-o", str(root), *world])


def differences(now: Path, before: Path) -> list[str]:
    """What differs between two folders of the same case, in words."""
    told = []
    for name in (POSES, STATUS, RECALL):
        files = [folder / name for folder in (before, now)]
        if all(file.is_file() for file in files) and files[0].read_bytes() != files[1].read_bytes():
            told.append(name)
    if POSES in told:
        poses = [_poses(folder / POSES) for folder in (before, now)]
        common = poses[0].keys() & poses[1].keys()
        moved = max(
            (float(np.abs(poses[0][key] - poses[1][key]).max()) for key in common), default=0.0
        )
        told.append(
            f"poses {len(poses[0])} -> {len(poses[1])}, numbers of the common ones differ by at "
            f"most {moved:.3g}"
        )
    return told


def _poses(path: Path) -> dict[str, np.ndarray]:
    rows = (line.split(",") for line in path.read_text().splitlines() if line and line[0] != "#")
    return {",".join(row[:2]): np.array([float(x) for x in row[2:]]) for row in rows}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the cases; compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--against", type=Path, help="results of another state of the code")
    parser.add_argument("--case", action="append", help="only cases whose names contain this")
    parser.add_argument("--workspace", type=Path, help="keep weights and rendered worlds here")
    options = parser.parse_args(arguments)
    differ: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory(prefix="megloc-golden-") as temporary:
        place = (options.workspace or Path(temporary)).resolve()
        for case in cases(place):
            if options.case and not any(part in case.name for part in options.case):
                continue
            if (options.output / case.name).is_dir():
                print(f"{case.name}: there", flush=True)
            else:
                if case.wiring == "random" and not (place / "weights").is_dir():
                    environment = weights_environment(WIRINGS["random"], place)
                    made = write_random_weights(place / "made")
                    add_weights(made, program(environment, place / "logs"))
                seconds = execute(case, place, options.output)
                print(f"{case.name}: {seconds:.0f} s", flush=True)
            if options.against and (options.against / case.name).is_dir():
                told = differences(options.output / case.name, options.against / case.name)
                if told:
                    differ[case.name] = told
                    print(json.dumps({case.name: told}), flush=True)
    if options.against:
        print(f"{len(differ)} cases differ" if differ else "all equal")
    sys.exit(1 if differ else 0)


if __name__ == "__main__":
    main()
