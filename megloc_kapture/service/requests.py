"""What strangers send, within limits: who is next, photographs, cameras, and the answers.

Work waits in a line for each client, and the lines take turns: who sends a hundred images delays
another client's by one of them.

Photographs are measured before anything of them is decoded. What a decoder would do is bounded by
the header: pixels, and the scans of a progressive JPEG, each of which goes over all of them. pillow
reads headers too, at a microsecond a segment in Python, of which 20 MB can have millions; so this
module walks the segments, and not far.
"""

from __future__ import annotations

import asyncio
import ipaddress
import math
import re
import struct
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from megloc_kapture.errors import DataError, MeglocError
from megloc_kapture.io.images import Photo, decode_image_rgb, photo_of
from megloc_kapture.values import (
    CAMERA_MODEL_NUM_PARAMS,
    ONE_FOCAL_MODELS,
    Camera,
    Failure,
    Options,
    Pose,
)


class Limits(Options):
    """What a service takes; of each worker process."""

    threads: int | None = Field(
        default=None,
        ge=1,
        description="Images that a process localizes at once; unless given, the cores divided by "
        "the workers.",
    )
    max_waiting: int = Field(
        default=32, ge=1, description="Images that may wait; half of them of one client."
    )
    max_mb: float = Field(default=20.0, gt=0, description="Size of a request.")
    max_megapixels: float = Field(default=32.0, gt=0, description="Size of an image.")
    requests_per_minute: float = Field(
        default=120.0, ge=0, description="Requests of one client; 0: no limit."
    )
    time_limit_s: float = Field(default=60.0, gt=0, description="Time to wait and to localize in.")
    upload_limit_s: float = Field(default=30.0, gt=0, description="Time for a request to come in.")


class Busy(Exception):
    """The lines are full."""


class Turns:
    """Slots that clients take in turn.

    One slot more is kept for clients that have none: long work of others does not stop them. A
    client's line may have half of all that wait, so that nobody fills it alone. To be used from one
    event loop.

    Parameters
    ----------
    slots : what may be taken at once, but for that one.
    max_waiting : of all lines together.
    """

    def __init__(self, slots: int, max_waiting: int) -> None:
        self._slots, self._max_waiting = slots, max_waiting
        self._taken: Counter[str] = Counter()
        self._lines: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()

    @property
    def taken(self) -> int:
        """Slots that are taken."""
        return self._taken.total()

    @property
    def waiting(self) -> int:
        """How many wait."""
        return sum(map(len, self._lines.values()))

    async def take(self, client: str) -> None:
        """Wait for a slot, which is to be given back; raises Busy."""
        line = self._lines.setdefault(client, deque())
        try:
            if not line and self._may_take(client):
                self._taken[client] += 1
                return
            if self.waiting >= self._max_waiting or len(line) >= (self._max_waiting + 1) // 2:
                raise Busy
            turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            line.append(turn)
            try:
                await turn
            except asyncio.CancelledError:
                if turn in line:
                    line.remove(turn)
                elif not turn.cancelled():
                    self.give_back(client)  # it came as we left
                raise
        finally:
            if not line and self._lines.get(client) is line:
                del self._lines[client]

    def give_back(self, client: str) -> None:
        """Give a slot back; the next client that waits gets it."""
        self._taken[client] -= 1
        if not self._taken[client]:
            del self._taken[client]
        for other, line in self._lines.items():
            while line and self._may_take(other):
                turn = line.popleft()
                if not turn.done():  # cancelled
                    self._taken[other] += 1
                    self._lines.move_to_end(other)
                    turn.set_result(None)
                    return

    def _may_take(self, client: str) -> bool:
        return self.taken < self._slots + (client not in self._taken)


class Rates:
    """Requests per minute of each client: a bucket that fills evenly and holds a minute's worth.

    Parameters
    ----------
    per_minute : 0: no limit.
    clock : seconds.
    """

    _MAX_CLIENTS = 10_000

    def __init__(self, per_minute: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._most = per_minute / 60.0, max(per_minute, 1.0)
        self._clock = clock
        # client -> what was left in its bucket, and when; that of the longest silence first
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, client: str) -> float:
        """Count a request; how long the client has to wait before it may send one, 0 for now."""
        if not self._per_s:
            return 0.0
        now = self._clock()
        left, then = self._left.pop(client, (self._most, now))
        left = min(self._most, left + (now - then) * self._per_s)
        wait_s = 0.0 if left >= 1.0 else (1.0 - left) / self._per_s
        self._left[client] = left - (wait_s == 0.0), now
        while len(self._left) > self._MAX_CLIENTS:
            self._left.popitem(last=False)
        return wait_s


def client_of(address: str | None) -> str:
    """What clients are told apart by: their address, of IPv6 the network of 64 bits."""
    try:
        found = ipaddress.ip_address((address or "").partition("%")[0])
    except ValueError:
        return ""
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)


_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_JPEG = b"\xff\xd8\xff"
_MAX_SEGMENTS, _MAX_SCANS = 1000, 32
# start of frame, all codings: what DHT, JPG and DAC leave of C0 to CF
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SCAN, _END = 0xDA, 0xD9
# within a scan's data 0xFF is followed by 0, or is a restart
_MARKER = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])", re.DOTALL)


class UnknownFormat(MeglocError):
    """What was sent is of a format that is not read."""


class TooManyPixels(MeglocError):
    """Decoding the image would cost more than is allowed."""


@dataclass(frozen=True)
class Photograph:
    """The bytes of an image file, and what its header says.

    Attributes
    ----------
    suffix : ".jpg" or ".png".
    width, height : pixels, as they are stored: the orientation of EXIF turns nothing.
    """

    content: bytes
    suffix: Literal[".jpg", ".png"]
    width: int
    height: int

    @classmethod
    def of(cls, content: bytes, *, max_pixels: float) -> Photograph:
        """Measure an image file.

        Raises
        ------
        UnknownFormat : neither JPEG nor PNG.
        TooManyPixels : more of them than that, or more scans than any camera writes.
        DataError : broken.
        """
        suffix: Literal[".jpg", ".png"] = ".png" if content.startswith(_PNG) else ".jpg"
        if suffix == ".png":
            width, height = _png_size(content)
        elif content.startswith(_JPEG):
            width, height = _jpeg_size(content)
        else:
            raise UnknownFormat("the image is neither JPEG nor PNG")
        if width < 1 or height < 1:
            raise DataError(f"the image is broken: it says that it is {width}x{height}")
        if width * height > max_pixels:
            raise TooManyPixels(
                f"the image is {width}x{height}, which is more than {max_pixels / 1e6:g} megapixels"
            )
        return cls(content, suffix, width, height)

    def decode(self) -> NDArray[np.uint8]:
        """The pixels, uint8 (H, W, 3) RGB, as they are stored; raises DataError."""
        try:
            pixels = decode_image_rgb(self.content)
        except DataError as error:
            raise DataError(f"the image is broken: {error.message}") from error
        if pixels.shape[:2] != (self.height, self.width):
            raise DataError(
                f"the image is broken: {pixels.shape[1]}x{pixels.shape[0]} pixels, and its header "
                f"says {self.width}x{self.height}"
            )
        return pixels

    def header(self) -> Photo:
        """Camera and orientation by EXIF; a guessed focal length where EXIF has none."""
        from PIL import Image

        try:
            with Image.open(BytesIO(self.content), formats=["JPEG", "PNG"]) as image:
                return photo_of(image)
        except Exception as error:  # pillow raises many kinds on broken headers
            raise DataError("the image is broken: its header cannot be read") from error


def _png_size(content: bytes) -> tuple[int, int]:
    # W3C PNG 11.2.1: IHDR is the first chunk
    if content[12:16] != b"IHDR" or not content.endswith(_PNG_END):
        raise DataError("the image is broken: a PNG begins with IHDR and ends with IEND")
    width, height = struct.unpack(">II", content[16:24])
    return width, height


def _jpeg_size(content: bytes) -> tuple[int, int]:
    # ITU-T T.81 B.1.1.3: markers, and segments with their length
    at, size, scans = 2, None, 0
    for _ in range(_MAX_SEGMENTS):
        found = _MARKER.match(content, at) if scans == 0 else _MARKER.search(content, at)
        marker = _END if found is None else found[1][0]
        if found is None or marker == _END:
            break
        at = found.end()
        length = int.from_bytes(content[at : at + 2], "big")
        if length < 2 or at + length > len(content):
            break
        if marker in _FRAMES:
            if size is not None or length < 8:
                raise DataError("the image is broken: a JPEG has one frame")
            height, width = struct.unpack(">HH", content[at + 3 : at + 7])
            size = width, height
        scans += marker == _SCAN
        if scans > _MAX_SCANS:
            raise TooManyPixels(f"the image is a JPEG of more than {_MAX_SCANS} scans")
        at += length
    else:
        raise TooManyPixels(f"the image is a JPEG of more than {_MAX_SEGMENTS} segments")
    if size is None or not scans:
        raise DataError("the image is broken: a JPEG has a frame and a scan")
    return size


_MAX_SIDE_PX = 100_000
# beyond these no lens is, and the solvers' numbers overflow
_FOCAL_OF_SIDE, _CENTRE_OF_SIDE, _MAX_DISTORTION = (0.01, 1000.0), 10.0, 100.0

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class CameraModel(BaseModel):
    """A camera as COLMAP describes it; the centre of the first pixel is (0.5, 0.5)."""

    model_config = ConfigDict(extra="forbid", strict=True)

    model: str = Field(description=f"one of {', '.join(CAMERA_MODEL_NUM_PARAMS)}", max_length=40)
    width: int = Field(ge=1, le=_MAX_SIDE_PX, description="of the image as it is stored, pixels")
    height: int = Field(ge=1, le=_MAX_SIDE_PX)
    params: list[float] = Field(
        max_length=12, description="in COLMAP's order; focal lengths and principal point in pixels"
    )

    def camera(self) -> Camera:
        """The camera; raises DataError where there can be none of this kind."""
        camera = Camera(self.model, self.width, self.height, tuple(self.params))
        num_focals = 1 if self.model in ONE_FOCAL_MODELS else 2
        side = max(self.width, self.height)
        focals, centre = self.params[:num_focals], self.params[num_focals : num_focals + 2]
        least, most = (times * side for times in _FOCAL_OF_SIDE)
        if not least <= min(focals) <= max(focals) <= most:
            raise DataError(f"camera: no lens of this image has a focal length of {focals} px")
        if max(map(abs, centre)) > _CENTRE_OF_SIDE * side:
            raise DataError(f"camera: the principal point {centre} is far out of the image")
        if max(map(abs, self.params[num_focals + 2 :]), default=0.0) > _MAX_DISTORTION:
            raise DataError("camera: no lens distorts like this")
        return camera


class Transform(BaseModel):
    """A rigid transform: x_cam = R x_world + t; axes as in COLMAP: x right, y down, z forward."""

    quat_wxyz: Annotated[list[float], Field(min_length=4, max_length=4)]
    translation: Vector = Field(description="in the unit of the map")


class Answer(BaseModel):
    """What became of an image: a pose, or the reason why there is none."""

    localized: bool
    reason: str | None = Field(description="why there is no pose")
    cam_from_world: Transform | None
    camera_center: Vector | None = Field(description="in the map")
    covariance: list[list[float]] | None = Field(
        description="6 by 6: rotation in radians, then translation in the unit of the map, of a "
        "left perturbation of cam_from_world"
    )
    confidence: float | None = Field(description="the probability that the pose is right")
    num_matches: int
    num_inliers: int
    candidates: list[str] = Field(description="map images that took part, best first")
    remarks: list[str]
    frame: str | None = Field(
        description="the coordinate frame of the pose, where the map has some"
    )
    camera: CameraModel = Field(
        description="the camera of the pose: that of the request; without one by EXIF, its focal "
        "length estimated with the pose, of the image the right way up"
    )


class Refused(BaseModel):
    """Why a request has no answer."""

    error: str


def read_camera(text: str) -> Camera:
    """A camera from JSON; raises DataError, which says what is wrong."""
    try:
        return CameraModel.model_validate_json(text).camera()
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"][:2])
        raise DataError(f"camera{f'.{where[:40]}' if where else ''}: {first['msg']}") from error


def answer_of(found: Pose | Failure, camera: Camera, frame: str = "") -> dict[str, Any]:
    """What :class:`Answer` holds of a result; numbers as they are, none that JSON cannot say.

    Parameters
    ----------
    frame : of the pose; "" where the map has only one.
    """
    pose = found.cam_from_world if isinstance(found, Pose) else None
    if isinstance(found, Pose) and found.camera is not None:
        camera = found.camera
    covariance = found.covariance if isinstance(found, Pose) else None
    return {
        "localized": bool(found),
        "reason": found.reason if isinstance(found, Failure) else None,
        "cam_from_world": None
        if pose is None
        else {"quat_wxyz": list(pose.quat_wxyz), "translation": list(pose.translation)},
        "camera_center": None if pose is None else [float(x) for x in pose.center()],
        "covariance": None if covariance is None else _finite(covariance.tolist()),
        "confidence": _finite(found.confidence),
        "num_matches": int(found.num_matches),
        "num_inliers": int(found.num_inliers),
        "candidates": list(found.candidates),
        "remarks": list(found.remarks),
        "frame": frame or None,
        "camera": {
            "model": camera.model,
            "width": camera.width,
            "height": camera.height,
            "params": list(camera.params),
        },
    }


def _finite(value: Any) -> Any:
    """The value, or None where any number of it is infinite or NaN."""
    rows = value if isinstance(value, list) else [[value]]
    known = value is not None and all(math.isfinite(x) for row in rows for x in row)
    return value if known else None


def camera_of(photograph: Photograph, camera: str | None) -> tuple[Camera, int]:
    """The camera, and how the pixels are to be turned before (1: not); raises DataError."""
    if not camera:
        found = photograph.header()
        return found.upright_camera, found.orientation
    given = read_camera(camera)
    if (given.width, given.height) != (photograph.width, photograph.height):
        raise DataError(
            f"the image is {photograph.width}x{photograph.height} as it is stored, its camera says "
            f"{given.width}x{given.height}"
        )
    return given, 1
