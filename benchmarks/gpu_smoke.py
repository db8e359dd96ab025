"""Smoke test of a device: compare networks and whole runs with the CPU.

    .venv/bin/python benchmarks/gpu_smoke.py --device cuda:0
    .venv/bin/python benchmarks/gpu_smoke.py --device cpu

Weights are random and the scene is rendered, so no data are needed. Each step runs in a separate
process and prints one line; the exit status is 1 if any step fails. Half precision is tested on a
GPU only, because many CPUs do not support bfloat16.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from whole_preset_weights import _WRITERS, FREE_NETWORKS, Sizes, write_random_weights

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.errors import MeglocError
from megloc_kapture.features import global_networks
from megloc_kapture.features.aliked import Aliked
from megloc_kapture.features.aslfeat import AslFeat
from megloc_kapture.features.kornia_features import Disk, XFeat
from megloc_kapture.features.r2d2 import R2D2
from megloc_kapture.features.superpoint import SuperPoint
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.weights import UNVERIFIED
from megloc_kapture.localization.lpips import LpipsDistance
from megloc_kapture.matching.networks import LightGlue, SuperGlue
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.preprocessing.deeplab import DeepLab
from megloc_kapture.stages.work import Work, in_batches
from megloc_kapture.training.train import TrainingOptions, train
from megloc_kapture.values import ImageFeatures, LocalFeatures

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "rendering"))
from corner import write_scene  # type: ignore[import-not-found]  # noqa: E402

Image = NDArray[np.uint8]
HEIGHT, WIDTH = 160, 224
SMALL = Sizes(clusters=4, whitened=32, hidden=8)
EXTRACTORS: dict[str, tuple[Any, dict[str, Any]]] = {
    "superpoint": (SuperPoint, {}),
    "aslfeat": (AslFeat, {}),
    "aliked": (Aliked, {"threshold": 0.0}),
    "r2d2": (R2D2, {"min_size": 160, "max_size": 224}),
    "xfeat": (XFeat, {}),
    "disk": (Disk, {}),
}
GLOBAL: dict[str, tuple[Any, dict[str, Any]]] = {
    "netvlad": (global_networks.NetVlad, {}),
    "openibl": (global_networks.OpenIbl, {"max_size_px": 224}),
    "apgem": (global_networks.ApGem, {}),
    "delg": (global_networks.Delg, {}),
    "megaloc": (global_networks.MegaLoc, {"size_px": 224}),
}
RUN = (
    *("--set", 'local_features=["xfeat"]', "--set", "local_features.xfeat.matching.name=nn"),
    *("--set", 'global_features=["netvlad"]', "--set", "global_features.netvlad.name=netvlad"),
    *("--set", "local_features.xfeat.options.max_keypoints=500"),
)


class Failed(Exception):
    """A result differs from the CPU result, or is missing."""


def expect(condition: bool | np.bool_, message: str) -> None:
    if not condition:
        raise Failed(message)


def image_of(seed: int = 0, height: int = HEIGHT, width: int = WIDTH) -> Image:
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3), np.uint8)
    return coarse.repeat(8, axis=0).repeat(8, axis=1)


def build(kind: Any, options: dict[str, Any], device: str, half: bool = False) -> Any:
    options = {**options, "device": device, "half_precision": half}
    return kind(kind.Options.model_validate(options))


def precisions(device: str) -> tuple[bool, ...]:
    """Return the tested values of ``half_precision``."""
    return (False,) if device == "cpu" else (False, True)


def same_features(a: LocalFeatures, b: LocalFeatures, half: bool) -> float:
    """Return the share of keypoints of ``a`` with an equal keypoint and descriptor in ``b``."""
    distance_px = np.linalg.norm(a.keypoints_px[:, None, :2] - b.keypoints_px[:, :2], axis=2)
    nearest, near = distance_px.argmin(axis=1), distance_px.min(axis=1) < (1.0 if half else 0.1)
    cosine = (a.descriptors * b.descriptors[nearest]).sum(axis=1)
    return float((near & (cosine > (0.95 if half else 0.999))).mean())


# --- steps: functions of a device and a working folder


def first_use(device: str, folder: Path) -> None:
    """Extract features in a process that has not used the device before."""
    megloc("extract-local", "-i", folder / "scene" / "mapping", "-o", folder / "first", *RUN[:4],
           "--device", device, "--executor", "inline", "-f")  # fmt: skip


def tf32(device: str, _: Path) -> None:
    """Compute in float32 even if TF32 is enabled, and do not change that setting."""
    matmul = torch.backends.cuda.matmul
    expected = SuperPoint(SuperPoint.Options(device="cpu")).extract(image_of())
    has_precision = hasattr(matmul, "fp32_precision")
    name, value = ("fp32_precision", "tf32") if has_precision else ("allow_tf32", True)
    setattr(matmul, name, value)
    features = build(SuperPoint, {}, device).extract(image_of())
    expect(same_features(expected, features, False) > 0.98, "keypoints differ from float32")
    expect(getattr(matmul, name) == value, f"{name} was changed")


def extraction(name: str) -> Callable[[str, Path], None]:
    def step(device: str, _: Path) -> None:
        kind, options = EXTRACTORS[name]
        image, flat = image_of(), np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
        mask = np.ones(image.shape[:2], bool)
        mask[:, :100] = False
        expected = build(kind, options, "cpu").extract_many([image], [mask])[0]
        expect(len(expected.scores) > 20, "no keypoints on the CPU")
        for half in precisions(device):
            plugin = build(kind, options, device, half)
            features, _flat = plugin.extract_many([image, flat], [mask, mask])
            share = same_features(expected, features, half)
            expect(share > (0.6 if half else 0.97), f"half={half}: {share:.3f} of keypoints agree")
            expect(
                bool((features.keypoints_px[:, 0] >= 100).all()), "keypoints in the masked region"
            )
            features = plugin.extract(image, np.zeros_like(mask))
            expect(len(features.scores) == 0, "keypoints in a fully masked image")

    return step


def global_features(name: str) -> Callable[[str, Path], None]:
    def step(device: str, _: Path) -> None:
        kind, options = GLOBAL[name]
        images = [image_of(seed) for seed in range(3)]
        expected = np.concatenate([build(kind, options, "cpu").describe_many([i]) for i in images])
        for half in precisions(device):
            plugin = build(kind, options, device, half)
            single = plugin.describe_many(images[:1])
            vectors = np.concatenate([single, plugin.describe_many(images)])
            cosine = (vectors * expected[[0, 0, 1, 2]]).sum(axis=1).min()
            expect(cosine > (0.95 if half else 0.9995), f"half={half}: cosine {cosine:.5f}")

    return step


def matching(kind: Any, device: str) -> None:
    rng = np.random.default_rng(0)
    descriptors = rng.normal(size=(1500, 256)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    table = np.column_stack([rng.uniform(1, 600, (1500, 2)), rng.uniform(0.1, 1, 1500)])

    def features(count: int) -> ImageFeatures:
        rows = np.random.default_rng(count).permutation(1500)[:count]
        return ImageFeatures(table[rows].astype(np.float32), descriptors[rows], 640, 480)

    count = 300 if device == "cpu" else 1500
    a, others = features(count), [features(n) for n in (count, count // 2, 1, 0)]
    options = {"sinkhorn_iterations": 20} if kind is SuperGlue else {}
    expected = build(kind, options, "cpu").match_many(a, others)
    for half in precisions(device):
        plugin = build(kind, options, device, half)
        single = [plugin.match(a, b) for b in others]
        for results in (single, plugin.match_many(a, others)):
            for (matches, _), (reference, _) in zip(results, expected, strict=True):
                ours, cpu = ({tuple(row) for row in p.tolist()} for p in (matches, reference))
                minimum = (0.9 if half else 0.98) * len(ours | cpu) - 1
                expect(len(ours & cpu) >= minimum, f"half={half}: {len(ours & cpu)} matches agree")


def labels(device: str, _: Path) -> None:
    expected = build(DeepLab, {}, "cpu").segment(image_of())
    for half in precisions(device):
        share = (build(DeepLab, {}, device, half).segment(image_of()) == expected).mean()
        expect(share > (0.9 if half else 0.999), f"half={half}: {share:.4f} of labels agree")


def image_distance(device: str, _: Path) -> None:
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, :100] = False
    expected = build(LpipsDistance, {}, "cpu").distance(image_of(0), image_of(1), valid)
    for half in precisions(device):
        distance = build(LpipsDistance, {}, device, half).distance(image_of(0), image_of(1), valid)
        tolerance = 0.03 if half else 1e-3
        expect(
            abs(distance - expected) < tolerance * expected, f"half={half}: {distance}, {expected}"
        )


def memory(device: str, _: Path) -> None:
    """Halve batches under a memory limit; report an error if one image does not fit."""
    plugin, images = build(SuperPoint, {}, device), [image_of(seed) for seed in range(16)]
    sizes: list[int] = []

    def run(batch: Sequence[Image]) -> list[LocalFeatures]:
        sizes.append(len(batch))
        features: list[LocalFeatures] = plugin.extract_many(batch, [None] * len(batch))
        return features

    expected = [features for image in images for features in run([image])]
    if device != "cpu":
        cuda = torch.device(device)
        total = torch.cuda.get_device_properties(cuda).total_memory
        single = torch.cuda.max_memory_allocated(cuda)
        run(images)
        batched = torch.cuda.max_memory_allocated(cuda)
        torch.cuda.empty_cache()
        torch.cuda.set_per_process_memory_fraction((single + batched) / 2 / total, cuda)
        sizes.clear()
        features = in_batches(plugin, "extract_many", run, images, name=str)
        expect(min(sizes) < 16 and len(features) == 16, f"no batch was halved: {sizes}")
        worst = min(same_features(*two, False) for two in zip(expected, features, strict=True))
        expect(worst > 0.97, f"{worst:.3f} of keypoints agree")
        torch.cuda.empty_cache()
        torch.cuda.set_per_process_memory_fraction(1e-6, cuda)
    else:

        def run(batch: Sequence[Image]) -> list[LocalFeatures]:
            raise torch.OutOfMemoryError("simulated memory limit")

    try:
        in_batches(plugin, "extract_many", run, images, name=str)
    except MeglocError as error:
        expect("not enough memory" in str(error), str(error))
    else:
        raise Failed("no error under a limit below one image")


def training(device: str, folder: Path) -> None:
    """Resume an interrupted training and compare the weights with an uninterrupted one."""
    options = TrainingOptions.model_validate(
        {"features": {"name": "superpoint"}, "steps": 4, "layers": 2, "pairs_per_step": 1,
         "max_keypoints": 40, "check_every": 2, "held_out_pairs": 2, "device": device,
         "max_size_px": 200}
    )  # fmt: skip
    folders = [KaptureFolder(folder / "scene" / "mapping")]

    def track(items: Iterable[Any], total: int, label: str) -> Iterator[Any]:
        for number, item in enumerate(items):
            if label.startswith("training") and number == 3:
                raise KeyboardInterrupt
            yield item

    whole, parts = (folder / name / "x.safetensors" for name in ("whole", "parts"))
    train(options, whole, kaptures=folders)
    with suppress(KeyboardInterrupt):
        train(options, parts, kaptures=folders, work=Work(track=track))
    train(options, parts, kaptures=folders)
    expected, resumed = load_file(whole), load_file(parts)
    for key, value in expected.items():
        difference = float((resumed[key].float() - value.float()).abs().max())
        expect(difference < 1e-3, f"{key}: weights differ by {difference:.1e}")


def neural_field(device: str, folder: Path) -> None:
    """Train a field, render along the map trajectory and refine poses with four workers."""
    scene, field = folder / "scene", folder / "field"
    mapping, query = scene / "mapping", scene / "query"
    kind = "cpu" if device == "cpu" else "cuda"
    megloc("train-field", "-i", mapping, "-o", field, "--steps", "6", "--max-side", "40",
           "--held-out-every", "0", "--device", kind, "-f")  # fmt: skip
    megloc("render", field, "--along", mapping, "--max-side", "32", "-o", folder / "views",
           "--workers", "2", "-f")  # fmt: skip
    views = KaptureFolder(folder / "views").read().image_names()
    expect(len(views) == len(KaptureFolder(mapping).read().image_names()), "views are missing")
    run = folder / "run-processes"
    expect(run.is_dir(), "no poses to refine: the step eval-processes has not run")
    refiner = f'[{{name="field",options={{field="{field}",max_side_px=80,device="{kind}"}}}}]'
    megloc("refine-poses", "-i", run / "map", "--query", query, "--poses",
           run / "localized", "-o", folder / "refined", "--by", "field", "--set",
           f"pose_refinement.by={refiner}", "--workers", "4", "-f")  # fmt: skip


def evaluation(executor: str) -> Callable[[str, Path], None]:
    def step(device: str, folder: Path) -> None:
        scene = folder / "scene"
        workspaces = (folder / "run-cpu", folder / f"run-{executor}")
        for workspace, *options in zip(
            workspaces, ("inline", executor), ("cpu", device), strict=True
        ):
            megloc("eval", "kapture", "--root", scene, "--workspace", workspace, *RUN,
                   "--executor", options[0], "--device", options[1])  # fmt: skip
        expected, poses = (
            KaptureFolder(workspace / "localized").read().poses() for workspace in workspaces
        )
        expect(len(expected) > 0, "no query is localized on the CPU")
        expect(
            len(set(poses) ^ set(expected)) <= 1,
            f"{len(poses)} queries localized, {len(expected)} on the CPU",
        )
        errors_m = [
            np.linalg.norm(poses[name].center() - expected[name].center())
            for name in set(poses) & set(expected)
        ]
        expect(float(np.median(errors_m)) < 0.05, f"poses differ by {np.median(errors_m):.3f} m")

    return step


def threads(device: str, folder: Path) -> None:
    """Compare localization in four threads with localization in one."""
    assignments = list(RUN[1::2])
    if device != "cpu":
        assignments.append(f"local_features.xfeat.options.device={device}")
    options = options_of_preset("classic", assignments=assignments)
    localizer = Localizer(KaptureMap.open(folder / "run-processes" / "map"), options=options)
    query_folder = KaptureFolder(folder / "scene" / "query")
    data = query_folder.read()
    queries = [(query_folder.image_path(n), data.camera_of(n)) for n in data.image_names()] * 2
    expected = [localizer.localize(*query) for query in queries]
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda query: localizer.localize(*query), queries))
    equal = sum(bool(a) == bool(b) for a, b in zip(expected, results, strict=True))
    expect(equal == len(queries), f"{equal} of {len(queries)} results equal those of one thread")


STEPS: dict[str, Callable[[str, Path], None]] = {
    "first-use": first_use,
    "tf32": tf32,
    **{f"extract-{name}": extraction(name) for name in EXTRACTORS},
    **{f"global-{name}": global_features(name) for name in GLOBAL},
    "match-superglue": lambda device, _: matching(SuperGlue, device),
    "match-lightglue": lambda device, _: matching(LightGlue, device),
    "deeplab": labels,
    "lpips": image_distance,
    "memory": memory,
    "train-matcher": training,
    "eval-processes": evaluation("processes"),
    "eval-dask": evaluation("dask"),
    "field": neural_field,
    "localizer-threads": threads,
}


def megloc(*arguments: str | Path) -> None:
    """Run the ``megloc`` command of this environment."""
    command = [str(Path(sys.executable).with_name("megloc")), *map(str, arguments), "-q"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise Failed(f"megloc {arguments[0]}: {done.stderr.strip()[-600:]}")


def run_step(name: str, device: str, folder: Path) -> tuple[bool, str]:
    """Run a step in a separate process; return success and the last line of its output."""
    command = [
        sys.executable,
        __file__,
        "--step",
        name,
        "--device",
        device,
        "--folder",
        str(folder),
    ]
    environment = {**os.environ, "MEGLOC_WEIGHTS": str(folder / "weights")}
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=900)
    except subprocess.TimeoutExpired:
        return False, "timed out after 900 s"
    lines = done.stderr.strip().splitlines()
    return done.returncode == 0, lines[-1] if lines else f"status {done.returncode}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda:0", help="cpu or cuda:N")
    parser.add_argument(
        "--step", action="append", choices=STEPS, help="run only this step; repeatable"
    )
    parser.add_argument("--folder", type=Path, help="run the steps in this process and folder")
    options = parser.parse_args()
    if options.folder is not None:
        for name in options.step:
            STEPS[name](options.device, options.folder)
        return
    failed = 0
    with tempfile.TemporaryDirectory(prefix="megloc-gpu-smoke-") as temporary:
        folder, start = Path(temporary), time.perf_counter()
        write_random_weights(
            folder / "weights" / UNVERIFIED, sizes=SMALL, names=[*_WRITERS, *FREE_NETWORKS]
        )
        write_scene(folder / "scene", with_depth=True)
        print(
            f"{'weights and scene':20s} written  {time.perf_counter() - start:6.1f} s", flush=True
        )
        for name in options.step or STEPS:
            start = time.perf_counter()
            succeeded, message = run_step(name, options.device, folder)
            status = "ok" if succeeded else f"failed: {message}"
            print(f"{name:20s} {time.perf_counter() - start:6.1f} s  {status}", flush=True)
            failed += not succeeded
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
