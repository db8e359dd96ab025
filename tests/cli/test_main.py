"""The command as such: help, examples, options, errors of the command line, tracebacks, pipes."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from typing import Any

import pytest

import megloc_kapture
from megloc_kapture.cli.info import shown
from megloc_kapture.cli.main import COMMANDS, main
from megloc_kapture.pipeline.presets import BASIC_OPTIONS, PRESETS, options_of, options_of_preset
from megloc_kapture.stages.options import PipelineOptions

BAD_ARGUMENTS = {
    "no command": ([], "Missing subcommand"),
    "unknown command": (["localise"], "unknown command 'localise'; did you mean 'localize'"),
    "missing flags": (["refine-poses", "-i", "map", "--poses", "p", "-o", "out"], "--query PATH"),
    "unknown flag": (["eval", "kapture", "--roots", "x"], "Perhaps you meant: --root "),
    "no value": (["eval", "--set"], "Missing value for argument '--set'"),
    "not a number": (["eval", "--workers", "two"], "Error parsing --workers: "),
    "not a choice": (["eval", "-v", "loud"], "invalid choice 'loud'"),
    "too many": (["info", "a", "b"], "Unrecognized options: b"),
    "value out of range": (["serve", "map", "--max-mb", "0"], "--max-mb 0.0: must be positive"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS)
def test_wrong_arguments_are_refused(megloc: Any, arguments: list[str], message: str) -> None:
    done = megloc(*arguments)
    assert (done.status, done.out) == (2, "")
    assert message in " ".join(done.err.replace("│", " ").split())
    assert "Traceback" not in done.err and "pydantic" not in done.err


@pytest.mark.parametrize("flag", ["-h", "--help"])
@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_help(megloc: Any, command: str | None, flag: str) -> None:
    done = megloc(*([command] if command else []), flag)
    assert (done.status, done.err) == (0, "")
    if command is None:
        assert all(name in done.out for name in COMMANDS)
    else:
        assert done.out.startswith(f"usage: megloc {command} ")


def test_the_list_of_commands_costs_no_solver() -> None:
    code = (
        "import sys\nfrom megloc_kapture.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: print(sorted({'torch', 'scipy', 'numba', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("\n[]\n")


def completed(script: str, *words: str) -> list[str]:
    """What bash offers for a line that ends with the last of the words."""
    line = (
        f"COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}; COMP_LINE='{words}'; "
        '_tyro_megloc; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "-c", f"{script}\n{line}"], capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def script_for(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit):
        main(["--tyro-print-completion", shell])
    return capsys.readouterr().out


def test_completion_knows_commands_and_their_flags(capsys: pytest.CaptureFixture[str]) -> None:
    script = script_for("bash", capsys)
    assert set(COMMANDS) <= set(completed(script, "megloc", ""))
    assert completed(script, "megloc", "loc") == ["localize"]
    assert "--features-dir" in completed(script, "megloc", "match", "--feat")
    assert script_for("zsh", capsys).startswith("#compdef megloc")


def test_every_option_is_listed_with_a_meaning(megloc: Any) -> None:
    basic = megloc("options", "--basic").out
    assert len(re.findall(r"^[a-z_.]+ = ", basic, flags=re.M)) == len(BASIC_OPTIONS) == 10
    told = megloc("options").out
    every = list(options_of(PipelineOptions()))
    assert 50 < len(every) <= 60
    for option in every:
        assert f"\n{option.key} = {shown(option.value)}\n" in f"\n{told}"
        assert option.meaning and option.meaning in told, option.key


@pytest.mark.parametrize("preset", PRESETS)
def test_a_value_is_shown_as_set_takes_it(preset: str) -> None:
    for option in options_of(PRESETS[preset]):
        text = f"{option.key}={shown(option.value)}"
        if isinstance(option.value, tuple) or option.key == "stages" or "none" in text:
            continue
        changed = options_of_preset(preset, assignments=[text])
        found = {one.key: one.value for one in options_of(changed)}[option.key]
        if isinstance(found, float):
            assert found == pytest.approx(option.value, rel=1e-3)
        else:
            assert found == option.value, text


def test_a_step_one_option_and_a_plugin(megloc: Any) -> None:
    told = megloc("options", "query_pairs", "--preset", "megloc").out
    assert told.startswith("query_pairs.by = retrieval\n    'retrieval' | 'exhaustive'; ")
    assert "query_pairs.top_k = 50\n" in told and "mapping_pairs" not in told
    assert megloc("options", "query_pairs.top_k").out.count("\n") == 2
    assert "aliked: options.threshold = 0.2\n" in megloc("options", "aliked").out
    assert "vlad: options." in megloc("options", "vlad").out


def test_the_version(megloc: Any) -> None:
    assert megloc("--version").out == f"megloc-kapture {version('megloc-kapture')}\n"
    assert megloc_kapture.__version__ == version("megloc-kapture")
