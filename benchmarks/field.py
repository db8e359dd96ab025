"""Neural fields of real scenes: held-out photographs, and what refining poses by them does.

    .venv/bin/python benchmarks/field.py --scene DIR --workspace OUT [--steps 2000] [-- ARGUMENTS]

DIR is a folder with mapping/, query/ and query_gt/ in kapture, which is run as ``megloc eval`` runs
it, with depth by stereo where the map has none. A field is trained on all images of the map. The
queries are held-out photographs: at their true poses the field's rendering is compared with the
warping of the four nearest map images by their depth, on the pixels that this covers of the right
half; the light of both is fitted on the left half, of the warping as a gain and a bias of each
channel. Refined poses are compared as by ``refinement.py``, and the medians' difference by a
bootstrap over queries. ``--views SIDE`` also renders what is halfway between the map's cameras,
with that longer side, and runs again with these views as map images more. ``--condition night``
prints the comparisons of the queries whose names contain it, too. Arguments that are not known here
go to ``megloc eval``; the twin of Aachen is a scene once ``megloc eval`` has imported it.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from refinement import NONE, Thresholds, comparison, refined
from scenes import DRAWS, errors_of, megloc

from megloc_kapture.geometry.poses import rotation_angles_deg
from megloc_kapture.geometry.warping import warp_to_view
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.kapture.matches import read_pairs
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.refinement.neural_field import FieldView, NeuralField, reduced_view
from megloc_kapture.stages.neural_field import open_field, views_of

_SIDE = 320  # of the images that are compared, as the field is trained
_NEAREST = 4
_MIN_COVERED_PX = 100


def held_out_psnr(
    field: NeuralField, scene: Path, map_views: list[FieldView]
) -> list[tuple[str, float, float, float]]:
    """Of each query its name, the share that warping covers, PSNR of warping and of the field;
    those of which it covers no part of one half are left out."""
    query, truth = KaptureFolder(scene / "query"), KaptureFolder(scene / "query_gt").read().poses()
    centers = np.array([view.cam_from_world.center() for view in map_views])
    rows = []
    for name, pose in truth.items():
        image, camera = read_image_rgb(query.image_path(name)), query.read().camera_of(name)
        view = reduced_view(FieldView(name, image, camera, pose), _SIDE)
        order = np.argsort(np.linalg.norm(centers - pose.center(), axis=1), kind="stable")
        near = [map_views[row] for row in order if map_views[row].depth is not None][:_NEAREST]
        warped = warp_to_view([each.as_source() for each in near], view.camera, pose)
        columns = np.arange(view.camera.width) < view.camera.width // 2
        left = np.broadcast_to(columns, warped.valid.shape)
        fitted = FieldView(name, view.image, view.camera, pose, left)
        light = field.fitted_appearance(fitted, _SIDE)
        shown = field.render(view.camera, pose, appearance=light).image
        ours, judged = warped.valid & left, warped.valid & ~left
        if min(ours.sum(), judged.sum()) < _MIN_COVERED_PX:
            continue
        matched = np.empty(view.image.shape)
        for channel in range(3):
            of_warp, seen = (
                each[..., channel].astype(float) for each in (warped.image, view.image)
            )
            matched[..., channel] = np.polyval(np.polyfit(of_warp[ours], seen[ours], 1), of_warp)
        rows.append(
            (
                name,
                float(warped.valid.mean()),
                psnr_db(matched, view.image, judged),
                psnr_db(shown, view.image, judged),
            )
        )
    return rows


def psnr_db(image: NDArray[Any], truth: NDArray[np.uint8], where: NDArray[np.bool_]) -> float:
    error = np.clip(image, 0, 255).astype(float)[where] - truth.astype(float)[where]
    return float(10 * np.log10(255**2 / np.square(error).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=lambda text: Path(text).resolve(), required=True)
    parser.add_argument("--workspace", type=Path, required=True, help="the run stays here")
    parser.add_argument("--steps", type=int, default=2000, help="of the field's training")
    parser.add_argument("--views", type=int, metavar="SIDE", help="px: try views between, too")
    parser.add_argument("--condition", help="part of the names of queries to compare apart, too")
    options, more = parser.parse_known_args()
    run, scene, name = options.workspace, options.scene, options.scene.name
    stereo = [] if KaptureFolder(scene / "mapping").read().records_depth else ["mvs.mode=depth"]
    settings = ["--set", "pose_refinement.by=[]", *more]
    depth = [part for text in stereo for part in ("--set", text)]
    megloc("eval", "kapture", "--root", str(scene), "--workspace", str(run), *settings, *depth)
    steps = ("--steps", str(options.steps), "--held-out-every", "0")
    megloc("train-field", "-i", str(run / "map"), "-o", str(run / "field"), *steps)
    with single_threaded():
        rows = held_out_psnr(open_field(run / "field"), scene, views_of(KaptureFolder(run / "map")))
    print("photograph, covered by warping, PSNR of warping and of the field on it")
    for image, covered, warped, rendered in rows:
        print(f"{image}  {covered:.0%}  {warped:.1f} dB  {rendered:.1f} dB", flush=True)
    covered, warped, rendered = np.mean([row[1:] for row in rows], axis=0)
    print(f"mean  {covered:.0%}  {warped:.1f} dB  {rendered:.1f} dB", flush=True)
    chosen = json.dumps(str((run / "field").resolve()))
    setting = f'pose_refinement.by=[{{name="field",options={{field={chosen}}}}}]'
    before = errors_of(run / "evaluation").assign(chain=NONE, seed=0, accepted=False, seconds=0.0)
    others = [refined("field", 0, run, setting)]
    if options.views is not None:
        others.append(with_views(scene, run, options.views, settings))
    for condition in [part for part in ("", options.condition) if part is not None]:
        ours, *theirs = (
            each[each["query"].str.contains(condition, regex=False)] for each in (before, *others)
        )
        label, thresholds = f"{name} {condition}", Thresholds.read(run / "evaluation")
        print(comparison(label, pd.concat([ours, *theirs]), thresholds))
        for each in theirs:
            print(f"{each.chain.iloc[0]}: {medians(ours, each)}{os.linesep}")


def with_views(scene: Path, run: Path, side_px: int, arguments: list[str]) -> pd.DataFrame:
    """Errors of a run whose map also has what the field shows between the cameras."""
    views, joined, again = run / "views", run / "joined", run / "with-views"
    between = ("--between", str(run / "map"), "--max-side", str(side_px))
    megloc("render", str(run / "field"), *between, "-o", str(views), "-f")
    joined.mkdir(exist_ok=True)
    merge = str(Path(sys.executable).with_name("kapture_merge"))
    parts = ("-i", str(scene / "mapping"), str(views), "-o", str(joined / "mapping"), "-f")
    keep = ("--keep-sensor-ids", "--image_transfer", "copy")
    subprocess.run([merge, *parts, *keep], check=True, capture_output=True)
    for part in ("query", "query_gt"):
        shutil.copytree(scene / part, joined / part, dirs_exist_ok=True)
    megloc("eval", "kapture", "--root", str(joined), "--workspace", str(again), *arguments)
    for label, of_run in (("map images", run), ("with views between", again)):
        print(f"first of the ranking, {label}: {first_ranked(of_run, scene / 'query_gt')}")
    errors = errors_of(again / "evaluation")
    return errors.assign(chain="views", seed=0, accepted=True, seconds=0.0)


def first_ranked(run: Path, truth: Path) -> str:
    """How far from each query, in the median, the image stands that retrieval ranks first."""
    of_map, posed = (KaptureFolder(each).read().poses() for each in (run / "map", truth))
    first: dict[str, str] = {}
    for pair in read_pairs(run / "pairs" / "query.txt"):
        first.setdefault(pair.query, pair.map)
    ranked = {query: of_map[image] for query, image in first.items() if query in posed}
    away = [np.linalg.norm(pose.center() - posed[q].center()) for q, pose in ranked.items()]
    apart = rotation_angles_deg(
        *(
            np.array([pose.quat_wxyz for pose in each.values()])
            for each in (ranked, {query: posed[query] for query in ranked})
        )
    )
    return f"{np.median(away):.2f} m, {np.median(apart):.1f} deg"


def medians(before: pd.DataFrame, after: pd.DataFrame) -> str:
    """By how much the medians move, with 95 % intervals of a bootstrap paired by query."""
    columns = ["error_m", "error_deg"]
    one, other = (each.set_index("query")[columns].sort_index() for each in (before, after))
    draws = np.random.default_rng(0).integers(0, len(one), (DRAWS, len(one)))
    moved = np.median(other.to_numpy()[draws], 1) - np.median(one.to_numpy()[draws], 1)
    low, high = np.quantile(moved, (0.025, 0.975), axis=0)
    change = other.median() - one.median()
    worse = int((other.error_m > one.error_m).sum())
    return (
        f"median moves by {1e3 * change.error_m:+.1f} mm "
        f"[{1e3 * low[0]:+.1f}, {1e3 * high[0]:+.1f}]"
        f" and {change.error_deg:+.3f} deg [{low[1]:+.3f}, {high[1]:+.3f}]; "
        f"{worse} of {len(one)} queries are farther away"
    )


if __name__ == "__main__":
    main()
