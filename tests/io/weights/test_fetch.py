"""Downloads from a real server on this machine: whole, broken, wrong, refused."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError, MeglocError
from megloc_kapture.io.weights import fetch

CONTENT = np.random.default_rng(0).bytes(300_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@dataclass
class Server:
    """What the server does."""

    address: str = ""
    content: bytes = CONTENT
    break_after: int | None = None
    status: int = 200

    @property
    def url(self) -> str:
        return f"{self.address}/net.pth"


def handler(server: Server) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if server.status != 200:
                self.send_error(server.status)
                return
            self.send_response(200)
            self.send_header("Content-Length", str(len(server.content)))
            self.end_headers()
            self.wfile.write(server.content[: server.break_after])

        def log_message(self, *_: object) -> None:
            pass

    return Handler


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    described = Server()
    running = ThreadingHTTPServer(("127.0.0.1", 0), handler(described))
    described.address = f"http://127.0.0.1:{running.server_port}"
    thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield described
    running.shutdown()
    thread.join()
    running.server_close()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "weights" / "net.pth"


def test_a_whole_file(server: Server, place: Path) -> None:
    seen = []

    def track(chunks: Iterable[bytes], total: int, label: str) -> Iterable[bytes]:
        seen.append((total, label))
        return chunks

    fetch(server.url, place, sha256=SHA256, track=track)
    assert place.read_bytes() == CONTENT and seen == [(1, "net.pth")]
    assert [path.name for path in place.parent.iterdir()] == ["net.pth"]


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"content": b"another"}, DataError, "the download is not the published file: .*" + SHA256),
        ({"break_after": 1000}, MeglocError, "the transfer broke"),
        ({"status": 404}, MeglocError, "the server answers 404"),
        ({"address": "http://127.0.0.1:9"}, MeglocError, "the transfer broke"),
    ],
    ids=["another file", "broken", "refused", "no server"],
)
def test_nothing_else_gets_the_name(
    server: Server, place: Path, change: dict[str, object], kind: type[Exception], message: str
) -> None:
    for name, value in change.items():
        setattr(server, name, value)
    with pytest.raises(kind, match=message):
        fetch(server.url, place, sha256=SHA256)
    assert list(place.parent.iterdir()) == []
