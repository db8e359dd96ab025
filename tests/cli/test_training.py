"""``megloc train``, ``train-field`` and ``render``: flags, files, and what they refuse."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas
import pytest
import torch
from corner import pose_at, write_kapture, write_scene
from kornia.feature import XFeat
from safetensors.torch import load_file, save_file

from megloc_kapture.cli.main import main
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.refinement import field_training
from megloc_kapture.stages.scene import depth_records

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


def arguments(inputs: Path, *more: str | Path) -> list[str | Path]:
    weights = f"features.options.weights={inputs / 'xfeat.safetensors'}"
    chosen = (*SMALL, weights, "features.options.threshold=0.0", "device=cpu")
    return [*(word for text in chosen for word in ("--set", text)), "--features", "xfeat", *more]


def test_a_matcher_and_its_files(megloc: Any, inputs: Path, tmp_path: Path) -> None:
    output = tmp_path / "small.safetensors"
    mine, other = inputs / "mine", inputs / "other"
    data = ("-i", mine, "--held-out", other)
    few = ("--set", "held_out_pairs=10")
    command = ["train", "matcher", *data, *arguments(inputs, "-o", output, *few)]
    done = megloc(*command)
    assert done.status == 0, done.err
    assert "held out loss" in done.out and f"trained: {output}" in done.out
    assert "bin_score" in load_file(output)
    manifest = json.loads(output.with_suffix(".json").read_text())
    assert list(manifest["training"]["data"]) == ["mine"]
    assert manifest["held_out"]["other"]["pairs"] == 10
    assert np.isfinite(manifest["held_out"]["other"]["loss"])
    again = megloc(*command)
    assert again.status == 0 and again.out == done.out


QUICK = ("--steps", "6", "--max-side", "40", "--device", "cpu")
HERE = ("--max-side", "80", "--executor", "inline")
CAMERA_TEXT = "SIMPLE_PINHOLE,48,36,40,24,18"


@pytest.fixture(scope="module")
def mapping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("corner")
    write_scene(root, with_depth=True)
    return root / "mapping"


@pytest.fixture(scope="module")
def field(mapping: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("field") / "field"
    with pytest.raises(SystemExit) as end:
        main(["train-field", "-i", str(mapping), "-o", str(out), *QUICK, "-q"])
    assert end.value.code == 0
    return out


def same_field(one: Path, other: Path) -> bool:
    names = ("field.json", "field.safetensors")
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in names)


def pose_text(mapping: Path) -> str:
    pose = KaptureFolder(mapping).read().poses()["0000.jpg"]
    return "--pose=" + ",".join(f"{value:.9f}" for value in (*pose.quat_wxyz, *pose.translation))


def test_an_interrupted_training_goes_on(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(field_training, "_KEEP_EVERY", 2)
    learn, out = field_training.FieldTrainer._learn, tmp_path / "out"
    command = ("train-field", "-i", mapping, "-o", out, *QUICK)

    def killed(trainer: Any, generator: Any) -> None:
        if trainer._step == 5:
            raise KeyboardInterrupt
        learn(trainer, generator)

    monkeypatch.setattr(field_training.FieldTrainer, "_learn", killed)
    megloc(*command)
    assert [path.name for path in out.iterdir() if path.name[0] != "."] == ["field.state.pt"]
    megloc("render", out, "--along", mapping, "-o", tmp_path / "x").refused(
        "train-field writes one"
    )
    monkeypatch.setattr(field_training.FieldTrainer, "_learn", learn)
    megloc(*command, "--seed", "1").refused("with other options or images; -f starts over")
    steps: list[int] = []
    monkeypatch.setattr(
        field_training.FieldTrainer, "_learn", lambda t, g: (steps.append(t._step), learn(t, g))
    )
    assert megloc(*command).status == 0 and steps == [4, 5]
    assert same_field(out, field)
    assert not (out / "field.state.pt").exists()


def test_a_view_in_colour_and_depth(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path
) -> None:
    out, depth = tmp_path / "view.png", tmp_path / "depth.png"
    command = ("render", field, pose_text(mapping), "--camera", CAMERA_TEXT, "-o", out)
    assert megloc(*command, "--depth", depth).status == 0
    image, stored = read_image_rgb(out), cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    assert image.shape == (36, 48, 3) and stored.shape == (36, 48) and stored.dtype == np.uint16
    # the walls are 4 to 7 m away; six steps are not enough for more than their order
    assert 1000 < np.median(stored[stored > 0]) < 15000
    megloc(*command).refused("exists; -f overwrites it")
    assert megloc(*command, "-f", "--appearance", "0000.jpg").status == 0
    assert not np.array_equal(read_image_rgb(out), image)


def test_views_along_a_result(megloc: Any, mapping: Path, field: Path, tmp_path: Path) -> None:
    one = tmp_path / "one"
    shutil.copytree(mapping / "sensors", one / "sensors", symlinks=True)
    path = one / "sensors" / "trajectories.txt"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:3]))  # the header, and one pose
    done = megloc("render", field, "--along", one, "-o", tmp_path / "rendered", *HERE)
    assert done.out.startswith("1 views rendered")
    written = KaptureFolder(tmp_path / "rendered")
    written.validate(deep=True)
    data = written.read()
    (name,) = data.image_names()
    assert data.poses()[name] == KaptureFolder(one).read().poses()["0000.jpg"]
    (depth,) = data.records_depth.values()
    assert (data.camera_of(name).width, data.camera_of(name).height) == (80, 60)
    assert written.depth_path(depth).stat().st_size == 4 * 80 * 60
    # names that differ in their ending alone would become one
    records = one / "sensors" / "records_camera.txt"
    records.write_text(records.read_text().replace("0002.jpg", "0000.jpeg"))
    path.write_text("".join(lines))
    megloc("render", field, "--along", one, "-o", tmp_path / "x").refused("rendered into one file")


def test_views_that_no_camera_took_join_the_map(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path
) -> None:
    out = tmp_path / "between"
    done = megloc("render", field, "--between", mapping, "-o", out, *HERE)
    assert done.status == 0, done
    written, real = KaptureFolder(out), KaptureFolder(mapping).read().poses()
    written.validate(deep=True)
    views = written.read().poses()
    assert done.out.startswith(f"{len(views)} views rendered") and len(views) >= len(real) // 2
    centers = np.array([pose.center() for pose in real.values()])
    axes = np.array([pose.rotation_matrix()[2] for pose in real.values()])
    for pose in views.values():
        middles = 0.5 * (centers[:, None] + centers[None])
        away = np.linalg.norm(middles - pose.center(), axis=2)
        one, other = np.unravel_index(int(np.argmin(away)), away.shape)
        assert away[one, other] < 1e-9 and one != other
        # it looks between the two: as far from one as from the other
        between = [float(np.dot(pose.rotation_matrix()[2], axes[row])) for row in (one, other)]
        assert between[0] == pytest.approx(between[1], abs=1e-3)
        assert min(between) >= np.dot(axes[one], axes[other]) - 1e-9
    merge = Path(sys.executable).with_name("kapture_merge")
    joined = tmp_path / "joined"
    command = [merge, "-i", mapping, out, "-o", joined, "--keep-sensor-ids"]
    subprocess.run([*map(str, command), "--image_transfer", "copy"], check=True)
    data = KaptureFolder(joined).read()
    assert set(data.poses()) == set(real) | set(views)
    assert len(data.records_depth) == len(real) + len(views)
    assert set(depth_records(data)) == set(real) | set(views)
    assert all(KaptureFolder(joined).image_path(name).is_file() for name in data.image_names())


def test_poses_are_refined_by_it_or_stay(
    megloc: Any, finished: Path, field: Path, tmp_path: Path
) -> None:
    out = tmp_path / "refined"
    chosen = f'pose_refinement.by=[{{name="field",options={{field="{field}",max_side_px=80}}}}]'
    done = megloc(
        *("refine-poses", "-i", finished / "map", "--query", finished / "query"),
        *("--poses", finished / "localized", "-o", out, "--executor", "inline", "-q"),
        *("--by", "field", "--set", chosen),
    )
    # six steps do not make a field that matches anything
    assert done.out.startswith("4 queries, 0 accepted by field;"), done.err
    for text in pandas.read_csv(out / "status.csv")["refinement"]:
        assert text.startswith("field: query and rendering: ")


def test_what_is_refused(megloc: Any, mapping: Path, field: Path, tmp_path: Path) -> None:
    out = tmp_path / "view.png"
    pose, camera = pose_text(mapping), ("--camera", CAMERA_TEXT)
    for arguments, words in (
        ((), "nothing to render: give --pose and --camera, --along or --between"),
        (("--between", mapping, "--along", mapping), "nothing to render"),
        ((pose,), "--pose needs --camera"),
        ((pose, *camera, "--appearance", "me.jpg"), "not trained on an image 'me.jpg'"),
        (("--between", out / "none"), "none"),
        *(
            ((f"--pose={wrong}", *camera), "qw,qx,qy,qz,tx")
            for wrong in ("1,0,0", "2,0,0,0,0,0,0", "1,0,0,0,0,0,nan", "x,0,0,0,0,0,0")
        ),
    ):
        megloc("render", field, *arguments, "-o", out).refused(words)
    megloc("render", field, pose, *camera, "-o", tmp_path / "view.gif").refused("must end in")
    megloc("render", mapping, pose, *camera, "-o", out).refused("train-field writes one")
    train = ("train-field", "-i", mapping, "-o", tmp_path / "out")
    megloc(*train, "--steps", "0").refused("steps: .*greater than 0")
    assert not out.exists() and not (tmp_path / "out").exists()
