"""``megloc import colmap`` and COLMAP models given to ``megloc localize`` and ``megloc info``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_workspace import write_workspace

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.io.kapture import KaptureFolder

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


def check(result: Path, scene: Path) -> None:
    row = evaluate(result, scene / "query_gt").row()
    assert row.num_localized == row.num_queries > 0
    assert row.median_position_m is not None and row.median_position_m < 0.01


def test_an_imported_model_is_localized_in(
    megloc: Any, colmap_room: Path, scene: Path, tmp_path: Path
) -> None:
    done = megloc("import", "colmap", colmap_room, "-o", tmp_path / "map", "--unit", "m")
    assert done.status == 0 and "observations" in done.out, done
    assert f"database: {colmap_room}/database.db" in done.err
    assert "unit              metres" in megloc("info", tmp_path / "map").out
    queries = ("--query", scene / "query", "-o", tmp_path / "localized")
    done = megloc("localize", "-i", tmp_path / "map", *queries)
    assert done.out.startswith("4 of 4 queries localized"), done
    check(tmp_path / "localized", scene)


def test_a_model_is_imported_to_the_cache_where_a_map_is_expected(
    megloc: Any, colmap_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    model = colmap_room / "sparse" / "0"
    done = megloc("info", model)
    assert f"{model}: a COLMAP model, as kapture in {tmp_path}/cache/" in done.err
    assert "7 (7 PINHOLE), 7 with a pose" in done.out and "extracted by plugin sift" in done.out
    assert "unit              units of the map" in done.out


def test_a_model_of_poses_alone_without_images_is_imported_as_poses(
    megloc: Any, colmap_room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = pycolmap.Reconstruction(str(colmap_room / "sparse" / "0"))
    for point in list(model.points3D):
        model.delete_point3D(point)
    model.write_text(str(tmp_path))
    done = megloc("import", "colmap", tmp_path, "-o", tmp_path / "poses")
    assert done.status == 0 and "kapture folder of poses, not a map" in caplog.text
    poses = KaptureFolder(tmp_path / "poses").read().poses()
    for image in model.images.values():
        expected = image.cam_from_world().matrix()
        np.testing.assert_allclose(poses[image.name].matrix()[:3], expected, atol=1e-9)


@pytest.mark.slow
def test_a_model_of_surveyed_photographs_is_localized_in(
    megloc: Any, shared_data: Path, tmp_path: Path
) -> None:
    scene = shared_data / "scenes" / "fountain_p11"
    write_workspace(tmp_path / "ws", scene)
    done = megloc("import", "colmap", tmp_path / "ws", "-o", tmp_path / "map")
    assert done.status == 0, done
    places = ("-i", tmp_path / "map", "--query", scene / "query", "-o", tmp_path / "localized")
    done = megloc("localize", *places)
    assert "localizing with sift" in done.err
    check(tmp_path / "localized", scene)
