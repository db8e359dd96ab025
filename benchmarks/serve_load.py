"""Load and abuse of ``megloc serve``: equal answers, memory, and what hostile clients cost others.

    .venv/bin/python benchmarks/serve_load.py --map MAP --query QUERY --seconds 600

First ``--clients`` send the query images one after another; every answer has to be that of
``Localizer``, byte for byte, and the server's memory in the last minute is compared with that in
the second. Then one client goes on alone, and again while ``--hostile`` requests of another address
run: huge and truncated images, wrong types, path tricks, slow bodies. Ends with status 1 where an
answer differs, is a 500 or has a path of this machine in it.
"""

from __future__ import annotations

import argparse
import http.client
import itertools
import json
import random
import re
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.service.requests import answer_of

# another address of this machine, so that the service takes it for another client
HOSTILE_ADDRESS = "127.0.0.2"
FORM = "multipart/form-data; boundary=b"
PATH = re.compile(rb"/(home|root|usr|tmp|work|var|site-packages)/")


@dataclass(frozen=True)
class Request:
    """What is sent to /localize, and the answer that is expected, where one is."""

    body: bytes
    content_type: str = FORM
    expected: bytes | None = None
    method: str = "POST"
    path: str = "/localize"
    slow: bool = False


@dataclass
class Seen:
    """What clients have met."""

    seconds: list[float] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)

    def quantiles(self) -> str:
        """Median, 95th percentile and maximum."""
        low, high, most = np.quantile(self.seconds, (0.5, 0.95, 1.0))
        return f"median {low:.2f} s, 95 % {high:.2f} s, longest {most:.2f} s"


def form(image: bytes, camera: str | None, name: str = "image.jpg") -> bytes:
    """A form with an image and its camera, for :data:`FORM`."""
    disposition = f'form-data; name="image"; filename="{name}"'.encode()
    body = b"--b\r\nContent-Disposition: " + disposition + b"\r\n\r\n" + image + b"\r\n"
    if camera is not None:
        body += b'--b\r\nContent-Disposition: form-data; name="camera"\r\n\r\n'
        body += camera.encode() + b"\r\n"
    return body + b"--b--\r\n"


def good_requests(map_path: Path, query: Path) -> list[Request]:
    """The query images, with what ``Localizer`` says of them."""
    localizer = Localizer(KaptureMap.open(map_path))
    folder, requests = KaptureFolder(query), []
    for name in folder.read().image_names():
        camera, path = localizer.map.to_colmap(folder.read().camera_of(name)), None
        path = folder.image_path(name)
        answer = answer_of(localizer.localize(path, camera), camera)
        expected = json.dumps(answer, ensure_ascii=False, separators=(",", ":")).encode()
        requests.append(Request(form(path.read_bytes(), camera_json(camera)), FORM, expected))
    return requests


def camera_json(camera: object) -> str:
    """A camera as the service takes it."""
    names = ("model", "width", "height", "params")
    return json.dumps({name: getattr(camera, name) for name in names})


def png(width: int, height: int, rows: int) -> bytes:
    """A black PNG whose header may promise more rows than it has."""

    def chunk(name: bytes, content: bytes) -> bytes:
        checked = name + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compressobj(9)
    packed = b"".join(pixels.compress(bytes(1 + 3 * width)) for _ in range(rows)) + pixels.flush()
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def hostile_requests(good: Request, number: int) -> list[Request]:
    """Requests that no page sends, each kind many times."""
    image = good.body.split(b"\r\n\r\n", 1)[1].split(b"\r\n--b", 1)[0]
    camera = good.body.split(b'name="camera"\r\n\r\n')[1].split(b"\r\n", 1)[0].decode()
    draw = random.Random(0)
    bomb, allowed = png(30_000, 30_000, 30_000), png(5600, 5600, 5600)
    pinhole = '{"model":"SIMPLE_PINHOLE","width":%d,"height":%d,"params":[5000,2800,2800]}'

    def mutated() -> bytes:
        content = bytearray(image)
        for _ in range(draw.randrange(1, 40)):
            content[draw.randrange(len(content))] = draw.randrange(256)
        return bytes(content)

    nan = json.dumps({**json.loads(camera), "params": [float("nan")] * 4})
    kinds: list[Callable[[], Request]] = [
        lambda: Request(form(bomb, pinhole % (30_000, 30_000))),
        lambda: Request(form(allowed, pinhole % (5600, 5600))),
        lambda: Request(form(png(65_000, 65_000, 1), camera)),
        lambda: Request(form(image[: draw.randrange(len(image))], camera)),
        lambda: Request(form(mutated(), camera)),
        lambda: Request(form(draw.randbytes(10_000), camera)),
        lambda: Request(form(b"GIF89a" + draw.randbytes(100), camera)),
        lambda: Request(draw.randbytes(1000), "application/zip"),
        lambda: Request(form(b"", camera, "../../../../etc/passwd")),
        lambda: Request(form(image, None, "/etc/passwd\\..\\..")),
        lambda: Request(form(image, "{" * draw.randrange(1, 900))),
        lambda: Request(form(image, nan)),
        lambda: Request(form(image, camera.replace('"width": ', '"width": 9'))),
        lambda: Request(bytes(25_000_000), "image/png"),
        lambda: Request(b"--b\r\n" * 50_000),
        lambda: Request(b"", "text/plain", None, "DELETE", "/../../etc/passwd"),
        lambda: Request(b"", "text/plain", None, "GET", "/%2e%2e/%2e%2e/etc/passwd?camera=%00"),
        lambda: Request(good.body, slow=True),
    ]
    return [kind() for kind, _ in zip(itertools.cycle(kinds), range(number), strict=False)]


def send(port: int, request: Request, address: str, seen: Seen) -> None:
    """Send a request and note what comes."""
    connection = http.client.HTTPConnection(
        "127.0.0.1", port, timeout=120, source_address=(address, 0)
    )
    begin = time.perf_counter()
    try:
        if request.slow:
            content = _sent_slowly(connection, request, seen)
        else:
            headers = {"Content-Type": request.content_type}
            connection.request(request.method, request.path, request.body, headers)
            answer = connection.getresponse()
            seen.statuses[str(answer.status)] += 1
            content = answer.read()
            if answer.status == 500:
                seen.faults.append(f"500 to {request.content_type} {request.body[:200]!r}")
    except (OSError, http.client.HTTPException) as error:
        seen.statuses[type(error).__name__] += 1
        content = b""
    finally:
        connection.close()
    seen.seconds.append(time.perf_counter() - begin)
    if PATH.search(content):
        seen.faults.append(f"a path: {content!r}")
    if request.expected is not None and content != request.expected:
        seen.faults.append(f"not what Localizer says: {content[:300]!r}")


def _sent_slowly(connection: http.client.HTTPConnection, request: Request, seen: Seen) -> bytes:
    """A byte a second until the server has enough."""
    connection.putrequest("POST", "/localize")
    connection.putheader("Content-Type", FORM)
    connection.putheader("Content-Length", str(len(request.body)))
    connection.endheaders()
    assert isinstance(connection.sock, socket.socket)
    connection.sock.settimeout(1.0)
    received = b""
    for at in range(100):
        connection.sock.sendall(request.body[at : at + 1])
        try:
            received = connection.sock.recv(4096)
            break
        except TimeoutError:
            continue
    seen.statuses[received[9:12].decode() or "cut off"] += 1
    return received


def run_clients(
    port: int, requests: Iterator[Request], clients: int, address: str = "127.0.0.1"
) -> Seen:
    """Send all requests, from as many threads."""
    seen, lock = Seen(), threading.Lock()

    def client() -> None:
        while True:
            with lock:
                request = next(requests, None)
            if request is None:
                return
            send(port, request, address, seen)

    threads = [threading.Thread(target=client) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return seen


def until(end: float, requests: list[Request]) -> Iterator[Request]:
    """The requests again and again, until a time of ``time.monotonic``."""
    for request in itertools.cycle(requests):
        if time.monotonic() > end:
            return
        yield request


@contextmanager
def server(map_path: Path, *arguments: str) -> Iterator[tuple[int, int]]:
    """A service of the map: its process and port."""
    program = str(Path(sys.executable).with_name("megloc"))
    command = [program, "serve", str(map_path), "--port", "0", "--requests-per-minute", "0"]
    process = subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        yield process.pid, int(line.rsplit(":", 1)[1].strip("/\n"))
    finally:
        process.terminate()
        print(f"ended with status {process.wait()}")


def memory_mb(pid: int) -> float:
    """Memory of a process and those that it has started, what they share counted once."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    own = next(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:"))
    return own / 1024 + sum(memory_mb(int(child)) for child in children)


def main() -> int:
    """Run it; 1 where something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", type=Path, required=True)
    parser.add_argument("--query", type=Path, required=True)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--hostile", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    good = good_requests(given.map, given.query)
    faults: list[str] = []
    with server(given.map, "--workers", str(given.workers)) as (pid, port):
        print(f"memory at the start {memory_mb(pid):.0f} MB")
        memory: list[tuple[float, float]] = []
        begin, over = time.monotonic(), threading.Event()

        def watch() -> None:
            while not over.wait(1.0):
                memory.append((time.monotonic() - begin, memory_mb(pid)))

        threading.Thread(target=watch, daemon=True).start()
        seen = run_clients(port, until(begin + given.seconds, good), given.clients)
        over.set()
        faults += seen.faults
        print(
            f"{given.clients} clients, {given.seconds:.0f} s: {len(seen.seconds)} requests, "
            f"{len(seen.seconds) / given.seconds:.2f} a second, {dict(seen.statuses)}, "
            f"{len(seen.faults)} answers not equal; {seen.quantiles()}"
        )
        second = np.mean([mb for at, mb in memory if 60 <= at < 120] or [np.nan])
        last = np.mean([mb for at, mb in memory if at >= given.seconds - 60])
        print(
            f"memory: second minute {second:.1f} MB, last {last:.1f} MB, "
            f"{100 * (last / second - 1):+.2f} %; most {max(mb for _, mb in memory):.0f} MB"
        )
        alone = run_clients(port, until(time.monotonic() + 15, good), 1)
        print(f"one client alone: {alone.quantiles()}")
        attack = iter(hostile_requests(good[0], given.hostile))
        done: list[Seen] = []
        thread = threading.Thread(
            target=lambda: done.append(run_clients(port, attack, 16, HOSTILE_ADDRESS))
        )
        started = time.monotonic()
        thread.start()
        meanwhile = Seen()
        for request in itertools.cycle(good):
            send(port, request, "127.0.0.1", meanwhile)
            if not thread.is_alive():
                break
        print(
            f"the same while {given.hostile} hostile requests run ({time.monotonic() - started:.0f}"
            f" s): {meanwhile.quantiles()}, {dict(meanwhile.statuses)}"
        )
        print(f"what these met: {dict(sorted(done[0].statuses.items()))}")
        faults += meanwhile.faults + done[0].faults + alone.faults
        print(f"memory at the end {memory_mb(pid):.0f} MB")
    for fault in faults[:20]:
        print(f"fault: {fault}", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
