"""The service behind a real socket: slow clients, large uploads, the example client, its end."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import httpx2
import pytest
import uvicorn
from serving import Photo

from megloc_kapture import Localizer
from megloc_kapture.service.app import Service, make_app
from megloc_kapture.service.server import bind, map_overview

HEAD = (
    b"POST /localize HTTP/1.1\r\nHost: x\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"
)


@pytest.fixture(scope="module")
def port(localizer: Localizer) -> Iterator[int]:
    with bind("127.0.0.1", 0) as bound:
        app = make_app(Service(localizer, threads=1), map_overview(localizer.map))
        server = uvicorn.Server(uvicorn.Config(app, log_config=None))
        thread = threading.Thread(target=server.run, args=([bound],))
        thread.start()
        yield bound.getsockname()[1]
        server.should_exit = True
        thread.join(30)


def connected(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=30)


def answer_to(connection: socket.socket, sent: bytes) -> bytes:
    """Everything that comes back until the server closes the connection."""
    connection.sendall(sent)
    received = b""
    while part := connection.recv(1 << 16):
        received += part
    return received


def test_a_slow_client_does_not_block_the_others(port: int, photos: list[Photo]) -> None:
    with connected(port) as slow, connected(port) as silent:
        slow.sendall(HEAD % 100_000 + photos[0].content[:1000])
        silent.sendall(b"GET / HTTP/1.1\r\nX-A: ")
        begin = time.monotonic()
        url = f"http://127.0.0.1:{port}/localize"
        assert httpx2.post(url, **photos[0].form(), timeout=30).status_code == 200
        assert time.monotonic() - begin < 20


def test_a_sending_client_receives_the_refusal(port: int) -> None:
    for size in (21_000_000, 50_000_000):
        answer = httpx2.post(f"http://127.0.0.1:{port}/localize", content=bytes(size), timeout=30)
        assert answer.status_code == 413


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


MEGLOC = str(Path(sys.executable).with_name("megloc"))
SMALL = ("--set", "local_features.options.max_keypoints=400")


@contextmanager
def served(served_map: Path, temporary: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    process = subprocess.Popen(
        [MEGLOC, "serve", str(served_map), "--port", "0", *SMALL],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(temporary)},
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "7 map images, listening at " in line, process.communicate()
        yield process, line.split()[-1]
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_lets_running_requests_finish(
    served_map: Path, tmp_path: Path, photos: list[Photo], number: signal.Signals
) -> None:
    with served(served_map, tmp_path) as (process, url):
        assert httpx2.get(f"{url}health", timeout=60).status_code == 200
        content = photos[0].content
        host, port = url.removeprefix("http://").strip("/").split(":")
        with socket.create_connection((host, int(port)), timeout=60) as connection:
            connection.sendall(HEAD % len(content) + content[:-100])
            time.sleep(0.5)
            process.send_signal(number)
            time.sleep(0.5)
            answer = answer_to(connection, content[-100:])
        assert answer.startswith(b"HTTP/1.1 200 ") and b'"localized":' in answer
        _, err = process.communicate(timeout=60)
        assert process.returncode in (128 + number, -number) and "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_the_page_runs_in_a_browser(port: int, tmp_path: Path) -> None:
    browser = ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    quiet = ["--enable-logging=stderr", f"--user-data-dir={tmp_path}", "--virtual-time-budget=5000"]
    done = subprocess.run(
        [*browser, *quiet, f"http://127.0.0.1:{port}/"], capture_output=True, text=True, timeout=120
    )
    assert "<canvas" in done.stdout and "CONSOLE" not in done.stderr, done.stderr
