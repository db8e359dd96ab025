"""The service behind a real socket: slow clients, floods of connections, its end, its workers."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx2
import pytest
from serving import Photo

from megloc_kapture import Localizer
from megloc_kapture.errors import OptionError
from megloc_kapture.service import server
from megloc_kapture.service.app import Service, make_app
from megloc_kapture.service.requests import Limits
from megloc_kapture.service.server import bind, map_overview

LIMITS = Limits(threads=2, upload_limit_s=1.0, time_limit_s=5.0, requests_per_minute=0)
HEAD = (
    b"POST /localize HTTP/1.1\r\nHost: x\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"
)


@pytest.fixture(scope="module")
def port(localizer: Localizer) -> Iterator[int]:
    """The port of a service in a thread of this process."""
    with pytest.MonkeyPatch.context() as patch, bind("127.0.0.1", 0) as bound:
        patch.setattr(server, "_HEADERS_LIMIT_S", 1.0)
        app = make_app(Service(localizer, LIMITS), map_overview(localizer.map))
        started = threading.Event()
        running = server._Server(
            server._config(app, limits=LIMITS, proxy="", log_requests=False), started.set
        )
        thread = threading.Thread(target=running.run, args=([bound],))
        thread.start()
        assert started.wait(30)
        yield bound.getsockname()[1]
        running.should_exit = True
        thread.join(30)


def connected(port: int) -> socket.socket:
    found = socket.create_connection(("127.0.0.1", port), timeout=30)
    return found


def answer_to(connection: socket.socket, sent: bytes) -> bytes:
    """Everything that comes back until the server closes the connection."""
    connection.sendall(sent)
    received = b""
    try:
        while part := connection.recv(1 << 16):
            received += part
    except ConnectionResetError:
        pass
    return received


def test_a_body_that_comes_slowly_is_cut_off(port: int) -> None:
    with connected(port) as connection:
        begin = time.monotonic()
        answer = answer_to(connection, HEAD % 1000 + b"\xff\xd8")
        assert 0.9 < time.monotonic() - begin < 8
    assert answer.startswith(b"HTTP/1.1 408 ") and b"connection: close" in answer.lower()


def test_headers_that_come_slowly_are_cut_off(port: int) -> None:
    with connected(port) as silent, connected(port) as slow:
        begin = time.monotonic()
        assert answer_to(slow, b"GET / HTTP/1.1\r\nX-A: ") == answer_to(silent, b"") == b""
        assert time.monotonic() - begin < 8
    with connected(port) as second:  # a request before does not help
        second.sendall(b"GET /health HTTP/1.1\r\nHost: x\r\n\r\n")
        begin = time.monotonic()
        assert answer_to(second, b"GET / HTTP/1.1\r\n").startswith(b"HTTP/1.1 200 ")
        assert time.monotonic() - begin < 8


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500),
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET " + b"/" * 100_000,
        b"POST /localize HTTP/1.1\r\nHost: x\r\nContent-Length: -1\r\n\r\n",
        b"POST /localize HTTP/1.1\r\nHost: x\r\nContent-Length: 1" + b"0" * 40 + b"\r\n\r\n",
        b"POST /localize HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: upgrade\r\n\r\n",
    ],
)
def test_what_is_no_http_is_refused(port: int, sent: bytes) -> None:
    with connected(port) as connection:
        connection.settimeout(20)
        answer = answer_to(connection, sent)
    assert not answer or re.match(rb"HTTP/1.1 (200|400|413)", answer), answer[:200]


def test_a_refusal_is_seen_by_who_is_still_sending(port: int) -> None:
    for size in (21_000_000, 30_000_000):
        answer = httpx2.post(f"http://127.0.0.1:{port}/localize", content=bytes(size), timeout=30)
        assert answer.status_code == 413
    with connected(port) as connection:  # endless
        answer_to_endless = b""
        connection.sendall(HEAD % 10**12)
        try:
            for _ in range(2000):
                connection.sendall(bytes(1 << 20))
        except OSError:
            answer_to_endless = b"cut off"
        assert answer_to_endless == b"cut off"


def test_one_client_has_few_connections(port: int, photos: list[Photo]) -> None:
    with ExitStack() as stack:
        many = [stack.enter_context(connected(port)) for _ in range(80)]
        time.sleep(0.5)
        closed = 0
        for connection in many:
            connection.setblocking(False)
            try:
                closed += connection.recv(1) == b""
            except BlockingIOError:
                pass
            except ConnectionResetError:
                closed += 1
        assert closed >= 80 - server._MAX_CONNECTIONS_OF_CLIENT
    time.sleep(0.5)
    url = f"http://127.0.0.1:{port}/localize"
    assert httpx2.post(url, **photos[0].form(), timeout=30).status_code == 200


def test_who_leaves_is_not_waited_for(port: int, photos: list[Photo]) -> None:
    content = photos[0].content
    for _ in range(30):
        with connected(port) as connection:
            connection.sendall(HEAD % len(content) + content)
    begin = time.monotonic()
    url = f"http://127.0.0.1:{port}/localize"
    assert httpx2.post(url, **photos[0].form(), timeout=30).status_code == 200
    assert time.monotonic() - begin < 10


def test_the_example_client(port: int, photos: list[Photo], tmp_path: Path) -> None:
    program = Path(__file__).parents[2] / "examples" / "serve_client.py"
    camera = photos[0].camera
    texts = (camera.model, camera.width, camera.height, *camera.params)
    words = [",".join(map(str, texts)), "--url", f"http://127.0.0.1:{port}/"]
    command = [sys.executable, str(program)]
    done = subprocess.run([*command, str(photos[0].path), *words], capture_output=True, text=True)
    assert done.returncode == 0 and json.loads(done.stdout)["localized"] is True, done.stderr
    (tmp_path / "no_image.jpg").write_bytes(b"x")
    other = [*command, str(tmp_path / "no_image.jpg"), *words]
    done = subprocess.run(other, capture_output=True, text=True)
    assert done.returncode == 1 and "neither JPEG" in json.loads(done.stdout)["error"]


def test_an_address_that_cannot_be_had_is_told() -> None:
    with bind("127.0.0.1", 0) as bound:
        bound.listen()
        with pytest.raises(OptionError, match="cannot listen at 127.0.0.1, port .*in use"):
            bind("127.0.0.1", bound.getsockname()[1])
    for host, port in (("no.such.host.invalid", 80), ("127.0.0.1", 99_999), ("127.0.0.1", -1)):
        with pytest.raises(OptionError, match="cannot listen"):
            bind(host, port)


# ------------------------------------------------------------------------------ as a process

MEGLOC = str(Path(sys.executable).with_name("megloc"))
SMALL = ("--set", "local_features.options.max_keypoints=400", "--requests-per-minute", "0")


def _obey_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def served(
    served_map: Path, temporary: Path, *arguments: str
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """``megloc serve`` in a process, and its URL."""
    process = subprocess.Popen(
        [MEGLOC, "serve", str(served_map), "--port", "0", *SMALL, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(temporary)},
        preexec_fn=_obey_interrupts,
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "7 map images, served at " in line, process.communicate()
        yield process, line.split()[-1]
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
@pytest.mark.parametrize("number, status", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_the_end_waits_for_what_is_running(
    served_map: Path,
    tmp_path: Path,
    photos: list[Photo],
    workers: str,
    number: signal.Signals,
    status: int,
) -> None:
    with served(served_map, tmp_path, "--workers", workers) as (process, url):
        content = photos[0].content
        host, port = url.removeprefix("http://").strip("/").split(":")
        with socket.create_connection((host, int(port)), timeout=60) as connection:
            head = (HEAD % len(content)).replace(
                b"/localize",
                b"/localize?camera=" + photos[0].camera_json().replace(" ", "").encode(),
            )
            connection.sendall(head.replace(b'"', b"%22") + content[:-100])
            time.sleep(0.5)
            process.send_signal(number)
            time.sleep(0.5)
            answer = answer_to(connection, content[-100:])
        assert answer.startswith(b"HTTP/1.1 200 ") and b'"localized":true' in answer
        out, err = process.communicate(timeout=60)
        assert (process.returncode, out, err) == (status, "", "stopped\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_workers_share_the_map_and_answer_alike(
    served_map: Path, tmp_path: Path, localizer: Localizer, photos: list[Photo]
) -> None:
    with served(served_map, tmp_path, "--workers", "2") as (process, url):
        poses = {photo.path: localizer.localize(photo.path, photo.camera) for photo in photos}
        for photo in photos * 3:
            answer = httpx2.post(f"{url}localize", **photo.form(), timeout=60).json()
            found = poses[photo.path]
            assert found and answer["covariance"] == found.covariance.tolist()  # type: ignore[union-attr]
        text = httpx2.get(f"{url}metrics").text
        assert 'megloc_images_total{localized="true"} 12.0' in text
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        maps = [Path(f"/proc/{child}/maps").read_text() for child in children]
        assert sum("xyz.npy" in one for one in maps) == 2
        process.kill()
        process.wait()
        patience = time.monotonic() + 20
        while any(Path(f"/proc/{child}/maps").exists() for child in children):
            assert time.monotonic() < patience, "workers outlive a killed service"
            time.sleep(0.1)


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(
    served_map: Path, tmp_path: Path, photos: list[Photo]
) -> None:
    with served(served_map, tmp_path, "--workers", "2") as (process, url):
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        before = set(children.read_text().split())
        serving = [one for one in before if "xyz.npy" in Path(f"/proc/{one}/maps").read_text()]
        os.kill(int(serving[0]), signal.SIGKILL)
        patience = time.monotonic() + 60
        while len(set(children.read_text().split()) - before) < 1:
            assert time.monotonic() < patience
            time.sleep(0.1)
        answer = httpx2.post(f"{url}localize", **photos[0].form(), timeout=60)
        assert answer.status_code == 200


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
@pytest.mark.parametrize("path, text", [("docs", "<h2>POST /localize</h2>"), ("", "<canvas")])
def test_pages_run_in_a_browser(port: int, tmp_path: Path, path: str, text: str) -> None:
    browser = ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    quiet = ["--enable-logging=stderr", f"--user-data-dir={tmp_path}", "--virtual-time-budget=5000"]
    done = subprocess.run(
        [*browser, *quiet, f"http://127.0.0.1:{port}/{path}"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert text in done.stdout and "CONSOLE" not in done.stderr, done.stderr
