"""Depth by multi-view stereo on the rendered world, whose depth is exact, by class of surface.

    .venv/bin/python benchmarks/mvs_twin.py -o OUT [--by sweep] [--seed 0]

A pixel is of one class, the first that fits: ``none``: nothing is there (sky), or the bonnet;
``thin``: what is nearer than what is around it and narrower than 9 pixels; ``textureless``: the
grey values of 7x7 pixels deviate by less than 2 of 255; ``ground``: within 15 cm of the plane that
the mapping rig drives on; ``facade``: all else, facades and what stands before them. Of ``none``
all that is filled is wrong. The table is printed, and kept as OUT/classes-NAME.txt.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from megloc_twins.synthetic_kapture import RIG_HEIGHT_M
from mvs import densified_map, depth_of
from numpy.typing import NDArray
from scenes import megloc  # which knows the way to timing
from timing import table

from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.files import link_records
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.mvs.views import AgreementOptions
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import DEPTH_ESTIMATORS
from megloc_kapture.stages.scene import depth_records, read_depth
from megloc_kapture.stages.stereo_depth import read_beside

CLASSES = ("facade", "ground", "thin", "textureless", "none")
_THIN_PX, _NEARER, _FLAT, _GROUND_M = 9, 0.02, 2.0, 0.15


def classes_of(
    truth: NDArray[np.float32], grey: NDArray[np.float32], height_m: NDArray[np.float64]
) -> NDArray[np.int64]:
    """The class of each pixel (H, W), a position in :data:`CLASSES`."""
    inverse = np.where(truth > 0, 1 / np.where(truth > 0, truth, 1), 0).astype(np.float32)
    opened = cv2.morphologyEx(inverse, cv2.MORPH_OPEN, np.ones((_THIN_PX, _THIN_PX), np.uint8))
    mean, square = (cv2.boxFilter(g, cv2.CV_64F, (7, 7)) for g in (grey, grey * grey))
    found = np.where(np.abs(height_m) < _GROUND_M, 1, 0)
    found[np.sqrt(np.maximum(square - mean * mean, 0)) < _FLAT] = 3
    found[inverse - opened > _NEARER * inverse] = 2
    found[truth == 0] = 4
    return found


def measure(world: Path, out: Path, name: str) -> str:
    """The table of an estimator."""
    exact = KaptureFolder(world / "mapping")
    data, records = exact.read(), depth_records(exact.read())
    bare = out / "mapping"
    if not bare.is_dir():
        write_sensors(bare, replace(data, records_depth={}))
        link_records(bare, {"": exact.root / "sensors/records_data"})
    estimator = load_plugin(DEPTH_ESTIMATORS, name, {})
    densified, row = densified_map(bare, out, estimator, name, AgreementOptions())
    parts: list[list[NDArray[np.float64]]] = [[] for _ in CLASSES]
    total = 0
    # of a world with one place
    ground_z = float(np.median([pose.center()[2] for pose in data.poses().values()])) - RIG_HEIGHT_M
    for image in sorted(depth_records(densified.read())):
        camera, depth = depth_of(densified, image)
        record, pose = records[image], data.poses()[image]
        stored = read_depth(exact, record)
        nearest = cv2.resize(stored, depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
        truth = np.asarray(nearest, np.float32)
        grey = cv2.cvtColor(read_image_rgb(exact.image_path(image)), cv2.COLOR_RGB2GRAY)
        small = cv2.resize(grey, depth.shape[::-1], interpolation=cv2.INTER_AREA)
        grid = np.stack(np.meshgrid(*map(np.arange, depth.shape[::-1])), axis=-1) + 0.5
        rays = bearing_rays(camera, grid.reshape(-1, 2))
        in_camera = rays / rays[:, 2:] * truth.reshape(-1, 1)
        height_m = pose.inverse().apply(in_camera)[:, 2].reshape(depth.shape) - ground_z
        sigma = read_beside(densified.root, image, "sigma")
        assert sigma is not None
        of = classes_of(truth, small.astype(np.float32), height_m)
        total += of.size
        for number, rows in enumerate(parts):
            mine = of == number
            rows.append(np.stack([depth[mine], truth[mine], sigma[mine]]).astype(np.float64))
    lines: list[tuple[str, ...]] = [
        ("class", "share", "filled", "within 1 %", "within 3 %", "median", "below 1 sigma")
    ]
    for label, rows in zip(CLASSES, parts, strict=True):
        depth_m, truth_m, sigma_m = np.concatenate(rows, axis=1)
        known = depth_m > 0
        shares = [f"{len(known) / total:.3f}", f"{known.mean():.3f}" if len(known) else "-"]
        if label == "none" or not known.any():
            lines.append((label, *shares, "-", "-", "-", "-"))
            continue
        off = np.abs(depth_m - truth_m)[known]
        relative = off / truth_m[known]
        told = [f"{np.mean(relative < limit):.3f}" for limit in (0.01, 0.03)]
        told += [f"{100 * np.median(relative):.2f} %", f"{np.mean(off < sigma_m[known]):.2f}"]
        lines.append((label, *shares, *told))
    return f"{name}, {row['seconds_per_image']:.1f} s per image\n{table(lines)}\n"


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--by", nargs="+", default=["sweep"], help="estimators")
    parser.add_argument("--seed", type=int, default=0, help="another seed is another world")
    asked = parser.parse_args()
    world = asked.output / f"world-{asked.seed}"
    if not world.is_dir():
        sets = [part for one in ("depth=true", "num_places=1") for part in ("--set", one)]
        megloc("synth", "-o", str(world), "--seed", str(asked.seed), *sets)
    for name in asked.by:
        with single_threaded():
            told = measure(world, asked.output / f"twin-{asked.seed}", name)
        print(told, flush=True)
        (asked.output / f"classes-{name}.txt").write_text(told)


if __name__ == "__main__":
    main()
