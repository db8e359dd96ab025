"""Help pages: their examples are commands that are taken; completion knows what there is."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import tyro

from megloc_kapture.cli.arguments import EXAMPLES
from megloc_kapture.cli.main import COMMANDS, _parser
from megloc_kapture.pipeline.presets import options_of_preset


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_is_taken_by_the_command(example: str) -> None:
    program, *arguments = shlex.split(example)
    assert program == "megloc" and arguments[0] in COMMANDS
    parsed: Any = tyro.cli(
        _parser(arguments), args=arguments, prog="megloc", config=(tyro.conf.OmitArgPrefixes,)
    )
    if getattr(parsed, "preset", None) or getattr(parsed, "set", ()):
        options_of_preset(parsed.preset or "classic", assignments=getattr(parsed, "set", ()))
    if hasattr(parsed, "uses"):
        parsed.options()  # refuses what the command does not act on


def test_every_command_has_one_to_three_examples() -> None:
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


def script_for(shell: str) -> str:
    megloc = Path(sys.executable).with_name("megloc")
    return subprocess.run(
        [megloc, "--tyro-print-completion", shell], capture_output=True, text=True, check=True
    ).stdout


def test_completion_knows_commands_and_their_flags() -> None:
    script = script_for("bash")
    assert set(COMMANDS) <= set(completed(script, "megloc", ""))
    assert completed(script, "megloc", "loc") == ["localize"]
    assert "--features-dir" in completed(script, "megloc", "match", "--feat")
    assert script_for("zsh").startswith("#compdef megloc")
