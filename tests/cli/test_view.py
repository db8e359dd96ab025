"""``megloc view``, the view beside a report, and both in a browser."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import kapture
import numpy as np
import pycolmap
import pytest
from kapture.io.csv import kapture_from_dir
from PIL import Image

import megloc_kapture as megloc_package
from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.evaluation.report.queries import StoredInliers, shown_queries
from megloc_kapture.io.tables import read_status

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")


def test_a_map_alone_then_a_result_then_its_truth(
    megloc: Any, finished: Path, tmp_path: Path, data_of: Any
) -> None:
    out = tmp_path / "view.html"
    done = megloc("view", finished / "map", "-o", out)
    assert done.status == 0 and done.out == f"view: {out}\n"
    assert data_of(out)["queries"] == []
    theirs = kapture_from_dir(str(finished / "mapping"))
    names = sorted(name for _, _, name in kapture.flatten(theirs.records_camera))
    assert data_of(out)["cameras"] == names

    # a view may be overwritten
    assert megloc("view", finished / "map", finished / "localized", "-o", out).status == 0
    statuses = read_status(finished / "localized/status.csv")
    shown = {query["name"]: query for query in data_of(out)["queries"]}
    assert shown.keys() == statuses.keys()
    for name, status in statuses.items():
        assert shown[name]["inliers"] == status.num_inliers and shown[name]["error"] is None
        assert shown[name]["meaning"].startswith("confidence")

    truth = ("--gt", finished / "query_gt")
    assert megloc("view", finished / "map", finished / "localized", *truth, "-o", out).status == 0
    expected = evaluate(finished / "localized", finished / "query_gt")
    errors = {query.image: query.position_m for query in expected.queries}
    assert {query["name"]: query["error"] for query in data_of(out)["queries"]} == errors


def test_inliers_lie_where_the_query_sees_their_points(finished: Path) -> None:
    found = evaluate(finished / "localized", finished / "query_gt")
    stored = StoredInliers(found.context)
    assert found.context.queries is not None
    camera = found.context.queries.read()
    for query in shown_queries(found):
        pixels, points = stored.of(query)
        assert query.num_inliers and query.cam_from_world is not None
        # the status counts those of the last estimate, by its own rule
        assert 0.9 * query.num_inliers <= len(points) <= 1.1 * query.num_inliers + 5
        own = camera.camera_of(query.image)
        theirs = pycolmap.Camera(
            model=own.model, width=own.width, height=own.height, params=own.params
        )
        seen = theirs.img_from_cam(query.cam_from_world.apply(points))
        assert np.linalg.norm(seen - pixels, axis=1).max() <= 12.0


def test_from_python(finished: Path, tmp_path: Path, data_of: Any) -> None:
    opened = megloc_package.open_map(finished / "map", features_dirs=[finished])
    opened.view(tmp_path / "map.html")
    assert data_of(tmp_path / "map.html")["queries"] == []
    results = opened.localize(finished / "query")
    results.view(tmp_path / "results.html", finished / "query_gt")
    data = data_of(tmp_path / "results.html")
    assert len(data["queries"]) == len(results)
    assert all(query["error"] is not None for query in data["queries"])
    # their cameras and inliers are at hand
    for query in data["queries"]:
        assert query["drawn"] == min(results[query["name"]].num_inliers, 300)
    opened.view(tmp_path / "same.html", results, finished / "query_gt")
    assert (tmp_path / "same.html").read_bytes() == (tmp_path / "results.html").read_bytes()
    # saved, they are seen from the same places, through the same cameras
    results.save(tmp_path / "localized")
    opened.view(tmp_path / "folder.html", tmp_path / "localized", finished / "query_gt")
    saved = data_of(tmp_path / "folder.html")
    assert saved["frusta"] == data["frusta"] and saved["trueFrusta"] == data["trueFrusta"]


def browse(page: Path, width: int, height: int, tmp_path: Path, *, script: str = "") -> Image.Image:
    """A screenshot of a page; a script error, or any other message of its console, fails."""
    assert CHROMIUM is not None
    if script:
        copy = tmp_path / f"{page.stem}-{width}.html"
        copy.write_text(page.read_text().replace("</body>", f"<script>{script}</script></body>"))
        page = copy
    shot = tmp_path / f"{page.stem}-{width}.png"
    flags = ["--headless=new", "--no-sandbox", "--hide-scrollbars", "--enable-logging=stderr"]
    flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--v=0"]
    flags += ["--force-prefers-reduced-motion"]  # flying takes no time
    flags += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=3000"]
    flags += [f"--window-size={width},{height}", f"--screenshot={shot}"]
    command = [CHROMIUM, *flags, page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert said == [], said
    with Image.open(shot) as image:
        return image.convert("RGB")


@needs_chromium
@pytest.mark.slow
def test_a_browser_draws_the_view(finished: Path, tmp_path: Path, data_of: Any) -> None:
    page = finished / "evaluation/view.html"
    shot = np.asarray(browse(page, 1000, 700, tmp_path))
    picture = shot[:600, :600].astype(int)
    # points and cameras on the dark ground, and the colour of the best queries
    drawn = (np.abs(picture - picture[0, 0]).sum(axis=2) > 60).mean()
    assert 0.005 < drawn < 0.9
    blue = (np.abs(picture - [0x4C, 0xC3, 0xF0]).sum(axis=2) < 60).sum()
    assert blue > 20
    # the first of the list is flown to, and what is seen is another thing
    name = data_of(page)["queries"][0]["name"]
    click = "document.querySelector('#list button').click()"
    flown = browse(page, 1000, 700, tmp_path, script=click)
    assert name and (np.abs(np.asarray(flown)[:600, :600] - picture).sum(axis=2) > 60).mean() > 0.01


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("width", [1400, 400])
def test_pages_fit_a_phone(finished: Path, tmp_path: Path, width: int) -> None:
    # an error in the console tells what sticks out
    script = (
        "const d = document.documentElement;"
        "if (d.scrollWidth > d.clientWidth || document.body.scrollWidth > d.clientWidth)"
        "console.error('wider than the page', d.scrollWidth, d.clientWidth);"
    )
    for name in ("report.html", "view.html"):
        browse(finished / "evaluation" / name, width, 900, tmp_path, script=script)
