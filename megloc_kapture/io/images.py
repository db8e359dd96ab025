"""Images, depth maps, frames of videos and headers of photographs, read the same way everywhere.

kapture and COLMAP know pixels as they are stored, and so do the cameras here. Who wants a
photograph the right way up turns pixels and camera by its EXIF orientation:
:func:`turned_upright`.

The focal length is COLMAP's reading of the EXIF (35 mm equivalent, COLMAP's database of sensors,
resolution of the focal plane, in this order). It is rarely exact: digital zoom, stabilisation and
rounded millimetres are in it, so a camera that comes from here is not certain of it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import focal_from_exif
from megloc_kapture.io.files import read_content, write_bytes
from megloc_kapture.values import Camera

if TYPE_CHECKING:
    from PIL import Image

WRITABLE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp"}
)
# named when a folder has them: they are photographs, and nothing here reads them
UNREAD_SUFFIXES = frozenset({".heic", ".heif", ".avif", ".dng", ".nef", ".cr2", ".cr3", ".arw"})
# relative standard deviations of focal lengths: of one from EXIF, and of a guess
EXIF_DEVIATION, GUESS_DEVIATION = 0.1, 0.7
# COLMAP's guess, times the larger side
_GUESS = 1.2
_ORIENTATION, _MAKE, _MODEL, _EXIF, _GPS = 0x0112, 0x010F, 0x0110, 0x8769, 0x8825
_JPEG = (".jpg", ".jpeg")


def read_image_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Read an image as uint8 (H, W, 3), RGB.

    Grey images are repeated over three channels, transparency is dropped, 16-bit images are
    scaled to 8 bit (``value / 257`` rounded).

    Raises DataError: missing, not an image, or truncated.
    """
    check_image_file(Path(path))
    content = read_content(path)
    if not content:
        raise DataError("empty file, not an image", path=path)
    return decode_image_rgb(content, path)


def decode_image_rgb(content: bytes, path: Path | str | None = None) -> NDArray[np.uint8]:
    """Decode the bytes of an image file; see :func:`read_image_rgb`.

    Parameters
    ----------
    path : what an error names; nothing is read there.

    Raises
    ------
    DataError : not an image, or truncated.
    """
    import cv2  # 0.1 s, and most commands that import io never read an image

    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise DataError("not an image, or broken", path=path)
    _check_complete(path, content)
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif image.dtype != np.uint8:
        raise DataError(f"pixels are {image.dtype}; 8 or 16 bit expected", path=path)
    return np.ascontiguousarray(image[:, :, ::-1])


def image_size(path: Path | str) -> tuple[int, int]:
    """``(width, height)`` in pixels as stored, from the header only.

    Raises DataError: missing, or not an image.
    """
    with _opened(Path(path)) as image:
        return int(image.width), int(image.height)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The header of an image file, by pillow."""
    from PIL import Image

    check_image_file(path)
    try:
        with Image.open(path) as image:
            yield image
    except Exception as error:  # pillow raises many kinds on broken headers
        raise DataError("not an image, or broken", path=path) from error


def write_image(path: Path | str, image: NDArray[np.uint8], *, jpeg_quality: int = 95) -> None:
    """Write uint8 (H, W, 3) RGB or (H, W) grey as its suffix says, atomically.

    The same pixels give the same bytes: no dates, no metadata.

    Raises
    ------
    ValueError : the array is not such an image or the suffix is none of WRITABLE_SUFFIXES.
    OutputError : the file cannot be written.
    """
    path = Path(path)
    write_bytes(path, _encoded(path, image, jpeg_quality))


def image_as_read_back(
    image: NDArray[np.uint8], name: str, *, jpeg_quality: int = 95
) -> NDArray[np.uint8]:
    """The image that reading gives after :func:`write_image`: uint8 (H, W, 3) RGB.

    Parameters
    ----------
    name : of the file that it would be; only its suffix counts.
    """
    if not name.lower().endswith(_JPEG):
        return image
    import cv2

    content = np.frombuffer(_encoded(Path(name), image, jpeg_quality), np.uint8)
    decoded = cv2.imdecode(content, cv2.IMREAD_COLOR)
    if decoded is None:
        raise ValueError(f"{name}: cannot decode what was encoded")
    return np.ascontiguousarray(decoded[:, :, ::-1], np.uint8)


def _encoded(path: Path, image: NDArray[np.uint8], jpeg_quality: int) -> bytes:
    import cv2

    suffix = path.suffix.lower()
    if suffix not in WRITABLE_SUFFIXES:
        raise ValueError(f"{path}: suffix must be one of {', '.join(WRITABLE_SUFFIXES)}")
    pixels = np.asarray(image)
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or 0 in pixels.shape:
        raise ValueError(f"expected uint8 (H, W, 3) or (H, W), got {pixels.dtype} {pixels.shape}")
    if pixels.ndim == 3:
        if pixels.shape[2] != 3:
            raise ValueError(f"expected 3 channels, got {pixels.shape[2]}")
        pixels = pixels[:, :, ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if suffix in _JPEG else []
    done, encoded = cv2.imencode(suffix, np.ascontiguousarray(pixels), options)
    if not done:
        raise ValueError(f"{path}: cannot encode an image of shape {image.shape}")
    return bytes(encoded.tobytes())


def check_image_file(path: Path) -> None:
    """Raise DataError where there is no plain file; its content is not looked at."""
    try:
        if path.is_file():
            return
        present = path.exists()
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror}", path=path) from error
    # reading a pipe or a device might never end
    problem = "not an image but a folder, pipe or device" if present else "no such image"
    raise DataError(problem, path=path)


def _check_complete(path: Path | str | None, content: bytes) -> None:
    """Refuse a truncated file; OpenCV fills what is missing with grey and says nothing.

    The end mark shows completeness without decoding twice; only where it is not found (other
    formats, data after the end) Pillow, which is strict, decodes once more.
    """
    if content.startswith(b"\xff\xd8"):
        # entropy-coded data cannot hold these pairs, and a thumbnail's pair precedes both
        complete = content.rfind(b"\xff\xd9") > content.rfind(b"\xff\xda")
    else:
        complete = content.startswith(b"\x89PNG") and content.endswith(b"IEND\xaeB`\x82")
    if complete:
        return
    from PIL import Image

    try:
        with Image.open(BytesIO(content)) as image:
            image.load()
    except Exception as error:  # pillow raises many kinds on broken data
        raise DataError(f"not an image, or truncated ({error})", path=path) from error


def read_depth_map(path: Path | str, *, width: int, height: int) -> NDArray[np.float32]:
    """Read a depth map as float32 (H, W) in metres; the size is its depth sensor's.

    Raises DataError: missing, or of another size (truncated).
    """
    path = Path(path)
    content = read_content(path)
    expected = 4 * width * height
    if len(content) != expected:
        raise DataError(
            f"{len(content)} bytes, but {width}x{height} float32 take {expected}", path=path
        )
    return np.frombuffer(content, dtype="<f4").astype(np.float32).reshape(height, width)


def write_depth_map(path: Path | str, depth_m: ArrayLike) -> None:
    """Write a depth map (H, W) in metres, atomically.

    Raises ValueError: not a two-dimensional array; OutputError: cannot be written.
    """
    pixels = np.asarray(depth_m, dtype="<f4")
    if pixels.ndim != 2:
        raise ValueError(f"expected a depth map of shape (H, W), got {pixels.shape}")
    write_bytes(path, np.ascontiguousarray(pixels).tobytes())


def extract_frames(video: Path, folder: Path, every: int) -> Iterator[str]:
    """Write every n-th frame of a video, the first included, as a JPEG file; yields their names.

    The names are the frames' numbers from 0: ``000120.jpg``. OpenCV turns frames as the file says.

    Raises
    ------
    DataError : missing, or OpenCV finds no frame in it.
    OutputError : a frame cannot be written.
    """
    import cv2

    check_image_file(video)
    capture = cv2.VideoCapture(str(video))
    try:
        number = 0
        while capture.grab():
            if number % every == 0:
                read, frame = capture.retrieve()
                if not read:
                    break
                name = f"{number:06}.jpg"
                write_image(folder / name, np.asarray(frame[:, :, ::-1], np.uint8))
                yield name
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise DataError("no video, or without a frame that OpenCV can read", path=video)


# ------------------------------------------------------------------------------ photographs


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
    path = Path(path)
    check_image_file(path)
    if path.suffix.lower() not in WRITABLE_SUFFIXES:
        known = ", ".join(WRITABLE_SUFFIXES)
        raise DataError(f"{path.suffix or 'such a file'} cannot be read; {known} can", path=path)
    with _opened(path) as image:
        return photo_of(image)


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
    content = BytesIO()
    Image.new("L", (width, height)).save(content, "JPEG", quality=1, exif=kept)
    return content.getvalue()
