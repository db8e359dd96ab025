"""The preset ``megloc`` whole: every stage of the paper runs and every artefact is there.

    .venv/bin/python benchmarks/whole_preset.py --workspace W
    .venv/bin/python benchmarks/whole_preset.py --wiring free --executor inline

``random``: seeded random weights in every official container, added by ``megloc weights add
--unverified``, and the preset on a small rendered scene whose queries have depth; the options are
sizes, and what depends on the scene. Such networks localize little or nothing; what counts is that
each stage runs, says why it found nothing, and leaves files that kapture reads. The refiners run on
the true poses as well, moved by 5 cm. The twins of the datasets run with the datasets' own files
and nothing else::

    .venv/bin/python benchmarks/whole_preset_weights.py DIR
    MEGLOC_WEIGHTS=DIR make eval DATASET=synthetic-aachen PRESET=megloc    # and the others

``free``: the same wiring with free weights in each slot, and recall that must reach the bars: 90 %
of the queries within 0.25 m and 2 deg, 95 % within 0.5 m and 5 deg. Exits with 1 below them. The
weights are those of ../shared/data/weights where that is there, else of the user's folder.

Arguments that are not known here go to ``megloc eval``. Nothing is downloaded.
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
from whole_preset_scene import (
    FREE_SCENE,
    RANDOM_SCENE,
    Scene,
    write_displaced_truth,
    write_scene,
)
from whole_preset_weights import write_random_weights

from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.io.tables import STATUS_FILE

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table, timed_command  # noqa: E402

SHARED_WEIGHTS = Path(__file__).resolve().parents[2] / "shared" / "data" / "weights"
BARS = {(0.25, 2.0): 0.90, (0.5, 5.0): 0.95}  # metres and degrees: share of all queries
_FIGURE = re.compile(r"\d+(\.\d+)?")
# depth is rendered, without noise, of a place that is tens of metres wide
REFINERS = """[
    { name = "icp", options = { depth = { max_depth_m = 40.0 }, noise = [0.01, 0.0, 0.0], \
voxels_m = [0.4, 0.2, 0.1], max_distances_m = [1.2, 0.6, 0.3] } },
    { name = "rendering" },
]"""

# sizes for a small scene, and what depends on it; all else is the preset's. Both wirings
_COMMON = f"""\
dataset = "kapture"
preset = "megloc"
thresholds = [[0.05, 5.0], [0.25, 2.0], [0.5, 5.0], [5.0, 10.0]]

# the map's cameras go round
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

# few matches, and poses by chance, so that there are points and places to choose between
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
    """What stands in the preset's slots, and the scene it runs on.

    Attributes
    ----------
    options : of the benchmark file, beside the common ones.
    """

    name: str
    scene: Scene
    options: str

    def config(self) -> str:
        """The benchmark file."""
        return _COMMON + self.options


WIRINGS = {
    "random": Wiring("random", RANDOM_SCENE, _RANDOM),
    "free": Wiring("free", FREE_SCENE, _FREE),
}

# runs a command of megloc: its name in the table, and its arguments; returns its seconds
Megloc = Callable[[str, Sequence[str]], float]


def add_weights(made: Mapping[str, Path], megloc: Megloc) -> float:
    """Add files as one who has them does; the seconds."""
    return sum(
        megloc(f"weights add {name}", ["weights", "add", str(path), "--name", name, "--unverified"])
        for name, path in made.items()
    )


def run(wiring: Wiring, place: Path, megloc: Megloc, arguments: Sequence[str] = ()) -> Path:
    """Render the scene unless it is there, and run everything; the workspace."""
    root, workspace = place / "scene", place / "workspace"
    if not (root / "megloc").is_dir():
        write_scene(root, wiring.scene)
    config = place / "config.toml"
    config.write_text(wiring.config(), encoding="utf-8")
    places = ["--root", str(root), "--config", str(config), "--workspace", str(workspace)]
    megloc("eval", ["eval", "kapture", *places, *arguments])
    return workspace


def pair_by_covisibility(workspace: Path, megloc: Megloc) -> int:
    """Pair the map's images by what they see of its points, and return how many pairs there are.

    Co-visibility needs points; a map made anew has them only at the end. The pairs are those that
    a second round of matching would take. Of a map without points there are none.
    """
    if not len(KaptureFolder(workspace / "map").points3d()):
        return 0
    output = workspace.parent / "covisible.txt"
    pairing = ["pairs-mapping", "-i", str(workspace / "map"), "--by", "covisibility"]
    megloc("pairs-mapping", [*pairing, "-o", str(output), "-f"])
    return len(read_pairs(output))


def refine_displaced(workspace: Path, megloc: Megloc, arguments: Sequence[str] = ()) -> Path:
    """Refine the true poses, each moved by 5 cm, with the run's map; the refined result."""
    query, place = workspace / "preprocessed" / "query", workspace.parent
    truth = KaptureFolder(workspace / "query_gt")
    write_displaced_truth(KaptureFolder(query), truth, place / "displaced")
    folders = ["--query", str(query), "--poses", str(place / "displaced")]
    by = ["--set", f"pose_refinement.by={REFINERS}"]
    output = place / "refined"
    refining = ["refine-poses", "-i", str(workspace / "map"), *folders, *by]
    megloc("refine-poses", [*refining, "-o", str(output), "-f", *arguments])
    return output


def reasons(localized: Path, title: str) -> str:
    """What ``status.csv`` says, without figures, and of how many queries."""
    told: Counter[str] = Counter()
    for row in pandas.read_csv(localized / STATUS_FILE, keep_default_na=False).itertuples():
        said = [row.reason or row.status]
        said += row.refinement.split("; ") if row.refinement else []
        told.update(_FIGURE.sub("#", text) for text in said)
    return table([(title, "queries"), *((text, str(n)) for text, n in told.most_common())])


def below_bars(workspace: Path) -> list[str]:
    """The bars that the recall of all queries does not reach."""
    rows = json.loads((workspace / "evaluation" / "recall.json").read_text())["rows"]
    recall = next(row for row in rows if row["name"] == "all")["recall"]
    found = {tuple(at["threshold"].values()): at["recall"] for at in recall}
    return [
        f"recall at {position_m:g} m, {angle_deg:g} deg is {found[position_m, angle_deg]:.3f}, "
        f"below {bar:.2f}"
        for (position_m, angle_deg), bar in BARS.items()
        if found[position_m, angle_deg] < bar
    ]


def program(environment: Mapping[str, str], logs: Path) -> Megloc:
    """The ``megloc`` beside this Python; a failure ends this run with what it said."""
    executable = str(Path(sys.executable).with_name("megloc"))
    logs.mkdir(parents=True, exist_ok=True)

    def megloc(name: str, arguments: Sequence[str]) -> float:
        log = logs / f"{name.replace(' ', '-')}.log"
        return timed_command(name, [executable, *arguments], environment, log).wall_s

    return megloc


def report(workspace: Path, refined: Path, covisible: int) -> str:
    """The table of what each stage left, and what became of the queries."""
    rows = [("stage", "seconds", "artefact", "content")]
    told = set()
    for one in artefacts(workspace):
        seconds = "" if one.stage in told else f"{one.seconds:.1f}"
        rows.append((one.stage, seconds, one.path, one.content))
        told.add(one.stage)
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [
        f"{row[0]:{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]:{widths[2]}}  {row[3]}"
        for row in rows
    ]
    return "\n\n".join(
        [
            os.linesep.join(lines),
            f"map images that see the same points: {covisible} pairs",
            reasons(workspace / "localized", "what became of the queries"),
            reasons(refined, "refined from the true poses, moved by 5 cm"),
            (workspace / "evaluation" / "recall.txt").read_text(encoding="utf-8"),
        ]
    )


def weights_environment(wiring: Wiring, place: Path) -> dict[str, str]:
    """This environment, with a folder of weights of the run's own, or the free ones."""
    environment = dict(os.environ)
    if wiring.name == "random":
        environment["MEGLOC_WEIGHTS"] = str(place / "weights")
    elif SHARED_WEIGHTS.is_dir():
        environment["MEGLOC_WEIGHTS"] = str(SHARED_WEIGHTS)
    return environment


def execute(wiring: Wiring, place: Path, arguments: Sequence[str]) -> bool:
    """Run a wiring and print its tables; whether it reaches what it has to."""
    place.mkdir(parents=True, exist_ok=True)
    megloc = program(weights_environment(wiring, place), place / "logs")
    added = place / "weights_added"  # marks that all of them are there
    if wiring.name == "random" and not added.exists():
        shutil.rmtree(place / "weights", ignore_errors=True)
        seconds = add_weights(write_random_weights(place / "made"), megloc)
        added.touch()
        print(f"random weights added in {seconds:.1f} s")
    workspace = run(wiring, place, megloc, arguments)
    covisible = pair_by_covisibility(workspace, megloc)
    refined = refine_displaced(workspace, megloc)
    print(f"\n{wiring.name}\n\n{report(workspace, refined, covisible)}")
    missed = below_bars(workspace) if wiring.name == "free" else []
    for text in missed:
        print(text)
    return not missed


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workspace", type=Path, help="keep weights, scenes and runs here")
    parser.add_argument("--wiring", choices=("random", "free", "both"), default="both")
    options, arguments = parser.parse_known_args()
    arguments = [argument for argument in arguments if argument != "--"]
    names = list(WIRINGS) if options.wiring == "both" else [options.wiring]
    with tempfile.TemporaryDirectory(prefix="megloc-whole-preset-") as temporary:
        place = (options.workspace or Path(temporary)).resolve()
        reached = [execute(WIRINGS[name], place / name, arguments) for name in names]
    sys.exit(0 if all(reached) else 1)


if __name__ == "__main__":
    main()
