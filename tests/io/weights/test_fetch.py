"""Downloads from a real server on this machine: broken, changed, redirected, wrong, too large."""

from __future__ import annotations

import fcntl
import hashlib
import http.client
import json
import multiprocessing
import re
import resource
import threading
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.weights.adding import CHUNK, SafeRedirects, TransferError, fetch

CONTENT = np.random.default_rng(0).bytes(3 * CHUNK + 1234)
SHA256 = hashlib.sha256(CONTENT).hexdigest()
PAGE = b"<html>sign in first</html>"


@dataclass
class Server:
    """What the server does, and what it was asked for."""

    address: str = ""
    content: bytes = CONTENT
    etag: str | None = '"one"'
    ranges: bool = True
    break_after: int | None = None
    wrong_range: bool = False
    content_type: str = "application/octet-stream"
    length: bool = True
    status: int = 200
    redirect: str | None = None
    asked: list[tuple[str | None, str | None]] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"{self.address}/net.pth"


def handler(server: Server) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/elsewhere" and server.redirect:
                self.send_response(302)
                self.send_header("Location", server.redirect)
                self.end_headers()
                return
            server.asked.append((self.headers["Range"], self.headers["If-Range"]))
            if server.status != 200:
                self.send_error(server.status)
                return
            start = self._start()
            if start >= len(server.content):
                self.send_error(416)
                return
            self.send_response(206 if start else 200)
            if start:
                shown = start + 1 if server.wrong_range else start
                whole = len(server.content)
                self.send_header("Content-Range", f"bytes {shown}-{whole - 1}/{whole}")
            if server.etag:
                self.send_header("ETag", server.etag)
            if server.length:
                self.send_header("Content-Length", str(len(server.content) - start))
            self.send_header("Content-Type", server.content_type)
            self.end_headers()
            self.wfile.write(server.content[start : server.break_after])

        def _start(self) -> int:
            told = re.fullmatch(r"bytes=(\d+)-", self.headers["Range"] or "")
            if told is None or not server.ranges or self.headers["If-Range"] != server.etag:
                return 0
            return int(told[1])

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


def partial(place: Path) -> Path:
    return place.with_name(".net.pth.part")


def left(place: Path) -> set[str]:
    return {path.name for path in place.parent.iterdir()}


def test_a_whole_file(server: Server, place: Path) -> None:
    seen: list[int] = []

    def watch(chunks: Iterator[bytes], total: int) -> Iterator[bytes]:
        seen.append(total)
        for chunk in chunks:
            seen.append(len(chunk))
            yield chunk

    assert fetch(server.url, place, size=len(CONTENT), sha256=SHA256, watch=watch) == SHA256
    assert place.read_bytes() == CONTENT and left(place) == {"net.pth"}
    assert seen == [4, CHUNK, CHUNK, CHUNK, 1234]
    assert server.asked == [(None, None)]
    server.etag, server.length = None, False
    assert fetch(server.url, place) == SHA256
    with pytest.raises(OutputError, match="cannot write"):
        fetch(server.url, place / "below.pth")


def test_a_transfer_that_breaks_again_and_again_goes_on(server: Server, place: Path) -> None:
    ends = (10, 2 * CHUNK + 77, 3 * CHUNK)
    for end in ends:
        server.break_after = end
        with pytest.raises(TransferError) as error:
            fetch(server.url, place, sha256=SHA256)
        assert str(error.value) == (
            f"{server.url}: the transfer broke after {end} of {len(CONTENT)} bytes; "
            "run the same command again to go on"
        )
        assert partial(place).read_bytes() == CONTENT[:end] and not place.exists()
    server.break_after = None
    assert fetch(server.url, place, sha256=SHA256) == SHA256
    assert server.asked == [(None, None), *((f"bytes={end}-", '"one"') for end in ends)]
    assert place.read_bytes() == CONTENT and left(place) == {"net.pth"}


@pytest.mark.parametrize(
    ("have", "total", "content", "asked"),
    [
        # killed between the last byte and the renaming: nothing is asked for again
        (CONTENT, len(CONTENT), CONTENT, 0),
        (CONTENT + b"more", len(CONTENT), CONTENT, 1),
        # the server has less than before, 416: what has arrived cannot be the beginning of it
        (b"x" * 2000, 3000, CONTENT[:1000], 2),
    ],
    ids=["all", "more", "less"],
)
def test_what_a_killed_run_left(
    server: Server, place: Path, have: bytes, total: int, content: bytes, asked: int
) -> None:
    place.parent.mkdir()
    partial(place).write_bytes(have)
    state = {"url": server.url, "validator": '"one"', "total": total}
    place.with_name(".net.pth.part.json").write_text(json.dumps(state))
    server.content = content
    assert fetch(server.url, place) == hashlib.sha256(content).hexdigest()
    assert place.read_bytes() == content
    assert len(server.asked) == asked and left(place) == {"net.pth"}


@pytest.mark.parametrize("how", ["no ranges", "no etag", "weak etag", "changed", "other url"])
def test_begins_anew_where_going_on_is_not_safe(server: Server, place: Path, how: str) -> None:
    server.etag = {"no etag": None, "weak etag": 'W/"one"'}.get(how, server.etag)
    server.break_after = CHUNK
    server.content = bytes(len(CONTENT)) if how == "changed" else CONTENT
    first = f"{server.url}?old" if how == "other url" else server.url
    with pytest.raises(TransferError):
        fetch(first, place, sha256=SHA256)
    server.break_after = None
    server.ranges = how != "no ranges"
    if how == "changed":
        server.content, server.etag = CONTENT, '"two"'
    assert fetch(server.url, place, sha256=SHA256) == SHA256
    assert place.read_bytes() == CONTENT
    assert (server.asked[-1][0] is None) == (how in ("no etag", "weak etag", "other url"))


def test_another_part_than_asked_for(server: Server, place: Path) -> None:
    server.break_after = CHUNK
    with pytest.raises(TransferError):
        fetch(server.url, place)
    server.break_after, server.wrong_range = None, True
    with pytest.raises(TransferError, match="sends another part .* to begin anew"):
        fetch(server.url, place)
    assert fetch(server.url, place) == SHA256


def test_a_wrong_hash(server: Server, place: Path) -> None:
    place.parent.mkdir()
    other = place.with_name("other.pth.part")
    other.write_bytes(b"mine")
    place.write_bytes(b"the old one")
    with pytest.raises(DataError) as error:
        fetch(server.url, place, sha256=64 * "0")
    assert SHA256 in str(error.value) and 64 * "0" in str(error.value)
    assert left(place) == {"net.pth", "other.pth.part"}
    assert place.read_bytes() == b"the old one"


def test_a_truncated_file(server: Server, place: Path) -> None:
    """The server itself has half of it, and says that this is all."""
    server.content = CONTENT[: len(CONTENT) // 2]
    with pytest.raises(DataError, match=f"{len(server.content)} bytes came instead of"):
        fetch(server.url, place, size=len(CONTENT))
    with pytest.raises(DataError, match="is not the published file"):
        fetch(server.url, place, size=len(CONTENT), sha256=SHA256)
    assert left(place) == set()
    server.content, server.length, server.break_after = CONTENT, False, CHUNK
    with pytest.raises(TransferError, match=f"broke after {CHUNK} of {len(CONTENT)}"):
        fetch(server.url, place, size=len(CONTENT))


def test_a_web_page_instead(server: Server, place: Path) -> None:
    server.break_after = CHUNK
    with pytest.raises(TransferError):
        fetch(server.url, place)
    server.content, server.content_type, server.break_after = PAGE, "text/html; charset=x", None
    server.etag = None
    with pytest.raises(TransferError, match="a web page came instead of the file"):
        fetch(server.url, place)
    # what had come before stays
    server.content, server.content_type, server.etag = CONTENT, "application/x", '"one"'
    assert fetch(server.url, place) == SHA256
    assert server.asked[-1][0] == f"bytes={CHUNK}-"


@pytest.mark.parametrize("status", [404, 403, 500])
def test_refusals_of_the_server(server: Server, place: Path, status: int) -> None:
    server.status = status
    with pytest.raises(TransferError, match=f"net.pth: the server answers {status} "):
        fetch(server.url, place)
    with pytest.raises(TransferError, match="cannot be reached: .*refused"):
        fetch("http://127.0.0.1:1/net.pth", place)
    assert not place.exists()


def test_redirections(server: Server, place: Path) -> None:
    server.redirect = server.url
    assert fetch(f"{server.address}/elsewhere", place) == SHA256
    for target, told in (
        ("file:///etc/hostname", "file:///etc/hostname' is not allowed"),
        ("ftp://127.0.0.1/net.pth", "leads to ftp://127.0.0.1/net.pth, which is not safe"),
        (f"{server.address}/elsewhere", "the server answers 302"),
    ):
        server.redirect = target
        with pytest.raises(TransferError, match=told):
            fetch(f"{server.address}/elsewhere", place)


def test_no_redirection_from_https_to_http() -> None:
    request = urllib.request.Request("https://example.org/net.pth")
    rule = SafeRedirects()
    answer = http.client.HTTPMessage()
    with pytest.raises(TransferError, match="leads to http://example.org/x, which is not safe"):
        rule.redirect_request(request, None, 302, "Found", answer, "http://example.org/x")
    led = rule.redirect_request(request, None, 302, "Found", answer, "https://example.org/x")
    assert led is not None and led.full_url == "https://example.org/x"


def test_two_at_once(server: Server, place: Path) -> None:
    place.parent.mkdir()
    with open(partial(place), "ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(OutputError, match="another megloc is fetching it"):
            fetch(server.url, place)
    assert fetch(server.url, place) == SHA256


def _small_files_only(url: str, place: Path, told: multiprocessing.SimpleQueue[str]) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (2 * CHUNK, resource.RLIM_INFINITY))
    try:
        fetch(url, place)
    except OutputError as error:
        told.put(str(error))
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    told.put(fetch(url, place))


def test_no_room(server: Server, place: Path) -> None:
    """A limit on the size of files stands for a full disk, which takes the right to mount."""
    context = multiprocessing.get_context("fork")
    told = context.SimpleQueue()
    process = context.Process(target=_small_files_only, args=(server.url, place, told))
    process.start()
    message, sha256 = told.get(), told.get()
    process.join()
    assert message.startswith(f"{partial(place)}: cannot write: File too large; make room")
    assert "run the same command again to go on" in message
    assert sha256 == SHA256 and server.asked[-1][0] == f"bytes={2 * CHUNK}-"


def test_a_file_larger_than_the_disk_is_not_begun(
    server: Server, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = BaseHTTPRequestHandler.send_header

    def send(self: BaseHTTPRequestHandler, name: str, value: str) -> None:
        told(self, name, str(1 << 60) if name == "Content-Length" else value)

    monkeypatch.setattr(BaseHTTPRequestHandler, "send_header", send)
    with pytest.raises(OutputError, match=r"No space left on device \(1152921504606846976 bytes, "):
        fetch(server.url, place)
    assert partial(place).stat().st_size == 0
