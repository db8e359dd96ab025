"""Run every stage of the preset ``megloc`` and check that every artefact exists.

    .venv/bin/python benchmarks/whole_preset.py --workspace W
    .venv/bin/python benchmarks/whole_preset.py --wiring free --executor inline

``random``: seeded random weights in the official file formats, added by ``megloc weights add
--unverified``, and the preset on a small rendered scene whose queries have depth; only sizes and
scene-dependent options are changed. Random networks localize little or nothing, but each stage must
run, report the reasons of failures and write files that kapture can read. The refiners also run on
the true poses displaced by 5 cm. The twins of the datasets run with the datasets' config files
alone::

    .venv/bin/python benchmarks/whole_preset_weights.py DIR
    MEGLOC_WEIGHTS=DIR make eval DATASET=synthetic-aachen PRESET=megloc    # or another twin

``free``: the same configuration with freely licensed networks, and a minimum recall: 90 % of the
queries within 0.25 m and 2 deg, 95 % within 0.5 m and 5 deg. The exit status is 1 below that.
Weights are read from ../shared/data/weights if it exists, else from the user's folder.

Unknown arguments are passed to ``megloc eval``. Nothing is downloaded.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas
from whole_preset_artefacts import artefacts
from whole_preset_scene import FREE_SCENE, RANDOM_SCENE, Scene, write_displaced_truth, write_scene
from whole_preset_weights import write_random_weights

from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.io.tables import STATUS_FILE

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table, timed_command  # noqa: E402

SHARED_WEIGHTS = Path(__file__).resolve().parents[2] / "shared" / "data" / "weights"
BARS = {(0.25, 2.0): 0.90, (0.5, 5.0): 0.95}  # (metres, degrees) -> share of all queries
_FIGURE = re.compile(r"\d+(\.\d+)?")
# rendered depth has no noise, and the scene is tens of metres wide
REFINERS = """[
    { name = "icp", options = { depth = { max_depth_m = 40.0 }, noise = [0.01, 0.0, 0.0], \
voxels_m = [0.4, 0.2, 0.1], max_distances_m = [1.2, 0.6, 0.3] } },
    { name = "rendering" },
]"""

# options of both wirings: sizes for a small scene, and options that depend on the scene
_COMMON = f"""\
dataset = "kapture"
preset = "megloc"
thresholds = [[0.05, 5.0], [0.25, 2.0], [0.5, 5.0], [5.0, 10.0]]

# the map trajectory is a circle
[options.mapping_pairs]
by = ["poses", "retrieval", "sequence"]
top_k = 4
poses = {{ num_neighbours = 4 }}
sequence = {{ window = 1 }}

[options.query_pairs]
top_k = 8

[options.guided_pyramid]
min_matches = 30
scales = [0.5, 1.0]
rotations_deg = [0, 90]

[options.pose_refinement]
by = {REFINERS}
"""
_RANDOM = """
[options.reranking]
keep = 5

[options.preprocessing]
max_size_px = 304
masks = { segmenter = { name = "deeplabv3plus" } }

[options.local_features]
superpoint = { options = { max_keypoints = 400 } }
aslfeat = { options = { max_keypoints = 400 } }

# accept few matches and chance poses, so that there are points, and clusters to rank
[options.triangulation]
two_view_tracks = true

[options.localization.pose]
min_inliers = 6

[options.localization.rank]
name = "perceptual"
options = { distance = { name = "lpips" } }
"""
_FREE = """
[options.reranking]
keep = 5
local_type = "xfeat"

[options.preprocessing]
max_size_px = 384

[[options.local_features]]
name = "aliked"
options = { max_keypoints = 1000, threshold = 0.05 }
matching = { name = "nn" }

[[options.local_features]]
name = "xfeat"
options = { max_keypoints = 600 }
matching = { name = "lighterglue" }

[[options.global_features]]
name = "vlad"
options = { local_type = "aliked-n16", num_clusters = 32 }

[[options.global_features]]
name = "vlad"
options = { local_type = "xfeat", num_clusters = 32 }

[options.localization.rank]
name = "perceptual"
options = { distance = { name = "structure" } }
"""


@dataclass(frozen=True)
class Wiring:
    """Networks of the preset and the scene for a run.

    Attributes
    ----------
    options : TOML text appended to the common options.
    """

    name: str
    scene: Scene
    options: str

    def config(self) -> str:
        """Return the content of the config file."""
        return _COMMON + self.options


WIRINGS = {
    "random": Wiring("random", RANDOM_SCENE, _RANDOM),
    "free": Wiring("free", FREE_SCENE, _FREE),
}

# run a megloc command, given its name and arguments, and return the seconds
Megloc = Callable[[str, Sequence[str]], float]


def add_weights(files: Mapping[str, Path], megloc: Megloc) -> float:
    """Add weight files with ``megloc weights add``; return the seconds."""
    return sum(
        megloc(f"weights add {name}", ["weights", "add", str(path), "--name", name, "--unverified"])
        for name, path in files.items()
    )


def run(wiring: Wiring, folder: Path, megloc: Megloc, arguments: Sequence[str] = ()) -> Path:
    """Render the scene if missing and run all stages; return the workspace."""
    root, workspace = folder / "scene", folder / "workspace"
    if not (root / "megloc").is_dir():
        write_scene(root, wiring.scene)
    config = folder / "config.toml"
    config.write_text(wiring.config(), encoding="utf-8")
    folders = ["--root", str(root), "--config", str(config), "--workspace", str(workspace)]
    megloc("eval", ["eval", "kapture", *folders, *arguments])
    return workspace


def pair_by_covisibility(workspace: Path, megloc: Megloc) -> int:
    """Pair the map images by co-visibility and return the number of pairs.

    Co-visibility requires triangulated points, so the pairs are those for a second round of
    matching. A map without points has no pairs.
    """
    if not len(KaptureFolder(workspace / "map").points3d()):
        return 0
    output = workspace.parent / "covisible.txt"
    pairing = ["pairs-mapping", "-i", str(workspace / "map"), "--by", "covisibility"]
    megloc("pairs-mapping", [*pairing, "-o", str(output), "-f"])
    return len(read_pairs(output))


def refine_displaced(workspace: Path, megloc: Megloc, arguments: Sequence[str] = ()) -> Path:
    """Refine the true poses displaced by 5 cm; return the folder of refined poses."""
    query, folder = workspace / "preprocessed" / "query", workspace.parent
    truth = KaptureFolder(workspace / "query_gt")
    write_displaced_truth(KaptureFolder(query), truth, folder / "displaced")
    folders = ["--query", str(query), "--poses", str(folder / "displaced")]
    by = ["--set", f"pose_refinement.by={REFINERS}"]
    output = folder / "refined"
    refining = ["refine-poses", "-i", str(workspace / "map"), *folders, *by]
    megloc("refine-poses", [*refining, "-o", str(output), "-f", *arguments])
    return output


def reasons(localized: Path, title: str) -> str:
    """Tabulate the messages of ``status.csv``, without their figures, with the query counts."""
    counts: Counter[str] = Counter()
    for row in pandas.read_csv(localized / STATUS_FILE, keep_default_na=False).itertuples():
        messages = [row.reason or row.status]
        messages += row.refinement.split("; ") if row.refinement else []
        counts.update(_FIGURE.sub("#", text) for text in messages)
    return table([(title, "queries"), *((text, str(n)) for text, n in counts.most_common())])


def below_bars(workspace: Path) -> list[str]:
    """Describe the thresholds at which the recall of all queries is too low."""
    rows = json.loads((workspace / "evaluation" / "recall.json").read_text())["rows"]
    entries = next(row for row in rows if row["name"] == "all")["recall"]
    recall = {tuple(entry["threshold"].values()): entry["recall"] for entry in entries}
    return [
        f"recall at {position_m:g} m, {angle_deg:g} deg is {recall[position_m, angle_deg]:.3f}, "
        f"below {bar:.2f}"
        for (position_m, angle_deg), bar in BARS.items()
        if recall[position_m, angle_deg] < bar
    ]


def program(environment: Mapping[str, str], logs: Path) -> Megloc:
    """Return a runner of the ``megloc`` command; on failure it exits with the end of the log."""
    executable = str(Path(sys.executable).with_name("megloc"))
    logs.mkdir(parents=True, exist_ok=True)

    def megloc(name: str, arguments: Sequence[str]) -> float:
        log = logs / f"{name.replace(' ', '-')}.log"
        return timed_command(name, [executable, *arguments], environment, log).wall_s

    return megloc


def report(workspace: Path, refined: Path, covisible: int) -> str:
    """Tabulate the artefacts of each stage and the outcomes of the queries."""
    rows = [("stage", "seconds", "artefact", "content")]
    listed = set()
    for artefact in artefacts(workspace):
        seconds = "" if artefact.stage in listed else f"{artefact.seconds:.1f}"
        rows.append((artefact.stage, seconds, artefact.path, artefact.content))
        listed.add(artefact.stage)
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [
        f"{row[0]:{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]:{widths[2]}}  {row[3]}"
        for row in rows
    ]
    return "\n\n".join(
        [
            os.linesep.join(lines),
            f"co-visible pairs of map images: {covisible}",
            reasons(workspace / "localized", "outcome of the queries"),
            reasons(refined, "outcome of the refinement of true poses displaced by 5 cm"),
            (workspace / "evaluation" / "recall.txt").read_text(encoding="utf-8"),
        ]
    )


def weights_environment(wiring: Wiring, folder: Path) -> dict[str, str]:
    """Return the environment variables with the weights folder of a wiring."""
    environment = dict(os.environ)
    if wiring.name == "random":
        environment["MEGLOC_WEIGHTS"] = str(folder / "weights")
    elif SHARED_WEIGHTS.is_dir():
        environment["MEGLOC_WEIGHTS"] = str(SHARED_WEIGHTS)
    return environment


def execute(wiring: Wiring, folder: Path, arguments: Sequence[str]) -> bool:
    """Run a wiring and print its tables; return True if its recall is sufficient."""
    folder.mkdir(parents=True, exist_ok=True)
    megloc = program(weights_environment(wiring, folder), folder / "logs")
    complete = folder / "weights_added"
    if wiring.name == "random" and not complete.exists():
        shutil.rmtree(folder / "weights", ignore_errors=True)
        seconds = add_weights(write_random_weights(folder / "made"), megloc)
        complete.touch()
        print(f"random weights added in {seconds:.1f} s")
    workspace = run(wiring, folder, megloc, arguments)
    covisible = pair_by_covisibility(workspace, megloc)
    refined = refine_displaced(workspace, megloc)
    print(f"\n{wiring.name}\n\n{report(workspace, refined, covisible)}")
    missed = below_bars(workspace) if wiring.name == "free" else []
    for text in missed:
        print(text)
    return not missed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workspace", type=Path, help="keep weights, scenes and runs here")
    parser.add_argument("--wiring", choices=("random", "free", "both"), default="both")
    options, arguments = parser.parse_known_args()
    arguments = [argument for argument in arguments if argument != "--"]
    names = list(WIRINGS) if options.wiring == "both" else [options.wiring]
    with tempfile.TemporaryDirectory(prefix="megloc-whole-preset-") as temporary:
        folder = (options.workspace or Path(temporary)).resolve()
        reached = [execute(WIRINGS[name], folder / name, arguments) for name in names]
    sys.exit(0 if all(reached) else 1)


if __name__ == "__main__":
    main()
