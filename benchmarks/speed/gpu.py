"""Networks on a GPU or a processor: batches beside the peers' loops, equal matches, items/s.

    MEGLOC_WEIGHTS=DIR .venv/bin/python benchmarks/speed/gpu.py --scene DIR [--device cpu]

Real weights and photographs. First local features of map images and matches of neighbours, as the
peers' loops make them (hloc's extract_features and match_features: one image, one pair at a time,
each read, computed and written before the next) and as the stages do with batches of 1, 4, 8 and as
many as fit: items per second, processor seconds per item, share of the time that the device waits,
peak memory, and how far results are from those of the loop. Then, of neighbouring images, matches
of ALIKED (mutual nearest neighbours) and of LighterGlue on XFeat found on the processor in float32,
on the device in float32, and in half precision; the Jaccard index of the sets of matches, where a
keypoint is the same within 0.5 px. Then recall of ``megloc eval kapture`` with ALIKED, both ways,
and SuperGlue's scores on peaky random weights (superpoint_superglue.py). ``--device cpu`` compares
the processor with itself and in bfloat16, and shows what batches cost where there is no GPU.
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
    """What a matcher gets of an image's features."""
    height, width = image.shape[:2]
    return ImageFeatures(features.keypoints_px, features.descriptors, width, height)


def renamed(features: LocalFeatures, reference: LocalFeatures) -> NDArray[np.int64]:
    """Of each keypoint the row of the same one in ``reference``; -1, -2, ... where it has none."""
    tree = cKDTree(reference.keypoints_px[:, :2])
    distance, row = tree.query(features.keypoints_px[:, :2], distance_upper_bound=SAME_PX)
    return np.where(np.isfinite(distance), row, -1 - np.arange(len(distance)))


def jaccard(found: list[Matches], reference: list[Matches]) -> float:
    """Of the matches of all pairs."""
    sets = [
        {(pair, *row) for pair, matches in enumerate(each) for row in matches.tolist()}
        for each in (found, reference)
    ]
    return len(sets[0] & sets[1]) / max(len(sets[0] | sets[1]), 1)


def seconds_each(
    call: Callable[[Any], Any], items: list[Any], device: str
) -> tuple[list[Any], float]:
    """Results, and seconds per item after one call to warm up."""
    call(items[0])
    started = time.perf_counter()
    results = [call(item) for item in items]
    if device != "cpu":
        torch.cuda.synchronize(device)
    return results, (time.perf_counter() - started) / len(items)


def extract(
    name: str, images: list[Image], device: str, half: bool
) -> tuple[list[LocalFeatures], float]:
    """Features of all images with plugin ``name``, and seconds per image."""
    extractor = load_plugin(LOCAL_FEATURES, name, {"device": device, "half_precision": half})
    return seconds_each(extractor.extract, images, device)


class Clocked:
    """A plugin, and the seconds in which its device computes; its calls end with a copy to here."""

    def __init__(self, plugin: Any) -> None:
        self.plugin, self.busy_s, self.calls = plugin, 0.0, 0

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.plugin, name)
        if name not in ("extract", "extract_many", "match", "match_many"):
            return found

        def timed(*arguments: Any) -> Any:
            started = time.perf_counter()
            result = found(*arguments)
            self.busy_s += time.perf_counter() - started
            self.calls += 1
            return result

        return timed


@dataclass(frozen=True)
class Measured:
    """One way to do all items."""

    wall_s: float
    cpu_s: float
    waits: float  # share of the time
    peak_mib: float
    calls: int


def measured(plugin: Clocked, run: Callable[[], object], device: str) -> Measured:
    """Seconds, and the peak of memory: of the GPU, or of this process so far."""
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
    """The peers' loop over images."""
    name: str = extractor.name
    writers: list[FeatureWriter] = []
    for image in folder.read().image_names():
        found = extractor.extract(read_image_rgb(folder.image_path(image)))
        arrays = {"keypoints": found.keypoints_px, "descriptors": found.descriptors}
        if not writers:
            for kind, array in arrays.items():
                of_keypoints = {"keypoints_type": name, "metric_type": "L2"}
                more = of_keypoints if kind == "descriptors" else {}
                config = FeatureConfig(name, array.dtype, array.shape[1], **more)
                writers.append(FeatureWriter(output, kind, name, config, orphan=True))  # type: ignore[arg-type]
        for writer, array in zip(writers, arrays.values(), strict=True):
            writer.write(image, array)


def matching_loop(
    folder: KaptureFolder, matcher: Any, name: str, pairs: list[ImagePair], output: Path
) -> None:
    """The peers' loop over pairs: features are read for each."""
    writer = MatchesWriter(output, name, orphan=True)

    def read(image: str) -> ImageFeatures:
        camera = folder.read().camera_of(image)
        arrays = folder.keypoints(name).read(image), folder.descriptors(name).read(image)
        return ImageFeatures(*arrays, camera.width, camera.height)

    for pair in pairs:
        writer.write(pair.query, pair.map, *matcher.match(read(pair.query), read(pair.map)))


def files_below(folder: Path) -> dict[str, bytes]:
    """Their contents by relative path."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix not in (".csv", ".txt")
    }


def difference(folder: Path, reference: Path, name: str, images: KaptureFolder) -> str:
    """In words: of local features, or of matches where there are any."""
    ours, theirs = files_below(folder), files_below(reference)
    if ours == theirs:
        return "same bytes"
    a, b = (KaptureFolder(images.root, features_dirs=[each]) for each in (folder, reference))
    if a.types("matches"):
        both = [
            (x.read(*pair), y.read(*pair))
            for x, y in [(a.matches(name), b.matches(name))]
            for pair in y.pairs
        ]
        other = sum(not np.array_equal(x[0], y[0]) for x, y in both)
        same = [(x[1], y[1]) for x, y in both if len(x[1]) == len(y[1])]
        most = max((float(np.abs(x - y).max(initial=0)) for x, y in same), default=0.0)
        return f"other matches in {other} of {len(both)} pairs, scores by {most:.0e}"
    moved = total = alike = 0.0
    for image in images.read().image_names():
        x, y = (each.keypoints(name).read(image)[:, :2] for each in (a, b))
        distance, _ = cKDTree(y).query(x)
        near = distance < SAME_PX
        alike, total = alike + near.sum(), total + max(len(x), len(y))
        moved = max(moved, float(distance[near].max(initial=0)))
    return f"{alike:.0f} of {total:.0f} keypoints, moved by {moved:.0e} px"


def throughput(scene: Path, names: list[str], device: str) -> list[tuple[str, ...]]:
    """Loops and batches: features of two kinds, and matches of each."""
    header = ("what", "how", "calls", "per s", "CPU s each", "waits", "peak MiB", "to the loop")
    rows: list[tuple[str, ...]] = [header]
    cuda_or_cpu = device.partition(":")[0]
    most = devices.MOST_AT_ONCE[cuda_or_cpu]
    sizes = (1, 4, 8) if device == "cpu" else (1, 4, 8, most)
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
            for what, plugin, run, number in (*steps, (matches, matcher, matching, len(pairs))):
                reference = loop if what == features else root / f"{matches}-loop"
                for batch in (0, *sizes):
                    devices.MOST_AT_ONCE[cuda_or_cpu] = max(batch, 1)
                    out = root / f"{what}-{batch}" if batch else reference
                    found = measured(plugin, lambda: run(out, batch), device)  # noqa: B023
                    rows.append(
                        (
                            what,
                            f"at most {batch}" if batch else "loop",
                            str(found.calls),
                            f"{number / found.wall_s:.2f}",
                            f"{found.cpu_s / number:.3f}",
                            f"{100 * found.waits:.0f} %",
                            f"{found.peak_mib:.0f}",
                            difference(out, reference, name, folder) if batch else "",
                        )
                    )
    devices.MOST_AT_ONCE[cuda_or_cpu] = most
    return rows


def subset(scene: Path, names: list[str], target: Path) -> Path:
    """A kapture folder of some images of a scene's map."""
    source = KaptureFolder(scene / "mapping")
    data = source.read()
    keep = set(names)
    data.records_camera = {k: v for k, v in data.records_camera.items() if v in keep}
    for name in names:
        place = target / "sensors" / "records_data" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(source.image_path(name).resolve())
    write_sensors(target, data)
    return target


def rows_of(name: str, images: list[Image], device: str) -> list[tuple[str, ...]]:
    """ALIKED with nearest neighbours: features and matches by device."""
    nearest = load_plugin(MATCHERS, "nn")
    kinds = [("cpu", False), (device, False), (device, True)]
    reference: list[LocalFeatures] = []
    true: list[Matches] = []
    rows: list[tuple[str, ...]] = []
    for where, half in kinds:
        features, seconds = extract(name, images, where, half)
        ready = [for_matcher(*each) for each in zip(features, images, strict=True)]
        matches = [nearest.match(a, b)[0] for a, b in zip(ready, ready[1:], strict=False)]
        if not reference:
            reference, true = features, matches
        names = [renamed(*each) for each in zip(features, reference, strict=True)]
        found = [
            np.stack([names[k][m[:, 0]], names[k + 1][m[:, 1]]], axis=1)
            for k, m in enumerate(matches)
        ]
        index = jaccard(found, true)
        rows.append(
            (f"{name}, nn", where, _kind(half), f"{1 / seconds:.1f} images/s", f"{index:.4f}")
        )
    return rows


def matcher_rows(images: list[Image], device: str) -> list[tuple[str, ...]]:
    """LighterGlue on the same features of XFeat by device."""
    features, _ = extract("xfeat", images, "cpu", False)
    ready = [for_matcher(*each) for each in zip(features, images, strict=True)]
    pairs = list(zip(ready, ready[1:], strict=False))
    rows: list[tuple[str, ...]] = []
    true: list[Matches] = []
    for where, half in [("cpu", False), (device, False), (device, True)]:
        matcher = load_plugin(MATCHERS, "lighterglue", {"device": where, "half_precision": half})
        results, seconds = seconds_each(lambda pair: matcher.match(*pair)[0], pairs, where)  # noqa: B023
        true = true or results
        index = jaccard(results, true)
        speed = f"{1 / seconds:.1f} pairs/s"
        rows.append(("xfeat, lighterglue", where, _kind(half), speed, f"{index:.4f}"))
    return rows


def _kind(half: bool) -> str:
    return "half" if half else "full"


def recall(scene: Path, device: str, half: bool, workspace: Path) -> str:
    """Recall of a whole run with ALIKED."""
    program = str(Path(sys.executable).with_name("megloc"))
    chosen = {"device": device, "precision": _kind(half)}
    sets = [
        "local_features=aliked",
        *(f"{k}={v}" for k, v in chosen.items()),
    ]
    arguments = [part for text in sets for part in ("--set", text)]
    places = ["--root", str(scene), "--workspace", str(workspace), "--executor", "inline"]
    subprocess.run([program, "eval", "kapture", *places, *arguments, "-q"], check=True)
    found = json.loads((workspace / "stages" / "evaluation.json").read_text())["counts"]
    return " / ".join(f"{100 * v:.1f}" for key, v in found.items() if key.startswith("recall"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=lambda text: Path(text).resolve(), required=True)
    parser.add_argument("--images", type=int, default=30)
    parser.add_argument("--device", default="cuda", help="cpu, cuda or cuda:N")
    parser.add_argument("--no-recall", action="store_true", help="leave the two whole runs out")
    options = parser.parse_args()
    if options.device != "cpu" and not torch.cuda.is_available():
        sys.exit("there is no GPU that torch can use; --device cpu tries the script")
    folder = KaptureFolder(options.scene / "mapping")
    names = folder.read().image_names()[: options.images]
    print(table(throughput(options.scene, names, options.device)))
    images = [read_image_rgb(folder.image_path(name)) for name in names]
    header = ("what", "device", "precision", "speed", "Jaccard index with cpu, float32")
    rows = rows_of("aliked", images, options.device) + matcher_rows(images, options.device)
    print(table([header, *rows]))
    if not options.no_recall:
        with tempfile.TemporaryDirectory(prefix="megloc-gpu-") as temporary:
            for device, half in (("cpu", False), (options.device, True)):
                place = Path(temporary) / f"{device}-{_kind(half)}"
                print(
                    f"recall, {device}, {_kind(half)}: {recall(options.scene, device, half, place)}"
                )
    if options.device != "cpu":
        glue = Path(__file__).with_name("superpoint_superglue.py")
        subprocess.run([sys.executable, str(glue), "--device", options.device], check=True)


if __name__ == "__main__":
    main()
