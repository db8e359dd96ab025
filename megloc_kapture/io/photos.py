"""Plain photographs: which way up they are, and the camera that their EXIF tells of.

kapture and COLMAP know pixels as they are stored, and so do the cameras here. Who wants a
photograph the right way up turns pixels and camera by its EXIF orientation:
:func:`turned_upright`.

The focal length is COLMAP's reading of the EXIF (35 mm equivalent, COLMAP's database of sensors,
resolution of the focal plane, in this order). It is rarely exact: digital zoom, stabilisation and
rounded millimetres are in it, so a camera that comes from here is not certain of it.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap_cameras import focal_from_exif
from megloc_kapture.io.images import WRITABLE_SUFFIXES, check_image_file
from megloc_kapture.values import Camera

if TYPE_CHECKING:
    from PIL import Image

# named when a folder has them: they are photographs, and nothing here reads them
UNREAD_SUFFIXES = frozenset({".heic", ".heif", ".avif", ".dng", ".nef", ".cr2", ".cr3", ".arw"})
# relative standard deviations of focal lengths: of one from EXIF, and of a guess
EXIF_DEVIATION, GUESS_DEVIATION = 0.1, 0.7
# COLMAP's guess, times the larger side
_GUESS = 1.2
_ORIENTATION, _MAKE, _MODEL, _EXIF, _GPS = 0x0112, 0x010F, 0x0110, 0x8769, 0x8825


@dataclass(frozen=True)
class Photo:
    """The header of a photograph.

    Attributes
    ----------
    camera : of the pixels as they are stored; its focal length is uncertain.
    orientation : EXIF's, 1 to 8: how the stored pixels are turned or mirrored; 1: not at all.
    make : of the camera, with its model; may be empty.
    gps : latitude and longitude in degrees, height in metres (0 where it is not said); None
        without.
    """

    camera: Camera
    orientation: int
    make: str
    gps: tuple[float, float, float] | None = None

    @property
    def upright_camera(self) -> Camera:
        """The camera of the pixels after :func:`turned_upright`."""
        width, height = self.camera.width, self.camera.height
        if self.orientation >= 5:
            width, height = height, width
        deviation = self.camera.focal_deviation
        return _centred(width, height, self.camera.params[0], deviation)


def guessed_camera(width: int, height: int) -> Camera:
    """A camera of which nothing but its image size is known: COLMAP's guess, very uncertain."""
    return _centred(width, height, _GUESS * max(width, height), GUESS_DEVIATION)


def read_photo(path: Path | str) -> Photo:
    """Read the header of a photograph.

    Raises DataError: missing, empty, or of a format that is not read.
    """
    from PIL import Image

    path = Path(path)
    check_image_file(path)
    if path.suffix.lower() not in WRITABLE_SUFFIXES:
        known = ", ".join(WRITABLE_SUFFIXES)
        raise DataError(f"{path.suffix or 'such a file'} cannot be read; {known} can", path=path)
    try:
        with Image.open(path) as image:
            return photo_of(image)
    except Exception as error:  # pillow raises many kinds on broken headers
        raise DataError("not an image, or broken", path=path) from error


def photo_of(image: Image.Image) -> Photo:
    """The header of an image that pillow has opened."""
    width, height = image.size
    try:
        with warnings.catch_warnings():  # pillow warns of what is broken in EXIF
            warnings.simplefilter("ignore")
            exif = image.getexif()
            orientation, make, model = (exif.get(tag) for tag in (_ORIENTATION, _MAKE, _MODEL))
            focal = focal_from_exif(_blank_with_exif(exif, width, height)) if exif else None
            gps = _position(exif.get_ifd(_GPS))
    except Exception:  # broken EXIF is as none: pillow raises many kinds on it
        orientation = make = model = focal = gps = None
    # pillow and OpenCV have turned TIFF files already
    turned = orientation in range(2, 9) and image.format != "TIFF"
    if focal is None:
        camera = guessed_camera(width, height)
    else:
        camera = _centred(width, height, focal, EXIF_DEVIATION)
    named = " ".join(str(text).strip("\0 ") for text in (make, model) if text)
    return Photo(camera, int(orientation or 1) if turned else 1, named, gps)


def turned_upright(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Stored pixels (H, W, ...) the right way up, by EXIF's orientation (EXIF 2.3, tag 0x0112)."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _centred(width: int, height: int, focal: float, deviation: float) -> Camera:
    params = (focal, width / 2, height / 2, 0.0)
    return Camera("SIMPLE_RADIAL", width, height, params, deviation)


def _position(gps: Mapping[int, Any]) -> tuple[float, float, float] | None:
    """Latitude, longitude and height of EXIF's GPS table (EXIF 2.3, table 15)."""
    if not {1, 2, 3, 4} <= gps.keys():
        return None
    found = []
    for reference, tag, negative in ((1, 2, "S"), (3, 4, "W")):
        degrees, minutes, seconds = map(float, gps[tag])
        value = degrees + minutes / 60 + seconds / 3600
        found.append(-value if gps[reference] == negative else value)
    below = gps.get(5) in (1, b"\x01")
    height = float(gps.get(6, 0.0)) * (-1 if below else 1)
    if not (abs(found[0]) <= 90 and abs(found[1]) <= 180 and math.isfinite(height)):
        return None
    return found[0], found[1], height


def _blank_with_exif(exif: Image.Exif, width: int, height: int) -> bytes:
    """A JPEG of that size that has nothing but what the EXIF says of the camera.

    COLMAP reads EXIF from files only, and decodes them; a blank one takes a tenth of the time, and
    may come from formats that COLMAP does not read.
    """
    from PIL import Image

    kept = Image.Exif()
    for tag in (_MAKE, _MODEL):
        if tag in exif:
            kept[tag] = exif[tag]
    kept.get_ifd(_EXIF).update(exif.get_ifd(_EXIF))
    content = io.BytesIO()
    Image.new("L", (width, height)).save(content, "JPEG", quality=1, exif=kept)
    return content.getvalue()
