"""``megloc import colmap`` and COLMAP models given to ``megloc localize`` and ``megloc info``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_workspace import write_workspace
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


def check(result: Path, scene: Path) -> None:
    row = evaluate(result, scene / "query_gt").row()
    assert row.num_localized == row.num_queries > 0
    assert row.median_position_m is not None and row.median_position_m < 0.01


def test_two_commands_to_poses(megloc: Any, colmap_room: Path, scene: Path, tmp_path: Path) -> None:
    done = megloc("import", "colmap", colmap_room, "-o", tmp_path / "map")
    assert done.status == 0 and "observations" in done.out, done
    assert f"database: {colmap_room}/database.db" in done.err
    queries = ("--query", scene / "query", "-o", tmp_path / "localized")
    done = megloc("localize", "-i", tmp_path / "map", *queries)
    assert done.out.startswith("4 of 4 queries localized"), done
    check(tmp_path / "localized", scene)


def test_a_model_is_taken_for_a_map(
    megloc: Any, colmap_room: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    model = colmap_room / "sparse" / "0"
    queries = ("--query", scene / "query", "-o", tmp_path / "localized")
    done = megloc("localize", "-i", model, *queries)
    assert f"{model}: a COLMAP model, as kapture in {tmp_path}/cache/" in done.err
    check(tmp_path / "localized", scene)
    told = megloc("info", model).out
    assert "7 (7 PINHOLE), 7 with a pose" in told and "extracted by plugin sift" in told


def test_poses_alone_become_a_kapture(
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


def write_poses(folder: Path, colmap_room: Path, matrices: dict[str, np.ndarray]) -> None:
    """Write a COLMAP model of poses alone, beside the room's images."""
    (folder / "sparse").mkdir(parents=True)
    (folder / "images").symlink_to(colmap_room / "images")
    pycolmap.Reconstruction(colmap_room / "sparse" / "0").write_text(folder / "sparse")
    for name in ("points3D.txt", "frames.txt", "rigs.txt"):
        (folder / "sparse" / name).unlink()
    (folder / "sparse" / "points3D.txt").touch()
    lines = []
    for number, (name, matrix) in enumerate(matrices.items(), start=1):
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
        tx, ty, tz = matrix[:3, 3].tolist()
        lines.append(f"{number} {w} {x} {y} {z} {tx} {ty} {tz} 1 {name}\n\n")
    (folder / "sparse" / "images.txt").write_text("".join(lines))


def test_poses_in_another_convention(
    megloc: Any, colmap_room: Path, scene: Path, tmp_path: Path
) -> None:
    poses = KaptureFolder(scene / "mapping").read().poses()
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    given = {name: np.linalg.inv(opengl @ pose.matrix()) for name, pose in poses.items()}
    write_poses(tmp_path / "wrong", colmap_room, given)
    arguments = ("import", "colmap", tmp_path / "wrong", "-o", tmp_path / "map")
    done = megloc(*arguments)
    assert done.status == 2 and not (tmp_path / "map").exists()
    (line,) = (line for line in done.err.splitlines() if line.startswith("megloc:"))
    assert f"{tmp_path}/wrong/sparse: the given poses contradict the matches" in line
    assert "poses inverted and with OpenGL's axes (camera-to-world, y up, z back)" in line
    done = megloc(*arguments, "-f")
    assert done.status == 0 and "observations" in done.out, done


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "local_type"), [(None, "sift"), ("ALIKED_N16ROT", "aliked-n16rot")]
)
def test_photographs(
    megloc: Any, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    kind: str | None, local_type: str,
) -> None:  # fmt: skip
    """Surveyed poses, COLMAP's points: of its SIFT, and of the networks whose features it has."""
    scene = shared_data / "scenes" / "fountain_p11"
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))
    extractor = None
    if kind is not None:
        # COLMAP's wheels come without its networks: ours has the same weights
        extractor = load_plugin(LOCAL_FEATURES, "aliked", {"weights": local_type})
    types = pycolmap.FeatureExtractorType.__members__
    write_workspace(tmp_path / "ws", scene, extractor=extractor, kind=types.get(kind))
    done = megloc("import", "colmap", tmp_path / "ws", "-o", tmp_path / "map")
    assert done.status == 0, done
    places = ("-i", tmp_path / "map", "--query", scene / "query", "-o", tmp_path / "localized")
    done = megloc("localize", *places)
    assert f"localizing with {local_type}" in done.err
    check(tmp_path / "localized", scene)
