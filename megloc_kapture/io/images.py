"""Images, depth maps, video frames and headers of photographs.

Cameras describe pixels as stored, as in kapture and COLMAP; :func:`turned_upright` applies the EXIF
orientation. Focal lengths from EXIF are uncertain because of zoom, stabilisation and rounding.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap import focal_from_exif
from megloc_kapture.io.files import link_as_text, read_content, reading, similar_name, write_bytes
from megloc_kapture.values import Camera

if TYPE_CHECKING:
    from PIL import Image

T = TypeVar("T")

WRITABLE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".tif", ".tiff", ".webp")
# supported formats of photographs, by pillow's names
_FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "JPEG2000")
VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp"}
)
UNREAD_SUFFIXES = frozenset({".heic", ".heif", ".avif", ".dng", ".nef", ".cr2", ".cr3", ".arw"})
# relative standard deviations of a focal length from EXIF and of a guessed focal length
EXIF_DEVIATION, GUESS_DEVIATION = 0.1, 0.7
# COLMAP's guess of the focal length, as a multiple of the larger side of the image
_GUESS = 1.2
# a focal length above this multiple of the larger side is not a measurement (EXIF: 65535 mm)
_LONGEST = 100
_ORIENTATION, _MAKE, _MODEL, _EXIF, _GPS = 0x0112, 0x010F, 0x0110, 0x8769, 0x8825
# focal length in mm and 35 mm equivalent, focal plane resolution (x, y) and unit, image size
_FOCAL_TAGS = (0x920A, 0xA405, 0xA20E, 0xA20F, 0xA210, 0xA002, 0xA003)
_JPEG = (".jpg", ".jpeg")
# images with these suffixes are written as PNG, those with other unknown suffixes as JPEG; their
# names do not change, because readers detect the format from the content
_LOSSLESS = (".pgm", ".pnm", ".gif", ".jp2")
# images that use more than this fraction of their range are scaled, others are stretched
_MIN_RANGE = 0.5
_STRETCHED_PERCENT = (0.1, 99.9)
# a depth map of whole numbers, some larger than this, is not in metres
_MOST_WHOLE_M = 100


def read_image_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Read an image as uint8 (H, W, 3), RGB, without transparency; see :func:`with_8_bits`."""
    check_image_file(Path(path))
    return decode_image_rgb(read_content(path), path)


def decode_image_rgb(content: bytes, path: Path | str | None = None) -> NDArray[np.uint8]:
    """Decode the bytes of an image file; errors name the ``path``."""
    _check_complete(path, content)
    image = _decoded_by_opencv(content)
    if image is None:
        with reading(path, "an image"):
            from PIL import Image

            with Image.open(BytesIO(content)) as opened:
                image = pillow_pixels(opened)
    return with_8_bits(image)


def _decoded_by_opencv(content: bytes) -> NDArray[Any] | None:
    import cv2  # takes 0.1 s, and most commands that import io never read an image

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # callers report errors
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image)[:, :, ::-1]


def pillow_pixels(image: Image.Image) -> NDArray[np.uint8]:
    """Convert an image opened by pillow, as :func:`read_image_rgb` does."""
    if image.mode[0] in "IF":  # more than 8 bits, which pillow would clip
        return with_8_bits(np.repeat(np.asarray(image)[:, :, None], 3, axis=2))
    return np.ascontiguousarray(image.convert("RGB"))


def with_8_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert an image (H, W, 3) of any number type to uint8.

    uint16 values, and numbers from 0 to 1, are scaled if they span more than half of their range.
    Other values, such as 12 bits in uint16 or thermal counts, are stretched so that their
    percentiles 0.1 and 99.9 become 0 and 255.
    """
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    values = pixels.astype(np.float32)
    known = values[np.isfinite(values)]
    whole = 65535.0 if pixels.dtype == np.uint16 else 1.0
    low, high = np.percentile(known, _STRETCHED_PERCENT) if len(known) else (0.0, 0.0)
    is_fraction = 0 <= low <= high <= whole
    if high == low or (is_fraction and high - low > _MIN_RANGE * whole):
        low, high = 0.0, whole
    stretched = np.clip((np.nan_to_num(values, nan=low) - low) * (255.0 / (high - low)), 0, 255)
    return np.ascontiguousarray(np.rint(stretched), np.uint8)


def image_size(path: Path | str) -> tuple[int, int]:
    """Return ``(width, height)`` in pixels as stored, from the header only."""
    with _opened(Path(path)) as image:
        return int(image.width), int(image.height)


@contextmanager
def _quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    from PIL import Image

    check_image_file(path)
    with reading(path, "an image"), _quiet(), Image.open(path) as image:
        yield image


def write_image(path: Path | str, image: NDArray[Any], *, jpeg_quality: int = 95) -> None:
    """Write uint8 (H, W, 3) RGB or (H, W) grey in the format of the suffix, atomically.

    PNG also takes uint16. The bytes are deterministic. A suffix that is not in WRITABLE_SUFFIXES
    gives PNG if it denotes a lossless format, else JPEG.
    """
    path = Path(path)
    write_bytes(path, _encoded(path, image, jpeg_quality))


def image_as_read_back(
    image: NDArray[np.uint8], name: str, *, jpeg_quality: int = 95
) -> NDArray[np.uint8]:
    """Return the image as it reads back after :func:`write_image` to a file of this name."""
    if _format_suffix(name) not in _JPEG:
        return image
    import cv2

    content = np.frombuffer(_encoded(Path(name), image, jpeg_quality), np.uint8)
    decoded = np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR))
    return np.ascontiguousarray(decoded[:, :, ::-1], np.uint8)


def _format_suffix(name: str) -> str:
    suffix = Path(name).suffix.lower()
    if suffix in WRITABLE_SUFFIXES:
        return suffix
    return ".png" if suffix in _LOSSLESS else ".jpg"


def _encoded(path: Path, image: NDArray[Any], jpeg_quality: int) -> bytes:
    import cv2

    suffix = _format_suffix(path.name)
    pixels = image if image.ndim == 2 else image[:, :, ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if suffix in _JPEG else []
    done, encoded = cv2.imencode(suffix, np.ascontiguousarray(pixels), options)
    if not done:
        raise ValueError(f"{path}: cannot encode an image of shape {image.shape}")
    return bytes(encoded.tobytes())


def check_image_file(path: Path) -> None:
    """Raise DataError unless the path is a file; its content is not checked."""
    with reading(path):
        if not path.is_file():
            remark = link_as_text(path.parent) or similar_name(path)
            raise DataError(f"no such image{remark}", path=path)


def _check_complete(path: Path | str | None, content: bytes) -> None:
    """Raise DataError if truncated: OpenCV fills such files with grey, and libpng prints errors."""
    if content.startswith(b"\xff\xd8"):
        # end-of-image marker after the last start-of-scan: entropy-coded data contains neither, and
        # the markers of a thumbnail come first
        complete = content.rfind(b"\xff\xd9") > content.rfind(b"\xff\xda")
    else:
        complete = content.startswith(b"\x89PNG") and content.endswith(b"IEND\xaeB`\x82")
    if complete:
        return
    from PIL import Image

    # pillow rejects truncated files
    with reading(path, "an image"), Image.open(BytesIO(content)) as image:
        image.load()


def read_depth_map(path: Path | str, *, width: int, height: int) -> NDArray[np.float32]:
    """Read a depth map, float32 (H, W) in metres, of the depth sensor's size."""
    path = Path(path)
    content = read_content(path)
    expected = 4 * width * height
    require(
        len(content) == expected,
        f"{len(content)} bytes, but {width}x{height} float32 need {expected}; a depth map is raw "
        "float32 in metres, of the size of its sensor",
        path=path,
    )
    depth_m = np.frombuffer(content, dtype="<f4").astype(np.float32).reshape(height, width)
    known = depth_m[(depth_m > 0) & np.isfinite(depth_m)]
    require(
        not (known > _MOST_WHOLE_M).any() or (np.abs(known - np.rint(known)) > 1e-3).any(),
        "all values are whole numbers, as in a 16-bit image in millimetres; give metres",
        path=path,
    )
    return depth_m


def write_depth_map(path: Path | str, depth_m: ArrayLike) -> None:
    write_bytes(path, np.ascontiguousarray(depth_m, dtype="<f4").tobytes())


def extract_frames(video: Path, folder: Path, every: int) -> Iterator[str]:
    """Write each ``every``-th frame of a video, upright, as ``000120.jpg``; yield the names."""
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
    require(number != 0, "not a video, or OpenCV cannot read its frames", path=video)


# ------------------------------------------------------------------------------ photographs


@dataclass(frozen=True)
class Photo:
    """The header of a photograph; ``camera`` describes the stored pixels.

    ``orientation`` is EXIF's, 1 (upright) to 8; ``make`` includes the model and may be empty;
    ``gps`` is latitude and longitude in degrees and height in metres (0 if unknown).
    """

    camera: Camera
    orientation: int = 1
    make: str = ""
    gps: tuple[float, float, float] | None = None

    @property
    def upright_camera(self) -> Camera:
        """Return the camera of the pixels after :func:`turned_upright`."""
        camera = self.camera
        if self.orientation < 5:
            return camera
        return _centred(camera.height, camera.width, camera.params[0], camera.focal_deviation)


def guessed_camera(width: int, height: int) -> Camera:
    """Guess a camera from its image size, as COLMAP does."""
    return _centred(width, height, _GUESS * max(width, height), GUESS_DEVIATION)


def is_image(path: Path) -> bool:
    """Return whether a file is an image of a supported format, by its content."""
    try:
        with _opened(path) as image:
            return image.format in _FORMATS
    except DataError:
        return False


def read_photo(path: Path | str) -> Photo:
    path = Path(path)
    known = f"cannot be read; {', '.join(WRITABLE_SUFFIXES)} can"
    require(path.suffix.lower() not in UNREAD_SUFFIXES, f"{path.suffix} {known}", path=path)
    with _opened(path) as image:
        require(image.format in _FORMATS, f"an image of this format {known}", path=path)
        return photo_of(image)


def photo_of(image: Image.Image) -> Photo:
    import PIL.Image

    width, height = image.size
    with _quiet():
        exif = _tried(image.getexif) or PIL.Image.Exif()
        orientation = _number(_tried(lambda: exif[_ORIENTATION]))
        make, model = _text(_tried(lambda: exif[_MAKE])), _text(_tried(lambda: exif[_MODEL]))
        gps = _tried(lambda: _position(exif.get_ifd(_GPS)))
        focal = _tried(lambda: focal_from_exif(_blank_with_exif(exif, make, model, image.size)))
    # pillow and OpenCV apply the orientation of TIFF files themselves
    turned = orientation in range(2, 9) and image.format != "TIFF"
    if focal is None or focal > _LONGEST * max(image.size):
        camera = guessed_camera(width, height)
    else:
        camera = _centred(width, height, focal, EXIF_DEVIATION)
    named = " ".join(text for text in (make, model) if text)
    return Photo(camera, int(orientation or 1) if turned else 1, named, gps)


def _tried(read: Callable[[], T]) -> T | None:
    try:
        return read()
    except Exception:  # pillow raises many kinds; damaged EXIF fields are treated as missing
        return None


def _numbers(value: Any) -> list[float]:
    """Return the numbers of an EXIF tag, up to the first unknown one, such as seconds of 0/0."""
    values = value if isinstance(value, tuple) else (value,)
    return list(takewhile(math.isfinite, map(float, values)))


def _number(value: Any) -> float | None:
    return next(iter(_tried(lambda: _numbers(value)) or ()), None)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        return ""
    return " ".join("".join(c if c.isprintable() else " " for c in value).split())


def turned_upright(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Rotate stored pixels (H, W, ...) upright by the EXIF orientation (EXIF 2.3, tag 0x0112)."""
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
    """Return latitude, longitude and height from EXIF's GPS table (EXIF 2.3, table 15)."""
    degrees = []
    for reference, tag, sides in ((1, 2, "NS"), (3, 4, "EW")):
        side, parts = _text(gps.get(reference))[:1].upper(), _numbers(gps.get(tag))
        if side not in sides or not side or not parts:
            return None
        value = sum(part / 60**at for at, part in enumerate(parts[:3]))
        degrees.append(-value if side == sides[1] else value)
    below = gps.get(5) in (1, b"\x01")
    height = (_number(gps.get(6)) or 0.0) * (-1 if below else 1)
    return degrees[0], degrees[1], height


def _blank_with_exif(exif: Image.Exif, make: str, model: str, size: tuple[int, int]) -> bytes:
    """Return a blank JPEG with make, model and focal tags, for COLMAP to infer the focal length.

    COLMAP reads only a few image formats, and it would decode all pixels of the photograph.
    """
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    kept = Image.Exif()
    kept[_MAKE], kept[_MODEL] = make, model
    stored = exif.get_ifd(_EXIF)
    for tag in _FOCAL_TAGS:
        value = _number(stored.get(tag))
        if value is not None and 0 < value < 2**31:
            whole = value.is_integer()  # pillow takes the type of a tag from its value
            kept.get_ifd(_EXIF)[tag] = int(value) if whole else IFDRational(value)
    content = BytesIO()
    Image.new("L", size).save(content, "JPEG", quality=1, exif=kept)
    return content.getvalue()
