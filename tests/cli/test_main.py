"""The command as such: help, examples, options, errors of the command line, tracebacks, pipes."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections import Counter
from importlib.metadata import EntryPoints, version
from pathlib import Path
from typing import Any

import pytest
import tyro

import megloc_kapture
from megloc_kapture import plugin_loading
from megloc_kapture.cli.common import Console
from megloc_kapture.cli.info import shown
from megloc_kapture.cli.main import (
    COMMANDS,
    EXAMPLES,
    _parser,
    command_class,
    main,
    summary,
)
from megloc_kapture.pipeline.presets import PRESETS, options_of, options_of_preset
from megloc_kapture.stages.options import PipelineOptions

PROGRAM = str(Path(sys.executable).with_name("megloc"))
BAD_ARGUMENTS = {
    "no command": ([], r"Missing subcommand: Expected one of \{eval, import"),
    "unknown command": (["evil"], r"Unrecognized options: evil; Available subcommands: eval, "),
    "missing flags": (
        ["refine-poses", "-i", "map", "--poses", "p", "-o", "out"],
        r"Missing from megloc refine-poses: --query PATH; see megloc refine-poses",
    ),
    "unknown flag": (["eval", "kapture", "--roots", "x"], r"Unrecognized options: --roots, x; see"),
    "unknown long flag": (["eval", "--" + 100 * "x"], r"Unrecognized options: --x{100}; see"),
    "no value": (["eval", "--set"], r"Missing value for argument '--set'"),
    "not a number": (["eval", "--workers", "two"], r"Error parsing --workers: .*'two'.*; see"),
    "not a choice": (["eval", "-v", "loud"], r"invalid choice 'loud' .*'debug', 'info'"),
    "too many": (["info", "a", "b"], r"Unrecognized options: b; see megloc"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS)
def test_argument_errors_are_one_line(
    megloc: Any, arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    line = megloc(*arguments).refused(message)
    assert "megloc" in line and "--help" in line
    assert not set("│╭╰─") & set(line)


COLOURED = (
    "\x1b[31m╭─\x1b[0m \x1b[31m\x1b[1mRequired options\x1b[0m ──────╮\n"
    "│ Missing from megloc submit: │\n"
    "│     -i PATH, --input PATH   │\n"
    "│         Localized kapture   │\n"
    "│         folder. (required)  │\n"
    "│     -o PATH, --output PATH  │\n"
    "│         Pose file.          │\n"
    "│ ─────────────────────────── │\n"
    "│ For full helptext, run:     │\n"
    "│     megloc submit --help    │\n"
    "╰─────────────────────────────╯\n"
)


def test_a_drawn_box_becomes_one_line() -> None:
    assert summary(COLOURED) == (
        "Missing from megloc submit: -i PATH, --input PATH, -o PATH, --output PATH; "
        "see megloc submit --help"
    )
    # what is no box is told as it is
    assert summary("something\n\nelse entirely\n") == "something else entirely"
    assert summary("") == "the arguments cannot be used"


@pytest.mark.parametrize("encoding", ["ascii", pytest.param("utf-8", marks=pytest.mark.slow)])
def test_argument_errors_are_one_line_in_a_terminal_of_any_encoding(encoding: str) -> None:
    done = subprocess.run(
        [PROGRAM, "triangulate", "--input", "x"],
        env=os.environ | {"PYTHONIOENCODING": encoding, "COLUMNS": "40"},
        capture_output=True,
        text=True,
    )
    told = "megloc: Missing from megloc triangulate: -o PATH, --output PATH; see megloc "
    assert (done.returncode, done.stdout, done.stderr) == (2, "", told + "triangulate --help\n")


@pytest.mark.parametrize("flag", ["-h", "--help"])
@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_help(megloc: Any, command: str | None, flag: str) -> None:
    done = megloc(*([command] if command else []), flag)
    assert (done.status, done.err) == (0, "")
    if command is None:
        assert all(name in done.out for name in COMMANDS)
    else:
        assert done.out.startswith(f"usage: megloc {command} ")


def test_a_rendered_dataset_is_refused_in_one_line(
    megloc: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    megloc("synth", "venice", "-o", out).refused(
        "nothing renders 'venice'; known: 4seasons, aachen"
    )
    megloc("synth", "aachen", "-o", out, "--set", "width=3").refused("'aachen' .* width: .* 64")
    monkeypatch.setattr(plugin_loading, "entry_points", lambda group: EntryPoints())
    megloc("synth", "aachen", "-o", out).refused("pip install megloc-twins")
    monkeypatch.undo()
    assert not out.exists()


def test_the_list_of_commands_costs_no_solver() -> None:
    code = (
        "import sys\nfrom megloc_kapture.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: print(sorted({'torch', 'scipy', 'numba', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("\n[]\n")


def test_the_traceback_is_shown_with_debug_only(megloc: Any, tmp_path: Path) -> None:
    place = tmp_path / "nowhere"
    told = f"megloc: {place}: no such kapture folder\n"
    assert megloc("info", place).err == told
    done = megloc("info", place, "--debug")
    assert done.status == 2
    assert done.err.startswith("Traceback (most recent call last):\n")
    assert "\nmegloc_kapture.errors.DataError: " in done.err
    assert done.err.endswith(told)


def test_who_stops_reading_gets_no_complaint() -> None:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "bufsize": 0}
    for arguments in (["weights", "list"], ["eval", "--help"]):
        command: Any = subprocess.Popen([PROGRAM, *arguments], **pipes)  # type: ignore[call-overload]
        command.stdout.close()
        assert command.stderr.read() == b""
        assert command.wait() == 0


def test_progress_says_how_many_how_fast_and_how_long(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("megloc_kapture.cli.common._LINE_EVERY_S", 0.0)
    assert list(Console().track("abc", 3, "features, 4 of 7 kept")) == ["a", "b", "c"]
    lines = capsys.readouterr().err.splitlines()
    for number, line in enumerate(lines, start=1):
        start = f"  features, 4 of 7 kept: {number} of 3, "
        assert re.fullmatch(re.escape(start) + r"[0-9.e+]+/s, 0:00:00 left", line)
    assert len(lines) == 2


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_is_taken_by_the_command(example: str) -> None:
    program, *arguments = shlex.split(example)
    assert program == "megloc" and arguments[0] in COMMANDS
    parsed: Any = tyro.cli(
        _parser(arguments), args=arguments, prog="megloc", config=(tyro.conf.OmitArgPrefixes,)
    )
    if getattr(parsed, "preset", None) or getattr(parsed, "set", ()):
        options_of_preset(parsed.preset or "classic", assignments=getattr(parsed, "set", ()))


def test_every_command_has_its_own_first_line_and_one_to_three_examples() -> None:
    for name, (_, told) in COMMANDS.items():
        assert " ".join((command_class(name).__doc__ or "").split()).startswith(told)
    counts = Counter(example.split()[1] for example in EXAMPLES)
    assert set(counts) == set(COMMANDS) and max(counts.values()) <= 3


@pytest.mark.parametrize("command", ["", "match", "weights", "weights fetch"])
def test_a_help_page_ends_with_its_examples(megloc: Any, command: str) -> None:
    done = megloc(*command.split(), "--help")
    assert done.status == 0
    *_, last = done.out.splitlines()
    assert last.startswith(f"  megloc {command}")
    head = done.out.rpartition("examples:\n")[0]
    assert head.startswith("usage: ")


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
    told = megloc("options").out
    every = list(options_of(PipelineOptions()))
    assert len(every) > 80
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


def test_names_that_are_nearly_right(megloc: Any) -> None:
    megloc("options", "localisation").refused("did you mean localization")
    megloc("options", "--preset", "moden").refused("did you mean 'modern'\\? known: classic")
    megloc("eval", "aachn").refused("did you mean 'aachen'\\? known: ")
    for text, meant in (
        ("query_pairs.topk=3", "'top_k'"),
        ("radius=3", "localization.clusters.radius"),
        ("local_features=aliqued", "'aliked'"),
    ):
        megloc("eval", "synthetic-aachen", "--set", text).refused(f"did you mean {meant}")
    megloc("weights", "fetch", "alikd-n16").refused("did you mean 'aliked-n16'")


def test_the_version(megloc: Any) -> None:
    assert megloc("--version").out == f"megloc-kapture {version('megloc-kapture')}\n"
    assert megloc_kapture.__version__ == version("megloc-kapture")
