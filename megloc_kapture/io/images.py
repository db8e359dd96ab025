"""Images, depth maps, frames of videos and headers of photographs, read the same way everywhere.

kapture and COLMAP know pixels as they are stored, and so do the cameras here;
:func:`turned_upright` rotates pixels by the EXIF orientation.

The focal length is COLMAP's reading of the EXIF (35 mm equivalent, COLMAP's database of sensors,
resolution of the focal plane, in this order). Digital zoom, stabilisation and rounding make it
uncertain.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import focal_from_exif
from megloc_kapture.io.files import read_content, write_bytes
from megloc_kapture.values import Camera

if TYPE_CHECKING:
    from PIL import Image

T = TypeVar("T")

WRITABLE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".tif", ".tiff", ".webp")
# pillow's names of the formats that photographs are read from
_FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "JPEG2000")
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
# what COLMAP reads of the focal length: its millimetres, those of 35 mm film, pixels per unit of
# the focal plane, the unit, and the size of the image
_FOCAL_TAGS = (0x920A, 0xA405, 0xA20E, 0xA20F, 0xA210, 0xA002, 0xA003)
_JPEG = (".jpg", ".jpeg")
# files of other suffixes are written in the nearest of these formats; readers look at the content
_LOSSLESS = (".pgm", ".pnm", ".gif", ".jp2")
# an image that uses more than this share of the range of its numbers is scaled, else stretched
_MIN_RANGE = 0.5
_STRETCHED_PERCENT = (0.1, 99.9)


def read_image_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Read an image as uint8 (H, W, 3), RGB.

    Grey images are repeated over three channels, transparency is dropped, and more than 8 bits
    become 8, see :func:`with_8_bits`.
    """
    check_image_file(Path(path))
    content = read_content(path)
    if not content:
        raise DataError("empty file, not an image", path=path)
    return decode_image_rgb(content, path)


def decode_image_rgb(content: bytes, path: Path | str | None = None) -> NDArray[np.uint8]:
    """Decode the bytes of an image file; errors name the ``path``."""
    image = _decoded_by_opencv(content)
    if image is None:
        try:
            image = _decoded_by_pillow(content)
        except Exception as error:  # pillow raises many kinds on broken data
            raise DataError("not an image, or broken", path=path) from error
    else:
        _check_complete(path, content)
    return with_8_bits(image)


def _decoded_by_opencv(content: bytes) -> NDArray[Any] | None:
    import cv2  # 0.1 s, and most commands that import io never read an image

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # errors are ours to say
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image)[:, :, ::-1]


def _decoded_by_pillow(content: bytes) -> NDArray[Any]:
    from PIL import Image

    with Image.open(BytesIO(content)) as image:
        return pillow_pixels(image)


def pillow_pixels(image: Image.Image) -> NDArray[np.uint8]:
    """The pixels of an image that pillow has opened, as :func:`read_image_rgb` gives them."""
    if image.mode[0] in "IF":  # more than 8 bits, which pillow would cut off
        return with_8_bits(np.repeat(np.asarray(image)[:, :, None], 3, axis=2))
    return np.ascontiguousarray(image.convert("RGB"))


def with_8_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """An image (H, W, 3) of any numbers as uint8.

    16 bits that use more than half of their range are scaled (``value / 257`` rounded), and so are
    fractions between 0 and 1. What uses less of it, as 12 bits in 16, counts of a thermal camera or
    other floats, is stretched: percentiles 0.1 and 99.9 of all channels become 0 and 255.
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
    """``(width, height)`` in pixels as stored, from the header only."""
    with _opened(Path(path)) as image:
        return int(image.width), int(image.height)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence pillow's warnings about broken EXIF."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The header of an image file, by pillow."""
    from PIL import Image

    check_image_file(path)
    try:
        with _quiet(), Image.open(path) as image:
            yield image
    except Exception as error:  # pillow raises many kinds on broken headers
        raise DataError("not an image, or broken", path=path) from error


def write_image(path: Path | str, image: NDArray[np.uint8], *, jpeg_quality: int = 95) -> None:
    """Write uint8 (H, W, 3) RGB or (H, W) grey as its suffix says, atomically.

    The same pixels give the same bytes: no dates, no metadata. Other suffixes than
    WRITABLE_SUFFIXES become JPEG, or PNG where their format is lossless.
    """
    path = Path(path)
    write_bytes(path, _encoded(path, image, jpeg_quality))


def image_as_read_back(
    image: NDArray[np.uint8], name: str, *, jpeg_quality: int = 95
) -> NDArray[np.uint8]:
    """The image that reading gives after :func:`write_image` to a file of this name."""
    if _format_suffix(name) not in _JPEG:
        return image
    import cv2

    content = np.frombuffer(_encoded(Path(name), image, jpeg_quality), np.uint8)
    decoded = cv2.imdecode(content, cv2.IMREAD_COLOR)
    if decoded is None:
        raise ValueError(f"{name}: cannot decode what was encoded")
    return np.ascontiguousarray(decoded[:, :, ::-1], np.uint8)


def _format_suffix(name: str) -> str:
    """The suffix of the format that an image of this name is written in."""
    suffix = Path(name).suffix.lower()
    if suffix in WRITABLE_SUFFIXES:
        return suffix
    return ".png" if suffix in _LOSSLESS else ".jpg"


def _encoded(path: Path, image: NDArray[np.uint8], jpeg_quality: int) -> bytes:
    import cv2

    suffix = _format_suffix(path.name)
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
    """Raise DataError unless this is a file; its content is not looked at."""
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
    """Read a depth map as float32 (H, W) in metres; the size is its depth sensor's."""
    path = Path(path)
    content = read_content(path)
    expected = 4 * width * height
    if len(content) != expected:
        raise DataError(
            f"{len(content)} bytes, but {width}x{height} float32 take {expected}", path=path
        )
    return np.frombuffer(content, dtype="<f4").astype(np.float32).reshape(height, width)


def write_depth_map(path: Path | str, depth_m: ArrayLike) -> None:
    """Write a depth map (H, W) in metres, atomically."""
    pixels = np.asarray(depth_m, dtype="<f4")
    if pixels.ndim != 2:
        raise ValueError(f"expected a depth map of shape (H, W), got {pixels.shape}")
    write_bytes(path, np.ascontiguousarray(pixels).tobytes())


def extract_frames(video: Path, folder: Path, every: int) -> Iterator[str]:
    """Write every n-th frame of a video, the first included, as a JPEG file; yield their names.

    The names are the frames' numbers from 0: ``000120.jpg``. OpenCV rotates frames as the file
    says.
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
    orientation : EXIF's, 1 to 8: how the stored pixels are rotated or mirrored; 1: not at all.
    make : make and model of the camera; may be empty.
    gps : latitude and longitude in degrees, height in metres (0 if unknown).
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
    """COLMAP's guess for a camera of which only the image size is known."""
    return _centred(width, height, _GUESS * max(width, height), GUESS_DEVIATION)


def is_image(path: Path) -> bool:
    """Whether a file is an image of a format that is read, by its content."""
    from PIL import Image

    try:
        if not path.is_file():  # reading a pipe might never end
            return False
        with _quiet(), Image.open(path) as image:
            return image.format in _FORMATS
    except Exception:  # pillow raises many kinds on broken headers
        return False


def read_photo(path: Path | str) -> Photo:
    """Read the header of a photograph; DataError for a format that is not read."""
    path = Path(path)
    check_image_file(path)
    known = f"cannot be read; {', '.join(WRITABLE_SUFFIXES)} can"
    if path.suffix.lower() in UNREAD_SUFFIXES:
        raise DataError(f"{path.suffix} {known}", path=path)
    with _opened(path) as image:
        photo = photo_of(image) if image.format in _FORMATS else None
    if photo is None:
        raise DataError(f"an image of this format {known}", path=path)
    return photo


def photo_of(image: Image.Image) -> Photo:
    """The header of an image that pillow has opened."""
    import PIL.Image

    width, height = image.size
    with _quiet():
        exif = _tried(image.getexif) or PIL.Image.Exif()
        orientation = _number(_tried(lambda: exif[_ORIENTATION]))
        make, model = _text(_tried(lambda: exif[_MAKE])), _text(_tried(lambda: exif[_MODEL]))
        gps = _tried(lambda: _position(exif.get_ifd(_GPS)))
        focal = _tried(lambda: focal_from_exif(_blank_with_exif(exif, make, model, image.size)))
    # pillow and OpenCV have turned TIFF files already
    turned = orientation in range(2, 9) and image.format != "TIFF"
    if focal is None:
        camera = guessed_camera(width, height)
    else:
        camera = _centred(width, height, focal, EXIF_DEVIATION)
    named = " ".join(text for text in (make, model) if text)
    return Photo(camera, int(orientation or 1) if turned else 1, named, gps)


def _tried(read: Callable[[], T]) -> T | None:
    try:
        return read()
    except Exception:  # pillow raises many kinds; a damaged part of EXIF counts as missing
        return None


def _numbers(value: Any) -> list[float]:
    """The numbers in an EXIF tag of any type, up to the first that is not finite."""
    if isinstance(value, bytes):
        text = value.decode("latin-1")
        value = text if re.search(r"\d", text) else list(value)
    if isinstance(value, str):
        value = re.findall(r"[-+]?\d+(?:\.\d+)?", value)
    elif not isinstance(value, tuple | list):
        value = () if value is None else (value,)
    found = []
    for number in map(float, value):
        if not math.isfinite(number):
            break
        found.append(number)
    return found


def _number(value: Any) -> float | None:
    return next(iter(_tried(lambda: _numbers(value)) or ()), None)


def _text(value: Any) -> str:
    """The printable text of an EXIF tag, up to its first NUL; empty where it is none."""
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    if not isinstance(value, str):
        return ""
    printable = "".join(c if c.isprintable() else " " for c in value.strip("\0").partition("\0")[0])
    return " ".join(printable.split())


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
    """Latitude, longitude and height of EXIF's GPS table (EXIF 2.3, table 15).

    Also of angles that are not degrees, minutes and seconds but fewer numbers, or text.
    """
    found = []
    for reference, tag, sides, limit in ((1, 2, "NS", 90), (3, 4, "EW", 180)):
        side, parts = _text(gps.get(reference))[:1].upper(), _numbers(gps.get(tag))
        if side not in sides or not side or not parts:
            return None
        value = sum(part / 60**at for at, part in enumerate(parts[:3]))
        if abs(value) > limit:
            return None
        found.append(-value if side == sides[1] else value)
    below = gps.get(5) in (1, b"\x01")
    height = (_number(gps.get(6)) or 0.0) * (-1 if below else 1)
    return found[0], found[1], height


def _blank_with_exif(exif: Image.Exif, make: str, model: str, size: tuple[int, int]) -> bytes:
    """A JPEG of that size that has nothing but what the EXIF says of the camera.

    COLMAP reads EXIF from files only, and decodes them; a blank file takes a tenth of the time and
    serves formats that COLMAP does not read.
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
