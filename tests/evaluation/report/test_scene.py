"""Views of a map: from above, and in 3D with its frusta against COLMAP's cameras."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scored import evaluate_poses, evaluation_of, shifted, upright_camera, write_kapture

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation import view as scenes
from megloc_kapture.evaluation.report.figures import views_from_above
from megloc_kapture.evaluation.report.queries import legend, shown_queries, top_view
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.evaluation.scoring import QueryResult
from megloc_kapture.evaluation.view import render_view, view_data
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.io.colmap import colmap_camera
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, KaptureFolder
from megloc_kapture.io.kapture.points import write_points3d
from megloc_kapture.values import Camera, LocalizationResult, RigidTransform


def arrays(poses: Iterable[RigidTransform]) -> tuple[np.ndarray, np.ndarray]:
    quats, translations = stack_poses(poses)
    return quats, camera_centers(quats, translations)


def turned(world: Any, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same cameras in a world turned by ``rotation``."""
    turn = RigidTransform.from_matrix(rotation, np.zeros(3))
    return arrays(pose @ turn.inverse() for pose in world.truth.values())


@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (1, -1), (2, 1), (2, -1)])
def test_top_view_along_any_axis_is_not_mirrored(world: Any, axis: int, sign: int) -> None:
    up = np.zeros(3)
    up[axis] = sign
    rotation = Rotation.align_vectors(up[None], np.array([[0.0, 0, 1]]))[0].as_matrix()
    page, labels = top_view(*turned(world, rotation))
    np.testing.assert_allclose(np.cross(*page), up, atol=1e-12)
    assert set(labels) == set("xyz") - {"xyz"[axis]}


def test_top_view_of_a_slanted_world(world: Any) -> None:
    level, labels = top_view(*arrays(world.truth.values()))
    assert labels == ("x", "y")
    np.testing.assert_array_equal(np.array([[1.0, 2.0, 3.0]]) @ level.T, [[1.0, 2.0]])
    rotation = Rotation.from_euler("xyz", [40, 25, 10], degrees=True).as_matrix()
    quats, centers = turned(world, rotation)
    page, labels = top_view(quats, centers)
    np.testing.assert_allclose(np.cross(*page), rotation[:, 2], atol=1e-9)
    assert labels == ("along the map", "across the map")
    # distances on the ground are kept
    flat = centers @ page.T
    ground = np.stack([pose.center()[:2] for pose in world.truth.values()])
    np.testing.assert_allclose(
        np.linalg.norm(flat - flat[0], axis=1), np.linalg.norm(ground - ground[0], axis=1)
    )


def test_frames_have_separate_figures() -> None:
    mapped = {f"DUC1/{i}.jpg": shifted(i) for i in range(5)}
    mapped |= {f"DUC2/{i}.jpg": shifted(1000.0 + i) for i in range(5)}
    frames = {name: name[:4] for name in mapped}
    truth = {"a.jpg": shifted(1.0), "b.jpg": shifted(1002.0), "c.jpg": shifted(1003.0)}
    conditions = {"a.jpg": "DUC1", "b.jpg": "DUC2", "c.jpg": "DUC2"}
    evaluation = evaluate_poses({"a.jpg": shifted(1.5)}, truth, conditions=conditions)
    views = views_from_above(shown_queries(evaluation), mapped, frames, "m")
    assert list(views) == ["DUC1", "DUC2"]
    assert b"truth, no pose" in views["DUC2"] and b"truth, no pose" not in views["DUC1"]
    # without frames there is one view, and without poses or truth none
    assert list(views_from_above(shown_queries(evaluation), mapped, {}, "m")) == [""]
    assert views_from_above([], mapped, {}, "m") == {}


EVIL = "</script><script>alert('\"&')</script>\u2028<!--.jpg"
CAMERAS = (
    Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0)),
    Camera("PINHOLE", 480, 640, (510.0, 500.0, 230.0, 322.0)),
    Camera("OPENCV", 800, 600, (600.0, 601.0, 400.0, 300.0, -0.2, 0.05, 1e-3, -1e-3)),
    Camera("OPENCV_FISHEYE", 800, 800, (600.0, 601.0, 400.0, 401.0, 0.02, -0.01, 0.0, 0.0)),
)


def data_of(page: str) -> dict[str, Any]:
    """The data of a view, arrays decoded."""
    result = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    data: dict[str, Any] = json.loads(result[1])
    for name in ("points", "inliers"):
        data[name] = decoded(data[name], "<f4").reshape(-1, 3)
    for name in ("cameraFrusta", "frusta", "trueFrusta"):
        data[name] = decoded(data[name], "<f4").reshape(-1, 5, 3)
    data["colors"] = decoded(data["colors"], "u1").reshape(-1, 3)
    return data


def decoded(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def check_corners(camera: Camera, pose: RigidTransform, frustum: np.ndarray) -> None:
    """The corners of a frustum are the image's corners, projected by COLMAP."""
    in_cam = frustum[1:].astype(np.float64) @ pose.rotation_matrix().T
    pixels = colmap_camera(camera).img_from_cam(in_cam)
    w, h = camera.width, camera.height
    np.testing.assert_allclose(pixels, [[0, 0], [w, 0], [w, h], [0, h]], atol=2e-3)


@pytest.fixture
def make_map(tmp_path: Path) -> Callable[..., Path]:
    def make(
        names: Sequence[str] = ("m/0.jpg", "m/1.jpg"),
        camera: Camera = CAMERAS[0],
        points: np.ndarray | None = None,
        offset: float = 0.0,
    ) -> Path:
        poses = {
            name: upright_camera(np.array([offset + 3.0 * k, k * 0.5, 1.6]), 0.3 * k)
            for k, name in enumerate(names)
        }
        root: Path = write_kapture(tmp_path / "map", names, poses, camera)
        write_points3d(root, np.zeros((1, 6)) if points is None else points)
        (root / "reconstruction" / "observations.txt").write_text("# kapture format: 1.1\n")
        return root

    return make


View = tuple[dict[str, Any], list[str]]


def drawn(root: Path, queries: Sequence[QueryResult] = (), **context: Any) -> View:
    mapping = KaptureFolder(root)
    return view_data(ResultContext(mapping=mapping, **context), queries)


def page_of(root: Path, queries: Sequence[QueryResult] = (), **context: Any) -> str:
    data, notes = drawn(root, queries, **context)
    return render_view(EVIL, data, queries, notes)


@pytest.mark.parametrize(
    ("camera", "offset"), [(CAMERAS[0], 4.2e6), *((camera, 0.0) for camera in CAMERAS[1:])]
)
def test_view_data_are_those_of_the_map(make_map: Any, camera: Camera, offset: float) -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack(
        [rng.normal((offset, 0, 0), 5, (50, 3)), rng.integers(0, 256, (50, 3))]
    )
    root = make_map([f"m/{k}.jpg" for k in range(6)], camera, points, offset)
    data = data_of(page_of(root))
    # to float32 about the view's origin
    apart = 1 + np.abs(points[:, :3] - data["origin"]).max()
    shown = data["origin"] + data["points"]
    np.testing.assert_allclose(shown, points[:, :3], rtol=0, atol=1e-7 * apart)
    np.testing.assert_array_equal(data["colors"], points[:, 3:])
    poses = KaptureFolder(root).read().poses()
    assert list(data["cameras"]) == sorted(poses)
    for name, frustum in zip(data["cameras"], data["cameraFrusta"], strict=True):
        center = poses[name].center()
        apart = 1 + np.abs(center - data["origin"]).max()
        np.testing.assert_allclose(data["origin"] + frustum[0], center, atol=1e-7 * apart)
        check_corners(camera, poses[name], frustum)
    np.testing.assert_allclose(data["up"], [0, 0, 1], atol=1e-9)


def test_large_scenes_are_subsampled(make_map: Any, monkeypatch: Any) -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.normal(0, 5, (900, 3)), rng.integers(0, 256, (900, 3))])
    monkeypatch.setattr(scenes, "MAX_CAMERAS", 10)
    monkeypatch.setattr(scenes, "MAX_POINTS", 600)
    root = make_map([f"m/{k:03d}.jpg" for k in range(30)], CAMERAS[0], points)
    data, notes = drawn(root)
    assert len(data["cameras"]) == 10 and len(data["points"]) == 600
    assert "600 of the map's 900 points" in notes[0]
    assert "10 of the map's 30 cameras" in notes[1]
    known = {tuple(row) for row in np.float32(points[:, :3] - data["origin"]).tolist()}
    assert {tuple(row) for row in data["points"].tolist()} <= known


def test_names_are_escaped_in_the_view(world: Any, make_map: Any) -> None:
    root = make_map()
    name = f"query/{EVIL}"
    world.truth[name] = world.estimated[name] = upright_camera(np.zeros(3), 0.0)
    world.conditions = dict.fromkeys(world.truth, EVIL)
    world.statuses[name] = LocalizationResult(name=name, reason=EVIL)
    evaluation = evaluation_of(world)
    queries = shown_queries(evaluation)
    data, notes = drawn(root, queries)
    page = render_view(EVIL, data | {"cameras": [EVIL, "m/1.jpg"]}, queries, notes)
    # two scripts, of data and ours, whatever the names say
    assert page.count("<script") == page.count("</script>") == 2 and "alert('" not in page[:2000]
    data = data_of(page)
    assert data["cameras"][0] == EVIL
    assert name in [query["name"] for query in data["queries"]]
    assert {query["condition"] for query in data["queries"]} == {EVIL}
    assert html.escape(EVIL).replace("&#x27;", "&#39;").replace("&quot;", "&#34;") in page
    for outside in ("http:", "https:", "src=", "href=", "import ", "fetch(", "url("):
        assert outside not in page


def test_queries_estimates_and_truths(world: Any, make_map: Any) -> None:
    root = make_map()
    evaluation = evaluation_of(world)
    shown = shown_queries(evaluation)
    data = data_of(page_of(root, shown))
    by_image = {query.image: query for query in evaluation.queries}
    drawings = zip(data["queries"], data["frusta"], data["trueFrusta"], strict=True)
    for query, frustum, true in drawings:
        name = query["name"]
        result = by_image[name]
        np.testing.assert_allclose(data["origin"] + true[0], world.truth[name].center(), atol=1e-5)
        if result.outcome == "missing":
            assert np.isnan(frustum).all() and query["meaning"] == "no pose"
            assert query["error"] is None and result.reason in query["facts"][0]
            continue
        center = world.estimated[name].center()
        np.testing.assert_allclose(data["origin"] + frustum[0], center, atol=1e-5)
        assert query["error"] == result.position_m
        within = [
            t for t in evaluation.thresholds
            if result.position_m <= t.position_m and result.angle_deg <= (t.angle_deg or np.inf)
        ]  # fmt: skip
        expected = f"within {within[0]}" if within else f"beyond {evaluation.thresholds[-1]}"
        assert query["meaning"] == expected
    used = legend(list(shown))
    assert [m for _, m in used][-1] == "no pose" and len({c for c, _ in used}) == len(used)


def test_coordinate_frames_are_separate(world: Any, make_map: Any) -> None:
    names = [f"m/{k}.jpg" for k in range(4)]
    root = make_map(names, points=np.zeros((3, 6)))
    (root / "reconstruction" / "observations.txt").write_text(
        "# kapture format: 1.1\n0, x, m/0.jpg, 0\n1, x, m/3.jpg, 0\n2, x, m/2.jpg, 1, m/3.jpg, 1\n"
    )
    evaluation = evaluation_of(world)
    shown = [
        replace(q, candidates=("m/2.jpg",) * (k % 2))
        for k, q in enumerate(shown_queries(evaluation))
    ]
    floors = {name: f"DUC{1 + k // 2}" for k, name in enumerate(names)}
    data, _ = drawn(root, shown, frames=floors)
    assert data["frames"] == ["DUC1", "DUC2"]
    assert data["pointFrames"].tolist() == [0, 1, 1]
    assert data["cameraFrames"].tolist() == [0, 0, 1, 1]
    assert data["queryFrames"].tolist() == [k % 2 for k in range(len(shown))]
    assert "DUC2</option>" in page_of(root, shown, frames=floors)
    assert 'id="frame"' not in page_of(root, shown)
    with pytest.raises(DataError, match="no image has a pose"):
        view_data(ResultContext())


def test_points_without_colours_get_image_colours(make_map: Any) -> None:
    names = ["m/0.jpg", "m/1.jpg"]
    root = make_map(names, points=np.zeros((4, 6)))
    (root / "reconstruction" / "observations.txt").write_text(
        "# kapture format: 1.1\n0, x, m/0.jpg, 0\n1, x, m/0.jpg, 1\n2, x, m/1.jpg, 0\n"
    )
    config = FeatureConfig("x", np.dtype("<f4"), 2)
    keypoints = FeatureWriter(root, "keypoints", "x", config)
    keypoints.write(names[0], np.float32([[100.5, 50.5], [639.9, 479.9]]))
    keypoints.write(names[1], np.float32([[0.1, 0.1]]))
    colors = {"m/0.jpg": (200, 30, 40), "m/1.jpg": (10, 150, 60)}
    for name, color in colors.items():
        pixels = np.full((480, 640, 3), color, np.uint8)
        write_image(root / "sensors/records_data" / name, pixels)
    data, _ = drawn(root)
    expected = np.array([colors["m/0.jpg"], colors["m/0.jpg"], colors["m/1.jpg"]])
    np.testing.assert_allclose(data["colors"][:3].astype(int), expected, atol=4)  # JPEG
    assert np.ptp(data["colors"][3].astype(int)) < 70  # a grey: nothing observes it
