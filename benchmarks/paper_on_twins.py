"""The preset ``megloc`` on the four rendered twins, with the datasets' config files.

    .venv/bin/python benchmarks/paper_on_twins.py --wiring random --workspace W
    .venv/bin/python benchmarks/paper_on_twins.py --wiring free --dataset inloc

``random``: seeded random weights in the official file formats. Each twin must run to its recall
table with every step of the paper that its data permit; disabled steps are printed with the reason.
Random networks localize by chance, so the recall has no meaning.

``free``: the same steps with freely licensed networks in place of the others: ALIKED with nearest
neighbours, XFeat with LighterGlue, a VLAD of each, no segmentation, no LPIPS. Queries by day must
reach 90 % within 0.25 m and 2 deg, 95 % within 0.5 m and 5 deg; InLoc's within 0.25 m and
10 deg, 0.5 m and 10 deg. The exit status is 1 below that. Weights are read from
../shared/data/weights if it exists, else from the user's folder.

``--rules`` repeats ``free`` with each of the paper's rules replaced by ours, one at a time and all
together, and tabulates the recalls.

By default the worlds have few images, and image size and keypoint limits are reduced, so that a
run takes an hour on two cores. ``--size images`` keeps the preset's image size and keypoint limits;
``--size all`` also renders the full worlds, for a GPU or an overnight run. Nothing else is changed.
Unknown arguments are passed to ``megloc eval``. Nothing is downloaded.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from whole_preset import SHARED_WEIGHTS, WIRINGS, Megloc, add_weights, program, weights_environment
from whole_preset_weights import write_random_weights

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from timing import table  # noqa: E402

DATASETS = ("aachen", "robotcar", "4seasons", "inloc")
SMALL_WORLDS = {
    # the smallest worlds with every kind of query
    "random": {
        "aachen": [
            *("num_places=1", "stations_per_place=3", "sequence_images=2", "day_queries=1"),
            *("night_queries=1", "additional_night_queries=1", "width=320", "height=240"),
        ],
        "robotcar": [
            *("num_locations=1", "stops_per_location=3", "moments_per_condition=2", "size_px=256")
        ],
        "4seasons": [
            *("num_places=1", "map_keyframes=4", "winter_keyframes=1", "dusk_keyframes=1"),
            *("width=400", "height=200"),
        ],
        "inloc": ["modules=1", "queries=2"],
    },
    "free": {
        "aachen": [
            *("num_places=2", "stations_per_place=7", "day_queries=6", "night_queries=2"),
            *("width=480", "height=360"),
        ],
        "robotcar": ["num_locations=2", "size_px=360", "moments_per_condition=2"],
        "4seasons": ["num_places=2", "map_keyframes=24", "winter_keyframes=6", "dusk_keyframes=2"],
        "inloc": ["queries=12"],
    },
}
SMALL_NETWORKS = {
    "random": [
        "preprocessing.max_size_px=160",
        "local_features.superpoint.options.max_keypoints=150",
        "local_features.aslfeat.options.max_keypoints=150",
    ],
    "free": ["preprocessing.max_size_px=800"],
}
FREE_FEATURES = [
    'local_features=[{name="aliked", options={max_keypoints=1500, threshold=0.05}, '
    'matching={name="nn"}}, {name="xfeat", options={max_keypoints=1000}, '
    'matching={name="lighterglue"}}]',
    'global_features=[{name="vlad", options={local_type="aliked-n16", num_clusters=32}}, '
    '{name="vlad", options={local_type="xfeat", num_clusters=32}}]',
]
FREE_INDOORS = ['localization.rank.options.distance={name="structure"}']
FREE_OUTDOORS = ["preprocessing.masks.segmenter=null"]
# the preset reranks with SuperPoint and SuperGlue
FREE_RERANKING = ["reranking.local_type=xfeat"]
# rules with better measured results than the paper's
OUR_RULES = {
    "reranking by coverage of all types": ["reranking.by=coverage", "reranking.local_type=none"],
    "pyramid counts verified matches": ["guided_pyramid.count=verified"],
}
OUR_RULES_OUTDOORS = {
    "clusters ranked by distinctive inliers": ["localization.rank.name=distinctive"],
    "pairs by poses within 60 deg": ["mapping_pairs.poses.max_angle_deg=60"],
}
# minimum recall at the two finest thresholds of a dataset; dark conditions are not checked
BARS = (0.90, 0.95)
DARK = ("night", "night-rain", "night-all", "dusk", "all")
SIZES = ("small", "images", "all")
SIZE_OPTIONS = ("width", "height", "size_px")


def world_options(wiring: str, dataset: str, size: str) -> list[str]:
    """Return the ``--set`` assignments of ``megloc synth``."""
    small = SMALL_WORLDS[wiring][dataset] if size != "all" else []
    return [o for o in small if size == "small" or o.partition("=")[0] not in SIZE_OPTIONS]


def options_of(wiring: str, dataset: str) -> list[str]:
    """Return the ``--set`` assignments of ``megloc eval`` other than sizes."""
    if wiring == "random":
        return []
    return [
        *FREE_FEATURES,
        *FREE_RERANKING,
        *(FREE_INDOORS if dataset == "inloc" else FREE_OUTDOORS),
    ]


def rules_of(dataset: str) -> dict[str, list[str]]:
    """Return the ``--set`` assignments of each set of rules."""
    ours = OUR_RULES | ({} if dataset == "inloc" else OUR_RULES_OUTDOORS)
    combined = [change for changes in ours.values() for change in changes]
    return {"the paper's rules": [], **ours, "all of ours": combined}


def run_twin(
    wiring: str, dataset: str, folder: Path, megloc: Megloc, size: str, arguments: Sequence[str]
) -> tuple[float, Path]:
    """Render a twin if missing and localize in it; return seconds and the workspace."""
    root, workspace = folder / "world", folder / "workspace"
    if not root.is_dir():
        world = world_options(wiring, dataset, size)
        changes = [part for option in world for part in ("--set", option)]
        megloc("synth", ["synth", dataset, "-o", str(root), *changes])
    assignments = options_of(wiring, dataset) + (SMALL_NETWORKS[wiring] if size == "small" else [])
    changes = [part for option in assignments for part in ("--set", option)]
    folders = ["--root", str(root), "--workspace", str(workspace)]
    seconds = megloc(
        "eval",
        ["eval", f"synthetic-{dataset}", *folders, "--preset", "megloc", *changes, *arguments],
    )
    return seconds, workspace


def compare_rules(
    dataset: str, folder: Path, megloc: Megloc, size: str, arguments: Sequence[str]
) -> str:
    """Tabulate the recall in percent: a row per set of rules, a column per condition."""
    lines: list[tuple[str, ...]] = []
    for name, rules in rules_of(dataset).items():
        changes = [part for rule in rules for part in ("--set", rule)]
        _, workspace = run_twin("free", dataset, folder, megloc, size, [*changes, *arguments])
        rows = json.loads((workspace / "evaluation" / "recall.json").read_text())["rows"]
        lines = lines or [("rules", *(row["name"] for row in rows))]
        recalls = (" / ".join(f"{100 * at['recall']:.1f}" for at in row["recall"]) for row in rows)
        lines.append((name, *recalls))
    return table(lines)


def below_bars(rows: Sequence[dict[str, object]]) -> list[str]:
    """Describe the daytime conditions whose recall is too low."""
    missed = []
    for row in rows:
        if row["name"] in DARK:
            continue
        for at, bar in zip(row["recall"], BARS, strict=False):  # type: ignore[call-overload]
            if at["recall"] < bar:
                missed.append(f"{row['name']} at {at['threshold']}: {at['recall']:.3f} < {bar}")
    return missed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wiring", choices=("random", "free"), required=True)
    parser.add_argument("--dataset", action="append", choices=DATASETS)
    parser.add_argument(
        "--size", choices=SIZES, default="small", help="parts that keep their full size"
    )
    parser.add_argument("--rules", action="store_true", help="compare the paper's rules with ours")
    parser.add_argument("--workspace", type=Path, help="keep weights, worlds and runs here")
    options, arguments = parser.parse_known_args()
    if options.rules and options.wiring != "free":
        parser.error("--rules is for --wiring free: random networks have no recall")
    with tempfile.TemporaryDirectory(prefix="megloc-paper-") as temporary:
        folder = (options.workspace or Path(temporary)).resolve() / options.wiring
        environment = weights_environment(WIRINGS[options.wiring], folder)
        if options.wiring == "random" and not (folder / "weights").is_dir():
            files = write_random_weights(folder / "made")
            add_weights(files, program(environment, folder / "logs"))
        print(f"weights: {SHARED_WEIGHTS if options.wiring == 'free' else folder / 'weights'}")
        missed: list[str] = []
        for dataset in options.dataset or DATASETS:
            dataset_folder = folder / dataset
            megloc = program(environment, dataset_folder / "logs")
            if options.rules:
                recalls = compare_rules(dataset, dataset_folder, megloc, options.size, arguments)
                print(f"\n{dataset}\n\n{recalls}\n", flush=True)
                continue
            seconds, workspace = run_twin(
                options.wiring, dataset, dataset_folder, megloc, options.size, arguments
            )
            evaluation = workspace / "evaluation"
            rows = json.loads((evaluation / "recall.json").read_text())["rows"]
            manifest = json.loads((workspace / "stages" / "evaluation.json").read_text())
            steps = [("step", "", "why")]
            steps += [
                (step["name"], "on" if step["on"] else "OFF", step["why"])
                for step in manifest["options"]["steps"]
            ]
            print(f"\n{dataset}: {seconds:.0f} s\n\n{table(steps)}\n", flush=True)
            print((evaluation / "recall.txt").read_text(encoding="utf-8"), flush=True)
            if options.wiring == "free":
                missed += [f"{dataset}: {text}" for text in below_bars(rows)]
        for text in missed:
            print(text)
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
