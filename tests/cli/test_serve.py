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
