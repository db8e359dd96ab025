"""``megloc serve``: mistakes are reported before the server listens; tests/service has the rest."""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.service import server


@pytest.fixture(autouse=True)
def no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that is not refused must not wait for clients."""
    monkeypatch.setattr(server, "serve", lambda *_, **__: pytest.fail("it is served"))


def test_a_port_in_use_is_refused_before_the_map_is_read(megloc: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        megloc("serve", tmp_path, "--port", port).refused(f"port {port}: .*in use")


def test_without_the_extra_the_installation_is_named(
    megloc: Any, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("megloc_kapture.service")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    line = megloc("serve", finished / "map").refused("uvicorn is not installed")
    assert line.endswith('pip install "megloc-kapture[serve]"')
