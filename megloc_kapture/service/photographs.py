"""Photographs that strangers send: measured before anything of them is decoded.

What a decoder would do is bounded by the header: pixels, and the scans of a progressive JPEG, each
of which goes over all of them. pillow reads headers too, at a microsecond a segment in Python, of
which 20 MB can have millions; so this module walks the segments, and not far.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from io import BytesIO
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, MeglocError
from megloc_kapture.io.images import GUESS_DEVIATION, Photo, decode_image_rgb, photo_of

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

    def exif(self) -> Photo | None:
        """Camera and orientation by EXIF; None where it says no focal length, as a PNG's."""
        if self.suffix != ".jpg":
            return None
        from PIL import Image

        try:
            with Image.open(BytesIO(self.content), formats=["JPEG"]) as image:
                found = photo_of(image)
        except Exception as error:  # pillow raises many kinds on broken headers
            raise DataError("the image is broken: its header cannot be read") from error
        return found if found.camera.focal_deviation < GUESS_DEVIATION else None


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
