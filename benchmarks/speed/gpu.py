"""Throughput and agreement of networks on a GPU or CPU, batched and one item at a time.

    MEGLOC_WEIGHTS=DIR .venv/bin/python benchmarks/speed/gpu.py --scene DIR [--device cpu]

Uses real weights and photographs, in three parts:

1. Local features of map images and matches of neighbouring images, computed by a loop as in hloc's
   extract_features and match_features (read, compute and write one item at a time) and by the
   stages with batches of 1, 4, 8 and the default size: items per second, CPU seconds per item,
   share of the time in which the device is idle, peak memory, difference from the loop's results.
2. Matches of neighbouring images with ALIKED (mutual nearest neighbours) and XFeat with LighterGlue
   in float32 on the CPU, in float32 on the device and in half precision on the device: Jaccard
   index of the sets of matches. Keypoints within 0.5 px are considered equal.
3. Recall of ``megloc eval kapture`` with ALIKED on the CPU and in half precision on the device.

On a GPU, superpoint_superglue.py runs last. ``--device cpu`` compares the CPU with itself and with
bfloat16, and shows the cost of batches without a GPU.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    write_sensors,
)
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS
from megloc_kapture.stages import work as devices
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.values import ImageFeatures, LocalFeatures

sys.path.append(str(Path(__file__).resolve().parent))
from timing import table  # noqa: E402

SAME_PX = 0.5
Image = NDArray[np.uint8]
Matches = NDArray[np.int64]


def for_matcher(features: LocalFeatures, image: Image) -> ImageFeatures:
    height, width = image.shape[:2]
    return ImageFeatures(features.keypoints_px, features.descriptors, width, height)


def renamed(features: LocalFeatures, reference: LocalFeatures) -> NDArray[np.int64]:
    """Return the row of each keypoint in ``reference``, or a unique negative number."""
    tree = cKDTree(reference.keypoints_px[:, :2])
    distance, row = tree.query(features.keypoints_px[:, :2], distance_upper_bound=SAME_PX)
    return np.where(np.isfinite(distance), row, -1 - np.arange(len(distance)))


def jaccard(matches: list[Matches], reference: list[Matches]) -> float:
    """Return the Jaccard index of the matches of all pairs."""
    a, b = (
        {(pair, *row) for pair, array in enumerate(arrays) for row in array.tolist()}
        for arrays in (matches, reference)
    )
    return len(a & b) / max(len(a | b), 1)


def seconds_each(
    call: Callable[[Any], Any], items: list[Any], device: str
) -> tuple[list[Any], float]:
    """Return the results and the seconds per item, after one call to warm up."""
    call(items[0])
    started = time.perf_counter()
    results = [call(item) for item in items]
    if device != "cpu":
        torch.cuda.synchronize(device)
    return results, (time.perf_counter() - started) / len(items)


def extract(
    name: str, images: list[Image], device: str, half: bool
) -> tuple[list[LocalFeatures], float]:
    """Extract features with the plugin ``name``; return them and the seconds per image."""
    extractor = load_plugin(LOCAL_FEATURES, name, {"device": device, "half_precision": half})
    return seconds_each(extractor.extract, images, device)


class Clocked:
    """A plugin with a timer; each call ends with a copy to the CPU and is thus synchronous."""

    def __init__(self, plugin: Any) -> None:
        self.plugin, self.busy_s, self.calls = plugin, 0.0, 0

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self.plugin, name)
        if name not in ("extract", "extract_many", "match", "match_many"):
            return attribute

        def timed(*arguments: Any) -> Any:
            started = time.perf_counter()
            result = attribute(*arguments)
            self.busy_s += time.perf_counter() - started
            self.calls += 1
            return result

        return timed


@dataclass(frozen=True)
class Measured:
    """Measurements of processing all items."""

    wall_s: float
    cpu_s: float
    idle: float  # share of the wall time in which the device is idle
    peak_mib: float
    calls: int


def measured(plugin: Clocked, run: Callable[[], object], device: str) -> Measured:
    """Measure a run. Peak memory is that of the GPU, or on a CPU of the process so far."""
    plugin.busy_s, plugin.calls = 0.0, 0
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats(device)
    started, cpu = time.perf_counter(), time.process_time()
    run()
    wall_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if device != "cpu":
        peak = torch.cuda.max_memory_allocated(device)
    return Measured(wall_s, cpu_s, 1 - plugin.busy_s / wall_s, peak / 2**20, plugin.calls)


def extraction_loop(folder: KaptureFolder, extractor: Any, output: Path) -> None:
    """Extract features as hloc does, one image at a time."""
    name: str = extractor.name
    writers: list[FeatureWriter] = []
    for image in folder.read().image_names():
        features = extractor.extract(read_image_rgb(folder.image_path(image)))
        arrays = {"keypoints": features.keypoints_px, "descriptors": features.descriptors}
        if not writers:
            for kind, array in arrays.items():
                descriptors = {"keypoints_type": name, "metric_type": "L2"}
                options = descriptors if kind == "descriptors" else {}
                config = FeatureConfig(name, array.dtype, array.shape[1], **options)
                writers.append(FeatureWriter(output, kind, name, config, orphan=True))  # type: ignore[arg-type]
        for writer, array in zip(writers, arrays.values(), strict=True):
            writer.write(image, array)


def matching_loop(
    folder: KaptureFolder, matcher: Any, name: str, pairs: list[ImagePair], output: Path
) -> None:
    """Match as hloc does, one pair at a time, reading the features of each pair."""
    writer = MatchesWriter(output, name, orphan=True)

    def read(image: str) -> ImageFeatures:
        camera = folder.read().camera_of(image)
        arrays = folder.keypoints(name).read(image), folder.descriptors(name).read(image)
        return ImageFeatures(*arrays, camera.width, camera.height)

    for pair in pairs:
        writer.write(pair.query, pair.map, *matcher.match(read(pair.query), read(pair.map)))


def files_below(folder: Path) -> dict[str, bytes]:
    """Return the content of binary files by relative path."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix not in (".csv", ".txt")
    }


def difference(folder: Path, reference: Path, name: str, images: KaptureFolder) -> str:
    """Describe the difference of two folders of matches, or else of local features."""
    ours, theirs = files_below(folder), files_below(reference)
    if ours == theirs:
        return "same bytes"
    a, b = (KaptureFolder(images.root, features_dirs=[path]) for path in (folder, reference))
    if a.types("matches"):
        both = [
            (x.read(*pair), y.read(*pair))
            for x, y in [(a.matches(name), b.matches(name))]
            for pair in y.pairs
        ]
        differ = sum(not np.array_equal(x[0], y[0]) for x, y in both)
        scores = [(x[1], y[1]) for x, y in both if len(x[1]) == len(y[1])]
        worst = max((float(np.abs(x - y).max(initial=0)) for x, y in scores), default=0.0)
        return f"matches differ in {differ} of {len(both)} pairs, scores by {worst:.0e}"
    moved = total = equal = 0.0
    for image in images.read().image_names():
        x, y = (side.keypoints(name).read(image)[:, :2] for side in (a, b))
        distance, _ = cKDTree(y).query(x)
        near = distance < SAME_PX
        equal, total = equal + near.sum(), total + max(len(x), len(y))
        moved = max(moved, float(distance[near].max(initial=0)))
    return f"{equal:.0f} of {total:.0f} keypoints equal, moved by {moved:.0e} px"


def throughput(scene: Path, names: list[str], device: str) -> list[tuple[str, ...]]:
    """Measure the loop and batches with two kinds of features and their matchers."""
    header = ("plugin", "batch", "calls", "per s", "CPU s each", "idle", "peak MiB", "versus loop")
    rows: list[tuple[str, ...]] = [header]
    device_type = device.partition(":")[0]
    default_batch = devices.MOST_AT_ONCE[device_type]
    sizes = (1, 4, 8) if device == "cpu" else (1, 4, 8, default_batch)
    kinds: list[tuple[str, str, dict[str, Any]]] = [
        ("xfeat", "lighterglue", {}),
        ("aliked", "lightglue", {"weights": "aliked_lightglue"}),
    ]
    with tempfile.TemporaryDirectory(prefix="megloc-gpu-") as temporary:
        root = Path(temporary)
        folder = KaptureFolder(subset(scene, names, root / "images"))
        pairs = [ImagePair(a, b, 1.0) for k, a in enumerate(names) for b in names[k + 1 : k + 9]]
        for features, matches, options in kinds:
            weights = {"weights": "aliked-n16rot"} if features == "aliked" else {}
            extractor = Clocked(
                load_plugin(LOCAL_FEATURES, features, {**weights, "device": device})
            )
            matcher = Clocked(load_plugin(MATCHERS, matches, {**options, "device": device}))
            name = extractor.name
            loop = root / f"{name}-loop"
            described = KaptureFolder(folder.root, features_dirs=[loop])
            extractor.extract(read_image_rgb(folder.image_path(names[0])))  # loads the network

            def extracting(
                out: Path, batch: int, extractor: Clocked = extractor, loop: Path = loop
            ) -> None:
                if batch:
                    extract_local_features([folder], extractor, out)
                else:
                    extraction_loop(folder, extractor, out)

            def matching(
                out: Path, batch: int, matcher: Clocked = matcher, name: str = name,
                described: KaptureFolder = described,
            ) -> None:  # fmt: skip
                if batch:
                    match_pairs(described, described, pairs, name, matcher, None, out)
                else:
                    matching_loop(described, matcher, name, pairs, out)

            steps = ((features, extractor, extracting, len(names)),)
            for step, plugin, run, number in (*steps, (matches, matcher, matching, len(pairs))):
                reference = loop if step == features else root / f"{matches}-loop"
                for batch in (0, *sizes):
                    devices.MOST_AT_ONCE[device_type] = max(batch, 1)
                    out = root / f"{step}-{batch}" if batch else reference
                    result = measured(plugin, lambda: run(out, batch), device)  # noqa: B023
                    rows.append(
                        (
                            step,
                            f"at most {batch}" if batch else "loop",
                            str(result.calls),
                            f"{number / result.wall_s:.2f}",
                            f"{result.cpu_s / number:.3f}",
                            f"{100 * result.idle:.0f} %",
                            f"{result.peak_mib:.0f}",
                            difference(out, reference, name, folder) if batch else "",
                        )
                    )
    devices.MOST_AT_ONCE[device_type] = default_batch
    return rows


def subset(scene: Path, names: list[str], target: Path) -> Path:
    """Write a kapture folder with some of a scene's map images."""
    source = KaptureFolder(scene / "mapping")
    data = source.read()
    keep = set(names)
    data.records_camera = {k: v for k, v in data.records_camera.items() if v in keep}
    for name in names:
        link = target / "sensors" / "records_data" / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(source.image_path(name).resolve())
    write_sensors(target, data)
    return target


def aliked_rows(images: list[Image], device: str) -> list[tuple[str, ...]]:
    """Compare ALIKED with nearest neighbours by device and precision."""
    nearest = load_plugin(MATCHERS, "nn")
    reference: list[LocalFeatures] = []
    reference_matches: list[Matches] = []
    rows: list[tuple[str, ...]] = []
    for used_device, half in [("cpu", False), (device, False), (device, True)]:
        features, seconds = extract("aliked", images, used_device, half)
        inputs = [for_matcher(*item) for item in zip(features, images, strict=True)]
        matches = [nearest.match(a, b)[0] for a, b in zip(inputs, inputs[1:], strict=False)]
        if not reference:
            reference, reference_matches = features, matches
        ids = [renamed(*item) for item in zip(features, reference, strict=True)]
        renamed_matches = [
            np.stack([ids[k][m[:, 0]], ids[k + 1][m[:, 1]]], axis=1) for k, m in enumerate(matches)
        ]
        index = jaccard(renamed_matches, reference_matches)
        speed = f"{1 / seconds:.1f} images/s"
        rows.append(("aliked, nn", used_device, _kind(half), speed, f"{index:.4f}"))
    return rows


def matcher_rows(images: list[Image], device: str) -> list[tuple[str, ...]]:
    """Compare LighterGlue by device and precision on the same XFeat features."""
    features, _ = extract("xfeat", images, "cpu", False)
    inputs = [for_matcher(*item) for item in zip(features, images, strict=True)]
    pairs = list(zip(inputs, inputs[1:], strict=False))
    rows: list[tuple[str, ...]] = []
    reference: list[Matches] = []
    for used_device, half in [("cpu", False), (device, False), (device, True)]:
        matcher = load_plugin(
            MATCHERS, "lighterglue", {"device": used_device, "half_precision": half}
        )
        results, seconds = seconds_each(lambda pair: matcher.match(*pair)[0], pairs, used_device)  # noqa: B023
        reference = reference or results
        index = jaccard(results, reference)
        speed = f"{1 / seconds:.1f} pairs/s"
        rows.append(("xfeat, lighterglue", used_device, _kind(half), speed, f"{index:.4f}"))
    return rows


def _kind(half: bool) -> str:
    return "half" if half else "full"


def recall(scene: Path, device: str, half: bool, workspace: Path) -> str:
    """Measure the recall of a whole run with ALIKED."""
    program = str(Path(sys.executable).with_name("megloc"))
    assignments = ["local_features=aliked", f"device={device}", f"precision={_kind(half)}"]
    arguments = [part for text in assignments for part in ("--set", text)]
    folders = ["--root", str(scene), "--workspace", str(workspace), "--executor", "inline"]
    subprocess.run([program, "eval", "kapture", *folders, *arguments, "-q"], check=True)
    counts = json.loads((workspace / "stages" / "evaluation.json").read_text())["counts"]
    return " / ".join(f"{100 * v:.1f}" for key, v in counts.items() if key.startswith("recall"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=lambda text: Path(text).resolve(), required=True)
    parser.add_argument("--images", type=int, default=30)
    parser.add_argument("--device", default="cuda", help="cpu, cuda or cuda:N")
    parser.add_argument("--no-recall", action="store_true", help="skip the two whole runs")
    options = parser.parse_args()
    if options.device != "cpu" and not torch.cuda.is_available():
        sys.exit("torch has no GPU; use --device cpu")
    folder = KaptureFolder(options.scene / "mapping")
    names = folder.read().image_names()[: options.images]
    print(table(throughput(options.scene, names, options.device)))
    images = [read_image_rgb(folder.image_path(name)) for name in names]
    header = ("plugins", "device", "precision", "speed", "Jaccard index to cpu, float32")
    rows = aliked_rows(images, options.device) + matcher_rows(images, options.device)
    print(table([header, *rows]))
    if not options.no_recall:
        with tempfile.TemporaryDirectory(prefix="megloc-gpu-") as temporary:
            for device, half in (("cpu", False), (options.device, True)):
                workspace = Path(temporary) / f"{device}-{_kind(half)}"
                shares = recall(options.scene, device, half, workspace)
                print(f"recall, {device}, {_kind(half)}: {shares}")
    if options.device != "cpu":
        glue = Path(__file__).with_name("superpoint_superglue.py")
        subprocess.run([sys.executable, str(glue), "--device", options.device], check=True)


if __name__ == "__main__":
    main()
