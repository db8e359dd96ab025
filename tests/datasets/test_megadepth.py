"""MegaDepth on a rendered sample: undistorted models, and tables of plain arrays."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corner import CAMERA, depth_m, pose_at, render
from kapture.io.csv import kapture_from_dir

from megloc_kapture.datasets.megadepth import import_megadepth
from megloc_kapture.errors import DataError
from megloc_kapture.io.images import read_depth_map, write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.scene import depth_records
from tests.pipeline.runs import run_command

h5py = pytest.importorskip("h5py")

DEPTHS = Path("phoenix/S6/zl548/MegaDepth_v1")
POSES = {f"{k}_o.jpg": pose_at((0.8 * k - 2, 0, 0), 18 - 12 * k, 0) for k in range(4)}
FX, FY, CX, CY = CAMERA.params


def write_depth(path: Path, depth: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["depth"] = depth


def write_sample(root: Path, scene: str, *, model: bool) -> None:
    """Write images: four with depth, one with relative depth, one without; one is missing."""
    images = root / "Undistorted_SfM" / scene / "images"
    depths = root / DEPTHS / scene / "dense0" / "depths"
    for name, pose in POSES.items():
        write_image(images / name, render(pose))
        write_depth(depths / f"{Path(name).stem}.h5", depth_m(pose))
    write_image(images / "relative.jpg", render(POSES["0_o.jpg"]))
    relative = np.where(np.arange(400) < 200, -1.0, 1.0) * np.ones((300, 1))
    write_depth(depths / "relative.h5", relative)
    write_image(images / "flat.jpg", render(POSES["0_o.jpg"]))
    others = ("relative.jpg", "flat.jpg", "absent.jpg")
    everything = POSES | dict.fromkeys(others, POSES["0_o.jpg"])
    if model:
        lines = []
        for number, (name, pose) in enumerate(everything.items(), start=1):
            values = " ".join(map(repr, (*pose.quat_wxyz, *pose.translation)))
            lines += [f"{number} {values} 1 {name}", "10.5 20.5 -1"]
        sparse = images.parent / "sparse-txt"
        sparse.mkdir()
        (sparse / "cameras.txt").write_text(f"# a\n1 PINHOLE 400 300 {FX} {FY} {CX} {CY}\n")
        (sparse / "images.txt").write_text("# a\n" + "\n".join(lines) + "\n")
        return
    (root / "scene_info").mkdir()
    names = list(everything)
    # of glue-factory's archives
    moved = root / "depth_undistorted" / scene
    moved.parent.mkdir()
    depths.rename(moved)
    arrays = {
        "image_paths": [f"Undistorted_SfM/{scene}/images/{name}" for name in names],
        "depth_paths": [f"elsewhere/{Path(name).stem}.h5" for name in names],
        "intrinsics": [np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]) for _ in names],
        "poses": [everything[name].matrix() for name in names],
    }
    # D2-Net writes None for a missing image, so all arrays hold objects
    arrays["image_paths"][-1] = arrays["intrinsics"][-1] = arrays["poses"][-1] = None
    as_published = {}
    for key, values in arrays.items():
        as_published[key] = np.empty(len(values), object)
        as_published[key][:] = values
    np.savez(root / "scene_info" / f"{scene}.npz", **as_published, overlap_matrix=np.eye(7))


def check(folder: Path) -> None:
    """Compare the written kapture with the sample; kapture must read it too."""
    data = KaptureFolder(folder).read()
    assert data.image_names() == [f"images/{name}" for name in POSES]
    records = depth_records(data)
    theirs = kapture_from_dir(str(folder))
    assert len(theirs.records_depth) == len(theirs.records_camera) == 4
    for name, pose in POSES.items():
        image = f"images/{name}"
        camera = data.camera_of(image)
        assert (camera.model, camera.width, camera.height) == ("PINHOLE", 400, 300)
        assert camera.params == pytest.approx(CAMERA.params)
        actual = data.cam_from_world(image)
        assert actual is not None
        np.testing.assert_allclose(actual.matrix(), pose.matrix(), atol=1e-12)
        path = KaptureFolder(folder).image_path(image)
        assert path.is_symlink() and path.resolve().parts[-3:] == ("0015", "images", name)
        depth = KaptureFolder(folder).depth_path(records[image].path)
        np.testing.assert_array_equal(read_depth_map(depth, width=400, height=300), depth_m(pose))


def test_a_scene_is_imported_by_its_undistorted_model(tmp_path: Path, capsys: Any) -> None:
    write_sample(tmp_path / "root", "0015", model=True)
    run_command("import", "megadepth", tmp_path / "root", "-o", tmp_path / "out")
    printed = " ".join(capsys.readouterr().out.split())
    assert printed == "scene 1 images 4 without depth 2"
    check(tmp_path / "out" / "0015")


def test_a_scene_is_imported_by_its_table_of_plain_arrays(tmp_path: Path) -> None:
    root = tmp_path / "root"
    write_sample(root, "0015", model=False)
    # the folder of the images alone is no model
    with pytest.raises(DataError, match=r"0015\.npz: not a file of plain arrays .*training\.md"):
        import_megadepth(root, tmp_path / "refused")
    docs = Path(__file__).parent.parent.parent / "docs" / "training.md"
    lines = docs.read_text().split("<!-- plain arrays -->\n```\n")[1].split("```")[0]
    table = root / "scene_info" / "0015.npz"
    script = tmp_path / "plain_arrays.py"
    script.write_text(lines.replace("TABLE", repr(str(table))))
    subprocess.run([sys.executable, script], check=True)
    counts = import_megadepth(root, tmp_path / "out", ("0015",))
    assert counts == {"scenes": 1, "images": 4, "without_depth": 2}
    check(tmp_path / "out" / "0015")


def test_missing_scenes_and_wrong_tables_are_refused(tmp_path: Path) -> None:
    for scenes, message in (
        ((), "found neither Undistorted_SfM/<scene> nor scene_info/<scene>.npz"),
        (("0001",), r"no sparse/0 or sparse or sparse-txt in .*0001, and no .*0001\.npz$"),
        (("..",), "'..'"),
    ):
        with pytest.raises(DataError, match=message):
            import_megadepth(tmp_path, tmp_path / "out", scenes)
    (tmp_path / "scene_info").mkdir()
    arrays = {"intrinsics": np.eye(3)[None], "poses": np.eye(4)[None]}
    for path, message in (("x.jpg", "scene 7 has no image with depth"), ("../../x.jpg", "x.jpg")):
        np.savez(tmp_path / "scene_info" / "7.npz", image_paths=[path], **arrays)
        with pytest.raises(DataError, match=message):
            import_megadepth(tmp_path, tmp_path / "out")
