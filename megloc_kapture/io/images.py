"""Images and depth maps as arrays: read, measured and written the same way everywhere."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import read_content, write_bytes

if TYPE_CHECKING:
    from numpy.typing import NDArray

WRITABLE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".tif", ".tiff", ".webp")
_JPEG = (".jpg", ".jpeg")


def read_image_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Read an image as uint8 (H, W, 3), RGB.

    Grey images are repeated over three channels, transparency is dropped, 16-bit images are
    scaled to 8 bit (``value / 257`` rounded).

    Raises DataError: missing, not an image, or truncated.
    """
    return decode_image_rgb(_content(Path(path)), path)


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
    from PIL import Image

    path = Path(path)
    check_image_file(path)
    try:
        with Image.open(path) as image:
            return int(image.width), int(image.height)
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


def _content(path: Path) -> bytes:
    check_image_file(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror}", path=path) from error
    if not content:
        raise DataError("empty file, not an image", path=path)
    return content


def check_image_file(path: Path) -> None:
    """Raise DataError where there is no plain file; its content is not looked at."""
    try:
        present, plain = path.exists(), path.is_file()
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror}", path=path) from error
    if not present:
        raise DataError("no such image", path=path)
    if not plain:  # reading a pipe or a device might never end
        raise DataError("not an image but a folder, pipe or device", path=path)


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

    Raises
    ------
    ValueError : not a two-dimensional array.
    OutputError : cannot be written.
    """
    pixels = np.asarray(depth_m, dtype="<f4")
    if pixels.ndim != 2:
        raise ValueError(f"expected a depth map of shape (H, W), got {pixels.shape}")
    write_bytes(path, np.ascontiguousarray(pixels).tobytes())
