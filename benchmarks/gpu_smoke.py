"""The GPU path in one run: networks and whole runs on a device beside the processor.

    .venv/bin/python benchmarks/gpu_smoke.py --device cuda:0
    .venv/bin/python benchmarks/gpu_smoke.py --device cpu

Weights are random and the scene is rendered, so that no data is needed. Each step is a process of
its own and prints one line; the status is 1 if any of them failed. Half precision is tried
on a GPU only: many processors have no bfloat16.
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
    """A difference from the processor, or something that did not happen."""


def expect(true: bool | np.bool_, words: str) -> None:
    if not true:
        raise Failed(words)


def image_of(seed: int = 0, height: int = HEIGHT, width: int = WIDTH) -> Image:
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3), np.uint8)
    return coarse.repeat(8, axis=0).repeat(8, axis=1)


def made(kind: Any, options: dict[str, Any], device: str, half: bool = False) -> Any:
    wanted = {**options, "device": device, "half_precision": half}
    return kind(kind.Options.model_validate(wanted))


def precisions(device: str) -> tuple[bool, ...]:
    """Return full and half precision; full alone on a processor."""
    return (False,) if device == "cpu" else (False, True)


def same_features(one: LocalFeatures, other: LocalFeatures, half: bool) -> float:
    """Return the share of keypoints that the other has too, with equal descriptors."""
    apart = np.linalg.norm(one.keypoints_px[:, None, :2] - other.keypoints_px[:, :2], axis=2)
    nearest, near = apart.argmin(axis=1), apart.min(axis=1) < (1.0 if half else 0.1)
    cosine = (one.descriptors * other.descriptors[nearest]).sum(axis=1)
    return float((near & (cosine > (0.95 if half else 0.999))).mean())


# --- steps: what is compared, on a device, with files in a folder


def first_use(device: str, place: Path) -> None:
    """Extract with the first thing that a process does on the device."""
    megloc("extract-local", "-i", place / "scene" / "mapping", "-o", place / "first", *RUN[:4],
           "--device", device, "--executor", "inline", "-f")  # fmt: skip


def tf32(device: str, _: Path) -> None:
    """Compute in float32 whatever the host has set, and leave what it has set."""
    products = torch.backends.cuda.matmul
    before = SuperPoint(SuperPoint.Options(device="cpu")).extract(image_of())
    newer = hasattr(products, "fp32_precision")
    name, value = ("fp32_precision", "tf32") if newer else ("allow_tf32", True)
    setattr(products, name, value)
    found = made(SuperPoint, {}, device).extract(image_of())
    expect(same_features(before, found, False) > 0.98, "keypoints differ from float32's")
    expect(getattr(products, name) == value, f"{name} was changed")


def extraction(name: str) -> Callable[[str, Path], None]:
    def step(device: str, _: Path) -> None:
        kind, options = EXTRACTORS[name]
        image, flat = image_of(), np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
        mask = np.ones(image.shape[:2], bool)
        mask[:, :100] = False
        expected = made(kind, options, "cpu").extract_many([image], [mask])[0]
        expect(len(expected.scores) > 20, "the processor has no keypoints")
        for half in precisions(device):
            plugin = made(kind, options, device, half)
            found, _flat = plugin.extract_many([image, flat], [mask, mask])
            share = same_features(expected, found, half)
            expect(share > (0.6 if half else 0.97), f"half={half}: {share:.3f} of keypoints")
            expect(bool((found.keypoints_px[:, 0] >= 100).all()), "keypoints under the mask")
            none = plugin.extract(image, np.zeros_like(mask))
            expect(len(none.scores) == 0, "keypoints without a pixel to use")

    return step


def global_features(name: str) -> Callable[[str, Path], None]:
    def step(device: str, _: Path) -> None:
        kind, options = GLOBAL[name]
        images = [image_of(seed) for seed in range(3)]
        expected = np.concatenate([made(kind, options, "cpu").describe_many([i]) for i in images])
        for half in precisions(device):
            plugin = made(kind, options, device, half)
            alone = plugin.describe_many(images[:1])
            found = np.concatenate([alone, plugin.describe_many(images)])
            cosine = (found * expected[[0, 0, 1, 2]]).sum(axis=1).min()
            expect(cosine > (0.95 if half else 0.9995), f"half={half}: cosine {cosine:.5f}")

    return step


def matching(kind: Any, device: str) -> None:
    rng = np.random.default_rng(0)
    descriptors = rng.normal(size=(1500, 256)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    table = np.column_stack([rng.uniform(1, 600, (1500, 2)), rng.uniform(0.1, 1, 1500)])

    def of(number: int) -> ImageFeatures:
        rows = np.random.default_rng(number).permutation(1500)[:number]
        return ImageFeatures(table[rows].astype(np.float32), descriptors[rows], 640, 480)

    most = 300 if device == "cpu" else 1500
    a, others = of(most), [of(most), of(most // 2), of(1), of(0)]
    options = {"sinkhorn_iterations": 20} if kind is SuperGlue else {}
    expected = made(kind, options, "cpu").match_many(a, others)
    for half in precisions(device):
        plugin = made(kind, options, device, half)
        alone = [plugin.match(a, b) for b in others]
        for found in (alone, plugin.match_many(a, others)):
            for (pairs, _), (true, _) in zip(found, expected, strict=True):
                one, other = ({tuple(row) for row in p.tolist()} for p in (pairs, true))
                enough = (0.9 if half else 0.98) * len(one | other) - 1
                expect(len(one & other) >= enough, f"half={half}: {len(one & other)} equal")


def labels(device: str, _: Path) -> None:
    expected = made(DeepLab, {}, "cpu").segment(image_of())
    for half in precisions(device):
        share = (made(DeepLab, {}, device, half).segment(image_of()) == expected).mean()
        expect(share > (0.9 if half else 0.999), f"half={half}: {share:.4f} of labels")


def image_distance(device: str, _: Path) -> None:
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, :100] = False
    expected = made(LpipsDistance, {}, "cpu").distance(image_of(0), image_of(1), valid)
    for half in precisions(device):
        found = made(LpipsDistance, {}, device, half).distance(image_of(0), image_of(1), valid)
        tolerance = 0.03 if half else 1e-3
        expect(abs(found - expected) < tolerance * expected, f"half={half}: {found}, {expected}")


def memory(device: str, _: Path) -> None:
    """Let batches halve under a limit, and say so where a single image does not fit."""
    plugin, images = made(SuperPoint, {}, device), [image_of(seed) for seed in range(16)]
    sizes: list[int] = []

    def run(batch: Sequence[Image]) -> list[LocalFeatures]:
        sizes.append(len(batch))
        found: list[LocalFeatures] = plugin.extract_many(batch, [None] * len(batch))
        return found

    expected = [found for image in images for found in run([image])]
    if device != "cpu":
        where = torch.device(device)
        total = torch.cuda.get_device_properties(where).total_memory
        alone = torch.cuda.max_memory_allocated(where)
        run(images)
        most = torch.cuda.max_memory_allocated(where)
        torch.cuda.empty_cache()
        torch.cuda.set_per_process_memory_fraction((alone + 0.5 * (most - alone)) / total, where)
        sizes.clear()
        found = in_batches(plugin, "extract_many", run, images, name=str)
        expect(min(sizes) < 16 and len(found) == 16, f"no batch was halved: {sizes}")
        worst = min(same_features(*two, False) for two in zip(expected, found, strict=True))
        expect(worst > 0.97, f"{worst:.3f} of keypoints")
        torch.cuda.empty_cache()
        torch.cuda.set_per_process_memory_fraction(1e-6, where)
    else:

        def run(batch: Sequence[Image]) -> list[LocalFeatures]:
            raise torch.OutOfMemoryError("a limit that nothing fits into")

    try:
        in_batches(plugin, "extract_many", run, images, name=str)
    except MeglocError as error:
        expect("not enough memory" in str(error), str(error))
    else:
        raise Failed("no error without memory")


def training(device: str, place: Path) -> None:
    """Interrupt a training, go on, and end where an uninterrupted one does."""
    options = TrainingOptions.model_validate(
        {"features": {"name": "superpoint"}, "steps": 4, "layers": 2, "pairs_per_step": 1,
         "max_keypoints": 40, "check_every": 2, "held_out_pairs": 2, "device": device,
         "max_size_px": 200}
    )  # fmt: skip
    folders = [KaptureFolder(place / "scene" / "mapping")]

    def track(items: Iterable[Any], total: int, label: str) -> Iterator[Any]:
        for number, item in enumerate(items):
            if label.startswith("training") and number == 3:
                raise KeyboardInterrupt
            yield item

    whole, parts = (place / name / "x.safetensors" for name in ("whole", "parts"))
    train(options, whole, kaptures=folders)
    with suppress(KeyboardInterrupt):
        train(options, parts, kaptures=folders, work=Work(track=track))
    train(options, parts, kaptures=folders)
    expected, resumed = load_file(whole), load_file(parts)
    for key, value in expected.items():
        apart = float((resumed[key].float() - value.float()).abs().max())
        expect(apart < 1e-3, f"{key}: weights are {apart:.1e} apart")


def neural_field(device: str, place: Path) -> None:
    """Train a field, render along the map, and refine poses with four workers."""
    mapping, field, query = place / "scene" / "mapping", place / "field", place / "scene" / "query"
    kind = "cpu" if device == "cpu" else "cuda"
    megloc("train-field", "-i", mapping, "-o", field, "--steps", "6", "--max-side", "40",
           "--held-out-every", "0", "--device", kind, "-f")  # fmt: skip
    megloc("render", field, "--along", mapping, "--max-side", "32", "-o", place / "views",
           "--workers", "2", "-f")  # fmt: skip
    views = KaptureFolder(place / "views").read().image_names()
    expect(len(views) == len(KaptureFolder(mapping).read().image_names()), "views are missing")
    localized = place / "run-processes"
    expect(localized.is_dir(), "the step eval-processes has no result to refine")
    chosen = f'[{{name="field",options={{field="{field}",max_side_px=80,device="{kind}"}}}}]'
    megloc("refine-poses", "-i", localized / "map", "--query", query, "--poses",
           localized / "localized", "-o", place / "refined", "--by", "field", "--set",
           f"pose_refinement.by={chosen}", "--workers", "4", "-f")  # fmt: skip


def evaluation(executor: str) -> Callable[[str, Path], None]:
    def step(device: str, place: Path) -> None:
        expected, workspace = place / "run-cpu", place / f"run-{executor}"
        for folder, how, where in (
            (expected, "inline", "cpu"),
            (workspace, executor, device),
        ):
            megloc("eval", "kapture", "--root", place / "scene", "--workspace", folder, *RUN,
                   "--executor", how, "--device", where)  # fmt: skip
        poses, true = (
            KaptureFolder(folder / "localized").read().poses() for folder in (workspace, expected)
        )
        expect(len(true) > 0, "the processor localizes nothing")
        expect(len(set(poses) ^ set(true)) <= 1, f"{len(poses)} localized, not {len(true)}")
        away = [
            np.linalg.norm(poses[n].center() - true[n].center()) for n in set(poses) & set(true)
        ]
        expect(float(np.median(away)) < 0.05, f"poses are {np.median(away):.3f} m away")

    return step


def threads(device: str, place: Path) -> None:
    """Localize from four threads as from one."""
    options = options_of_preset("classic", assignments=RUN[1::2])
    given: Any = {"preset": "classic", "options": None}
    if device == "cpu":
        given = {"options": options}
    else:
        more = [f"local_features.xfeat.options.device={device}"]
        given = {"options": options_of_preset("classic", assignments=[*RUN[1::2], *more])}
    localizer = Localizer(KaptureMap.open(place / "run-processes" / "map"), **given)
    folder = KaptureFolder(place / "scene" / "query")
    data = folder.read()
    queries = [(folder.image_path(n), data.camera_of(n)) for n in data.image_names()] * 2
    alone = [localizer.localize(*query) for query in queries]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda query: localizer.localize(*query), queries))
    equal = sum(bool(one) == bool(two) for one, two in zip(alone, together, strict=True))
    expect(equal == len(queries), f"{equal} of {len(queries)} as from one thread")


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
    """Run the command beside this Python."""
    command = [str(Path(sys.executable).with_name("megloc")), *map(str, arguments), "-q"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise Failed(f"megloc {arguments[0]}: {done.stderr.strip()[-600:]}")


def run_step(name: str, device: str, place: Path) -> tuple[bool, str]:
    """Run a step in a process of its own; whether it succeeded, and the last line it printed."""
    command = [sys.executable, __file__, "--step", name, "--device", device, "--folder", str(place)]
    environment = {**os.environ, "MEGLOC_WEIGHTS": str(place / "weights")}
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=900)
    except subprocess.TimeoutExpired:
        return False, "it took more than 900 s"
    lines = done.stderr.strip().splitlines()
    return done.returncode == 0, lines[-1] if lines else f"status {done.returncode}"


def main() -> None:
    """Write weights and scene, run the steps, and print one line for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda:0", help="cpu or cuda:N")
    parser.add_argument("--step", action="append", choices=STEPS, help="only this; repeatable")
    parser.add_argument("--folder", type=Path, help="that a step in this process works in")
    options = parser.parse_args()
    if options.folder is not None:
        for name in options.step:
            STEPS[name](options.device, options.folder)
        return
    failed = 0
    with tempfile.TemporaryDirectory(prefix="megloc-gpu-smoke-") as temporary:
        place, began = Path(temporary), time.perf_counter()
        write_random_weights(
            place / "weights" / UNVERIFIED, sizes=SMALL, names=[*_WRITERS, *FREE_NETWORKS]
        )
        write_scene(place / "scene", with_depth=True)
        print(
            f"{'weights and scene':20s} written  {time.perf_counter() - began:6.1f} s", flush=True
        )
        for name in options.step or STEPS:
            start = time.perf_counter()
            succeeded, words = run_step(name, options.device, place)
            told = "ok" if succeeded else f"failed: {words}"
            print(f"{name:20s} {time.perf_counter() - start:6.1f} s  {told}", flush=True)
            failed += not succeeded
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
