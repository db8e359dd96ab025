"""HTTP service that estimates the poses of uploaded images; see docs/serve.md.

Errors are JSON, ``{"error": "..."}``. Client errors have a status from 400 to 499 and say what is
wrong; 503 means too many waiting images, 500 an internal error whose details are only logged.
"""

from __future__ import annotations

import asyncio
import hmac
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, Response
from PIL import Image
from pydantic import BaseModel, Field, TypeAdapter, ValidationError
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from megloc_kapture.errors import DataError, OptionError, require
from megloc_kapture.io.images import decode_image_rgb, photo_of, turned_upright
from megloc_kapture.pipeline.executors import available_cores
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.queries import Query as ImageQuery
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

_PAGE = Path(__file__).with_name("localize.html")
_PAGE_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src blob: data:; connect-src 'self'"
)
# read oversized requests up to this multiple of the limit, so that clients receive the error
_READ_BEYOND_LIMIT = 3
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_FORM = {
    "type": "object",
    "required": ["image"],
    "properties": {
        "image": {"type": "string", "format": "binary", "description": "JPEG or PNG"},
        "camera": {"type": "string", "description": "a Camera as JSON"},
    },
}
_REQUEST_BODY = {
    "required": True,
    "content": {
        "multipart/form-data": {"schema": _FORM},
        "image/jpeg": _BINARY,
        "image/png": _BINARY,
    },
}

_CAMERA_FORM = (
    'a camera is JSON, as in {"model": "PINHOLE", "width": 1920, "height": 1080, "params": '
    "[1371, 1371, 960, 540]}"
)

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class Answer(BaseModel):
    """Result for an image: a pose, or the reason for its absence."""

    localized: bool
    reason: str | None = Field(description="reason why there is no pose")
    cam_from_world: RigidTransform | None = Field(
        description="x_cam = R x_world + t, t in the unit of the map; COLMAP's axes: x right, y "
        "down, z forward"
    )
    camera_center: Vector | None = Field(description="camera centre in the map's frame")
    covariance: list[list[float]] | None = Field(
        description="6 by 6: rotation in radians, then translation in the unit of the map, of a "
        "left perturbation of cam_from_world"
    )
    confidence: float | None = Field(description="probability that the pose is correct")
    num_matches: int
    num_inliers: int
    candidates: list[str] = Field(description="matched map images, best first")
    remarks: list[str]
    frame: str | None = Field(description="the pose's coordinate frame, if the map has several")
    camera: Camera = Field(
        description="camera of the request; if omitted, the camera of the upright image, whose "
        "focal length is initialised from EXIF or a guess and estimated with the pose"
    )

    @classmethod
    def of(cls, result: Pose | Failure, camera: Camera, frame: str = "") -> Answer:
        """Return the answer for a query; non-finite numbers become null in JSON.

        ``frame`` is the pose's coordinate frame, "" if the map has only one.
        """
        pose = result if isinstance(result, Pose) else None
        covariance = None if pose is None else pose.covariance
        return cls(
            localized=pose is not None,
            reason=result.reason if isinstance(result, Failure) else None,
            cam_from_world=None if pose is None else pose.cam_from_world,
            camera_center=None if pose is None else pose.cam_from_world.center().tolist(),
            covariance=None if covariance is None else covariance.tolist(),
            confidence=result.confidence,
            num_matches=result.num_matches,
            num_inliers=result.num_inliers,
            candidates=list(result.candidates),
            remarks=list(result.remarks),
            frame=frame or None,
            camera=camera if pose is None else pose.camera or camera,
        )


def read_camera(text: str) -> Camera:
    try:
        return TypeAdapter(Camera).validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(["camera", *map(str, first["loc"][:2])])
        raise DataError(f"{where}: {first['msg']}; {_CAMERA_FORM}") from error


def read_query(content: bytes, camera: str | None, *, max_megapixels: float) -> ImageQuery:
    """Read a query from an image file's bytes and a camera as JSON.

    The header is checked before decoding. Raise HTTPException for a different format or a broken
    header (415) or too many pixels (413), and DataError for other errors in image or camera.
    """
    try:
        image = Image.open(BytesIO(content), formats=["JPEG", "PNG"])
    except Image.DecompressionBombError as error:
        raise HTTPException(
            413, f"the image has more than {max_megapixels:g} megapixels"
        ) from error
    except Exception as error:  # pillow raises many kinds of errors for broken headers
        reason = "the image is neither JPEG nor PNG, or is broken"
        if content.startswith((b"/9j/", b"iVBOR", b"data:")):
            reason += "; this is base64: send the bytes of the file"
        raise HTTPException(415, reason) from error
    width, height = image.size
    if width * height > max_megapixels * 1e6:
        raise HTTPException(
            413, f"the image is {width}x{height}, which is more than {max_megapixels:g} megapixels"
        )
    try:
        pixels = decode_image_rgb(content)
    except DataError as error:
        raise DataError(f"the image is broken: {error.message}") from error
    suffix = ".png" if image.format == "PNG" else ".jpg"
    name = f"image{suffix}"  # preprocessing depends on the suffix
    if not camera:
        photo = photo_of(image)
        return ImageQuery(photo.upright_camera, turned_upright(pixels, photo.orientation), name)
    known = read_camera(camera)
    require(
        (known.width, known.height) == (width, height),
        f"the image is {width}x{height} as stored, but its camera says "
        f"{known.width}x{known.height}",
    )
    return ImageQuery(known, pixels, name)


class Service:
    """A localizer with limits, shared by worker threads.

    Parameters
    ----------
    threads : number of images localized in parallel; None means all cores.
    max_waiting : number of images that may wait; further images are rejected (503).
    max_mb, max_megapixels : largest request and largest image; larger ones are rejected (413).
    token : secret that clients must send; None means that everybody has access.
    """

    def __init__(
        self,
        localizer: Localizer,
        *,
        threads: int | None = None,
        max_waiting: int = 32,
        max_mb: float = 20.0,
        max_megapixels: float = 32.0,
        token: str | None = None,
    ) -> None:
        self.localizer, self._token = localizer, token
        self._max_mb, self._max_megapixels = max_mb, max_megapixels
        num_threads = threads or available_cores()
        self._threads = ThreadPoolExecutor(num_threads, thread_name_prefix="localize")
        self._pending, self._max_pending = 0, num_threads + max_waiting

    def check_token(self, request: Request) -> None:
        """Raise HTTPException for requests without the token, compared in constant time."""
        if self._token is None:
            return
        kind, _, sent = request.headers.get("authorization", "").partition(" ")
        same = hmac.compare_digest(sent.strip().encode(), self._token.encode())
        if kind.lower() != "bearer" or not same:
            raise HTTPException(
                401, "give the token: Authorization: Bearer TOKEN", {"www-authenticate": "Bearer"}
            )

    async def answer(self, request: Request, camera: str | None) -> Answer:
        """Localize the image in a request when a thread is free."""
        content, camera_in_form = await self._image_in(request)
        if self._pending >= self._max_pending:
            raise HTTPException(503, "too many images are waiting", {"retry-after": "2"})
        self._pending += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(
                self._threads, self._localize, content, camera_in_form or camera
            )
        finally:
            self._pending -= 1

    def _localize(self, content: bytes, camera: str | None) -> Answer:
        try:
            query = read_query(content, camera, max_megapixels=self._max_megapixels)
            result = self.localizer.localize_query(query)
        except (DataError, OptionError) as error:
            if isinstance(error, DataError) and error.path is not None:
                raise  # a map file is broken
            raise HTTPException(422, str(error)) from error
        frame = self.localizer.map.tables.frame(result.candidates[0]) if result else ""
        return Answer.of(result, query.camera, frame)

    async def _image_in(self, request: Request) -> tuple[bytes, str | None]:
        body = await self._read_body(request)
        kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if kind.startswith("image/") or kind in ("application/octet-stream", ""):
            return body, None
        if kind != "multipart/form-data":
            raise HTTPException(
                415,
                f"the header Content-Type says {kind}: send image/jpeg or image/png (curl -H "
                "'Content-Type: image/jpeg' --data-binary @photo.jpg), or a form (curl -F "
                "image=@photo.jpg)",
            )

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body}

        form = await Request(request.scope, receive).form(max_files=4, max_fields=4)
        image, camera = form.get("image"), form.get("camera")
        if isinstance(camera, UploadFile):
            camera = (await camera.read()).decode(errors="replace")
        if (
            not isinstance(image, UploadFile)
            or set(form) - {"image", "camera"}
            or len(form.multi_items()) > len(form)
        ):
            raise HTTPException(422, "a form has one file `image`, and may have one `camera`")
        return await image.read(), camera

    async def _read_body(self, request: Request) -> bytes:
        max_bytes = int(self._max_mb * 1e6)
        body, size = bytearray(), 0
        async for chunk in request.stream():
            size += len(chunk)
            if size <= max_bytes:
                body += chunk
            elif size > _READ_BEYOND_LIMIT * max_bytes:
                break
        if size > max_bytes:
            raise HTTPException(413, f"the request is larger than {self._max_mb:g} MB")
        return bytes(body)


def make_app(service: Service, overview: bytes) -> FastAPI:
    """Return the application; ``overview`` is the map as JSON, see :func:`.server.map_overview`."""
    app = FastAPI(title="megloc", description="Where was this photograph taken? Poses in one map.")
    protected = [Depends(service.check_token)]

    @app.post(
        "/localize",
        response_model=Answer,
        dependencies=protected,
        openapi_extra={"requestBody": _REQUEST_BODY},
        summary="Localize an image",
    )
    async def localize(
        request: Request,
        camera: Annotated[
            str | None,
            Query(
                max_length=2000,
                description="a Camera as JSON; a form may have it as a field instead",
            ),
        ] = None,
    ) -> Response:
        if unknown := set(request.query_params) - {"camera"}:
            raise HTTPException(422, f"unknown parameter {min(unknown)!r}; there is only `camera`")
        answer = await service.answer(request, camera)
        return Response(answer.model_dump_json(), media_type="application/json")

    @app.get("/map", dependencies=protected, summary="The map from above: cameras and points")
    async def get_map() -> Response:
        return Response(overview, media_type="application/json")

    @app.head("/health", include_in_schema=False)
    @app.get("/health", summary="Report that the service is running")
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(_PAGE, headers={"content-security-policy": _PAGE_POLICY})

    @app.exception_handler(HTTPException)
    async def refuse(_: Request, error: HTTPException) -> Response:
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)

    @app.exception_handler(RequestValidationError)
    async def refuse_parameter(_: Request, error: RequestValidationError) -> Response:
        return JSONResponse({"error": f"camera: {error.errors()[0]['msg']}"}, 422)

    @app.exception_handler(ClientDisconnect)
    async def leave(_: Request, __: ClientDisconnect) -> Response:
        return Response(status_code=400)  # the client has disconnected

    @app.exception_handler(Exception)
    async def fail(_: Request, __: Exception) -> Response:
        return JSONResponse({"error": "internal error; see the service's log"}, 500)

    return app
