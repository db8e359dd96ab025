"""Queries with their images and matches: what is shown, what is left out, and what fits a pose."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from megloc_kapture.evaluation.report.pictures import (
    AGREES,
    DISAGREES,
    UNKNOWN,
    MatchLines,
    StoredMatches,
    fits_poses,
    read_small,
)
from megloc_kapture.evaluation.report.queries import Chosen, QueryPictures
from megloc_kapture.evaluation.results import ResultContext, context_of
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.dataset_tables import Protocol, write_protocol
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, MatchesWriter
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.02))
# the query's true pose, and two map images: one beside it, one far away
QUERY, NEAR, FAR = "query/q.jpg", "map/near.jpg", "map/far.jpg"
POSES = {
    QUERY: RigidTransform((0.998, 0.0, 0.0632, 0.0), (0.3, 0.1, 0.0)),
    NEAR: RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.5, 0.0, 0.2)),
    FAR: RigidTransform((0.8, 0.0, 0.6, 0.0), (40.0, 0.0, 3.0)),
}
NUM_RIGHT, NUM_WRONG = 30, 12


@dataclass(frozen=True)
class Run:
    """A workspace with images, keypoints and matches of one query."""

    workspace: Path
    context: ResultContext
    lines: MatchLines


@pytest.fixture
def run(tmp_path: Path, kaptures: Callable[..., Path]) -> Run:
    rng = np.random.default_rng(0)
    workspace = tmp_path / "workspace"
    write_protocol(workspace / "megloc", Protocol())
    map_poses = {name: POSES[name] for name in (NEAR, FAR)}
    kaptures(workspace / "mapping", list(map_poses), map_poses, CAMERA)
    kaptures(workspace / "query", [QUERY, "query/other.jpg"], {}, CAMERA)
    kaptures(workspace / "localized", [QUERY, "query/other.jpg"], {}, CAMERA)
    for folder, names in (("mapping", map_poses), ("query", [QUERY])):
        for name in names:
            pixels = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
            write_image(workspace / folder / "sensors/records_data" / name, pixels)
    points = np.column_stack(
        [rng.uniform(-2, 2, 60), rng.uniform(-1, 1, 60), rng.uniform(4, 9, 60)]
    )
    query_px = project(CAMERA, POSES[QUERY], points)
    near_px = project(CAMERA, POSES[NEAR], points)
    # far beside their epipolar lines, which run across the images
    near_px[NUM_RIGHT : NUM_RIGHT + NUM_WRONG, 1] += 60.0
    config = FeatureConfig("x", np.dtype("<f4"), 2)
    with FeatureWriter(workspace, "keypoints", "x", config, orphan=True) as keypoints:
        keypoints.write(QUERY, query_px.astype(np.float32))
        keypoints.write(NEAR, near_px.astype(np.float32))
        keypoints.write(FAR, near_px.astype(np.float32))
    matched = np.arange(NUM_RIGHT + NUM_WRONG)
    with MatchesWriter(workspace / "matches/query", "x", orphan=True) as matches:
        both = np.stack([matched, matched], axis=1)
        matches.write(QUERY, NEAR, both, np.ones(len(matched)))
        matches.write(QUERY, FAR, both[:5], np.ones(5))
    lines = MatchLines(query_px[matched], near_px[matched])
    return Run(workspace, context_of(workspace / "localized"), lines)


@pytest.fixture
def chosen() -> Chosen:
    return Chosen(
        name=QUERY,
        image=QUERY,
        facts=("5 m off",),
        candidates=(FAR, NEAR),
        pose=POSES[QUERY],
        pose_name="true",
    )


def test_matches_are_found_in_the_workspace(run: Run) -> None:
    stored = StoredMatches(run.context)
    assert (stored.count(QUERY, NEAR), stored.count(QUERY, FAR)) == (42, 5)
    assert stored.count("query/other.jpg", NEAR) is None
    lines = stored.lines(QUERY, NEAR)
    assert lines is not None
    np.testing.assert_allclose(lines.query_px, run.lines.query_px, atol=1e-3)
    np.testing.assert_allclose(lines.map_px, run.lines.map_px, atol=1e-3)
    assert StoredMatches(ResultContext()).lines(QUERY, NEAR) is None


def test_projections_of_one_point_fit_and_others_do_not(run: Run) -> None:
    map_from_query = POSES[NEAR] @ POSES[QUERY].inverse()
    fits = fits_poses(run.lines, CAMERA, CAMERA, map_from_query)
    assert fits.tolist() == [True] * NUM_RIGHT + [False] * NUM_WRONG
    # under a wrong pose most do not
    wrong = POSES[FAR] @ POSES[QUERY].inverse()
    assert fits_poses(run.lines, CAMERA, CAMERA, wrong).mean() < 0.5
    # from one place every match is possible
    same = replace(map_from_query, translation=(0.0, 0.0, 0.0))
    assert fits_poses(run.lines, CAMERA, CAMERA, same).all()


def test_the_best_match_stands_beside_the_query(run: Run, chosen: Chosen) -> None:
    shown = QueryPictures(run.context, run.context.map_poses()).of(chosen)
    # ranked second, but with more matches
    assert shown.main is not None
    assert f'<span class="name">{NEAR}</span>, candidate 2' in shown.main.caption
    assert "42 matches, 30 of them agree with the true pose" in shown.main.caption
    picture = str(shown.main.element)
    assert picture.count("<image ") == 2
    assert picture.count(f'stroke="{AGREES}"') == picture.count(f'stroke="{DISAGREES}"') == 1
    assert picture.count("M") >= 42
    (other,) = shown.others
    assert f'alt="{FAR}"' in other.element
    assert other.caption.startswith("candidate 1, ") and other.caption.endswith(", 5 matches")


def test_lines_join_the_matched_pixels(run: Run, chosen: Chosen) -> None:
    shown = QueryPictures(run.context, run.context.map_poses()).of(chosen)
    scale = 400 / 640
    x0, y0 = run.lines.query_px[0] * scale
    x1, y1 = run.lines.map_px[0] * scale + np.array([400 + 6, 0.0])
    assert f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" in shown.main.element


def test_without_a_known_pose_lines_have_one_colour(run: Run, chosen: Chosen) -> None:
    shown = QueryPictures(run.context, {}).of(replace(chosen, pose=None))
    assert UNKNOWN in shown.main.element and AGREES not in shown.main.element
    assert "agree" not in shown.main.caption


def test_without_candidates_the_nearest_map_image_is_shown(run: Run, chosen: Chosen) -> None:
    shown = QueryPictures(run.context, run.context.map_poses()).of(replace(chosen, candidates=()))
    assert f"{NEAR}</span>, nearest to the true pose" in shown.main.caption


def test_what_is_missing_is_left_out(run: Run, chosen: Chosen) -> None:
    poses = run.context.map_poses()
    other = QueryPictures(run.context, poses).of(
        replace(chosen, name="query/other.jpg", image="query/other.jpg")
    )
    assert other.main is None  # no such file
    shutil.rmtree(run.workspace / "matches")
    shutil.rmtree(run.workspace / "mapping/sensors/records_data")
    alone = QueryPictures(context_of(run.workspace / "localized"), poses).of(chosen)
    assert alone.main.element.startswith("<img ")
    assert (alone.main.caption, alone.others) == ("", ())
    assert QueryPictures(ResultContext(), {}).of(chosen).main is None


@pytest.mark.parametrize(
    "spoilt", ["keypoints.txt", "q.jpg.kpt", "far.jpg.overlapping/query/q.jpg.matches"]
)
def test_broken_features_cost_no_report(run: Run, chosen: Chosen, spoilt: str) -> None:
    (path,) = run.workspace.rglob(spoilt)
    path.write_bytes(b"?")
    shown = QueryPictures(run.context, run.context.map_poses()).of(chosen)
    assert shown.main is not None


def test_pictures_are_small_jpegs_of_the_image(tmp_path: Path) -> None:
    gradient = np.zeros((300, 800, 3), np.uint8)
    gradient[:, :, 0] = np.linspace(0, 255, 800)
    gradient[:, :, 2] = 128
    write_image(tmp_path / "wide.png", gradient)
    picture = read_small(tmp_path / "wide.png", width=200, height=150)
    assert (picture.width, picture.height, picture.scale) == (200, 75, 0.25)
    content = base64.b64decode(picture.address.removeprefix("data:image/jpeg;base64,"))
    decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    expected = cv2.resize(gradient, (200, 75), interpolation=cv2.INTER_AREA)
    assert np.abs(decoded.astype(int) - expected).mean() < 3.0
    again = read_small(tmp_path / "wide.png", width=200, height=150)
    assert again == picture
    # one that fits already is not made larger
    assert read_small(tmp_path / "wide.png", width=9000, height=9000).width == 800
