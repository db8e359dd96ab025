"""Run the service: one process, or several that share a map's index as memory-mapped files."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import socket
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import uvicorn
from numpy.typing import NDArray
from uvicorn.config import STARTUP_FAILURE
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.supervisors import Multiprocess

from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.io.files import clear_leftovers, owned_name
from megloc_kapture.pipeline.executors import end_with_parent, single_threaded
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.service.app import Service, make_app
from megloc_kapture.service.requests import Limits, client_of
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.shared_index import open_index, shared_index
from megloc_kapture.values import Camera

if TYPE_CHECKING:
    from starlette.types import ASGIApp

_MAX_CONNECTIONS, _MAX_CONNECTIONS_OF_CLIENT = 512, 64
_HEADERS_LIMIT_S = 10.0


def prepared_localizer(kapture_map: KaptureMap, options: PipelineOptions) -> Localizer:
    """A localizer that has loaded what it needs: what is missing is found before the first image.

    Raises
    ------
    MeglocError : the map is broken, or lacks what localizing needs; weights are missing.
    """
    localizer = Localizer(kapture_map, options=options)
    kapture_map.check()
    for local in localizer.types:
        _ = local.extractor
    # noise matches nothing, but goes the whole way
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    with single_threaded():
        localizer.localize(noise, Camera.pinhole(320, 240, 300.0))
    return localizer


def bind(host: str, port: int) -> socket.socket:
    """A socket that is bound and does not listen yet; port 0: a free one. Raises OptionError."""
    try:
        if not 0 <= port <= 65_535:
            raise OSError("a port is a number from 0 to 65535")
        family, kind, _, _, place = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with ExitStack() as unless_bound:
            bound = unless_bound.enter_context(socket.socket(family, kind))
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(place)
            unless_bound.pop_all()
        return bound
    except OSError as error:
        reason = error.strerror or str(error)
        raise OptionError(f"cannot listen at {host}, port {port}: {reason}") from error


def serve(
    opening: Callable[..., KaptureMap],
    kapture_map: KaptureMap,
    options: PipelineOptions,
    bound: socket.socket,
    *,
    limits: Limits,
    workers: int = 1,
    proxy: str = "",
    token: str | None = None,
    log_requests: bool = False,
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Serve until SIGTERM or SIGINT; what is running then is finished.

    Parameters
    ----------
    opening : :meth:`~megloc_kapture.pipeline.kapture_map.KaptureMap.open` with its arguments, but
        for ``indices``: so worker processes open the map.
    kapture_map : the map, opened.
    options : of localizing.
    bound : of :func:`bind`.
    workers : processes; each has ``limits`` of its own.
    proxy : address of a reverse proxy, whose X-Forwarded-For is believed; "" without one.
    ready : called when images are taken.

    Raises
    ------
    MeglocError : the map cannot be localized in.
    """
    logging.getLogger("uvicorn").setLevel(logging.ERROR)  # a client's mistakes are no news
    localizer = prepared_localizer(kapture_map, options)
    overview = map_overview(kapture_map)
    configure = partial(_config, limits=limits, proxy=proxy, log_requests=log_requests)
    if workers == 1:
        cv2.setNumThreads(1)  # threads are for images
        app = make_app(Service(localizer, limits, token), overview)
        with single_threaded():
            _Server(configure(app), ready).run([bound])
        return
    clear_leftovers(Path(tempfile.gettempdir()))
    indices = {name: one.index for name, one in kapture_map.keypoints.items()}
    with (
        shared_index(indices) as folders,
        tempfile.TemporaryDirectory(prefix=f".{owned_name()}") as counters,
    ):
        os.environ["PROMETHEUS_MULTIPROC_DIR"] = counters
        factory = partial(_app_of_worker, opening, options, folders, limits, token, overview)
        config = configure(factory, factory=True, workers=workers, timeout_worker_healthcheck=60)
        del localizer, kapture_map, indices  # the workers have theirs
        _Workers(config, [bound], ready).run()


def _config(
    app: Any, *, limits: Limits, proxy: str, log_requests: bool, **others: Any
) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        http=_Connection,
        loop="asyncio",
        ws="none",
        log_config=None,
        access_log=log_requests,
        server_header=False,
        proxy_headers=bool(proxy),
        forwarded_allow_ips=proxy or None,
        limit_concurrency=_MAX_CONNECTIONS,
        timeout_graceful_shutdown=int(limits.time_limit_s + limits.upload_limit_s) + 5,
        **others,
    )


def _app_of_worker(
    opening: Callable[..., KaptureMap],
    options: PipelineOptions,
    folders: Mapping[str, Path],
    limits: Limits,
    token: str | None,
    overview: bytes,
) -> ASGIApp:
    end_with_parent()
    logging.getLogger("uvicorn").setLevel(logging.ERROR)
    cv2.setNumThreads(1)
    try:
        indices = {name: open_index(folder) for name, folder in folders.items()}
        localizer = prepared_localizer(opening(indices=indices), options)
    except MeglocError as error:
        print(f"megloc: {error}", file=sys.stderr)
        sys.exit(STARTUP_FAILURE)
    return make_app(Service(localizer, limits, token), overview)


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._ready()


class _Workers(Multiprocess):
    """Worker processes; one that dies is started again."""

    def __init__(
        self, config: uvicorn.Config, sockets: list[socket.socket], ready: Callable[[], None]
    ) -> None:
        self._before = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)}
        super().__init__(config, sockets)
        self._ready: Callable[[], None] | None = ready
        self._signal: int | None = None

    def keep_subprocess_alive(self) -> None:
        super().keep_subprocess_alive()
        if self._ready is not None and all(one.is_ready() for one in self.processes):
            self._ready()
            self._ready = None

    def handle_int(self) -> None:
        self._signal = signal.SIGINT
        self.should_exit.set()

    def handle_term(self) -> None:
        self._signal = signal.SIGTERM
        self.should_exit.set()

    def run(self) -> None:
        super().run()
        for one, handler in self._before.items():
            signal.signal(one, handler)
        if self._signal is None:
            raise MeglocError("a worker process could not start")
        signal.raise_signal(self._signal)


class _Connection(H11Protocol):
    """A connection whose requests' headers have to come in in time, and few of one client."""

    _of_client: Counter[str] = Counter()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._cut: asyncio.TimerHandle | None = None
        self._client = client_of(self.client[0] if self.client else None)
        self._of_client[self._client] += 1
        behind_proxy = self.config.proxy_headers
        if self._of_client[self._client] > _MAX_CONNECTIONS_OF_CLIENT and not behind_proxy:
            transport.abort()
        self._expect_request()

    def connection_lost(self, exc: Exception | None) -> None:
        self._of_client[self._client] -= 1
        if self._of_client[self._client] <= 0:
            del self._of_client[self._client]
        self._stop_waiting()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        super().handle_events()
        if self.cycle is not None and not self.cycle.response_complete:
            self._stop_waiting()

    def on_response_complete(self) -> None:
        self._expect_request()
        super().on_response_complete()

    def _expect_request(self) -> None:
        self._stop_waiting()
        self._cut = self.loop.call_later(_HEADERS_LIMIT_S, self.transport.abort)

    def _stop_waiting(self) -> None:
        if self._cut is not None:
            self._cut.cancel()
            self._cut = None


_MAX_POINTS, _MAX_CAMERAS = 15_000, 3_000


def map_overview(kapture_map: KaptureMap) -> bytes:
    """JSON: ``right`` and ``up``, unit vectors of the world, and an ``origin`` in it; on these
    ``points`` [x, y, ...] and ``cameras`` [x, y, direction x, direction y, ...]; how many
    ``images`` there are, and the ``unit`` of the world, ``m`` or ``units``.

    Of many points and cameras a sample.
    """
    # matplotlib comes with it, and worker processes are given what it makes
    from megloc_kapture.evaluation.report.map_view import top_view

    names = kapture_map.images
    quats, translations = stack_poses([kapture_map.poses[name] for name in names])
    centers = camera_centers(quats, translations)
    origin = centers.mean(axis=0)
    view = top_view(quats, centers)
    forward = rotate(invert_quats(quats), np.array([0.0, 0.0, 1.0]))
    cameras = np.hstack([view.project(centers - origin), view.project(forward)])
    points = _trimmed(np.concatenate([k.index.xyz for k in kapture_map.keypoints.values()]))
    content = {
        "images": len(names),
        "unit": kapture_map.unit,
        "right": _rounded(view.right, 9),
        "up": _rounded(view.up, 9),
        "origin": origin.tolist(),
        "cameras": _rounded(_sample(cameras, _MAX_CAMERAS)),
        "points": _rounded(view.project(_sample(points, _MAX_POINTS) - origin)),
    }
    return json.dumps(content, separators=(",", ":")).encode()


def _trimmed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without the outermost, which would make the rest a dot."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        return points
    low, high = np.percentile(points, [1.0, 99.0], axis=0)
    margin = 0.5 * (high - low)
    return points[((points >= low - margin) & (points <= high + margin)).all(axis=1)]


def _sample(rows: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    if len(rows) <= most:
        return rows
    return rows[np.sort(np.random.default_rng(0).choice(len(rows), most, replace=False))]


def _rounded(values: NDArray[np.float64], digits: int = 5) -> list[float]:
    return [float(f"{value:.{digits}g}") for value in values.ravel().tolist()]
