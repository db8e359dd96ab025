"""Pictures of the report: the worst queries next to their matches."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copytree, ignore_patterns

import numpy as np
import pytest
from scored import evaluate_poses, write_kapture

from megloc_kapture.evaluation.report.gallery import AGREES, DISAGREES, fits_poses, worst_pictures
from megloc_kapture.evaluation.report.queries import shown_queries
from megloc_kapture.evaluation.results import ResultContext, context_of
from megloc_kapture.evaluation.scoring import QueryResult
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.dataset_tables import Protocol, write_protocol
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, MatchesWriter
from megloc_kapture.values import Camera, LocalizationResult, RigidTransform

CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.02))
# the query's true pose, and two map images: one nearby, one far away
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
    query_px: np.ndarray
    map_px: np.ndarray


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Not to be written into."""
    rng = np.random.default_rng(0)
    workspace = tmp_path_factory.mktemp("gallery") / "workspace"
    write_protocol(workspace / "megloc", Protocol())
    map_poses = {name: POSES[name] for name in (NEAR, FAR)}
    write_kapture(workspace / "mapping", list(map_poses), map_poses, CAMERA)
    write_kapture(workspace / "query", [QUERY, "query/other.jpg"], {}, CAMERA)
    write_kapture(workspace / "localized", [QUERY, "query/other.jpg"], {}, CAMERA)
    for folder, names in (("mapping", map_poses), ("query", [QUERY])):
        for name in names:
            pixels = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
            write_image(workspace / folder / "sensors/records_data" / name, pixels)
    points = rng.uniform((-2, -1, 4), (2, 1, 9), (60, 3))
    query_px = project(CAMERA, POSES[QUERY], points)
    near_px = project(CAMERA, POSES[NEAR], points)
    # far from their epipolar lines, which run across the images
    near_px[NUM_RIGHT : NUM_RIGHT + NUM_WRONG, 1] += 60.0
    config = FeatureConfig("x", np.dtype("<f4"), 2)
    keypoints = FeatureWriter(workspace, "keypoints", "x", config, orphan=True)
    for name, px in ((QUERY, query_px), (NEAR, near_px), (FAR, near_px)):
        keypoints.write(name, px.astype(np.float32))
    matched = np.arange(NUM_RIGHT + NUM_WRONG)
    matches = MatchesWriter(workspace / "matches/query", "x", orphan=True)
    both = np.stack([matched, matched], axis=1)
    matches.write(QUERY, NEAR, both, np.ones(len(matched)))
    matches.write(QUERY, FAR, both[:5], np.ones(5))
    context = context_of(workspace / "localized")
    return Run(workspace, context, query_px[matched], near_px[matched])


@pytest.fixture
def shown() -> QueryResult:
    status = LocalizationResult(name=QUERY, candidates=(FAR, NEAR))
    off = {QUERY: RigidTransform((1.0, 0.0, 0.0, 0.0), (5.0, 0.0, 0.0))}
    (query,) = shown_queries(evaluate_poses(off, {QUERY: POSES[QUERY]}, statuses={QUERY: status}))
    return query


def test_matches_that_fit_poses(run: Run) -> None:
    map_from_query = POSES[NEAR] @ POSES[QUERY].inverse()
    matches = run.query_px, run.map_px, CAMERA, CAMERA
    fits = fits_poses(*matches, map_from_query)
    assert fits.tolist() == [True] * NUM_RIGHT + [False] * NUM_WRONG
    # under a wrong pose most do not
    assert fits_poses(*matches, POSES[FAR] @ POSES[QUERY].inverse()).mean() < 0.5
    # from one place every match is possible
    same = replace(map_from_query, translation=(0.0, 0.0, 0.0))
    assert fits_poses(*matches, same).all()


def test_the_best_match_is_shown_next_to_the_query(run: Run, shown: QueryResult) -> None:
    map_poses = run.context.map_poses()
    ((_, facts, element),) = worst_pictures([shown], run.context, map_poses)
    # ranked second, but with more matches
    assert f"right: {NEAR}, 42 matches, 30 of them agree with the true pose" in facts
    assert element.count("<image ") == 2
    assert element.count(f'stroke="{AGREES}"') == element.count(f'stroke="{DISAGREES}"') == 1
    # lines join the matched pixels
    x0, y0 = run.query_px[0] * 400 / 640
    x1, y1 = run.map_px[0] * 400 / 640 + np.array([400 + 6, 0.0])
    assert f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" in element
    # without candidates the map image nearest to the pose is shown
    ((_, facts, _),) = worst_pictures([replace(shown, candidates=())], run.context, map_poses)
    assert f"right: {NEAR}, 0 matches" in facts


def test_missing_data_are_left_out(run: Run, shown: QueryResult, tmp_path: Path) -> None:
    poses = run.context.map_poses()
    assert worst_pictures([replace(shown, image="query/other.jpg")], run.context, poses) == []
    assert worst_pictures([shown], ResultContext(), poses) == []
    without = ignore_patterns("matches", "records_data")
    workspace = copytree(run.workspace, tmp_path / "workspace", ignore=without)
    assert worst_pictures([shown], context_of(workspace / "localized"), poses) == []
