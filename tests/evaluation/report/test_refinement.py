"""What reports say and show of refined poses: counts, errors, tiles that meet."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.report.document import Block, Pictures, Table
from megloc_kapture.evaluation.report.pictures import encoded, image_tag
from megloc_kapture.evaluation.report.refinement import in_tiles, refinement_blocks
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.io.images import write_depth_map, write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import ClusterRow
from megloc_kapture.values import Camera, RefinementRow, RigidTransform

Displace = Callable[[RigidTransform, np.ndarray, float], RigidTransform]

DEPTH_M, FOCAL_PX = 2.0, 160.0
SHIFT_PX = 8
TRUE = RigidTransform((1.0, 0.0, 0.0, 0.0), (-SHIFT_PX * DEPTH_M / FOCAL_PX, 0.0, 0.0))


def row(image: str, method: str, before: RigidTransform, reason: str = "", moved: float = 0.0):
    return RefinementRow(image, method, reason, moved, 0.0, (), before)


def steps_of(blocks: tuple[Block, ...]) -> list[dict[str, str]]:
    """The rows of the table of steps."""
    table = blocks[0]
    assert isinstance(table, Table)
    return [
        {own.heading: str(cell.text or cell.page) for own, cell in cells}
        for cells in table.rows("page")
    ]


def pictures_of(blocks: tuple[Block, ...]) -> list[Pictures]:
    return [block for block in blocks if isinstance(block, Pictures)]


def test_steps_tell_errors_before_and_after_each_of_them(displace: Displace) -> None:
    truth = {name: RigidTransform.identity() for name in ("a", "b", "c", "d")}
    off = {
        m: displace(truth["a"], np.array([m, 0.0, 0.0]), 0.0) for m in (0.4, 0.3, 0.2, 0.1, 0.02)
    }
    refinements = {
        # 0.4 -> 0.2 -> 0.02; 0.3 stays, -> 0.1; 0.1 -> 0.2, stays; d is not refined
        "a": [row("a", "icp", off[0.4], moved=0.2), row("a", "rendering", off[0.2], moved=0.18)],
        "b": [row("b", "icp", off[0.3], "3.5 m apart"), row("b", "rendering", off[0.3], moved=0.2)],
        "c": [row("c", "icp", off[0.1], moved=0.1), row("c", "rendering", off[0.2], "covers 12 %")],
    }
    estimated = {"a": off[0.02], "b": off[0.1], "c": off[0.2], "d": off[0.02]}
    thresholds = [Threshold(position_m=0.15), Threshold(position_m=0.25)]
    found = refinement_blocks(ResultContext(refinements=refinements), estimated, truth, thresholds)
    icp, rendering = steps_of(found)
    assert icp == {
        "step": "icp",
        "queries": "3",
        "accepted": "2",
        "moved by\n(median)": "0.1500 m, 0.000 deg",
        "error before\n(median)": "0.2500 m, 0.000 deg",
        "error after\n(median)": "0.2000 m, 0.000 deg",
        "nearer\nthe truth": "1 of 2",
        "the other poses stay": "1 x … m apart",
    }
    assert (rendering["accepted"], rendering["nearer\nthe truth"]) == ("2", "2 of 2")
    assert rendering["error before\n(median)"] == "0.2500 m, 0.000 deg"
    assert rendering["error after\n(median)"] == "0.0600 m, 0.000 deg"
    assert rendering["the other poses stay"] == "1 x covers … %"
    recall = "Recall (%) of all queries: 50.0 / 50.0 before, 75.0 / 100.0 after."
    assert found[1].text.endswith(recall)


def test_without_truth_only_movement_is_told() -> None:
    start = RigidTransform.identity()
    assert refinement_blocks(ResultContext(), {"q.jpg": start}) == ()
    context = ResultContext(refinements={"a": [row("a", "icp", start, moved=0.25)]})
    found = refinement_blocks(context, {"a": start}, thresholds=[Threshold(position_m=1.0)])
    (step,) = steps_of(found)
    assert step["moved by\n(median)"] == "0.2500 m, 0.000 deg"
    assert not any("error" in heading for heading in step)
    assert found[1].text == "Movement and errors are those of the accepted poses."
    # of a query without a pose it is not counted
    assert refinement_blocks(context, {}) == ()


def test_tiles_alternate_and_holes_show_the_query() -> None:
    query = np.zeros((40, 80, 3), np.uint8)
    warped = np.full((40, 80, 3), 200, np.uint8)
    valid = np.ones((40, 80), bool)
    valid[:, 60:] = False
    mixed = in_tiles(query, warped, valid)[..., 0]
    tiles = mixed.reshape(4, 10, 8, 10)
    assert (tiles == tiles[:, :1, :, :1]).all()
    expected = 200 * ((np.add.outer(np.arange(4), np.arange(8)) % 2 == 1) & (np.arange(8) < 6))
    np.testing.assert_array_equal(tiles[:, 0, :, 0], expected)


@pytest.fixture
def wall(tmp_path: Path) -> ResultContext:
    """A wall 2 m away, seen by a map image with depth and by a query 10 cm beside it."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (120, 200, 3), np.uint8), (0, 0), 3.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    camera = Camera("PINHOLE", 160, 120, (FOCAL_PX, FOCAL_PX, 80.0, 60.0))
    images = {"map": texture[:, :160], "query": texture[:, SHIFT_PX : 160 + SHIFT_PX]}
    for role, image in images.items():
        data = KaptureData(sensors={"cam": Sensor.from_camera(camera)})
        data.records_camera[0, "cam"] = f"{role}.png"
        if role == "map":
            data.sensors["depth"] = Sensor.from_camera(camera, name="depth", sensor_type="depth")
            data.rigs["rig"] = {key: RigidTransform.identity() for key in ("cam", "depth")}
            data.records_depth[0, "depth"] = "map.depth"
            data.trajectories[0, "rig"] = RigidTransform.identity()
        write_sensors(tmp_path / role, data)
        records = tmp_path / role / "sensors" / "records_data"
        write_image(records / f"{role}.png", np.ascontiguousarray(image))
        if role == "map":
            write_depth_map(records / "map.depth", np.full((120, 160), DEPTH_M, np.float32))
    # of 9 matches, inliers and score
    cluster = ClusterRow(
        "query.png", 0, "yes", 9, 9, 9.0, "", ("map.png",), RigidTransform.identity()
    )
    return ResultContext(
        queries=KaptureFolder(tmp_path / "query"),
        mapping=KaptureFolder(tmp_path / "map"),
        clusters={"query.png": [cluster]},
        refinements={"query.png": [row("query.png", "rendering", TRUE, moved=0.1)]},
    )


def decoded(picture: str) -> np.ndarray:
    found = re.search(r"base64,([^\"]+)", picture)
    data = np.frombuffer(base64.b64decode(found.group(1)), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(np.float64)


def test_tiles_of_query_and_map_meet_at_the_true_pose_only(wall: ResultContext) -> None:
    query = cv2.imread(str(wall.queries.image_path("query.png")))[..., ::-1].astype(np.float64)
    wrong = RigidTransform.identity()
    found = refinement_blocks(wall, {"query.png": wrong}, {"query.png": TRUE})
    (view,) = pictures_of(found)
    assert view.name == "query.png"
    before, after = view.panels
    assert before.caption == "before: 0.0000 m, 0.000 deg off"
    assert after.caption == "after: 0.1000 m, 0.000 deg off"
    # what JPEG alone does
    own = np.abs(decoded(image_tag(encoded(query.astype(np.uint8), 1.0), "")) - query).mean()
    right, wrong_by = (np.abs(decoded(one.element) - query).mean() for one in (before, after))
    assert right < 1.3 * own < 3.0 * own < wrong_by


def test_a_pose_that_stayed_and_a_map_without_depth_are_not_shown(wall: ResultContext) -> None:
    kept = {"query.png": [row("query.png", "icp", TRUE, "no depth")]}
    stayed = replace(wall, refinements=kept)
    assert pictures_of(refinement_blocks(stayed, {"query.png": TRUE})) == []
    (wall.mapping.root / "sensors" / "records_depth.txt").unlink()
    fresh = replace(wall, mapping=KaptureFolder(wall.mapping.root))
    found = refinement_blocks(fresh, {"query.png": TRUE})
    assert found and pictures_of(found) == []
