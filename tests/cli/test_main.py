"""The command itself: help, options, signals, completion; mistakes in arguments and in data."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import megloc_kapture
from megloc_kapture.cli.info import shown
from megloc_kapture.cli.main import COMMANDS, main
from megloc_kapture.io.images import write_image
from megloc_kapture.pipeline.presets import BASIC_OPTIONS, PRESETS, options_of, options_of_preset
from megloc_kapture.service import server
from megloc_kapture.stages.options import PipelineOptions
from tests.cli.foreign import DESCRIPTORS, rename_type
from tests.worlds import folder_bytes

WRONG_ARGUMENTS = {
    "unknown command": (["localise"], "unknown command 'localise'; did you mean 'localize'"),
    "missing flags": (["refine-poses", "-i", "map", "--poses", "p", "-o", "out"], "--query PATH"),
    "unknown flag": (["eval", "kapture", "--roots", "x"], "Perhaps you meant: --root "),
    "import without a root": (["import", "aachen", "-o", "x"], "megloc import DATASET ROOT"),
    "not a number": (["eval", "--workers", "two"], "Error parsing --workers: "),
    "not a choice": (["eval", "-v", "loud"], "invalid choice 'loud'"),
    "camera of a kapture folder": (
        ["localize", "-i", "map", "--query", "query", "--every", "2"],
        "--camera and --every apply to --images",
    ),
    "value out of range": (["serve", "map", "--max-mb", "0"], "--max-mb 0.0: must be positive"),
}


@pytest.mark.parametrize(("arguments", "message"), WRONG_ARGUMENTS.values(), ids=WRONG_ARGUMENTS)
def test_wrong_arguments_are_refused(megloc: Any, arguments: list[str], message: str) -> None:
    done = megloc(*arguments)
    assert (done.status, done.out) == (2, "")
    assert message in " ".join(done.err.replace("│", " ").split())
    assert "Traceback" not in done.err and "pydantic" not in done.err


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help_text(megloc: Any, command: str) -> None:
    done = megloc(command, "-h")
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith(f"usage: megloc {command} ")


def test_help_loads_no_heavy_package_and_no_command_but_serve_the_web_server() -> None:
    code = """
import sys
from megloc_kapture.cli.main import COMMANDS, command_class, main
try:
    main(["--help"])
except SystemExit:
    slow = {"torch", "scipy", "numba", "cv2", "pandas", "pycolmap", "matplotlib"}
    print(slow & set(sys.modules))
for name in COMMANDS:
    command_class(name)
print({"fastapi", "uvicorn", "starlette"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("\nset()\nset()\n") and done.stderr == ""
    assert all(name in done.stdout for name in COMMANDS)


def test_sigterm_ends_with_143_and_promises_no_resumption_to_commands_that_start_over(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def terminate(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(sys, "argv", ["megloc", "options"])
    monkeypatch.setattr("megloc_kapture.cli.info.OptionsCommand.run", terminate)
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as end:
            main()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert end.value.code == 143
    assert capsys.readouterr().err == "megloc: terminated\n"


def test_a_kapture_folder_without_the_name_of_its_dataset_is_no_aachen(
    megloc: Any, scene: Path, tmp_path: Path
) -> None:
    command = ("eval", "--root", scene, "--workspace", tmp_path / "run", "-q")
    megloc(*command).refused("in its name; `megloc eval kapture` is for datasets other")


def test_a_full_disk_is_no_internal_error() -> None:
    command = [sys.executable, "-m", "megloc_kapture", "options"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("megloc: No space left on device: free some ")


def test_the_completion_of_bash_has_all_commands_and_their_flags(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["--tyro-print-completion", "bash"])
    script = capsys.readouterr().out
    assert all(command in script for command in COMMANDS) and "--features-dir" in script
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)


def test_every_option_is_listed_with_a_meaning(megloc: Any) -> None:
    basic = megloc("options", "--basic").out
    assert len(re.findall(r"^[a-z_.]+ = ", basic, flags=re.M)) == len(BASIC_OPTIONS) == 10
    listed = megloc("options").out
    every = list(options_of(PipelineOptions()))
    assert 50 < len(every) <= 60
    for key, value, field in every:
        assert f"\n{key} = {shown(value)}\n" in f"\n{listed}"
        assert field.description and field.description in listed, key


@pytest.mark.parametrize("preset", PRESETS)
def test_a_shown_value_is_accepted_by_set(preset: str) -> None:
    for key, value, _ in options_of(PRESETS[preset]):
        text = f"{key}={shown(value)}"
        if key == "stages":
            continue
        changed = options_of_preset(preset, assignments=[text])
        actual = {key: value for key, value, _ in options_of(changed)}[key]
        if isinstance(actual, float) or key == "guided_pyramid.scales":
            assert actual == pytest.approx(value, rel=1e-3)
        else:
            assert actual == value, text


def test_options_are_listed_by_stage_key_and_plugin(megloc: Any) -> None:
    of_stage = megloc("options", "query_pairs", "--preset", "megloc").out
    assert of_stage.startswith("query_pairs.by = retrieval\n    'retrieval' | 'exhaustive'; ")
    assert "query_pairs.top_k = 50\n" in of_stage and "mapping_pairs" not in of_stage
    assert megloc("options", "query_pairs.top_k").out.count("\n") == 2
    assert "aliked: options.threshold = 0.2\n" in megloc("options", "aliked").out
    assert "vlad: options." in megloc("options", "vlad").out
    assert "sweep: options." in megloc("options", "sweep").out
    assert megloc("options", "inliers").out == "inliers has no options\n"
    assert megloc("options", "mvs.estimator", "--basic").out.startswith("mvs.estimator = ")


def test_the_version(megloc: Any) -> None:
    assert megloc("--version").out == f"megloc-kapture {version('megloc-kapture')}\n"
    assert megloc_kapture.__version__ == version("megloc-kapture")


@pytest.fixture
def no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that is not refused must not wait for clients."""
    monkeypatch.setattr(server, "serve", lambda *_, **__: pytest.fail("it is served"))


@pytest.mark.usefixtures("no_server")
def test_a_port_in_use_is_refused_before_the_map_is_read(megloc: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        megloc("serve", tmp_path, "--port", port).refused(f"port {port}: .*in use")


@pytest.mark.usefixtures("no_server")
def test_without_the_extra_the_installation_is_named(
    megloc: Any, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("megloc_kapture.service")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    line = megloc("serve", finished / "map").refused("uvicorn is not installed")
    assert line.endswith('pip install "megloc-kapture[serve]"')


Damage = Callable[[Path], Any]

IMAGE = "mapping/sensors/records_data/0005.jpg"


def image_of_another_size(root: Path) -> None:
    write_image(root / IMAGE, np.zeros((100, 200, 3), np.uint8))


DATASETS: dict[str, tuple[Damage, str]] = {
    "missing image": (lambda root: (root / IMAGE).unlink(), r"records_data/0005\.jpg: "),
    "image of another size": (image_of_another_size, r"records_data/0005\.jpg: .*200x100.*400x300"),
}


@pytest.mark.parametrize(("damage", "message"), DATASETS.values(), ids=DATASETS)
def test_a_damaged_dataset_is_refused(
    megloc: Any, dataset: Path, damage: Damage, message: str
) -> None:
    damage(dataset)
    before = folder_bytes(dataset)
    new = dataset.parent / "new"
    for root in (dataset,), ("--root", dataset):  # as in megloc eval
        megloc("import", "kapture", *root, "-o", new / "imported").refused(message)
    assert not any(new.glob("*"))
    assert folder_bytes(dataset) == before


def test_localize_and_info_refuse_a_damaged_map(megloc: Any, foreign: Path) -> None:
    path = foreign / "map" / DESCRIPTORS / "0000.jpg.desc"
    path.write_bytes(path.read_bytes()[: 128 * 4 * 799])
    places = ("-i", foreign / "map", "--query", foreign / "query")
    message = r"0000\.jpg\.desc: 799 descriptors for 800 keypoints"
    megloc("localize", *places, "-o", foreign.parent / "localized").refused(message)
    assert not (foreign.parent / "localized").exists()
    assert megloc("info", foreign / "map").status == 2


def test_missing_features_that_no_plugin_extracts_are_named(megloc: Any, foreign: Path) -> None:
    rename_type(foreign)
    output = foreign.parent / "localized"
    localize = ("localize", "-i", foreign / "map", "--query", foreign / "query", "-o", output)
    assert "no extractor for orb_800" in megloc("info", foreign / "map").out
    of_type = megloc("info", foreign / "map", "--keypoints-type", "orb")
    assert of_type.status == 2 and "no points of keypoints type 'orb'" in of_type.err
    (foreign / "query/reconstruction/keypoints/orb_800/0001.jpg.kpt").unlink()
    message = r"image '.*0001\.jpg': features of type 'orb_800' are missing and no extractor"
    megloc(*localize).refused(message)
    (foreign / "map/reconstruction/descriptors/orb_800/0000.jpg.desc").unlink()
    assert "missing for 1 images, such as 0000.jpg; " in megloc("info", foreign / "map").out
    lacking = r"/map: 1 map images, such as 0000\.jpg, lack descriptors: .*'orb_800'"
    megloc(*localize).refused(lacking, "no extractor")
    assert not output.exists()


@pytest.mark.parametrize(
    "command",
    [
        "evaluate --gt {}/nowhere -i {}/query_gt",
        "evaluate --gt {}/query_gt -i {}/nowhere",
        "submit kapture -i {}/nowhere -o {}/new/poses.txt",
        "extract-local -i {}/nowhere -o {}/new",
        "extract-global -i {}/nowhere -o {}/new",
        "pairs-mapping -i {}/nowhere -o {}/new/pairs.txt",
        "pairs-query -i {}/mapping --query {}/nowhere -o {}/new/pairs.txt",
        "match -i {}/nowhere --pairs {}/pairs.txt -o {}/new",
        "triangulate -i {}/nowhere -o {}/new",
        "info {}/nowhere",
    ],
)
def test_every_command_names_a_missing_folder(megloc: Any, dataset: Path, command: str) -> None:
    words = [word.replace("{}", str(dataset)) for word in command.split()]
    megloc(*words).refused("/nowhere|/mapping")
    assert not (dataset / "new").exists()
