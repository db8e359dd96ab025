"""The confidence of poses: data for it, its calibration, and how well it tells right from wrong.

    .venv/bin/python benchmarks/confidence.py collect --scene DIR [--scene DIR ...] \\
        [--unrelated DIR] --preset classic [--set KEY=VALUE ...] -o classic.csv
    .venv/bin/python benchmarks/confidence.py fit classic.csv modern.csv [--write]

A scene is a folder with mapping/, query/ and query_gt/ in kapture. ``collect`` maps each and
localizes in it, with every pose kept: its own queries, the same made worse (half and a third of the
size, blurred, dark, cropped, covered) and upside down; and the images of all other scenes
and of a folder of photographs, which have no right pose there. ``fit`` leaves out one
scene after the other, with its images as queries of the others, and prints what the calibration of
the rest makes of it beside the rule "at least 12 inliers"; ``--write`` puts the calibration of all
data into the package. Scenes whose names begin alike, up to the first ``_``, are the same place.

A pose is right if its centre is off by at most a tenth of the distance to what the camera sees, and
its rotation by at most 10 degrees: a rule that maps without metres can have.
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
from megloc_kapture.pipeline.presets import assigned
from megloc_kapture.preprocessing.frames import scaled_camera
from megloc_kapture.values import Camera, Pose, RigidTransform

MAX_ERROR, MAX_ANGLE_DEG = 0.1, 10.0
# a term that speaks for a pose may not be given a weight against it, and the reverse
AGAINST = ("residual", "misfit", "deviation", "viewing_angle", "distance_ratio")
# presets whose features have a calibration of their own, and what these are called: SIFT's fit
# badly on blurred images and are right, ALIKED's are not
OWN = {"modern": "aliked"}
Pixels = NDArray[np.uint8]
Case = tuple[str, str, Pixels, Camera, RigidTransform | None]


def place(scene: str) -> str:
    """What scenes of the same place have in common."""
    return scene.split("_")[0]


# ------------------------------------------------------------------------------- queries


def images_of(folder: Path, truth: Path | None = None, most: int = 10_000) -> Iterator[Case]:
    """The images of a kapture folder, at most so many, with their true poses."""
    opened = KaptureFolder(folder)
    data = opened.read()
    poses = data if truth is None else KaptureFolder(truth).read()
    names = data.image_names()
    for name in names[:: max(1, -(-len(names) // most))]:
        pixels = read_image_rgb(opened.image_path(name))
        yield name, "", pixels, data.camera_of(name), poses.cam_from_world(name)


def worse(
    pixels: Pixels, camera: Camera, rng: np.random.Generator
) -> Iterator[tuple[str, Pixels, Camera]]:
    """An image made worse in several ways; its pose stays."""
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
    """Every query of one map: name, kind, pixels, camera, and its pose where it has one."""
    rng = np.random.default_rng(0)
    turned = RigidTransform((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    for name, _, pixels, camera, pose in images_of(scene / "query", scene / "query_gt", most):
        if pose is None:
            continue
        yield name, "own", pixels, camera, pose
        for kind, changed, changed_camera in worse(pixels, camera, rng):
            yield f"{name}#{kind}", kind, changed, changed_camera, pose
        # a turned image has its principal point turned with it
        cx, cy = principal_point_px(camera)
        across, along = camera.width - 2 * cx, camera.height - 2 * cy
        upside = np.ascontiguousarray(pixels[::-1, ::-1])
        of_upside = shift_principal_point(camera, across, along)
        yield f"{name}#upside_down", "upside_down", upside, of_upside, turned @ pose
    seen = {place(scene.name)}
    for other in scenes:
        if place(other.name) in seen:
            continue
        seen.add(place(other.name))
        for part in ("mapping", "query"):
            for name, _, pixels, camera, _ in images_of(other / part, most=most):
                yield f"{other.name}/{name}", f"of {place(other.name)}", pixels, camera, None
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
    """Localize every query of one map, and keep every pose."""
    with TemporaryDirectory() as folder:
        place = Path(folder) / "map"
        built = megloc.build_map(scene / "mapping", preset, set=assigned(changes), workspace=place)
        every = {"min_confidence": 0.0, "sure_confidence": None}
        localization = built.options.localization.model_copy(update=every)
        options = built.options.model_copy(update={"localization": localization})
        localizer = Localizer(built.kapture_map, options=options)
        rows = []
        for name, kind, pixels, camera, truth in cases(scene, scenes, unrelated, most):
            found = localizer.localize(pixels, camera)
            row: dict[str, object] = {
                "scene": scene.name,
                "preset": preset,
                "query": name,
                "kind": kind,
                "belongs": truth is not None,
                "localized": bool(found),
                "right": False,
            }
            if isinstance(found, Pose):
                row |= {"num_inliers": found.num_inliers, **found.evidence}
                if truth is not None:
                    row["right"] = is_right(found.cam_from_world, truth, localizer)
            rows.append(row)
    return pd.DataFrame(rows)


def is_right(pose: RigidTransform, truth: RigidTransform, localizer: Localizer) -> bool:
    """Whether a pose is near enough to the truth for what the camera sees."""
    angle = 2 * np.degrees(np.arccos(min(1.0, abs((pose @ truth.inverse()).quat_wxyz[0]))))
    points = localizer.map.folder.points3d()[:, :3]
    ahead = truth.apply(points)
    ahead = ahead[(ahead[:, 2] > 0) & (np.abs(ahead[:, :2]) < ahead[:, 2:]).all(axis=1)]
    distance = float(np.median(np.linalg.norm(ahead, axis=1))) if len(ahead) else 1.0
    error = float(np.linalg.norm(pose.center() - truth.center()))
    return error <= MAX_ERROR * distance and float(angle) <= MAX_ANGLE_DEG


# ------------------------------------------------------------------------------- calibration


def fitted(table: pd.DataFrame, terms: Sequence[str], origin: str) -> confidence.Calibration:
    """The logistic model of the poses of a table: regularised, its signs as they must be."""
    posed = table[table.localized]
    values = posed[list(terms)].to_numpy(np.float64)
    right = posed.right.to_numpy(np.float64)
    mean, spread = values.mean(axis=0), values.std(axis=0) + 1e-9
    scaled = (values - mean) / spread

    def loss(parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        logits = scaled @ parameters[1:] + parameters[0]
        excess = 1 / (1 + np.exp(-logits)) - right
        penalty = 1e-3 * np.r_[0.0, parameters[1:]]
        value = np.mean(np.logaddexp(0, logits) - right * logits) + penalty @ parameters / 2
        return float(value), np.r_[excess.mean(), scaled.T @ excess / len(right)] + penalty

    signs = [(None, 0.0) if term in AGAINST else (0.0, None) for term in terms]
    start = np.zeros(len(terms) + 1)
    found = minimize(loss, start, jac=True, bounds=[(None, None), *signs], method="L-BFGS-B").x
    weights = found[1:] / spread
    kept = {t: round(float(w), 4) for t, w in zip(terms, weights, strict=True) if abs(w) > 1e-6}
    return confidence.Calibration(origin, round(float(found[0] - weights @ mean), 4), kept)


def confidences(table: pd.DataFrame, model: confidence.Calibration) -> NDArray[np.float64]:
    """Confidences of the rows; NaN without a pose."""
    found = np.full(len(table), np.nan)
    for at, row in enumerate(table.fillna({MAP_POINTS: 1.0}).to_dict("records")):
        if row["localized"]:
            found[at] = model.probability(row)
    return found


def left_out(table: pd.DataFrame, terms: Sequence[str]) -> NDArray[np.float64]:
    """Confidences of each scene's rows by what the others say, which its images have no part in."""
    places = table.scene.map(place)
    found = np.full(len(table), np.nan)
    for own in sorted(set(places)):
        test = (places == own).to_numpy()
        strange = (table.kind == f"of {own}").to_numpy()
        model = fitted(table[~test & ~strange], terms, "")
        found[test] = confidences(table[test], model)
    return found


def judged(table: pd.DataFrame, terms: Sequence[str]) -> NDArray[np.float64]:
    """As :func:`left_out`, by the calibration that poses of the preset get."""
    found = left_out(table, terms)
    for preset in OWN:
        own = (table.preset == preset).to_numpy()
        found[own] = left_out(table[own].reset_index(drop=True), terms)
    return found


def summary(table: pd.DataFrame, found: NDArray[np.float64], accepted: float) -> dict[str, str]:
    """One line of the table that is printed."""
    posed, right = table.localized.to_numpy(), table.right.to_numpy()
    taken = posed & (found >= accepted)
    strays, own = ~table.belongs.to_numpy(), (table.kind == "own").to_numpy()
    wrong, count = int((taken & strays).sum()), int(strays.sum())
    low, high = (100 * float(end[0]) for end in confidence_interval(np.array([wrong]), count))
    # what an earlier rule took
    kept, before = int((taken & own & right).sum()), int((posed & own & right).sum())
    worse_kept, worse_all = (int((these & right).sum()) for these in (taken & ~own, posed & ~own))
    return {
        "wrong queries": str(count),
        "accepted": f"{wrong} ({100 * wrong / count:.2f} %, {low:.2f}-{high:.2f})",
        "wrong poses of own": str(int((taken & ~strays & ~right).sum())),
        "right own": f"{kept} of {before}",
        "right, made worse": f"{worse_kept} of {worse_all}",
    }


def report(table: pd.DataFrame, found: NDArray[np.float64], accepted: float) -> None:
    """Print how poses are told apart by these confidences."""
    inliers = np.where(table.localized, 1.0, np.nan)
    lines = {"12 inliers": summary(table, inliers, 0.5)}
    lines[f"confidence {accepted:g}"] = summary(table, found, accepted)
    print(pd.DataFrame(lines).T.to_string())
    posed = table.localized.to_numpy()
    right = table.right.to_numpy()[posed]
    bins = reliability(found[posed], right)
    by_inliers = risk_by_score(table.num_inliers.to_numpy(np.float64)[posed], right).mean()
    print(
        f"calibration error {calibration_error(bins):.3f}; area under risk against coverage "
        f"{risk_by_score(found[posed], right).mean():.4f}, by inliers {by_inliers:.4f}, at best "
        f"{least_area(right):.4f}"
    )
    for one in bins:
        bounds = f"{one.low:.1f}-{one.high:.1f}"
        print(f"  {bounds}: {one.num_poses:5d} poses, {one.share_right:.2f} right")
    table = table.assign(confidence=found)
    missed = table[posed & (table.confidence >= accepted) & ~table.right]
    print(missed.groupby(["scene", "kind"]).size().to_string() if len(missed) else "none wrong")


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
    """What a calibration was fitted to, in words."""
    scenes, presets = (", ".join(sorted(set(table[name]))) for name in ("scene", "preset"))
    return f"{int(table.localized.sum())} poses of {presets} in {scenes}"


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    collecting = commands.add_parser("collect")
    collecting.add_argument("--scene", type=Path, action="append", required=True)
    collecting.add_argument("--map", action="append", help="localize in the maps of these only")
    collecting.add_argument("--unrelated", type=Path)
    collecting.add_argument("--preset", default="classic")
    collecting.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    collecting.add_argument("--most", type=int, default=60, help="images of one folder")
    collecting.add_argument("-o", "--output", type=Path, required=True)
    fitting = commands.add_parser("fit")
    fitting.add_argument("tables", type=Path, nargs="+")
    fitting.add_argument("--terms", nargs="+", choices=list(TERMS), default=list(TERMS))
    fitting.add_argument("--accepted", type=float, default=0.6)
    fitting.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.command == "collect":
        parts = []
        for scene in options.scene:
            if options.map and scene.name not in options.map:
                continue
            chosen = options.unrelated, options.preset, options.most, options.set
            parts.append(collect(scene, options.scene, *chosen))
            pd.concat(parts).to_csv(options.output, index=False)
            print(f"{scene.name}: {len(parts[-1])} queries, {parts[-1].localized.sum()} poses")
        return
    everything = pd.concat([pd.read_csv(path) for path in options.tables], ignore_index=True)
    found = judged(everything, options.terms)
    for name, table in (("all", everything), *everything.groupby("preset")):
        print(f"\n{name}: {len(table)} queries of {table.scene.nunique()} maps")
        report(table, found[table.index], options.accepted)
    fits = {confidence.OF_ALL: everything}
    fits |= {kind: everything[everything.preset == preset] for preset, kind in OWN.items()}
    models = {n: fitted(part, options.terms, origin_of(part)) for n, part in fits.items()}
    print("", *models.items(), sep="\n")
    if options.write:
        write(models)


if __name__ == "__main__":
    main()
