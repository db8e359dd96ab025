"""The HTTP service: an image comes in, its pose goes out; see docs/serve.md.

All that a client can get wrong is answered with a status of 400 to 499 and one line; a defect of
ours is a 500 that says nothing about this machine. What it says is in the log.
"""

from __future__ import annotations

import asyncio
import hmac
import os
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import prometheus_client as prometheus
from fastapi import FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from prometheus_client import multiprocess
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from megloc_kapture.errors import DataError, MeglocError, OptionError
from megloc_kapture.io.images import turned_upright
from megloc_kapture.pipeline.executors import available_cores
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.queries import Query as ImageQuery
from megloc_kapture.service.requests import (
    Answer,
    Busy,
    Limits,
    Photograph,
    Rates,
    Refused,
    TooManyPixels,
    Turns,
    UnknownFormat,
    answer_of,
    camera_of,
    client_of,
)

_PATH = re.compile(r"(^|[\s'\"(=])/\w[^\s]*/")
_DISCARD_S = 2.0
_HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "content-security-policy": "default-src 'none'; script-src 'unsafe-inline'; style-src "
    "'unsafe-inline'; img-src blob: data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
}
_STATUSES = {
    400: "what was sent is no form, or not all of it came",
    401: "no token, or a wrong one",
    408: "the request came in too slowly",
    413: "too many bytes or pixels",
    415: "neither JPEG nor PNG",
    422: "the image is broken, or its camera is wrong, or of another size",
    429: "too many requests of this client; Retry-After says when",
    503: "too many images are waiting; Retry-After says when",
    504: "it took too long",
}
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_BODY = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["image"],
                "properties": {
                    "image": {"type": "string", "format": "binary", "description": "JPEG or PNG"},
                    "camera": {"type": "string", "description": "a CameraModel as JSON"},
                },
            }
        },
        "image/jpeg": _BINARY,
        "image/png": _BINARY,
    },
}


class Service:
    """A localizer behind limits.

    Parameters
    ----------
    localizer : its map and options; threads share it.
    limits : what is taken.
    token : what clients have to show; None: nothing.
    """

    def __init__(self, localizer: Localizer, limits: Limits, token: str | None = None) -> None:
        self.localizer, self.limits, self._token = localizer, limits, token
        self.num_threads = limits.threads or available_cores()
        self.turns = Turns(self.num_threads, limits.max_waiting)
        self._rates = Rates(limits.requests_per_minute)
        self.threads = ThreadPoolExecutor(self.num_threads + 1, thread_name_prefix="localize")
        self.metrics = Metrics(self)

    # ---------------------------------------------------------------- who may ask

    def check_token(self, request: Request) -> None:
        """Refuse who does not show the token, in a time that does not depend on what is shown."""
        if self._token is None:
            return
        kind, _, shown = request.headers.get("authorization", "").partition(" ")
        same = hmac.compare_digest(shown.strip().encode(), self._token.encode())
        if kind.lower() != "bearer" or not same:
            raise HTTPException(
                401, "give the token: Authorization: Bearer TOKEN", {"www-authenticate": "Bearer"}
            )

    def check_rate(self, client: str) -> None:
        """Refuse who has sent too many requests."""
        wait_s = self._rates.wait_s(client)
        if wait_s > 0:
            raise HTTPException(429, "too many requests", {"retry-after": str(int(wait_s) + 1)})

    # ---------------------------------------------------------------- an answer

    async def answer(self, request: Request, camera: str | None) -> Response:
        """The answer to an image; raises HTTPException, ClientDisconnect."""
        client = client_of(request.client.host if request.client else None)
        self.check_rate(client)
        self.check_token(request)
        body = await self._read_body(request)
        content, in_form = await _image_of(request, body)
        del body
        begin = time.perf_counter()
        work = asyncio.ensure_future(self._in_turn(client, content, in_form or camera))
        gone = asyncio.ensure_future(_disconnected(request))
        try:
            await asyncio.wait({work, gone}, return_when=asyncio.FIRST_COMPLETED)
            if not work.done():
                raise ClientDisconnect
            answer = work.result()
        finally:
            work.cancel()
            gone.cancel()
        seconds = time.perf_counter() - begin
        self.metrics.answered(answer["localized"], seconds)
        return JSONResponse(answer, headers={"server-timing": f"total;dur={seconds * 1e3:.0f}"})

    async def _in_turn(self, client: str, content: bytes, camera: str | None) -> dict[str, Any]:
        try:
            async with asyncio.timeout(self.limits.time_limit_s):
                await self.turns.take(client)
                loop = asyncio.get_running_loop()
                work = loop.run_in_executor(self.threads, self.localize, content, camera)
                # a thread cannot be ended: its slot is free when it is done
                work.add_done_callback(partial(self._end_turn, client))
                return await asyncio.shield(work)
        except TimeoutError as error:
            raise HTTPException(504, "it took too long") from error
        except Busy as error:
            headers = {"retry-after": "2"}
            raise HTTPException(503, "too many images are waiting", headers) from error

    def _end_turn(self, client: str, work: asyncio.Future[dict[str, Any]]) -> None:
        self.turns.give_back(client)
        if not work.cancelled():
            work.exception()  # known to who waits for it, where one does

    def localize(self, content: bytes, camera: str | None) -> dict[str, Any]:
        """The answer to the bytes of an image and a camera as JSON; raises HTTPException."""
        try:
            max_pixels = self.limits.max_megapixels * 1e6
            photograph = Photograph.of(content, max_pixels=max_pixels)
            chosen, orientation = camera_of(photograph, camera)
            pixels = turned_upright(photograph.decode(), orientation)
            # a JPEG is pre-processed as a JPEG
            query = ImageQuery(chosen, pixels, f"image{photograph.suffix}")
            found = self.localizer.localize_query(query)
        except UnknownFormat as error:
            raise HTTPException(415, str(error)) from error
        except TooManyPixels as error:
            raise HTTPException(413, str(error)) from error
        except MeglocError as error:
            ours = not isinstance(error, DataError | OptionError) or (
                isinstance(error, DataError) and error.path is not None
            )
            if ours or _PATH.search(str(error)):
                raise
            raise HTTPException(422, str(error)) from error
        frame = self.localizer.map.restrictions.frame(found.candidates[0]) if found else ""
        return answer_of(found, chosen, frame)

    async def _read_body(self, request: Request) -> bytes:
        most = int(self.limits.max_mb * 1e6)
        too_large = HTTPException(413, f"the request is larger than {self.limits.max_mb:g} MB")
        length = request.headers.get("content-length", "")
        if length.isdigit() and int(length) > most:
            raise too_large
        body = bytearray()
        try:
            async with asyncio.timeout(self.limits.upload_limit_s):
                async for chunk in request.stream():
                    body += chunk
                    if len(body) > most:
                        raise too_large
        except TimeoutError as error:
            raise HTTPException(408, "the request came in too slowly") from error
        return bytes(body)


class Metrics:
    """Counters for Prometheus; of all worker processes where PROMETHEUS_MULTIPROC_DIR says so."""

    def __init__(self, service: Service) -> None:
        self._registry = registry = prometheus.CollectorRegistry()
        self._requests = prometheus.Counter(
            "megloc_requests", "Requests by path and status", ["path", "status"], registry=registry
        )
        self._images = prometheus.Counter(
            "megloc_images", "Images that were answered", ["localized"], registry=registry
        )
        self._seconds = prometheus.Histogram(
            "megloc_image_seconds",
            "From the whole request to its answer",
            buckets=(0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60),
            registry=registry,
        )
        self._several = "PROMETHEUS_MULTIPROC_DIR" in os.environ
        if not self._several:  # a function cannot be asked from another process
            for name, what, read in (
                ("waiting", "Images that wait", lambda: service.turns.waiting),
                ("busy", "Threads at work", lambda: service.turns.taken),
            ):
                prometheus.Gauge(f"megloc_{name}", what, registry=registry).set_function(read)
            prometheus.ProcessCollector(registry=registry)

    def requested(self, path: str, status: int) -> None:
        """Count an answer."""
        self._requests.labels(path, str(status)).inc()

    def answered(self, localized: bool, seconds: float) -> None:
        """Count an image that was localized, or not."""
        self._images.labels(str(localized).lower()).inc()
        self._seconds.observe(seconds)

    def text(self) -> bytes:
        """Prometheus' text format."""
        registry = self._registry
        if self._several:
            registry = prometheus.CollectorRegistry()
            multiprocess.MultiProcessCollector(registry)  # type: ignore[no-untyped-call]
        return prometheus.generate_latest(registry)


def make_app(service: Service, overview: bytes) -> ASGIApp:
    """The application.

    Parameters
    ----------
    overview : the map from above as JSON; see :mod:`megloc_kapture.service.server`.
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        service.threads.shutdown(wait=True, cancel_futures=True)

    app = FastAPI(
        title="megloc",
        description="Where was this photograph taken? Poses in one map.",
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
    )
    refusals: dict[int | str, dict[str, Any]] = {
        status: {"model": Refused, "description": text} for status, text in _STATUSES.items()
    }

    @app.post(
        "/localize",
        response_model=Answer,
        responses=refusals,
        openapi_extra={"requestBody": _BODY},
        summary="Localize an image",
    )
    async def localize(
        request: Request,
        camera: Annotated[
            str | None,
            Query(max_length=2000, description="a CameraModel as JSON, where no form has it"),
        ] = None,
    ) -> Response:
        return await service.answer(request, camera)

    @app.get("/map", summary="The map from above: cameras, points, two axes")
    async def get_map(request: Request) -> Response:
        service.check_token(request)
        return Response(overview, media_type="application/json")

    @app.get("/health", summary="Whether images are localized")
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/metrics", summary="Counters for Prometheus")
    async def metrics(request: Request) -> Response:
        service.check_token(request)
        return Response(service.metrics.text(), media_type=prometheus.CONTENT_TYPE_LATEST)

    @app.get("/", include_in_schema=False)
    async def page() -> HTMLResponse:
        return HTMLResponse(_page("localize.html"))

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(_page("docs.html"))

    @app.exception_handler(HTTPException)
    async def refuse(_: Request, error: HTTPException) -> Response:
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)

    @app.exception_handler(RequestValidationError)
    async def refuse_parameter(_: Request, error: RequestValidationError) -> Response:
        return JSONResponse({"error": f"camera: {error.errors()[0]['msg']}"}, 422)

    @app.exception_handler(ClientDisconnect)
    async def leave(_: Request, __: ClientDisconnect) -> Response:
        return Response(status_code=400)  # nobody reads it

    @app.exception_handler(Exception)
    async def fail(_: Request, __: Exception) -> Response:
        return JSONResponse({"error": "a defect of the service; its log says more"}, 500)

    known = {route.path for route in app.routes if hasattr(route, "path")}

    def told(path: str, status: int) -> None:
        service.metrics.requested(path if path in known else "other", status)

    return _Envelope(app, told=told, max_bytes=int(service.limits.max_mb * 1e6))


class _Envelope:
    """Headers of every answer; a request that is answered before all of it has come is cut off.

    What still comes is read for a moment: a client that is sending would not see the answer.
    """

    def __init__(self, app: ASGIApp, *, told: Callable[[str, int], None], max_bytes: int) -> None:
        self._app, self._told, self._max_bytes = app, told, max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        complete = False

        async def receive_noted() -> Message:
            nonlocal complete
            message = await receive()
            complete = complete or not message.get("more_body", False)
            return message

        async def send_enveloped(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._told(scope["path"], message["status"])
                headers = list(message.get("headers", []))
                headers += [(name.encode(), text.encode()) for name, text in _HEADERS.items()]
                slow = message["status"] == 408
                if not complete and (slow or not await self._discarded(scope, receive_noted)):
                    headers.append((b"connection", b"close"))
                message = {**message, "headers": headers}
            await send(message)

        await self._app(scope, receive_noted, send_enveloped)

    async def _discarded(self, scope: Scope, receive: Callable[[], Awaitable[Message]]) -> bool:
        """Read what still comes; whether that was all."""
        names = {name for name, _ in scope["headers"]}
        if not names & {b"content-length", b"transfer-encoding"}:
            return True
        if b"expect" in names:
            return False  # nothing comes before we ask for it
        size = 0
        with suppress(TimeoutError):
            async with asyncio.timeout(_DISCARD_S):
                while size <= 2 * self._max_bytes:
                    message = await receive()
                    size += len(message.get("body", b""))
                    if not message.get("more_body", False):
                        return True
        return False


@cache
def _page(name: str) -> str:
    """A page of this folder: one file that needs nothing else."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


class _FormInMemory(MultiPartParser):
    spool_max_size = 1 << 40  # nothing of a client's goes to a disk


async def _image_of(request: Request, body: bytes) -> tuple[bytes, str | None]:
    """The bytes of the image, and the camera where a form has it; raises HTTPException."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "multipart/form-data":
        if kind not in ("image/jpeg", "image/png", "application/octet-stream", ""):
            raise HTTPException(
                415,
                f"the header Content-Type says {kind}: send image/jpeg or image/png (curl -H "
                "'Content-Type: image/jpeg' --data-binary @photo.jpg), or a form (curl -F "
                "image=@photo.jpg)",
            )
        return body, None

    async def whole() -> AsyncIterator[bytes]:
        yield body

    parser = _FormInMemory(request.headers, whole(), max_files=1, max_fields=4)  # type: ignore[arg-type]
    try:
        form: FormData = await parser.parse()
    except MultiPartException as error:
        raise HTTPException(400, f"the form is broken: {error.message}") from error
    unknown = set(form) - {"image", "camera"}
    image, camera = form.get("image"), form.get("camera")
    if unknown or not isinstance(image, UploadFile) or isinstance(camera, UploadFile):
        raise HTTPException(422, "a form has a file `image`, and may have a text `camera`")
    return await image.read(), camera


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
