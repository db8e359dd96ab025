"""Train a night descriptor for XFeat's detector and a small SuperGlue on free data only.

    .venv/bin/python benchmarks/train_free.py worlds       # rendered squares by day and at night
    .venv/bin/python benchmarks/train_free.py descriptor   # hours; rerun to resume
    .venv/bin/python benchmarks/train_free.py matcher      # on the trained descriptors
    .venv/bin/python benchmarks/train_free.py evaluate     # recall on worlds with other seeds
    .venv/bin/python benchmarks/train_free.py inliers --scene DIR ...    # matching of real pairs

XFeat's weights are Apache-2.0 and the worlds are rendered by this project, so the trained weights
may be published under a free licence. More data: ``--also FOLDER`` (kapture with depth),
``--photographs FOLDER``. Output goes to ``runs/train_free``. The worlds are rendered like
Aachen's twin, with seeds from 1000 (training) and 2000 (held out), which no test and no other
benchmark uses.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from megloc_twins.aachen import AachenTwin, AachenTwinOptions, build_aachen_frames
from megloc_twins.frames import Frame
from megloc_twins.render import RenderedFrame, render_frames

import megloc_kapture as megloc
from megloc_kapture.geometry.cameras import normalized_from_px
from megloc_kapture.io.images import read_image_rgb, write_depth_map, write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.matching.verification import ray_slopes, sampson_error_px
from megloc_kapture.pipeline.executors import open_executor
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import ImageFeatures, RigidTransform

TRAINING_SEED, HELD_OUT_SEED = 1000, 2000
ALBUM = {"stations_per_place": 6, "day_queries": 16, "night_queries": 24}
PAIRS = {"max_size_px": 640, "max_keypoints": 512, "check_every": 250}
DESCRIPTOR = {"through": "products", "pairs_per_step": 4, "learning_rate": 2e-4, "steps": 20_000}
MATCHER = {"layers": 12, "pairs_per_step": 8, "learning_rate": 5e-4, "steps": 100_000}


def write_album(root: Path, seed: int, work: Work = HERE) -> None:
    """Render the day and night photographs of a world, with depth, as kapture."""
    options = AachenTwinOptions.model_validate({"seed": seed, **ALBUM})
    frames = build_aachen_frames(options)
    images = [*frames.mapping(), *frames.queries()]
    names = [frame.name for frame in images]
    records = root / "sensors" / "records_data"
    render_frames(options.world(), images, partial(_write, records), with_depth=names, work=work)
    data = KaptureData()
    identity = RigidTransform.identity()
    for number, frame in enumerate(sorted(images, key=lambda image: image.name)):
        camera, depth = f"{number}", f"{number}_depth"
        data.sensors[camera] = Sensor.from_camera(frame.camera)
        data.sensors[depth] = Sensor.from_camera(frame.camera, sensor_type="depth")
        data.rigs[f"{number}_rig"] = {camera: identity, depth: identity}
        data.trajectories[number, camera] = frame.cam_from_world
        data.records_camera[number, camera] = frame.name
        data.records_depth[number, depth] = f"{frame.name}.depth"
    write_sensors(root, data)


def _write(records: Path, frame: Frame, view: RenderedFrame) -> None:
    write_image(records / frame.name, view.image)
    assert view.depth_m is not None  # requested by write_album
    write_depth_map(records / f"{frame.name}.depth", view.depth_m)


def worlds(root: Path, seeds: Sequence[int], workers: int) -> None:
    """Render missing worlds."""
    with open_executor("processes", workers) as executor:
        for seed in seeds:
            folder = root / "worlds" / str(seed)
            if not (folder / "sensors" / "sensors.txt").is_file():
                write_album(folder, seed, Work(executor))
                print(f"world {seed}", flush=True)


def train(task: str, root: Path, arguments: argparse.Namespace) -> None:
    """Train from the start or from the last checkpoint."""
    rendered = [folder for folder in sorted((root / "worlds").iterdir()) if folder.is_dir()]
    held_out = [folder for folder in rendered if int(folder.name) >= HELD_OUT_SEED]
    kaptures = [*(folder for folder in rendered if folder not in held_out), *arguments.also]
    options = {**PAIRS, **(DESCRIPTOR if task == "descriptor" else MATCHER)}
    if task == "matcher":
        options["features.options.descriptor_weights"] = str(root / "xfeat-night.safetensors")
    assignments = dict(text.split("=", 1) for text in arguments.set or ())
    if "matcher_weights" in assignments:
        options.pop("layers", None)  # defined by the weights
    name = {"descriptor": "xfeat-night", "matcher": "xfeat-night-superglue"}[task]
    metrics = megloc.train(
        task,
        root / f"{name}.safetensors",
        kaptures=kaptures,
        photographs=arguments.photographs,
        held_out=held_out,
        features="xfeat",
        set={**options, **assignments},
    )
    print({key: round(value, 5) for key, value in metrics.items()})


def evaluate(root: Path, seeds: Sequence[int], scenes: Sequence[Path], workers: int) -> None:
    """Compare the recall of original and trained descriptors on twins of Aachen and on scenes."""
    runs = [("aachen", root / "twins" / str(seed)) for seed in seeds]
    for seed, (_, twin) in zip(seeds, runs, strict=True):
        if not twin.is_dir():
            AachenTwin(AachenTwinOptions(seed=seed)).write(twin)
    gains: dict[str, list[pd.DataFrame]] = {}
    for dataset, folder in [*runs, *(("kapture", scene) for scene in scenes)]:
        recalls = []
        for name, options in (
            ("original", {}),
            ("night", {"descriptor_weights": str(root / "xfeat-night.safetensors")}),
        ):
            features = {"name": "xfeat", "options": {"max_keypoints": 2048, **options}}
            run = megloc.run(
                dataset,
                folder,
                preset="classic",
                set={"local_features": [features], "matching.options.max_ratio": 1.0},
                workspace=root / "runs" / f"{folder.name}-{name}",
                workers=workers,
            )
            recalls.append(run.recall)
            print(f"{folder.name}, {name} descriptors\n{run.recall.round(3)}", flush=True)
        kind = "twins" if dataset == "aachen" else folder.name
        gains.setdefault(kind, []).append(recalls[1] - recalls[0])
    for kind, tables in gains.items():
        print(f"mean gain, {kind}\n{(sum(tables[1:], tables[0]) / len(tables)).round(3)}")


def inliers(root: Path, scenes: Sequence[Path]) -> None:
    """Count matches within 3 px of the true epipolar line in pairs of real images with known poses.

    Each image of mapping/ is paired with the three nearest whose viewing direction is within 60
    degrees. The function prints the number of inliers of all pairs and their share of the matches.
    """
    original: dict[str, object] = {"max_keypoints": 2048}
    night: dict[str, object] = {
        **original,
        "descriptor_weights": str(root / "xfeat-night.safetensors"),
    }
    weights = str(root / "xfeat-night-superglue.safetensors")
    trained: dict[str, object] = {"weights": weights, "match_threshold": 0.05}
    nearest: dict[str, object] = {"max_ratio": 1.0}
    methods = [
        ("original descriptors, mutual nearest neighbours", original, "nn", nearest),
        ("night descriptors, mutual nearest neighbours", night, "nn", nearest),
        ("night descriptors, SuperGlue", night, "superglue", trained),
        ("original descriptors, LighterGlue", original, "lighterglue", {}),
    ]
    rows = []
    for scene in scenes:
        folder = KaptureFolder(scene / "mapping")
        data = folder.read()
        poses = data.poses()
        pairs = _near_pairs(poses)
        for method, features, matcher_name, options in methods:
            extractor = load_plugin(LOCAL_FEATURES, "xfeat", features)
            matcher = load_plugin(MATCHERS, matcher_name, options)
            features_of, num_inliers, num_matches = {}, 0, 0
            for name in sorted({name for pair in pairs for name in pair}):
                image = read_image_rgb(folder.image_path(name))
                local = extractor.extract(image)
                size = image.shape[1], image.shape[0]
                features_of[name] = ImageFeatures(local.keypoints_px, local.descriptors, *size)
            for a, b in pairs:
                matches, _ = matcher.match(features_of[a], features_of[b])
                sides = []
                for name, ids in zip((a, b), matches.T, strict=True):
                    px = features_of[name].keypoints_px[ids, :2].astype(np.float64)
                    rays = normalized_from_px(data.camera_of(name), px)
                    rays = np.column_stack([rays, np.ones(len(rays))])
                    sides += [rays, ray_slopes(data.camera_of(name), px, rays)]
                rays_a, slopes_a, rays_b, slopes_b = sides
                b_from_a = poses[b] @ poses[a].inverse()
                errors = sampson_error_px(rays_a, slopes_a, rays_b, slopes_b, b_from_a)
                num_inliers += int((errors < 3).sum())
                num_matches += len(matches)
            share = num_inliers / max(num_matches, 1)
            rows.append((scene.name, method, len(pairs), num_inliers, share))
            print(rows[-1], flush=True)
    table = pd.DataFrame(rows, columns=["scene", "method", "pairs", "inliers", "share"])
    print(table.to_string(index=False))


def _near_pairs(poses: Mapping[str, RigidTransform]) -> list[tuple[str, str]]:
    names = sorted(poses)
    centres = np.array([poses[name].center() for name in names])
    axes = np.array([poses[name].rotation_matrix()[2] for name in names])
    pairs = set()
    for row, name in enumerate(names):
        distances = np.linalg.norm(centres - centres[row], axis=1)
        distances[(axes @ axes[row] < 0.5) | (distances == 0)] = np.inf
        for other in np.argsort(distances, kind="stable")[:3]:
            if np.isfinite(distances[other]):
                pairs.add((min(name, names[other]), max(name, names[other])))
    return sorted(pairs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=("worlds", "descriptor", "matcher", "evaluate", "inliers"))
    parser.add_argument("--root", type=Path, default=Path("runs") / "train_free")
    parser.add_argument("--worlds", type=int, default=24, help="number of training worlds")
    parser.add_argument("--held-out", type=int, default=2, help="number of held-out worlds")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=list(range(5)), help="twins to evaluate"
    )
    parser.add_argument("--scene", type=Path, nargs="+", default=[], help="scenes to evaluate")
    parser.add_argument("--also", action="append", default=[], metavar="KAPTURE")
    parser.add_argument("--photographs", action="append", default=[], metavar="FOLDER")
    parser.add_argument(
        "--set", action="append", metavar="KEY=VALUE", help="option of megloc train"
    )
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    root = arguments.root
    if arguments.task == "worlds":
        seeds = [TRAINING_SEED + k for k in range(arguments.worlds)]
        seeds += [HELD_OUT_SEED + k for k in range(arguments.held_out)]
        worlds(root, seeds, arguments.workers)
    elif arguments.task == "evaluate":
        evaluate(root, arguments.seeds, arguments.scene, arguments.workers)
    elif arguments.task == "inliers":
        inliers(root, arguments.scene)
    else:
        train(arguments.task, root, arguments)


if __name__ == "__main__":
    main()
