"""ALIKED, XFeat and LighterGlue on a GPU beside a processor: equal matches, images and pairs/s.

    MEGLOC_WEIGHTS=DIR .venv/bin/python benchmarks/speed/gpu.py --scene DIR

Real weights and photographs. Of neighbouring map images, the matches of ALIKED (mutual nearest
neighbours) and of LighterGlue on XFeat, found on the processor in float32, on the GPU in float32,
and on the GPU in half precision; the Jaccard index of the sets of matches, where a keypoint is the
same within 0.5 px. Then recall of ``megloc eval kapture`` with ALIKED, both ways, and SuperGlue's
scores on peaky random weights (superpoint_superglue.py). ``--device cpu`` compares the processor
with itself and in bfloat16, to try the script where there is no GPU.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS, load_plugin
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
    if device == "cuda":
        torch.cuda.synchronize()
    return results, (time.perf_counter() - started) / len(items)


def extract(
    name: str, images: list[Image], device: str, half: bool
) -> tuple[list[LocalFeatures], float]:
    """Features of all images with plugin ``name``, and seconds per image."""
    extractor = load_plugin(LOCAL_FEATURES, name, {"device": device, "half_precision": half})
    return seconds_each(extractor.extract, images, device)


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
    return "half" if half else "float32"


def recall(scene: Path, device: str, half: bool, workspace: Path) -> str:
    """Recall of a whole run with ALIKED."""
    program = str(Path(sys.executable).with_name("megloc"))
    chosen = {"device": device, "half_precision": str(half).lower()}
    sets = [
        "local_features=aliked",
        *(f"local_features.options.{k}={v}" for k, v in chosen.items()),
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
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--no-recall", action="store_true", help="leave the two whole runs out")
    options = parser.parse_args()
    if options.device == "cuda" and not torch.cuda.is_available():
        sys.exit("there is no GPU that torch can use; --device cpu tries the script")
    folder = KaptureFolder(options.scene / "mapping")
    names = folder.read().image_names()[: options.images]
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
    if options.device == "cuda":
        glue = Path(__file__).with_name("superpoint_superglue.py")
        subprocess.run([sys.executable, str(glue), "--device", "cuda"], check=True)


if __name__ == "__main__":
    main()
