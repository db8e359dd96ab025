"""``megloc train-field`` and ``megloc render`` on a corner of a room that is rendered exactly."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from corner import write_scene

from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import read_status

pytest.importorskip("torch")

QUICK = ("--steps", "6", "--max-side", "40", "--device", "cpu")
CAMERA_TEXT = "SIMPLE_PINHOLE,48,36,40,24,18"


@pytest.fixture(scope="module")
def mapping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("corner")
    write_scene(root, with_depth=True)
    return root / "mapping"


@pytest.fixture(scope="module")
def field(mapping: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from megloc_kapture.cli.main import main

    out = tmp_path_factory.mktemp("field") / "field"
    with pytest.raises(SystemExit) as end:
        main(["train-field", "-i", str(mapping), "-o", str(out), *QUICK, "-q"])
    assert end.value.code == 0
    return out


def pose_text(mapping: Path) -> str:
    pose = KaptureFolder(mapping).read().poses()["0000.jpg"]
    return "--pose=" + ",".join(f"{value:.9f}" for value in (*pose.quat_wxyz, *pose.translation))


def test_the_same_bytes_twice(megloc: Any, mapping: Path, field: Path, tmp_path: Path) -> None:
    done = megloc("train-field", "-i", mapping, "-o", tmp_path / "again", *QUICK)
    assert done.status == 0 and "PSNR of 0 held-out images" in done.out
    assert "step 1 of 6" in done.err
    for name in ("field.json", "field.safetensors"):
        assert (tmp_path / "again" / name).read_bytes() == (field / name).read_bytes()
    assert len(json.loads((field / "field.json").read_text())["images"]) == 7


def test_an_interrupted_training_goes_on(
    megloc: Any, mapping: Path, field: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from megloc_kapture.refinement import field_training

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
    megloc(*command, "--seed", "1").refused("of other options or images; -f begins again")
    steps: list[int] = []
    monkeypatch.setattr(
        field_training.FieldTrainer, "_learn", lambda t, g: (steps.append(t._step), learn(t, g))
    )
    assert megloc(*command).status == 0 and steps == [4, 5]
    for name in ("field.json", "field.safetensors"):
        assert (out / name).read_bytes() == (field / name).read_bytes()
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
    megloc(*command).refused("stands there")
    assert megloc(*command, "-f", "--appearance", "0000.jpg").status == 0
    assert not np.array_equal(read_image_rgb(out), image)


def test_views_along_a_result(megloc: Any, mapping: Path, field: Path, tmp_path: Path) -> None:
    one = tmp_path / "one"
    shutil.copytree(mapping / "sensors", one / "sensors", symlinks=True)
    path = one / "sensors" / "trajectories.txt"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:3]))  # the header, and one pose
    done = megloc("render", field, "--along", one, "-o", tmp_path / "rendered", "--max-side", "80")
    assert done.out.startswith("1 views rendered")
    written = KaptureFolder(tmp_path / "rendered")
    written.validate(deep=True)
    data = written.read()
    (name,) = data.image_names()
    assert data.poses()[name] == KaptureFolder(one).read().poses()["0000.jpg"]
    (depth,) = data.records_depth.values()
    assert (data.camera_of(name).width, data.camera_of(name).height) == (80, 60)
    assert written.depth_path(depth).stat().st_size == 4 * 80 * 60


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
    assert done.out.startswith("4 poses, 0 accepted by field;"), done.err
    for status in read_status(out / "status.csv").values():
        assert status.refinement.startswith("field: query and rendering: ")


def test_what_is_refused(megloc: Any, mapping: Path, field: Path, tmp_path: Path) -> None:
    out = tmp_path / "view.png"
    pose, camera = pose_text(mapping), ("--camera", CAMERA_TEXT)
    megloc("render", field, "-o", out).refused("either --pose and --camera, or --along")
    megloc("render", field, pose, "-o", out).refused("--pose needs the --camera")
    side = ("--max-side", "9")
    megloc("render", field, pose, *camera, *side, "-o", out).refused("--max-side changes nothing")
    megloc("render", field, "--along", mapping, *camera, "-o", out).refused("--camera changes")
    for wrong in ("1,0,0", "2,0,0,0,0,0,0", "1,0,0,0,0,0,nan", "x,0,0,0,0,0,0"):
        megloc("render", field, f"--pose={wrong}", *camera, "-o", out).refused("qw,qx,qy,qz,tx")
    megloc("render", field, pose, *camera, "-o", tmp_path / "view.gif").refused("must end in")
    unknown = megloc("render", field, pose, *camera, "-o", out, "--appearance", "me.jpg")
    unknown.refused("not trained on an image 'me.jpg'")
    megloc("render", mapping, pose, *camera, "-o", out).refused("train-field writes one")
    train = ("train-field", "-i", mapping, "-o", tmp_path / "out")
    megloc(*train, "--steps", "0").refused("steps: .*greater than 0")
    assert not out.exists() and not (tmp_path / "out").exists()


def test_a_damaged_field_is_named(megloc: Any, mapping: Path, field: Path, tmp_path: Path) -> None:
    command = (pose_text(mapping), "--camera", CAMERA_TEXT, "-o", tmp_path / "view.png")
    for name, content, said in (
        ("field.json", b"{}", r"field\.json: .*kind"),
        ("field.safetensors", b"nonsense", r"field\.safetensors: "),
    ):
        broken = tmp_path / name
        shutil.copytree(field, broken)
        (broken / name).write_bytes(content)
        megloc("render", broken, *command).refused(said)
    fewer = tmp_path / "fewer"
    shutil.copytree(field, fewer)
    manifest = json.loads((field / "field.json").read_text())
    manifest["images"].pop()
    (fewer / "field.json").write_text(json.dumps(manifest))
    megloc("render", fewer, *command).refused("keys of another shape: appearance.weight")
