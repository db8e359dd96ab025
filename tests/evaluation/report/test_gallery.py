"""Pictures of queries: which, in what order, beside what they match, and what fits a pose."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from megloc_kapture.evaluation.report import gallery
from megloc_kapture.evaluation.report.document import Cards
from megloc_kapture.evaluation.report.gallery import (
    AGREES,
    DISAGREES,
    UNKNOWN,
    MatchLines,
    QueryPictures,
    StoredMatches,
    fits_poses,
    gallery_blocks,
)
from megloc_kapture.evaluation.report.pictures import read_small
from megloc_kapture.evaluation.report.queries import Chosen, StoredInliers, shown_queries
from megloc_kapture.evaluation.report.reports import render_report
from megloc_kapture.evaluation.results import ResultContext, context_of
from megloc_kapture.evaluation.scoring import Evaluation, evaluate_poses
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.dataset_tables import Protocol, write_protocol
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, KaptureFolder, MatchesWriter
from megloc_kapture.values import Camera, RigidTransform


@pytest.fixture
def evaluation(world: Any, tmp_path: Path, kaptures: Any) -> Evaluation:
    root = kaptures(tmp_path / "query", list(world.truth), {})
    rng = np.random.default_rng(0)
    for name in world.truth:
        pixels = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        write_image(root / "sensors/records_data" / name, pixels)
    found = evaluate_poses(
        world.estimated, world.truth, conditions=world.conditions, statuses=world.statuses
    )
    return replace(found, context=ResultContext(queries=KaptureFolder(root)))


def cards_of(evaluation: Evaluation) -> Cards:
    blocks = gallery_blocks(StoredInliers(evaluation.context), shown_queries(evaluation))
    return next(block for block in blocks if isinstance(block, Cards))


def test_best_typical_and_worst_come_first_then_the_worst(
    evaluation: Evaluation, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = cards_of(evaluation)
    assert found.values("condition") == ["day", "night"]
    assert found.values("outcome") == ["fallback", "localized", "no pose"]
    assert found.orders() == ["error", "inliers"]  # nobody gave confidences
    cards = found.cards
    assert [card.role for card in cards[:9]] == ["best"] * 3 + ["typical"] * 3 + ["worst"] * 3
    assert len(cards) == len({card.name for card in cards}) == 40
    errors = [card.sort["error"] for card in cards]
    everything = sorted(query.position_m for query in evaluation.queries)
    assert sorted(errors[:3]) == everything[:3]
    assert sorted(errors[3:6]) == everything[19:22]
    assert errors[6:9] == [np.inf] * 3
    assert errors[9:] == sorted(errors[9:], reverse=True)
    # of many some are shown
    monkeypatch.setattr(gallery, "MAX_PICTURES", 19)
    cards = cards_of(evaluation).cards
    assert len(cards) == 19
    worst = sorted(shown_queries(evaluation), key=lambda query: query.rank())[3:8]
    assert [card.name for card in cards[9:14]] == [query.name for query in worst]


def test_the_page_has_them_all_and_stands_without_the_script(
    evaluation: Evaluation, page_of: Any
) -> None:
    html = render_report(evaluation)
    page = page_of(html)
    assert len(page.images) >= 40 and page.scripts == ["script"]
    for query in evaluation.queries:
        assert query.image in page.text
    assert '<p class="pick" hidden>' in html  # shown by the script alone
    assert render_report(evaluation) == html
    evil = "\"'></p></script><script>alert(1)</script>"
    queries = tuple(
        replace(query, condition=evil if k % 2 else "day", reason=query.reason and evil)
        for k, query in enumerate(evaluation.queries)
    )
    html = render_report(replace(evaluation, queries=queries))
    assert "<script>alert" not in html
    page_of(html)


def test_without_images_there_is_none(evaluation: Evaluation) -> None:
    shown = shown_queries(evaluation)
    assert gallery_blocks(StoredInliers(ResultContext()), shown) == ()
    for path in evaluation.context.queries.root.rglob("*.jpg"):
        path.unlink()
    assert gallery_blocks(StoredInliers(evaluation.context), shown) == ()


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
    points = rng.uniform((-2, -1, 4), (2, 1, 9), (60, 3))
    query_px = project(CAMERA, POSES[QUERY], points)
    near_px = project(CAMERA, POSES[NEAR], points)
    # far beside their epipolar lines, which run across the images
    near_px[NUM_RIGHT : NUM_RIGHT + NUM_WRONG, 1] += 60.0
    config = FeatureConfig("x", np.dtype("<f4"), 2)
    with FeatureWriter(workspace, "keypoints", "x", config, orphan=True) as keypoints:
        for name, px in ((QUERY, query_px), (NEAR, near_px), (FAR, near_px)):
            keypoints.write(name, px.astype(np.float32))
    matched = np.arange(NUM_RIGHT + NUM_WRONG)
    with MatchesWriter(workspace / "matches/query", "x", orphan=True) as matches:
        both = np.stack([matched, matched], axis=1)
        matches.write(QUERY, NEAR, both, np.ones(len(matched)))
        matches.write(QUERY, FAR, both[:5], np.ones(5))
    lines = MatchLines(query_px[matched], near_px[matched])
    return Run(workspace, context_of(workspace / "localized"), lines)


@pytest.fixture
def chosen() -> Chosen:
    return Chosen(QUERY, QUERY, ("5 m off",), (FAR, NEAR), POSES[QUERY], "true")


def test_matches_are_found_in_the_workspace(run: Run) -> None:
    stored = StoredMatches(run.context)
    assert (stored.count(QUERY, NEAR), stored.count(QUERY, FAR)) == (42, 5)
    assert stored.count("query/other.jpg", NEAR) is None
    lines = stored.lines(QUERY, NEAR)
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
    pictures = QueryPictures(run.context, run.context.map_poses())
    shown = pictures.of(chosen)
    # ranked second, but with more matches
    assert f'<span class="name">{NEAR}</span>, candidate 2' in shown.main.caption
    assert "42 matches, 30 of them agree with the true pose" in shown.main.caption
    picture = str(shown.main.element)
    assert picture.count("<image ") == 2
    assert picture.count(f'stroke="{AGREES}"') == picture.count(f'stroke="{DISAGREES}"') == 1
    assert picture.count("M") >= 42
    # lines join the matched pixels
    x0, y0 = run.lines.query_px[0] * 400 / 640
    x1, y1 = run.lines.map_px[0] * 400 / 640 + np.array([400 + 6, 0.0])
    assert f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" in picture
    (other,) = shown.others
    assert f'alt="{FAR}"' in other.element
    assert other.caption.startswith("candidate 1, ") and other.caption.endswith(", 5 matches")
    # without candidates the map image nearest to the pose is shown
    nearest = pictures.of(replace(chosen, candidates=())).main
    assert f"{NEAR}</span>, nearest to the true pose" in nearest.caption
    # and not one that stands there and looks the other way
    turned = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0)) @ POSES[QUERY]
    behind = QueryPictures(run.context, {**run.context.map_poses(), FAR: turned})
    assert behind.of(replace(chosen, candidates=())).main.caption == nearest.caption
    # without a known pose lines have one colour
    unknown = QueryPictures(run.context, {}).of(replace(chosen, pose=None)).main
    assert UNKNOWN in unknown.element and AGREES not in unknown.element
    assert "agree" not in unknown.caption


def test_what_is_missing_is_left_out(run: Run, chosen: Chosen) -> None:
    poses = run.context.map_poses()
    other = replace(chosen, name="query/other.jpg", image="query/other.jpg")
    assert QueryPictures(run.context, poses).of(other).main is None  # no such file
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
    picture = read_small(tmp_path / "wide.png", (200, 150))
    assert (picture.width, picture.height, picture.scale) == (200, 75, 0.25)
    content = base64.b64decode(picture.address.removeprefix("data:image/jpeg;base64,"))
    decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    expected = cv2.resize(gradient, (200, 75), interpolation=cv2.INTER_AREA)
    assert np.abs(decoded.astype(int) - expected).mean() < 3.0
    again = read_small(tmp_path / "wide.png", (200, 150))
    assert again == picture
    # one that fits already is not made larger
    assert read_small(tmp_path / "wide.png", (9000, 9000)).width == 800
