"""``megloc export`` read back and compared with kapture's reading, and ``megloc view``."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import kapture
import numpy as np
import pycolmap
import pytest
from kapture import flatten
from kapture.io.csv import kapture_from_dir
from PIL import Image
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.io.tables import read_status


def poses(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return world_from_cam by image, as read by kapture: rotation (3, 3) and centre (3,)."""
    data = kapture_from_dir(str(folder))
    by_image = {}
    for timestamp, sensor, image in flatten(data.records_camera):
        if (timestamp, sensor) in data.trajectories:
            pose = data.trajectories[timestamp, sensor].inverse()
            w, x, y, z = pose.r_raw
            by_image[image] = (Rotation.from_quat([x, y, z, w]).as_matrix(), np.ravel(pose.t))
    return by_image


def sources(finished: Path) -> tuple[str | Path, ...]:
    return ("-i", finished / "map", "--query", finished / "localized")


def test_colmap_reads_an_exported_model(megloc: Any, finished: Path, tmp_path: Path) -> None:
    printed = megloc("export", "colmap", *sources(finished), "-o", tmp_path / "model").out
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    truth = poses(finished / "map") | poses(finished / "localized")
    assert printed.startswith(f"{len(truth)} images exported")
    assert model.num_reg_images() == len(truth)
    for image in model.images.values():
        rotation, centre = truth[image.name]
        world_from_cam = image.cam_from_world().inverse()
        np.testing.assert_allclose(world_from_cam.rotation.matrix(), rotation, atol=1e-12)
        np.testing.assert_allclose(world_from_cam.translation, centre, atol=1e-12)
    given = kapture_from_dir(str(finished / "map"))
    assert model.num_points3D() == len(given.points3d)
    ordered = [model.points3D[i] for i in sorted(model.points3D)]
    xyz = np.array([point.xyz for point in ordered])
    np.testing.assert_array_equal(xyz, np.asarray(given.points3d)[:, :3])
    seen = [rows for of_type in given.observations.values() for rows in of_type.values()]
    assert model.compute_num_observations() == sum(map(len, seen))
    # keypoints, observations and cameras are consistent
    assert model.compute_mean_reprojection_error() < 1.0


def test_tum_rows_and_ply_vertices_are_those_of_the_poses_and_points(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    for kind in ("tum", "ply"):
        assert megloc("export", kind, *sources(finished), "-o", tmp_path / kind).status == 0
    rows = np.loadtxt(tmp_path / "tum", ndmin=2)
    centres = [centre.tolist() for _, centre in poses(finished / "localized").values()]
    np.testing.assert_allclose(sorted(rows[:, 1:4].tolist()), sorted(centres), atol=1e-12)
    points = len(kapture_from_dir(str(finished / "map")).points3d)
    images = len(poses(finished / "map") | poses(finished / "localized"))
    header = (tmp_path / "ply").read_bytes().partition(b"end_header\n")[0].decode()
    assert f"element vertex {points + 5 * images}\n" in header
    assert f"element edge {8 * images}\n" in header


def test_queries_without_poses_are_not_exported_silently(
    megloc: Any, finished: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    places = ("-i", finished / "map", "--query", finished / "query", "-o", tmp_path / "a.ply")
    done = megloc("export", "ply", *places)
    assert "/query: no query with a pose; give the output of `megloc localize`" in caplog.text
    assert done.status == 0 and (tmp_path / "a.ply").is_file()


def test_nerfstudio_has_opengl_axes_and_paths_of_the_images(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    out = tmp_path / "deep" / "nerf"
    megloc("export", "nerfstudio", *sources(finished), "-o", out)
    content = json.loads((out / "transforms.json").read_text())
    truth = poses(finished / "map") | poses(finished / "localized")
    assert len(content["frames"]) == len(truth)
    for frame in content["frames"]:
        path = (out / frame["file_path"]).resolve()
        assert path.is_file()
        rotation, centre = truth[path.name]
        matrix = np.array(frame["transform_matrix"])
        # looks along -z, y up
        np.testing.assert_allclose(-matrix[:3, 2], rotation[:, 2], atol=1e-12)
        np.testing.assert_allclose(-matrix[:3, 1], rotation[:, 1], atol=1e-12)
        np.testing.assert_allclose(matrix[:3, 3], centre, atol=1e-12)
        assert frame["w"] > frame["cx"] > 0 and frame["fl_x"] > 0
    assert (out / content["ply_file_path"]).is_file()


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")


def data_of(page: Path) -> dict[str, Any]:
    """Return the data of a page of ``megloc view``."""
    content = page.read_text().partition('id="data">')[2].partition("</script>")[0]
    data: dict[str, Any] = json.loads(content)
    return data


def test_a_view_shows_a_map_a_result_and_its_errors(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    out = tmp_path / "view.html"
    done = megloc("view", finished / "map", "-o", out)
    assert done.status == 0 and done.out == f"view: {out}\n"
    assert data_of(out)["queries"] == []
    theirs = kapture_from_dir(str(finished / "mapping"))
    names = sorted(name for _, _, name in kapture.flatten(theirs.records_camera))
    assert data_of(out)["cameras"] == names

    # an existing view is overwritten
    assert megloc("view", finished / "map", finished / "localized", "-o", out).status == 0
    statuses = read_status(finished / "localized/status.csv")
    shown = {query["name"]: query["inliers"] for query in data_of(out)["queries"]}
    assert shown == {name: status.num_inliers for name, status in statuses.items()}
    described = {(query["error"], query["meaning"][:10]) for query in data_of(out)["queries"]}
    assert described == {(None, "confidence")}

    truth = ("--gt", finished / "query_gt")
    assert megloc("view", finished / "map", finished / "localized", *truth, "-o", out).status == 0
    expected = evaluate(finished / "localized", finished / "query_gt")
    errors = {query.image: query.position_m for query in expected.queries}
    assert {query["name"]: query["error"] for query in data_of(out)["queries"]} == errors


def browse(page: Path, width: int, height: int, tmp_path: Path, *, script: str = "") -> Image.Image:
    """Return a screenshot of a page; any message on its console fails."""
    assert CHROMIUM is not None
    if script:
        copy = tmp_path / f"{page.stem}-{width}.html"
        copy.write_text(page.read_text().replace("</body>", f"<script>{script}</script></body>"))
        page = copy
    shot = tmp_path / f"{page.stem}-{width}.png"
    flags = ["--headless=new", "--no-sandbox", "--hide-scrollbars", "--enable-logging=stderr"]
    flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--v=0"]
    flags += ["--force-prefers-reduced-motion"]  # without animations
    flags += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=3000"]
    flags += [f"--window-size={width},{height}", f"--screenshot={shot}"]
    command = [CHROMIUM, *flags, page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    messages = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert messages == []
    with Image.open(shot) as image:
        return image.convert("RGB")


@needs_chromium
@pytest.mark.slow
def test_a_browser_draws_the_view(finished: Path, tmp_path: Path) -> None:
    page = finished / "evaluation/view.html"
    shot = np.asarray(browse(page, 1000, 700, tmp_path))
    picture = shot[:600, :600].astype(int)
    # points and cameras on the dark ground, and the colour of the best queries
    drawn = (np.abs(picture - picture[0, 0]).sum(axis=2) > 60).mean()
    assert 0.005 < drawn < 0.9
    blue = (np.abs(picture - [0x4C, 0xC3, 0xF0]).sum(axis=2) < 60).sum()
    assert blue > 20
    # a click on the first query moves the camera
    click = "document.querySelector('#list button').click()"
    flown = browse(page, 1000, 700, tmp_path, script=click)
    assert (np.abs(np.asarray(flown)[:600, :600] - picture).sum(axis=2) > 60).mean() > 0.01


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("name", ["report.html", "view.html"])
def test_pages_are_no_wider_than_a_phone(finished: Path, tmp_path: Path, name: str) -> None:
    # an error on the console fails
    script = (
        "const d = document.documentElement;"
        "if (d.scrollWidth > d.clientWidth || document.body.scrollWidth > d.clientWidth)"
        "console.error('wider than the page', d.scrollWidth, d.clientWidth);"
    )
    browse(finished / "evaluation" / name, 400, 900, tmp_path, script=script)
