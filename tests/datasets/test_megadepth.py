"""MegaDepth's layout, as a rendered sample has it, to kapture; and a training on it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from corner import CAMERA, depth_m, pose_at, render
from kapture.io.csv import kapture_from_dir
from safetensors.torch import load_file, save_file

from megloc_kapture.cli.main import main
from megloc_kapture.datasets.megadepth import (
    MegaDepthOptions,
    import_megadepth,
    read_megadepth_depth,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.images import read_depth_map, write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.nets.superpoint import SuperPointNet
from megloc_kapture.stages.rigs import depth_records

h5py = pytest.importorskip("h5py")

DEPTHS = Path("phoenix/S6/zl548/MegaDepth_v1")
POSES = {f"{k}_o.jpg": pose_at((0.8 * k - 2, 0, 0), 18 - 12 * k, 0) for k in range(4)}
FX, FY, CX, CY = CAMERA.params


def write_depth(path: Path, depth: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["depth"] = depth


def write_sample(root: Path, scene: str, *, model: bool) -> None:
    """Four images; a fifth has relative depth, of a sixth there is only the model's line."""
    images = root / "Undistorted_SfM" / scene / "images"
    depths = root / DEPTHS / scene / "dense0" / "depths"
    for name, pose in POSES.items():
        write_image(images / name, render(pose))
        write_depth(depths / f"{Path(name).stem}.h5", depth_m(pose))
    write_image(images / "relative.jpg", render(POSES["0_o.jpg"]))
    write_depth(
        depths / "relative.h5", np.where(np.arange(400) < 200, -1.0, 1.0) * np.ones((300, 1))
    )
    everything = {**POSES, "relative.jpg": POSES["0_o.jpg"], "absent.jpg": POSES["0_o.jpg"]}
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
    # as D2-Net writes them: of an image that is not there None, which makes objects of all
    arrays["image_paths"][-1] = arrays["intrinsics"][-1] = arrays["poses"][-1] = None
    as_published = {}
    for key, values in arrays.items():
        as_published[key] = np.empty(len(values), object)
        as_published[key][:] = values
    np.savez(root / "scene_info" / f"{scene}.npz", **as_published, overlap_matrix=np.eye(6))


def check(folder: Path) -> None:
    """The kapture of a scene is the sample's, by kapture's own reader too."""
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
        found = data.cam_from_world(image)
        assert found is not None
        np.testing.assert_allclose(found.matrix(), pose.matrix(), atol=1e-12)
        path = KaptureFolder(folder).image_path(image)
        assert path.is_symlink() and path.resolve().parts[-3:] == ("0015", "images", name)
        depth = KaptureFolder(folder).depth_path(records[image].path)
        np.testing.assert_array_equal(read_depth_map(depth, width=400, height=300), depth_m(pose))


def test_a_scene_with_its_undistorted_model(tmp_path: Path, capsys: Any) -> None:
    write_sample(tmp_path / "root", "0015", model=True)
    with pytest.raises(SystemExit) as end:
        main(["import", "megadepth", str(tmp_path / "root"), "-o", str(tmp_path / "out")])
    assert end.value.code == 0, capsys.readouterr().err
    printed = capsys.readouterr().out.split("\n")
    assert [line.split() for line in printed if line] == [
        ["scenes", "1"],
        ["images", "4"],
        ["without", "depth", "1"],
    ]
    check(tmp_path / "out" / "0015")


def test_a_scene_by_its_table(tmp_path: Path) -> None:
    root = tmp_path / "root"
    write_sample(root, "0015", model=False)
    # the folder of the images alone is no model
    with pytest.raises(DataError, match=r"0015\.npz: its arrays are Python objects.*training\.md"):
        import_megadepth(root, tmp_path / "refused")
    docs = Path(__file__).parent.parent.parent / "docs" / "training.md"
    lines = docs.read_text().split("<!-- plain arrays -->\n```\n")[1].split("```")[0]
    table = root / "scene_info" / "0015.npz"
    script = tmp_path / "plain_arrays.py"
    script.write_text(lines.replace("TABLE", repr(str(table))))
    subprocess.run([sys.executable, script], check=True)
    counts = import_megadepth(root, tmp_path / "out", MegaDepthOptions(scenes=("0015",)))
    assert counts == {"scenes": 1, "images": 4, "without_depth": 1}
    check(tmp_path / "out" / "0015")
    found = dict(np.load(table))
    for changes, message in (
        ({"poses": found["poses"][:2]}, r"poses is float64 \(2, 4, 4\), expected \(5, 4, 4\)"),
        ({"image_paths": np.array(["../../x.jpg"] * 5)}, "x.jpg"),
    ):
        np.savez(table, **{**found, **changes})
        with pytest.raises(DataError, match=message):
            import_megadepth(root, tmp_path / "broken")


def test_depth_that_is_none_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_depth(tmp_path / "other.h5", np.ones((3, 4), np.float32))
    elsewhere = [(str(tmp_path / "raw"), 0, h5py.h5f.UNLIMITED)]
    in_others = "lies in another file"
    for message in ("no array 'depth'", in_others, f"'depth' {in_others}", "int64", "HDF5"):
        with h5py.File(path, "w") as file:
            if message.startswith("no array"):
                file["depth"] = h5py.ExternalLink("other.h5", "depth")
            elif message.startswith("'depth'"):
                file.create_dataset("depth", (3, 4), np.float32, external=elsewhere)
            elif message == in_others:
                layout = h5py.VirtualLayout((3, 4), np.float32)
                layout[...] = h5py.VirtualSource(tmp_path / "other.h5", "depth", (3, 4))
                file.create_virtual_dataset("depth", layout)
            elif "int64" in message:
                file["depth"] = np.arange(3)
        if message == "HDF5":
            path.write_bytes(path.read_bytes()[:100])
        with pytest.raises(DataError, match=rf"a\.h5: .*{message}"):
            read_megadepth_depth(path)
    write_depth(path, np.array([[1.5, np.nan], [0.0, 2.0]], np.float32))
    found = read_megadepth_depth(path)
    assert found is not None and found.tolist() == [[1.5, 0.0], [0.0, 2.0]]
    write_depth(path, np.zeros((2, 2), np.float32))
    assert read_megadepth_depth(path) is None


def test_what_is_missing_is_named(tmp_path: Path, capsys: Any) -> None:
    with pytest.raises(DataError, match="neither Undistorted_SfM/SCENE nor scene_info/SCENE.npz"):
        import_megadepth(tmp_path, tmp_path / "out")
    with pytest.raises(DataError, match=r"neither .*0001 nor .*0001\.npz is there"):
        import_megadepth(tmp_path, tmp_path / "out", MegaDepthOptions(scenes=("0001",)))
    (tmp_path / "empty" / "scene_info").mkdir(parents=True)
    arrays = {"intrinsics": np.eye(3)[None], "poses": np.eye(4)[None]}
    np.savez(tmp_path / "empty" / "scene_info" / "7.npz", image_paths=["x.jpg"], **arrays)
    with pytest.raises(DataError, match="scene 7 has no image that is there with its depth"):
        import_megadepth(tmp_path / "empty", tmp_path / "out")
    with pytest.raises(DataError, match="'..'"):
        import_megadepth(tmp_path, tmp_path / "out", MegaDepthOptions(scenes=("..",)))
    with pytest.raises(SystemExit) as end:
        main(["import", "megadepth", str(tmp_path), "-o", str(tmp_path / "o"), "--images", "x"])
    assert end.value.code == 2
    assert "--images changes nothing of MegaDepth" in capsys.readouterr().err


@pytest.mark.slow
def test_the_split_superpoint_trains_on_it(tmp_path: Path, capsys: Any) -> None:
    """As the paper did, with random weights: import, train through SuperGlue, two files."""
    for scene in ("0015", "0022"):
        write_sample(tmp_path / "root", scene, model=True)
    torch.manual_seed(0)
    net, weights = SuperPointNet(), tmp_path / "superpoint_v1.safetensors"
    for name, value in net.named_parameters():
        if name.endswith("weight"):
            torch.nn.init.kaiming_normal_(value)
    save_file(net.state_dict(), weights)
    kaptures, output = tmp_path / "kapture", tmp_path / "night.safetensors"
    train = ["train", "descriptor", "-i", kaptures / "0015", "--held-out", kaptures / "0022"]
    chosen = ("steps=4", "check_every=2", "pairs_per_step=1", "layers=4", "max_keypoints=128")
    chosen += ("held_out_pairs=3", f"features.options.weights={weights}", "device=cpu")
    for command in (
        ["import", "megadepth", tmp_path / "root", "-o", kaptures],
        [*train, "-o", output, *(word for text in chosen for word in ("--set", text))],
    ):
        with pytest.raises(SystemExit) as end:
            main([str(word) for word in command])
        assert end.value.code == 0, capsys.readouterr().err
    assert set(load_file(output)) == {k for k in net.state_dict() if not k.startswith("convP")}
    assert (tmp_path / "night-superglue.safetensors").is_file()
    assert len(output.with_suffix(".csv").read_text().splitlines()) == 3
