"""Collect data for the confidence of poses, and fit and evaluate its calibration.

    .venv/bin/python benchmarks/confidence.py collect --scene DIR [--scene DIR ...] \\
        [--unrelated DIR] --preset classic [--set KEY=VALUE ...] -o classic.csv
    .venv/bin/python benchmarks/confidence.py fit classic.csv modern.csv [--write]

A scene is a folder with mapping/, query/ and query_gt/ in kapture. ``collect`` maps each scene,
localizes queries in it and keeps every pose. Positive queries are those of the scene, degraded
copies (half and a third of the size, blurred, dark, cropped, occluded) and upside-down copies;
negative queries are the images of all other scenes and of a folder of unrelated photographs.
``fit`` evaluates by leave-one-scene-out cross-validation, excluding the test scene's images as
negatives, and compares the calibration with the rule "at least 12 inliers"; ``--write`` fits all
data and writes the calibration into the package. Scenes whose names share the part before the first
``_`` show the same location.

A pose is correct if its centre error is at most a tenth of the median depth of the visible map
points and its rotation error at most 10 degrees. This also works for maps without metric scale.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import minimize

import megloc_kapture as megloc
from megloc_kapture.evaluation.metrics import (
    calibration_error,
    confidence_interval,
    least_area,
    reliability,
    risk_by_score,
)
from megloc_kapture.geometry.cameras import principal_point_px, shift_principal_point
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.localization import confidence
from megloc_kapture.localization.confidence import MAP_POINTS, TERMS
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.presets import parse_assignments
from megloc_kapture.preprocessing.frames import scaled_camera
from megloc_kapture.values import Camera, Pose, RigidTransform

MAX_ERROR, MAX_ANGLE_DEG = 0.1, 10.0
ACCEPTED = 0.6  # minimum confidence of an accepted pose
# terms that lower the confidence; the weights of all others are nonnegative
NEGATIVE_TERMS = ("residual", "misfit", "deviation", "viewing_angle", "distance_ratio")
# presets with a separate calibration, and its name: in blurred images SIFT has large residuals in
# correct poses, ALIKED does not
PRESET_CALIBRATIONS = {"modern": "aliked"}
Pixels = NDArray[np.uint8]
Case = tuple[str, str, Pixels, Camera, RigidTransform | None]


def location(scene: str) -> str:
    """Return the location of a scene from its name."""
    return scene.split("_")[0]


# ------------------------------------------------------------------------------- queries


def images_of(folder: Path, truth: Path | None = None, most: int = 10_000) -> Iterator[Case]:
    """Yield at most ``most`` images of a kapture folder with their true poses."""
    opened = KaptureFolder(folder)
    data = opened.read()
    poses = data if truth is None else KaptureFolder(truth).read()
    names = data.image_names()
    for name in names[:: max(1, -(-len(names) // most))]:
        pixels = read_image_rgb(opened.image_path(name))
        yield name, "", pixels, data.camera_of(name), poses.cam_from_world(name)


def degraded(
    pixels: Pixels, camera: Camera, rng: np.random.Generator
) -> Iterator[tuple[str, Pixels, Camera]]:
    """Yield degraded versions of an image; its pose stays valid for all of them."""
    height, width = pixels.shape[:2]
    for name, share in (("half", 0.5), ("third", 0.33)):
        size = int(width * share), int(height * share)
        small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        yield name, small, scaled_camera(camera, *size)
    yield "blurred", cv2.GaussianBlur(pixels, (0, 0), width / 400).astype(np.uint8), camera
    dark = 64 * (pixels / 255.0) ** 2 + rng.normal(0, 4, pixels.shape)
    yield "dark", dark.clip(0, 255).astype(np.uint8), camera
    for name, share in (("cut", 0.5), ("small_cut", 0.3)):
        size = int(width * share), int(height * share)
        x = 1 + int((width - size[0] - 1) * rng.random())
        y = 1 + int((height - size[1] - 1) * rng.random())
        part = np.ascontiguousarray(pixels[y : y + size[1], x : x + size[0]])
        cropped = replace(camera, width=size[0], height=size[1])
        yield name, part, shift_principal_point(cropped, -x, -y)
    covered = pixels.copy()
    x, y = int(0.3 * width * rng.random()), int(0.3 * height * rng.random())
    covered[y : y + int(0.7 * height), x : x + int(0.7 * width)] = rng.integers(0, 255, 3)
    yield "covered", covered, camera


def cases(scene: Path, scenes: Sequence[Path], unrelated: Path | None, most: int) -> Iterator[Case]:
    """Yield name, kind, pixels, camera and, for positive queries, the true pose."""
    rng = np.random.default_rng(0)
    half_turn = RigidTransform((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    for name, _, pixels, camera, pose in images_of(scene / "query", scene / "query_gt", most):
        if pose is None:
            continue
        yield name, "own", pixels, camera, pose
        for kind, changed, changed_camera in degraded(pixels, camera, rng):
            yield f"{name}#{kind}", kind, changed, changed_camera, pose
        # the principal point rotates with the image
        cx, cy = principal_point_px(camera)
        shift_x, shift_y = camera.width - 2 * cx, camera.height - 2 * cy
        rotated = np.ascontiguousarray(pixels[::-1, ::-1])
        rotated_camera = shift_principal_point(camera, shift_x, shift_y)
        yield f"{name}#upside_down", "upside_down", rotated, rotated_camera, half_turn @ pose
    seen = {location(scene.name)}
    for other in scenes:
        if location(other.name) in seen:
            continue
        seen.add(location(other.name))
        for part in ("mapping", "query"):
            for name, _, pixels, camera, _ in images_of(other / part, most=most):
                yield f"{other.name}/{name}", f"of {location(other.name)}", pixels, camera, None
    for path in sorted(unrelated.iterdir()) if unrelated else ():
        pixels = read_image_rgb(path)
        height, width = pixels.shape[:2]
        yield path.name, "unrelated", pixels, Camera.pinhole(width, height, 1.1 * width), None


def collect(
    scene: Path,
    scenes: Sequence[Path],
    unrelated: Path | None,
    preset: str,
    most: int,
    changes: Sequence[str] = (),
) -> pd.DataFrame:
    """Localize every query in the map of one scene."""
    with TemporaryDirectory() as folder:
        workspace = Path(folder) / "map"
        built = megloc.build_map(
            scene / "mapping", preset, set=parse_assignments(changes), workspace=workspace
        )
        keep_all = {"min_confidence": 0.0, "sure_confidence": None}
        localization = built.options.localization.model_copy(update=keep_all)
        options = built.options.model_copy(update={"localization": localization})
        localizer = Localizer(built.kapture_map, options=options)
        rows = []
        for name, kind, pixels, camera, truth in cases(scene, scenes, unrelated, most):
            result = localizer.localize(pixels, camera)
            row: dict[str, object] = {
                "scene": scene.name,
                "preset": preset,
                "query": name,
                "kind": kind,
                "belongs": truth is not None,
                "localized": bool(result),
                "right": False,
            }
            if isinstance(result, Pose):
                row |= {"num_inliers": result.num_inliers, **result.evidence}
                if truth is not None:
                    row["right"] = is_right(result.cam_from_world, truth, localizer)
            rows.append(row)
    return pd.DataFrame(rows)


def is_right(pose: RigidTransform, truth: RigidTransform, localizer: Localizer) -> bool:
    """Compare a pose with the truth, relative to the median depth of the visible map points."""
    angle = 2 * np.degrees(np.arccos(min(1.0, abs((pose @ truth.inverse()).quat_wxyz[0]))))
    points = localizer.map.folder.points3d()[:, :3]
    points = truth.apply(points)
    visible = points[(points[:, 2] > 0) & (np.abs(points[:, :2]) < points[:, 2:]).all(axis=1)]
    distance = float(np.median(np.linalg.norm(visible, axis=1))) if len(visible) else 1.0
    error = float(np.linalg.norm(pose.center() - truth.center()))
    return error <= MAX_ERROR * distance and float(angle) <= MAX_ANGLE_DEG


# ------------------------------------------------------------------------------- calibration


def fitted(table: pd.DataFrame, origin: str) -> confidence.Calibration:
    """Fit a regularised logistic model to the poses, with the sign of each weight constrained."""
    posed = table[table.localized]
    values = posed[list(TERMS)].to_numpy(np.float64)
    right = posed.right.to_numpy(np.float64)
    mean, spread = values.mean(axis=0), values.std(axis=0) + 1e-9
    scaled = (values - mean) / spread

    def loss(parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        logits = scaled @ parameters[1:] + parameters[0]
        excess = 1 / (1 + np.exp(-logits)) - right
        penalty = 1e-3 * np.r_[0.0, parameters[1:]]
        value = np.mean(np.logaddexp(0, logits) - right * logits) + penalty @ parameters / 2
        return float(value), np.r_[excess.mean(), scaled.T @ excess / len(right)] + penalty

    signs = [(None, 0.0) if term in NEGATIVE_TERMS else (0.0, None) for term in TERMS]
    start = np.zeros(len(TERMS) + 1)
    solution = minimize(loss, start, jac=True, bounds=[(None, None), *signs], method="L-BFGS-B").x
    weights = solution[1:] / spread
    kept = {t: round(float(w), 4) for t, w in zip(TERMS, weights, strict=True) if abs(w) > 1e-6}
    return confidence.Calibration(origin, round(float(solution[0] - weights @ mean), 4), kept)


def confidences(table: pd.DataFrame, model: confidence.Calibration) -> NDArray[np.float64]:
    """Return the confidence of each row; NaN without a pose."""
    probability = np.full(len(table), np.nan)
    for number, row in enumerate(table.fillna({MAP_POINTS: 1.0}).to_dict("records")):
        if row["localized"]:
            probability[number] = model.probability(row)
    return probability


def left_out(table: pd.DataFrame) -> NDArray[np.float64]:
    """Return leave-one-location-out confidences.

    The training rows contain neither queries nor negatives of the test location.
    """
    locations = table.scene.map(location)
    scores = np.full(len(table), np.nan)
    for held_out in sorted(set(locations)):
        test = (locations == held_out).to_numpy()
        negatives = (table.kind == f"of {held_out}").to_numpy()
        model = fitted(table[~test & ~negatives], "")
        scores[test] = confidences(table[test], model)
    return scores


def cross_validated(table: pd.DataFrame) -> NDArray[np.float64]:
    """Cross-validate with a separate calibration for each preset that has one."""
    scores = left_out(table)
    for preset in PRESET_CALIBRATIONS:
        rows = (table.preset == preset).to_numpy()
        scores[rows] = left_out(table[rows].reset_index(drop=True))
    return scores


def summary(table: pd.DataFrame, scores: NDArray[np.float64], accepted: float) -> dict[str, str]:
    """Return a row of the table of acceptance rules."""
    posed, right = table.localized.to_numpy(), table.right.to_numpy()
    taken = posed & (scores >= accepted)
    negative, original = ~table.belongs.to_numpy(), (table.kind == "own").to_numpy()
    wrong, count = int((taken & negative).sum()), int(negative.sum())
    low, high = (100 * float(end[0]) for end in confidence_interval(np.array([wrong]), count))
    kept, total = (int((rows & original & right).sum()) for rows in (taken, posed))
    degraded_kept, degraded_total = (
        int((rows & ~original & right).sum()) for rows in (taken, posed)
    )
    return {
        "negative queries": str(count),
        "accepted": f"{wrong} ({100 * wrong / count:.2f} %, {low:.2f}-{high:.2f})",
        "wrong poses of positive queries": str(int((taken & ~negative & ~right).sum())),
        "correct, original": f"{kept} of {total}",
        "correct, degraded": f"{degraded_kept} of {degraded_total}",
    }


def report(table: pd.DataFrame, scores: NDArray[np.float64]) -> None:
    """Print accepted and rejected poses, the calibration and the wrong poses that are accepted."""
    inliers = np.where(table.localized, 1.0, np.nan)
    lines = {"12 inliers": summary(table, inliers, 0.5)}
    lines[f"confidence {ACCEPTED:g}"] = summary(table, scores, ACCEPTED)
    print(pd.DataFrame(lines).T.to_string())
    posed = table.localized.to_numpy()
    right = table.right.to_numpy()[posed]
    bins = reliability(scores[posed], right)
    by_inliers = risk_by_score(table.num_inliers.to_numpy(np.float64)[posed], right).mean()
    print(
        f"calibration error {calibration_error(bins):.3f}; area under the risk-coverage curve "
        f"{risk_by_score(scores[posed], right).mean():.4f}, by inliers {by_inliers:.4f}, at best "
        f"{least_area(right):.4f}"
    )
    for entry in bins:
        bounds = f"{entry.low:.1f}-{entry.high:.1f}"
        print(f"  {bounds}: {entry.num_poses:5d} poses, {entry.share_right:.2f} correct")
    table = table.assign(confidence=scores)
    missed = table[posed & (table.confidence >= ACCEPTED) & ~table.right]
    print(
        missed.groupby(["scene", "kind"]).size().to_string()
        if len(missed)
        else "no wrong pose accepted"
    )


def write(models: Mapping[str, confidence.Calibration]) -> None:
    """Write the calibrations into the package."""
    path = Path(confidence.__file__).with_name("confidence.toml")
    lines = ["# fitted by benchmarks/confidence.py"]
    for name, model in models.items():
        lines += ["", f"[{name}]", f'origin = "{model.origin}"', f"bias = {model.bias}"]
        lines += ["", f"[{name}.weights]"]
        lines += [f"{term} = {model.weights[term]}" for term in TERMS if term in model.weights]
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    print(f"written: {path}")


def origin_of(table: pd.DataFrame) -> str:
    """Describe the data of a calibration."""
    scenes, presets = (", ".join(sorted(set(table[name]))) for name in ("scene", "preset"))
    return f"{int(table.localized.sum())} poses of {presets} in {scenes}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    collecting = commands.add_parser(
        "collect", help="localize in each scene and write a table of poses"
    )
    collecting.add_argument("--scene", type=Path, action="append", required=True)
    collecting.add_argument("--map", action="append", help="use only the maps of these scenes")
    collecting.add_argument("--unrelated", type=Path)
    collecting.add_argument("--preset", default="classic")
    collecting.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    collecting.add_argument("--most", type=int, default=60, help="images per folder")
    collecting.add_argument("-o", "--output", type=Path, required=True)
    fitting = commands.add_parser("fit", help="evaluate, and with --write store, a calibration")
    fitting.add_argument("tables", type=Path, nargs="+")
    fitting.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.command == "collect":
        parts = []
        for scene in options.scene:
            if options.map and scene.name not in options.map:
                continue
            settings = options.unrelated, options.preset, options.most, options.set
            parts.append(collect(scene, options.scene, *settings))
            pd.concat(parts).to_csv(options.output, index=False)
            print(f"{scene.name}: {len(parts[-1])} queries, {parts[-1].localized.sum()} poses")
        return
    everything = pd.concat([pd.read_csv(path) for path in options.tables], ignore_index=True)
    scores = cross_validated(everything)
    for name, table in (("all", everything), *everything.groupby("preset")):
        print(f"\n{name}: {len(table)} queries of {table.scene.nunique()} maps")
        report(table, scores[table.index])
    fits = {confidence.OF_ALL: everything}
    fits |= {
        kind: everything[everything.preset == preset]
        for preset, kind in PRESET_CALIBRATIONS.items()
    }
    models = {n: fitted(part, origin_of(part)) for n, part in fits.items()}
    print("", *models.items(), sep="\n")
    if options.write:
        write(models)


if __name__ == "__main__":
    main()
