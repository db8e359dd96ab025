"""Local features x scenes: recall, median errors, seconds per image and per pair.

    .venv/bin/python benchmarks/features.py --scene DIR --scene DIR -o features.csv
    .venv/bin/python benchmarks/features.py --read features.csv

Every row is ``megloc eval kapture`` with the same options but for features and matcher; retrieval
is VLAD over the row's own features. A scene is a folder with mapping/, query/ and query_gt/ in
kapture, or with map/ instead of mapping/, of which only images and poses are used. Rows whose
weights are absent are named and left out (``megloc weights list``). Seconds are processor time of
one thread, of three images and their pairs, without verification. A seed changes all that draws
random numbers, as in scenes.py; figures are means over the seeds, with the least and the greatest.
Arguments that are not known here go to ``megloc eval``.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from scenes import SEEDED, THRESHOLDS  # which knows the way to timing
from timing import table

from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.values import ImageFeatures

LIGHTGLUE = ("matching.name=lightglue", "matching.options.weights=aliked_lightglue")
LIGHTERGLUE = ("matching.name=lighterglue",)
SUPERGLUE = ("local_features.superpoint.matching.name=superglue",)


def _aliked_2048(threshold: float) -> tuple[str, ...]:
    return (
        "local_features=aliked",
        f"local_features.options.threshold={threshold:g}",
        "local_features.options.max_keypoints=2048",
    )


ROWS: dict[str, tuple[str, ...]] = {
    "rootsift nn": ("local_features=rootsift",),
    "aliked-t16 nn": ("local_features=aliked", "local_features.options.weights=aliked-t16"),
    "aliked-n16 nn": ("local_features=aliked",),
    **{f"aliked-n16 (2048 above {t:g}) nn": _aliked_2048(t) for t in (0.2, 0.05, 0.01, 0.0)},
    "aliked-n16 (2048 above 0.05) lightglue": (*_aliked_2048(0.05), *LIGHTGLUE),
    "aliked-n16rot nn": ("local_features=aliked", "local_features.options.weights=aliked-n16rot"),
    "aliked-n32 nn": ("local_features=aliked", "local_features.options.weights=aliked-n32"),
    "aliked-n16 lightglue": ("local_features=aliked", *LIGHTGLUE),
    "xfeat nn": ("local_features=xfeat",),
    "xfeat lighterglue": ("local_features=xfeat", *LIGHTERGLUE),
    "r2d2_WASF_N16 nn": ("local_features=r2d2",),
    "aliked-n16 nn + xfeat nn": ('local_features=["aliked", "xfeat"]',),
    "aliked-n16 nn + xfeat lighterglue": (
        'local_features=["aliked", "xfeat"]',
        "local_features.xfeat.matching.name=lighterglue",
    ),
    "superpoint superglue": ('local_features=["superpoint"]', *SUPERGLUE),
    "aslfeat nn": ("local_features=aslfeat", "matching.options.max_ratio=0.8"),
    "superpoint superglue + aslfeat nn": (
        'local_features=["superpoint", "aslfeat"]',
        *SUPERGLUE,
    ),
}
_REFUSED = 2
_TIMED_IMAGES = 3


def as_dataset(scene: Path, folder: Path) -> Path:
    """The scene with a mapping/ folder; a map's images and poses are copied into ``folder``."""
    if (scene / "mapping").is_dir():
        return scene
    if not folder.is_dir():
        shutil.copytree(scene / "map" / "sensors", folder / "mapping" / "sensors")
        for part in ("query", "query_gt"):
            shutil.copytree(scene / part / "sensors", folder / part / "sensors")
    return folder


def measure(
    scene: Path, name: str, seed: int, workspace: Path, workers: int, arguments: Sequence[str]
) -> dict[str, float | str] | str:
    """One row of a scene with one seed, or why there is none."""
    program = str(Path(sys.executable).with_name("megloc"))
    places = ("--root", str(scene), "--workspace", str(workspace), "--workers", str(workers))
    texts = (*ROWS[name], *(f"{key}={seed}" for key in SEEDED))
    sets = [part for text in texts for part in ("--set", text)]
    done = subprocess.run(
        [program, "eval", "kapture", *places, *sets, *arguments, "-q"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode == _REFUSED and "megloc weights" in done.stderr:
        return done.stderr.strip()
    if done.returncode != 0:
        sys.exit(f"{name}: {done.stderr.strip()}")
    features, points = (
        json.loads((workspace / "stages" / f"{stage}.json").read_text())["counts"]
        for stage in ("local_features", "points")
    )
    rows = pd.read_csv(workspace / "evaluation" / "per_query.csv")
    error_m, error_deg = (
        rows[column].fillna(np.inf) for column in ("position_error_m", "angle_error_deg")
    )
    per_image_s, per_pair_s = processor_seconds(scene, name)
    return {
        "scene": scene.name,
        "features": name,
        "seed": seed,
        **{
            f"{m:g} m, {deg:g} deg": 100.0 * float(((error_m <= m) & (error_deg <= deg)).mean())
            for m, deg in THRESHOLDS
        },
        "median m": float(error_m.median()),
        "median deg": float(error_deg.median()),
        "keypoints": features["keypoints"] / features["images"],
        "points": points["points"],
        "s per image": per_image_s,
        "ms per pair": 1e3 * per_pair_s,
    }


@cache
def processor_seconds(scene: Path, name: str) -> tuple[float, float]:
    """Of one image and of one pair, on one thread."""
    options = options_of_preset(assignments=ROWS[name])
    folder = KaptureFolder(scene / "mapping")
    paths = [folder.image_path(image) for image in folder.read().image_names()[:_TIMED_IMAGES]]
    images = [read_image_rgb(path) for path in paths]
    per_image = per_pair = 0.0
    with single_threaded():
        for extractor in options.make_extractors():
            matcher = options.make_matcher(extractor.name)
            found = [extractor.extract(image) for image in images[:1]]  # loads the network
            started = time.process_time()
            found += [extractor.extract(image) for image in images[1:]]
            per_image += (time.process_time() - started) / (len(images) - 1)
            ready = [
                ImageFeatures(f.keypoints_px, f.descriptors, image.shape[1], image.shape[0])
                for f, image in zip(found, images, strict=True)
            ]
            matcher.match(ready[0], ready[0])
            started = time.process_time()
            for a, b in zip(ready, ready[1:], strict=False):
                matcher.match(a, b)
            per_pair += (time.process_time() - started) / (len(ready) - 1)
    return per_image, per_pair


_DIGITS = {"median m": 4, "median deg": 3, "s per image": 2, "ms per pair": 0, "points": 0}


def printed(results: pd.DataFrame) -> str:
    """The rows as text: means over the seeds, with the least and the greatest where they differ."""
    figures = [column for column in results.columns if column not in ("scene", "features", "seed")]
    rows = [("scene", "features", "seeds", *figures)]
    for (scene, features), of_row in results.groupby(["scene", "features"], sort=False):
        cells = (_over_seeds(of_row[column], _DIGITS.get(column, 1)) for column in figures)
        rows.append((str(scene), str(features), str(len(of_row)), *cells))
    return table(rows)


def _over_seeds(values: pd.Series[float], digits: int) -> str:
    mean, least, greatest = (f"{v:.{digits}f}" for v in (values.mean(), values.min(), values.max()))
    return mean if least == greatest else f"{mean} ({least}-{greatest})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=lambda text: Path(text).resolve(), action="append")
    parser.add_argument("--only", action="append", choices=ROWS, help="a row; may be repeated")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--workspace", type=Path, help="keep the runs here")
    parser.add_argument("--read", type=Path, help="a result written before, instead of scenes")
    parser.add_argument("-o", "--output", type=Path, help="write the rows here as CSV")
    options, arguments = parser.parse_known_args()
    if (options.read is None) == (options.scene is None):
        parser.error("give scenes or --read")
    if options.read is not None:
        print(printed(pd.read_csv(options.read)))
        return
    names = options.only or list(ROWS)
    found: list[dict[str, float | str]] = []
    absent: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="megloc-features-") as temporary:
        root = options.workspace or Path(temporary)
        for scene in options.scene:
            dataset = as_dataset(scene, root / "scenes" / scene.name)
            for name in names:
                place = root / f"{scene.name}-{name.replace(' ', '-')}"
                for seed in options.seeds:
                    row = measure(dataset, name, seed, place, options.workers, arguments)
                    if isinstance(row, str):
                        absent[name] = row
                        break
                    found.append(row)
                    if options.output is not None:
                        pd.DataFrame(found).to_csv(options.output, index=False)
    if found:
        print(printed(pd.DataFrame(found)))
    for name, reason in absent.items():
        print(f"left out: {name}: {reason}")


if __name__ == "__main__":
    main()
