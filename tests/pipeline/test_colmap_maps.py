"""COLMAP models where a kapture map is expected: imported once, beside nothing of the user's."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pytest

import megloc_kapture as megloc
from megloc_kapture.datasets.colmap_map import find_colmap
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.colmap_maps import colmap_maps_folder, import_colmap, kapture_of

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


@pytest.fixture
def workspace(colmap_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the workspace, and an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Path(shutil.copytree(colmap_room, tmp_path / "room", symlinks=True))


def state(root: Path) -> dict[str, tuple[int, int]]:
    found = {path: path.lstat() for path in sorted(root.rglob("*"))}
    return {str(path): (at.st_size, at.st_mtime_ns) for path, at in found.items()}


def test_three_lines(workspace: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workspace)
    before = state(workspace)
    opened = megloc.open_map("sparse/0")
    queries = KaptureFolder(scene / "query")
    name = queries.read().image_names()[0]
    found = opened.localize(queries.image_path(name), queries.read().camera_of(name))
    assert found, found
    truth = KaptureFolder(scene / "query_gt").read().poses()[name]
    off = found.cam_from_world.center() - truth.center()
    assert float((off**2).sum()) ** 0.5 < 0.01
    assert state(workspace) == before
    # the second time nothing is imported
    kept = state(colmap_maps_folder())
    begin = time.perf_counter()
    megloc.open_map(workspace)
    assert time.perf_counter() - begin < 2.0
    assert state(colmap_maps_folder()) == kept


def test_a_model_that_has_changed_is_imported_again(workspace: Path) -> None:
    first = kapture_of(workspace)
    points = len(KaptureFolder(first).points3d())
    inode = (first / "colmap.json").stat().st_ino
    assert kapture_of(workspace / "sparse" / "0") == first
    assert (first / "colmap.json").stat().st_ino == inode
    model = pycolmap.Reconstruction(workspace / "sparse" / "0")
    model.delete_point3D(next(iter(model.points3D)))
    model.write_binary(workspace / "sparse" / "0")
    assert kapture_of(workspace) == first
    assert len(KaptureFolder(first).points3d()) == points - 1
    # so is one whose map was spoilt, or whose images lie elsewhere
    (first / "colmap.json").write_text("{")
    assert kapture_of(workspace) == first
    os.rename(workspace / "images", workspace / "sparse" / "images")
    link = first / "sensors" / "records_data"
    kapture_of(workspace)
    assert link.resolve() == (workspace / "sparse" / "images").resolve()
    # a map per model, nothing else
    assert [path.name for path in colmap_maps_folder().iterdir()] == [first.name]


def test_a_model_of_poses_alone_is_mapped_anew(
    workspace: Path, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = pycolmap.Reconstruction(workspace / "sparse" / "0")
    model.delete_all_points2D_and_points3D()
    model.write_binary(workspace / "sparse" / "0")
    (tmp_path / "map").mkdir()
    counts = import_colmap(find_colmap(workspace), tmp_path / "map")
    assert "the model has no points; its images are mapped anew with its poses" in caplog.text
    folder = KaptureFolder(tmp_path / "map")
    folder.validate(deep=True)
    assert counts["points"] == len(folder.points3d()) > 100
    assert sorted(path.name for path in folder.root.iterdir()) == ["reconstruction", "sensors"]
    results = megloc.open_map(folder.root).localize(scene / "query")
    found = megloc.evaluate(results, truth=scene / "query_gt").row()
    assert found.num_localized == 4 and (found.median_position_m or 1) < 0.01


def test_nothing_is_kept_of_what_cannot_be_imported(
    workspace: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kapture in (scene / "mapping", scene / "none"):
        assert kapture_of(kapture) == kapture  # which stays what it is
    path = workspace / "sparse" / "0" / "points3D.bin"
    content = path.read_bytes()
    path.write_bytes(content[:-3])
    with pytest.raises(megloc.DataError, match=r"points3D.bin: the file ends within"):
        megloc.open_map(workspace)
    assert list(colmap_maps_folder().iterdir()) == []
    path.write_bytes(content)
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(megloc.OutputError, match=r"maps: cannot write: Not a directory"):
        kapture_of(workspace)
