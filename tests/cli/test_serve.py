"""``megloc serve``: what is wrong is said before anything listens; tests/service has the rest."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.service import server


@pytest.fixture(autouse=True)
def nothing_is_served(monkeypatch: pytest.MonkeyPatch) -> None:
    """A test that is not refused must not wait for clients."""
    monkeypatch.setattr(server, "serve", lambda *_, **__: pytest.fail("it is served"))


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--port", "99999"), "cannot listen at 127.0.0.1, port 99999: .*0-65535"),
        (("--set", "nothing=1"), "nothing"),
        (("--keypoints-type", "orb"), "no points of keypoints type 'orb'; there are: rootsift"),
        (("--features-dir", "nowhere"), "nowhere: no such folder"),
        (("--max-mb", "0"), "--max-mb: it should be greater than 0"),
        (("--threads", "0"), "--threads: it should be greater than or equal to 1"),
        (("--host", "0.0.0.0"), "--host 0.0.0.0: reachable from other machines; give --token-file"),
    ],
)
def test_what_cannot_be_served_is_refused(
    megloc: Any, finished: Path, arguments: tuple[str, ...], words: str
) -> None:
    megloc("serve", finished / "map", "--port", "0", *arguments).refused(words)


def test_no_map_is_no_map(megloc: Any, scene: Path, tmp_path: Path) -> None:
    megloc("serve", scene / "mapping", "--port", "0").refused("no map to localize in")
    megloc("serve", tmp_path / "nowhere", "--port", "0").refused("nowhere")


@pytest.mark.parametrize(
    "text", ["", "short", "two words in\ntwo lines, long", "ü" * 20, "\0" * 20]
)
def test_a_token_is_one_line(megloc: Any, finished: Path, tmp_path: Path, text: str) -> None:
    token = tmp_path / "token.txt"
    command = ("serve", finished / "map", "--port", "0", "--token-file", token)
    megloc(*command).refused("token.txt: .*missing")
    token.write_text(text)
    megloc(*command).refused("token.txt")


def test_a_port_that_is_taken_is_told_before_the_map_is_read(megloc: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        megloc("serve", tmp_path, "--port", port).refused(f"port {port}: .*in use")


def test_without_the_extra_it_says_what_to_install(
    megloc: Any, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("megloc_kapture.service")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    line = megloc("serve", finished / "map").refused("uvicorn is not installed")
    assert line.endswith('pip install "megloc-kapture[serve]"')


def test_no_other_command_imports_the_extra() -> None:
    code = """
import sys
from megloc_kapture.cli.main import COMMANDS, command_class
for name in COMMANDS:
    command_class(name)
print({"fastapi", "uvicorn", "starlette"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("set()\n", "")
