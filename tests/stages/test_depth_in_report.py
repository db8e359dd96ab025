"""Depth by stereo in the report and the view, against the exact depth of the rendered corner."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from corner import depth_m

from megloc_kapture.evaluation.report import panels
from megloc_kapture.evaluation.report.document import Paragraph, Pictures
from megloc_kapture.evaluation.report.panels import depth_blocks
from megloc_kapture.evaluation.report.queries import StoredInliers
from megloc_kapture.evaluation.report.scene import render_view, scene_of
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.stages.densifying import DensifyOptions, densify_map
from megloc_kapture.stages.stereo_depth import DEPTH_FILE, side_file

FAST = PluginChoice(name="sweep", options={"passes": 1, "max_planes": 64})


@pytest.fixture(scope="module")
def densified(world: Any, tmp_path_factory: pytest.TempPathFactory) -> KaptureFolder:
    root = tmp_path_factory.mktemp("densified") / "map"
    options = DensifyOptions(mode="depth", max_size_px=200, num_sources=2, estimator=FAST)
    densify_map(world.map(), root, options)
    return KaptureFolder(root, features_dirs=[world.features_dir])


def panels_of(own: Pictures) -> list[np.ndarray]:
    found = []
    for panel in own.panels:
        address = re.search(r'src="data:image/jpeg;base64,([^"]+)"', str(panel.element))
        assert address is not None
        content = np.frombuffer(base64.b64decode(address[1]), np.uint8)
        found.append(cv2.imdecode(content, cv2.IMREAD_COLOR)[:, :, ::-1].astype(int))
    return found


def test_pictures_show_the_depth_that_is_there(densified: KaptureFolder) -> None:
    told, _, *shown = depth_blocks(ResultContext(mapping=densified))
    assert isinstance(told, Paragraph) and told.text.startswith("5 of 5 map images with depth")
    poses = densified.read().poses()
    assert [own.name for own in shown if isinstance(own, Pictures)] == sorted(poses)
    for own in shown:
        assert isinstance(own, Pictures)
        image, depth, sigma, normals = panels_of(own)
        assert image.shape[:2] == (192, 256) and depth.shape == sigma.shape == normals.shape
        exact = depth_m(poses[own.name])[::2, ::2]
        assert depth.shape[:2] == exact.shape
        dark = np.abs(depth - [46, 50, 58]).sum(axis=2) < 30
        assert (
            0.02 < dark.mean() < 0.6
            and (dark == (np.abs(normals - [46, 50, 58]).sum(2) < 30)).mean() > 0.9
        )
        # yellow is near: green rises along the scale, and with what is near
        known = ~dark & (exact > 0)
        assert np.corrcoef(depth[..., 1][known], 1 / exact[known])[0, 1] > 0.8
        # what is seen faces the camera
        assert np.median(normals[..., 2][known]) > 150


def test_many_images_are_shown_in_part_and_broken_ones_left_out(
    densified: KaptureFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panels, "MAX_IMAGES", 3)
    told, _, *shown = depth_blocks(ResultContext(mapping=densified))
    assert isinstance(told, Paragraph) and told.text.endswith(" 3 are shown.")
    names = sorted(densified.read().poses())
    assert [own.name for own in shown if isinstance(own, Pictures)] == [
        names[at] for at in (0, 2, 4)
    ]
    root = tmp_path / "map"
    shutil.copytree(densified.root, root, symlinks=True)
    side_file(root, names[0], "sigma").write_bytes(b"no array")
    broken = depth_blocks(ResultContext(mapping=KaptureFolder(root)))
    assert len(broken) == 2 + 2
    (root / DEPTH_FILE).write_text("not a table")
    assert depth_blocks(ResultContext(mapping=KaptureFolder(root))) == ()


def test_a_map_without_stereo_has_no_such_section(world: Any) -> None:
    assert depth_blocks(ResultContext(mapping=world.map())) == ()
    assert depth_blocks(ResultContext()) == ()


def test_the_view_shows_the_cloud_on_the_walls(
    world: Any, densified: KaptureFolder, distance_to_walls: Callable[..., Any]
) -> None:
    scene = scene_of("corner", StoredInliers(ResultContext(mapping=densified)))
    assert scene is not None and scene.num_dense > 3000
    dense = scene.points[-scene.num_dense :] + scene.origin
    assert np.mean(distance_to_walls(dense) < 0.1) > 0.95
    own = densified.points3d()[:, :3]
    np.testing.assert_allclose(scene.points[: len(own)] + scene.origin, own, atol=1e-5)
    page = render_view(scene)
    again = scene_of("corner", StoredInliers(ResultContext(mapping=KaptureFolder(densified.root))))
    assert again is not None and render_view(again) == page
    assert 'id="show-dense"' in page and f"{scene.num_dense:,} of depth by stereo" in page
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])  # type: ignore[index]
    assert data["numDense"] == scene.num_dense
    assert len(base64.b64decode(data["points"])) == 12 * len(scene.points)
    bare = scene_of("corner", StoredInliers(ResultContext(mapping=world.map())))
    assert bare is not None and bare.num_dense == 0 and 'id="show-dense"' not in render_view(bare)
