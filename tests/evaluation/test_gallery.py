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

from megloc_kapture.evaluation.gallery import Chosen, Gallery
from megloc_kapture.evaluation.match_lines import MatchLines, StoredMatches, fits_poses
from megloc_kapture.evaluation.pictures import AGREES, DISAGREES, UNKNOWN, small_picture
from megloc_kapture.evaluation.surroundings import Surroundings, surroundings_of
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture_store import FeatureConfig, FeatureWriter, MatchesWriter
from megloc_kapture.io.side_tables import Protocol, write_protocol
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
class Place:
    """A workspace with images, keypoints and matches of one query."""

    workspace: Path
    around: Surroundings
    lines: MatchLines


@pytest.fixture
def place(tmp_path: Path, kaptures: Callable[..., Path]) -> Place:
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
    return Place(workspace, surroundings_of(workspace / "localized"), lines)


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


def test_matches_are_found_in_the_workspace(place: Place) -> None:
    stored = StoredMatches(place.around)
    assert (stored.count(QUERY, NEAR), stored.count(QUERY, FAR)) == (42, 5)
    assert stored.count("query/other.jpg", NEAR) is None
    lines = stored.lines(QUERY, NEAR)
    assert lines is not None
    np.testing.assert_allclose(lines.query_px, place.lines.query_px, atol=1e-3)
    np.testing.assert_allclose(lines.map_px, place.lines.map_px, atol=1e-3)
    assert StoredMatches(Surroundings()).lines(QUERY, NEAR) is None


def test_projections_of_one_point_fit_and_others_do_not(place: Place) -> None:
    map_from_query = POSES[NEAR] @ POSES[QUERY].inverse()
    fits = fits_poses(place.lines, CAMERA, CAMERA, map_from_query)
    assert fits.tolist() == [True] * NUM_RIGHT + [False] * NUM_WRONG
    # under a wrong pose most do not
    wrong = POSES[FAR] @ POSES[QUERY].inverse()
    assert fits_poses(place.lines, CAMERA, CAMERA, wrong).mean() < 0.5
    # from one place every match is possible
    same = replace(map_from_query, translation=(0.0, 0.0, 0.0))
    assert fits_poses(place.lines, CAMERA, CAMERA, same).all()


def test_the_best_match_stands_beside_the_query(place: Place, chosen: Chosen) -> None:
    shown = Gallery(place.around, place.around.map_poses()).exhibit(chosen)
    assert shown.best == NEAR  # ranked second, but with more matches
    assert "candidate 2" in shown.caption
    assert "42 matches, 30 of them agree with the true pose" in shown.caption
    picture = str(shown.picture)
    assert picture.count("<image ") == 2
    assert picture.count(f'stroke="{AGREES}"') == picture.count(f'stroke="{DISAGREES}"') == 1
    assert picture.count("M") >= 42
    assert [other.image for other in shown.others] == [FAR]
    assert shown.others[0].facts[0] == "candidate 1"
    assert shown.others[0].facts[2] == "5 matches"


def test_lines_join_the_matched_pixels(place: Place, chosen: Chosen) -> None:
    shown = Gallery(place.around, place.around.map_poses()).exhibit(chosen)
    scale = 400 / 640
    x0, y0 = place.lines.query_px[0] * scale
    x1, y1 = place.lines.map_px[0] * scale + np.array([400 + 6, 0.0])
    assert f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" in str(shown.picture)


def test_without_a_known_pose_lines_have_one_colour(place: Place, chosen: Chosen) -> None:
    shown = Gallery(place.around, {}).exhibit(replace(chosen, pose=None))
    assert UNKNOWN in str(shown.picture) and AGREES not in str(shown.picture)
    assert "agree" not in shown.caption


def test_without_candidates_the_nearest_map_image_is_shown(place: Place, chosen: Chosen) -> None:
    shown = Gallery(place.around, place.around.map_poses()).exhibit(replace(chosen, candidates=()))
    assert shown.best == NEAR
    assert "nearest to the true pose" in shown.caption


def test_what_is_missing_is_left_out(place: Place, chosen: Chosen) -> None:
    poses = place.around.map_poses()
    other = Gallery(place.around, poses).exhibit(
        replace(chosen, name="query/other.jpg", image="query/other.jpg")
    )
    assert other.picture is None  # no such file
    shutil.rmtree(place.workspace / "matches")
    shutil.rmtree(place.workspace / "mapping/sensors/records_data")
    alone = Gallery(surroundings_of(place.workspace / "localized"), poses).exhibit(chosen)
    assert str(alone.picture).startswith("<img ")
    assert (alone.best, alone.others) == ("", ())
    assert Gallery(Surroundings(), {}).exhibit(chosen).picture is None


@pytest.mark.parametrize(
    "spoilt", ["keypoints.txt", "q.jpg.kpt", "far.jpg.overlapping/query/q.jpg.matches"]
)
def test_broken_features_cost_no_report(place: Place, chosen: Chosen, spoilt: str) -> None:
    (path,) = place.workspace.rglob(spoilt)
    path.write_bytes(b"?")
    shown = Gallery(place.around, place.around.map_poses()).exhibit(chosen)
    assert shown.picture is not None


def test_pictures_are_small_jpegs_of_the_image(tmp_path: Path) -> None:
    gradient = np.zeros((300, 800, 3), np.uint8)
    gradient[:, :, 0] = np.linspace(0, 255, 800)
    gradient[:, :, 2] = 128
    write_image(tmp_path / "wide.png", gradient)
    picture = small_picture(tmp_path / "wide.png", width=200, height=150)
    assert (picture.width, picture.height, picture.scale) == (200, 75, 0.25)
    content = base64.b64decode(picture.address.removeprefix("data:image/jpeg;base64,"))
    decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    expected = cv2.resize(gradient, (200, 75), interpolation=cv2.INTER_AREA)
    assert np.abs(decoded.astype(int) - expected).mean() < 3.0
    again = small_picture(tmp_path / "wide.png", width=200, height=150)
    assert again == picture
    # one that fits already is not made larger
    assert small_picture(tmp_path / "wide.png", width=9000, height=9000).width == 800
