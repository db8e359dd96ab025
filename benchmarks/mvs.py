"""Depth by multi-view stereo: how right it is, how much of an image it fills, what it costs.

    .venv/bin/python benchmarks/mvs.py --data DIR -o OUT [--by sweep ppg]
        [--scenes fountain_p11 herzjesu_p25 hololens_room motorcycle] [--ppg-python PYTHON]

DIR/SCENE has mapping/, query/ and query_gt/ in kapture. fountain_p11 and herzjesu_p25 (Strecha et
al., CVPR 2008): truth are tracks over all photographs, those held out included, with surveyed
poses: at least 4 views, at least one of them outside the image and its sources, every residual
below 0.8 px. Rephotography (Waechter et al., TOG 2017): held-out photographs predicted from the
depth, ZNCC of 7x7 above 0.5, as a share of all their pixels and of those that are predicted.
hololens_room: the sensor's depth. motorcycle: structured light (Middlebury 2014), from an installed
scikit-image. ``ppg`` is the PatchMatch of the package pyarchinit-photogrammetry-core, run by the
interpreter of an environment of its own. One row per scene and estimator is printed, and appended
to OUT/mvs.csv.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import megloc_kapture as megloc
from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.warping import WarpSource, warp_to_view
from megloc_kapture.io.files import link_records
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, write_sensors
from megloc_kapture.io.tables import read_depth_rows
from megloc_kapture.mvs.views import AgreementOptions, confirmed, pinhole_matrix, stereo_view
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import (
    DEPTH_ESTIMATORS,
    DepthEstimate,
    DepthEstimator,
    PluginChoice,
    StereoView,
)
from megloc_kapture.stages.densifying import DensifyOptions, densify_map
from megloc_kapture.stages.scene import depth_records, read_depth
from megloc_kapture.stages.stereo_depth import read_beside
from megloc_kapture.values import Camera, RigidTransform

_SIZE = 768
_MIN_VIEWS, _MAX_RESIDUAL_PX = 4, 0.8
_PPG = """
import sys, numpy as np, ppg_core
d = np.load(sys.argv[1])
src = [(d[f"i{k}"], tuple(d[f"k{k}"]), d[f"r{k}"], d[f"t{k}"]) for k in range(int(d["n"]))]
z, n, c = ppg_core.patchmatch_depth(d["ref"], tuple(d["k"]), src, tuple(d["z"]))
np.savez(sys.argv[2], depth=z, normals=n, cost=c)
"""


class PpgPatchMatch:
    """Slanted PatchMatch of another package, in an environment of its own."""

    def __init__(self, python: str) -> None:
        self.python = python

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        """Depth as of the package's defaults; a deviation of 1 % stands for none."""
        arrays: dict[str, Any] = {
            "ref": _grey(reference.image) / 255,
            "k": _pinhole(reference.camera),
            "z": depth_range_m,
            "n": len(sources),
        }
        for k, source in enumerate(sources):
            relative = source.cam_from_world @ reference.cam_from_world.inverse()
            arrays |= {
                f"i{k}": _grey(source.image) / 255,
                f"k{k}": _pinhole(source.camera),
                f"r{k}": relative.rotation_matrix(),
                f"t{k}": np.array(relative.translation),
            }
        with tempfile.TemporaryDirectory() as folder:
            given, made = Path(folder, "in.npz"), Path(folder, "out.npz")
            np.savez(given, **arrays)
            subprocess.run([self.python, "-c", _PPG, str(given), str(made)], check=True)
            with np.load(made) as found:
                depth = np.nan_to_num(found["depth"].astype(np.float32))
                normals = found["normals"].astype(np.float32)
        return DepthEstimate(depth, 0.01 * depth, normals)


def _grey(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.float32)


def _pinhole(camera: Camera) -> tuple[float, ...]:
    matrix = pinhole_matrix(camera)
    return matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]


# --------------------------------------------------------------------------------------- truth


def tracks(scene: Path, out: Path) -> tuple[NDArray[np.float64], dict[str, list[int]]]:
    """Surveyed points (N, 3), and of every photograph the rows of those it sees."""
    folders = [KaptureFolder(scene / name) for name in ("mapping", "query", "query_gt")]
    given, asked, truth = (folder.read() for folder in folders)
    everything = KaptureData(
        sensors={**given.sensors, **asked.sensors},
        rigs={**given.rigs, **asked.rigs},
        trajectories={**given.trajectories, **truth.trajectories},
        records_camera={**given.records_camera, **asked.records_camera},
    )
    root = out / "all"
    if not root.is_dir():
        write_sensors(root, everything)
        images = {
            name: folder.image_path(name).resolve()
            for folder, data in zip(folders, (given, asked), strict=False)
            for name in data.image_names()
        }
        link_records(root, images)
    changes = {"local_features.options.max_keypoints": 8000}
    megloc.build_map(root, set=changes, workspace=out / "all-map")
    found = KaptureFolder(out / "all-map" / "map")
    data, xyz = found.read(), found.points3d()[:, :3]
    poses = data.poses()
    counts, worst = np.zeros(len(xyz), int), np.zeros(len(xyz))
    seen: dict[str, list[int]] = {}
    for local_type, observed in found.observations().items():
        for row, name in enumerate(observed.image_names):
            own = observed.image_ids == row
            points = observed.point_ids[own]
            keypoints = found.keypoints(local_type).read(name)[observed.keypoint_ids[own], :2]
            px = project(data.camera_of(name), poses[name], xyz[points])
            np.maximum.at(worst, points, np.linalg.norm(px - keypoints, axis=1))
            np.add.at(counts, points, 1)
            seen[name] = points.tolist()
    good = (counts >= _MIN_VIEWS) & (worst < _MAX_RESIDUAL_PX)
    return xyz, {name: [p for p in points if good[p]] for name, points in seen.items()}


# ------------------------------------------------------------------------------------ measures


def track_errors(
    densified: KaptureFolder, xyz: NDArray[np.float64], seen: dict[str, list[int]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors in depth (N,), NaN without, and the deviations (N,) that were claimed."""
    data = densified.read()
    poses, records = data.poses(), depth_records(data)
    viewers: dict[int, set[str]] = {}
    for name, points in seen.items():
        for point in points:
            viewers.setdefault(point, set()).add(name)
    errors, deviations = [np.zeros(0)], [np.zeros(0)]
    for row in read_depth_rows(densified.root / "reconstruction" / "depth.csv"):
        used = {row.image, *row.sources}
        own = xyz[[p for p in seen.get(row.image, ()) if viewers[p] - used]]
        if row.image not in records or not len(own):
            continue
        camera, depth = depth_of(densified, row.image)
        sigma = read_beside(densified.root, row.image, "sigma")
        assert sigma is not None
        z = poses[row.image].apply(own)[:, 2]
        found, claimed = _at(depth, sigma, project(camera, poses[row.image], own))
        errors.append(found - z)
        deviations.append(claimed)
    return np.concatenate(errors), np.concatenate(deviations)


def _at(
    depth: NDArray[np.float32], sigma: NDArray[np.float32], px: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depth at pixels (N, 2), between the four around them where they are of one surface."""
    height, width = depth.shape
    column, row = np.floor(px).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    nearest = depth[row, column].astype(float)
    left, top = (np.clip(np.floor(v - 0.5).astype(int), 0, n - 2) for v, n in
                 zip(px.T, (width, height), strict=True))  # fmt: skip
    corners = np.stack([depth[top + i, left + j] for i in (0, 1) for j in (0, 1)]).astype(float)
    across, down = px[:, 0] - 0.5 - left, px[:, 1] - 0.5 - top
    weights = np.stack(
        [(1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down]
    )
    low, high = corners.min(0), corners.max(0)
    smooth = inside & (low > 0) & (high < 1.1 * np.maximum(low, 1e-9))
    with np.errstate(divide="ignore", invalid="ignore"):
        between = 1 / (weights / corners).sum(0)
    found = np.where(smooth, between, nearest)
    known = inside & (nearest > 0)
    return np.where(known, found, np.nan), np.where(known, sigma[row, column], np.nan)


def depth_of(folder: KaptureFolder, image: str) -> tuple[Camera, NDArray[np.float32]]:
    """The camera and the depth (H, W) of an image."""
    record = depth_records(folder.read())[image]
    return record.camera, read_depth(folder, record)


def rephotography(densified: KaptureFolder, scene: Path) -> tuple[float, float]:
    """Share of held-out photographs' pixels that are explained, and of those predicted."""
    data = densified.read()
    poses = data.poses()
    images = sorted(depth_records(data))
    sources = {}
    for image in images:
        camera, depth = depth_of(densified, image)
        pixels = read_image_rgb(densified.image_path(image))
        view = stereo_view(pixels, data.camera_of(image), poses[image], None, _SIZE)
        sources[image] = WarpSource(view.image, camera, poses[image], depth, camera)
    asked, truth = KaptureFolder(scene / "query"), KaptureFolder(scene / "query_gt").read().poses()
    explained = predicted = total = 0
    for name, pose in truth.items():
        shown = read_image_rgb(asked.image_path(name))
        view = stereo_view(shown, asked.read().camera_of(name), pose, None, _SIZE)
        near = sorted(
            images, key=lambda image: float(np.linalg.norm(poses[image].center() - pose.center()))
        )
        warped = warp_to_view([sources[image] for image in near[:4]], view.camera, pose)
        score, whole = _zncc(_grey(view.image), _grey(warped.image), warped.valid)
        explained += int((score[whole] > 0.5).sum())
        predicted += int(whole.sum())
        total += whole.size
    return explained / total, explained / max(predicted, 1)


def _zncc(
    a: NDArray[np.float32], b: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Correlation of 7x7 windows, and where the window is whole."""

    def mean(x: NDArray[Any]) -> NDArray[np.float64]:
        return np.asarray(cv2.boxFilter(x.astype(np.float64), cv2.CV_64F, (7, 7)), np.float64)

    both = mean(a * b) - mean(a) * mean(b)
    spread = (mean(a * a) - mean(a) ** 2) * (mean(b * b) - mean(b) ** 2)
    return both / np.sqrt(np.maximum(spread, 1e-6)), mean(valid.astype(float)) > 0.999


# ------------------------------------------------------------------------------------- scenes


def photographs(
    scene: Path, out: Path, estimator: DepthEstimator, name: str, agreement: AgreementOptions
) -> dict[str, float]:
    """Strecha's scenes."""
    xyz, seen = tracks(scene, out)
    densified, row = densified_map(scene / "mapping", out, estimator, name, agreement)
    errors, claimed = track_errors(densified, xyz, seen)
    known = np.isfinite(errors)
    errors, claimed = np.abs(errors), claimed
    explained, of_predicted = rephotography(densified, scene)
    return row | {
        "truth": len(errors),
        "within_2cm": float(np.mean(errors < 0.02)),
        "within_2cm_of_filled": float(np.mean(errors[known] < 0.02)),
        "within_10cm_of_filled": float(np.mean(errors[known] < 0.1)),
        "median_mm": 1000 * float(np.median(errors[known])),
        "below_1_sigma": float(np.mean(errors[known] < claimed[known])),
        "rephotography": explained,
        "rephotography_of_predicted": of_predicted,
    }


def sensor_depth(
    scene: Path, out: Path, estimator: DepthEstimator, name: str, agreement: AgreementOptions
) -> dict[str, float]:
    """A scene whose depth_png/ has the sensor's depth of each image."""
    densified, row = densified_map(scene / "mapping", out, estimator, name, agreement)
    both, within, below, ratios = [], [], [], []
    for image in sorted(depth_records(densified.read())):
        _, depth = depth_of(densified, image)
        png = scene / "depth_png" / Path(image).with_suffix(".png")
        stored = np.asarray(cv2.imread(str(png), cv2.IMREAD_UNCHANGED), np.float64) / 1000
        truth = cv2.resize(stored, depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
        sigma = read_beside(densified.root, image, "sigma")
        assert sigma is not None
        there = (depth > 0) & (truth > 0)
        ratio = np.maximum(depth[there] / truth[there], truth[there] / depth[there])
        both.append(there.sum() / max((truth > 0).sum(), 1))
        within.append(ratio < 1.03)
        below.append(np.abs(depth - truth)[there] < sigma[there])
        ratios.append(np.abs(depth[there] / truth[there] - 1))
    return row | {
        "cover": float(np.mean(both)),
        "within_ratio_1.03": float(np.mean(np.concatenate(within))),
        "median_relative": float(np.median(np.concatenate(ratios))),
        "below_1_sigma": float(np.mean(np.concatenate(below))),
    }


def motorcycle(estimator: DepthEstimator, agreement: AgreementOptions) -> dict[str, float]:
    """Middlebury's motorcycle, a pair; the range of depth is that of its truth."""
    from importlib.util import find_spec

    spec = find_spec("skimage")
    if spec is None or spec.origin is None:
        raise SystemExit("motorcycle needs scikit-image beside this environment's packages")
    folder = Path(spec.origin).parent / "data"
    with np.load(folder / "motorcycle_disp.npz") as file:
        disparity = file["arr_0"].astype(np.float64)
    focal, baseline_m, offset = 994.978, 0.193001, 31.086
    left, right = (read_image_rgb(folder / f"motorcycle_{side}.png") for side in ("left", "right"))
    height, width = left.shape[:2]
    cameras = [
        Camera("PINHOLE", width, height, (focal, focal, cx, 255.377))
        for cx in (311.193 + 0.5, 311.193 + offset + 0.5)
    ]
    beside = RigidTransform((1.0, 0.0, 0.0, 0.0), (-baseline_m, 0.0, 0.0))
    views = [
        StereoView(left, cameras[0], RigidTransform.identity()),
        StereoView(right, cameras[1], beside),
    ]
    there = np.isfinite(disparity) & (disparity > 0)
    truth = np.where(there, focal * baseline_m / (np.where(there, disparity, 0) + offset), 0)
    low, high = np.percentile(truth[there], [1, 99])
    limits = float(0.8 * low), float(1.25 * high)
    started = _cpu_seconds()
    pair = [estimator.estimate(views[a], [views[1 - a]], limits) for a in (0, 1)]
    seconds = _cpu_seconds() - started
    kept = confirmed(views[0], pair[0], [(views[1], pair[1].depth_m)], agreement)
    known = there & (kept.depth_m > 0)
    found = focal * baseline_m / np.where(known, kept.depth_m, 1) - offset
    off = np.abs(found - disparity)[known]
    below = np.abs(kept.depth_m - truth)[known] < kept.sigma_m[known]
    return {
        "seconds_per_image": seconds / 2,
        "fill": float(known.sum() / there.sum()),
        "within_half_px_of_filled": float(np.mean(off < 0.5)),
        "within_1px_of_filled": float(np.mean(off < 1)),
        "below_1_sigma": float(below.mean()),
    }


def densified_map(
    mapping: Path, out: Path, estimator: DepthEstimator, name: str, agreement: AgreementOptions
) -> tuple[KaptureFolder, dict[str, float]]:
    """A map of the images with depth, below ``out``, and the first figures of its row."""
    megloc.build_map(mapping, workspace=out / "map")
    target = out / name
    shutil.rmtree(target, ignore_errors=True)
    options = DensifyOptions(
        mode="depth",
        estimator=PluginChoice(name=name),
        max_size_px=_SIZE,
        agreement=agreement,
    )
    started = _cpu_seconds()
    counts = densify_map(KaptureFolder(out / "map" / "map"), target, options, estimator=estimator)
    seconds = _cpu_seconds() - started
    row = {
        "seconds_per_image": seconds / counts["images"],
        "fill": counts["share_with_depth"],
    }
    return KaptureFolder(target), row


def _cpu_seconds() -> float:
    """Processor time of this process and its children."""
    return sum(os.times()[:4])


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the scenes")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--by", nargs="+", default=["sweep"], help="estimators; ppg: the peer")
    scenes = ("fountain_p11", "herzjesu_p25", "hololens_room", "motorcycle")
    parser.add_argument("--scenes", nargs="+", default=list(scenes), choices=scenes)
    parser.add_argument("--ppg-python", help="interpreter of an environment with ppg_core")
    parser.add_argument("--agreement", default="{}", help="options of mvs.agreement, as JSON")
    asked = parser.parse_args()
    agreement = AgreementOptions.model_validate_json(asked.agreement)
    asked.output.mkdir(parents=True, exist_ok=True)
    for scene in asked.scenes:
        for name in asked.by:
            if name == "ppg":
                if asked.ppg_python is None:
                    raise SystemExit("ppg needs --ppg-python")
                estimator: DepthEstimator = PpgPatchMatch(asked.ppg_python)
            else:
                estimator = load_plugin(DEPTH_ESTIMATORS, name, {})
            out, data = asked.output / scene, asked.data / scene
            with single_threaded():
                if scene == "motorcycle":
                    row = motorcycle(estimator, agreement)
                else:
                    measure = sensor_depth if scene == "hololens_room" else photographs
                    row = measure(data, out, estimator, name, agreement)
            text = {key: f"{value:.4g}" for key, value in row.items()}
            print(scene, name, *(f"{key} {value}" for key, value in text.items()), flush=True)
            with (asked.output / "mvs.csv").open("a", newline="") as file:
                writer = csv.writer(file)
                writer.writerows([scene, name, key, value] for key, value in text.items())


if __name__ == "__main__":
    _main()
