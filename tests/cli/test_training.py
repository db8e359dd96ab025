"""``megloc train``, ``train-field`` and ``render``: flags, files, refused arguments."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from corner import pose_at, write_kapture, write_scene
from kornia.feature import XFeat
from safetensors.torch import load_file, save_file

from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.refinement import field_training
from megloc_kapture.stages.scene import depth_records
from tests.pipeline.runs import run_command

SMALL = ("steps=2", "layers=2", "pairs_per_step=1", "max_keypoints=40", "max_size_px=200")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two kapture folders, and random weights."""
    root = tmp_path_factory.mktemp("inputs")
    for name, shift in (("mine", 0.0), ("other", 0.3)):
        poses = {f"{k}.png": pose_at((shift + 0.8 * k - 2, 0, 0), 12 - 12 * k, 0) for k in range(3)}
        write_kapture(root / name, poses, with_poses=True, with_depth=True)
    torch.manual_seed(0)
    save_file(XFeat().net.state_dict(), root / "xfeat.safetensors")
    return root


def test_a_matcher_is_trained_and_evaluated(megloc: Any, inputs: Path, tmp_path: Path) -> None:
    output = tmp_path / "small.safetensors"
    weights = f"features.options.weights={inputs / 'xfeat.safetensors'}"
    chosen = (*SMALL, weights, "features.options.threshold=0.0", "device=cpu", "held_out_pairs=10")
    options = [word for text in chosen for word in ("--set", text)]
    data = ("-i", inputs / "mine", "--held-out", inputs / "other")
    done = megloc("train", "matcher", *data, "--features", "xfeat", *options, "-o", output)
    assert done.status == 0, done.err
    assert "held out loss" in done.out and f"trained: {output}" in done.out
    assert "bin_score" in load_file(output)
    manifest = json.loads(output.with_suffix(".json").read_text())
    assert list(manifest["training"]["data"]) == ["mine"]
    assert manifest["held_out"]["other"]["pairs"] == 10
    assert np.isfinite(manifest["held_out"]["other"]["loss"])


QUICK = ("--steps", "4", "--max-side", "40", "--device", "cpu")
HERE = ("--max-side", "32", "--executor", "inline")
CAMERA_TEXT = "SIMPLE_PINHOLE,48,36,40,24,18"


@pytest.fixture(scope="module")
def mapping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("corner")
    write_scene(root, with_depth=True)
    return root / "mapping"


@pytest.fixture(scope="module")
def field(mapping: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("field") / "field"
    run_command("train-field", "-i", mapping, "-o", out, *QUICK, "-q")
    return out


def pose_text(mapping: Path) -> str:
    pose = KaptureFolder(mapping).read().poses()["0000.jpg"]
    return "--pose=" + ",".join(f"{value:.9f}" for value in (*pose.quat_wxyz, *pose.translation))


def test_an_interrupted_training_is_resumed(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(field_training, "_KEEP_EVERY", 2)
    learn, out = field_training.FieldTrainer._learn, tmp_path / "out"
    command = ("train-field", "-i", mapping, "-o", out, *QUICK)

    def interrupted(trainer: Any, generator: Any) -> None:
        if trainer._step == 3:
            raise KeyboardInterrupt
        learn(trainer, generator)

    with monkeypatch.context() as patch:
        patch.setattr(field_training.FieldTrainer, "_learn", interrupted)
        assert megloc(*command).status == 130
    assert [path.name for path in out.iterdir() if path.name[0] != "."] == ["field.state.pt"]
    megloc("render", out, "--along", mapping, "-o", tmp_path / "x").refused("train-field writes")
    megloc(*command, "--seed", "1").refused("with different options or images; -f starts over")
    assert megloc(*command).status == 0
    for name in ("field.json", "field.safetensors"):
        assert (out / name).read_bytes() == (field / name).read_bytes()
    assert not (out / "field.state.pt").exists()


def test_a_view_in_colour_and_depth(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, depth = tmp_path / "view.png", tmp_path / "depth.png"
    command = ("render", field, pose_text(mapping), "--camera", CAMERA_TEXT, "-o", out)
    assert megloc(*command, "--depth", depth).status == 0
    image, stored = read_image_rgb(out), cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    assert image.shape == (36, 48, 3) and stored.shape == (36, 48) and stored.dtype == np.uint16
    # the walls are 4 to 7 m away; four steps reach the order of magnitude
    assert 1000 < np.median(stored[stored > 0]) < 15000
    megloc(*command).refused("exists; -f overwrites it")
    # depth of more than 16 bits is unknown
    monkeypatch.setattr("megloc_kapture.cli.training._MILLIMETRES", 1e6)
    light = ("--appearance", "0000.jpg")
    assert megloc(*command, "--depth", depth, "-f", *light).status == 0
    assert not np.array_equal(read_image_rgb(out), image)
    assert cv2.imread(str(depth), cv2.IMREAD_UNCHANGED).max() < 65535


def test_views_are_rendered_along_the_poses_of_a_folder(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path
) -> None:
    done = megloc("render", field, "--along", mapping, "-o", tmp_path / "rendered", *HERE)
    assert done.out.startswith("7 views rendered")
    written = KaptureFolder(tmp_path / "rendered").read()
    poses = KaptureFolder(mapping).read().poses()
    assert list(written.poses().values()) == list(poses.values())
    camera = written.camera_of(written.image_names()[0])
    assert (camera.width, camera.height) == (32, 24)


def test_views_between_the_cameras_can_be_merged_with_the_map(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path
) -> None:
    out, joined = tmp_path / "between", tmp_path / "joined"
    done = megloc("render", field, "--between", mapping, "-o", out, *HERE)
    assert done.status == 0, done
    KaptureFolder(out).validate(deep=True)
    views, real = (KaptureFolder(root).read().poses() for root in (out, mapping))
    assert done.out.startswith(f"{len(views)} views rendered") and len(views) >= len(real) // 2
    centers = np.array([pose.center() for pose in real.values()])
    middles = 0.5 * (centers[:, None] + centers[None])
    for pose in views.values():
        away = np.linalg.norm(middles - pose.center(), axis=2)
        first, second = np.unravel_index(int(np.argmin(away)), away.shape)
        assert away[first, second] < 1e-9 and first != second
    merge = [Path(sys.executable).with_name("kapture_merge"), "-i", mapping, out, "-o", joined]
    merge += ["--keep-sensor-ids", "--image_transfer", "copy"]
    subprocess.run([*map(str, merge)], check=True)
    data = KaptureFolder(joined).read()
    assert set(data.poses()) == set(depth_records(data)) == set(real) | set(views)
    assert all(KaptureFolder(joined).image_path(name).is_file() for name in data.image_names())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give one of --pose .*, --along and --between"),
        (["POSE"], "--pose needs --camera"),
        (["POSE", "--camera", CAMERA_TEXT, "--appearance", "me.jpg"], "not trained on image"),
        (["--between", "absent"], "absent"),
        (["--pose=1,0,0", "--camera", CAMERA_TEXT], "qw,qx,qy,qz,tx"),
        (["--pose=2,0,0,0,0,0,0", "--camera", CAMERA_TEXT], "qw,qx,qy,qz,tx"),
        (["POSE", "--camera", CAMERA_TEXT, "-o", "view.gif"], "must end in"),
    ],
)
def test_wrong_views_are_refused(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    given = [pose_text(mapping) if word == "POSE" else word for word in arguments]
    output = () if "-o" in given else ("-o", tmp_path / "view.png")
    megloc("render", field, *given, *output).refused(message)
    assert not (tmp_path / "view.png").exists()
