"""Headers of images as pillow reads them, and what decoding may cost."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from megloc_kapture.errors import DataError, MeglocError
from megloc_kapture.service.photographs import Photograph, TooManyPixels, UnknownFormat

NOISE = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
KINDS = {
    "baseline": ("JPEG", {}),
    "progressive": ("JPEG", {"progressive": True}),
    "restarts": ("JPEG", {"restart_marker_blocks": 1}),
    "comment": ("JPEG", {"comment": b"\xff\xd9 \xff\xda \xff\xc0 \xff\xff\xc0"}),
    "png": ("PNG", {}),
}


def encoded(kind: str, mode: str = "RGB") -> bytes:
    content = io.BytesIO()
    form, options = KINDS[kind]
    Image.fromarray(NOISE).convert(mode).save(content, form, **options)
    return content.getvalue()


@pytest.mark.parametrize("mode", ["RGB", "L"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_header_says_what_pillow_reads(kind: str, mode: str) -> None:
    content = encoded(kind, mode)
    found = Photograph.of(content, max_pixels=2400)
    assert (found.width, found.height) == Image.open(io.BytesIO(content)).size == (60, 40)
    assert found.suffix == (".png" if kind == "png" else ".jpg")
    pixels = found.decode()
    assert pixels.shape == (40, 60, 3)
    if kind == "png" and mode == "RGB":
        np.testing.assert_array_equal(pixels, NOISE)
    with pytest.raises(TooManyPixels, match="60x40, which is more than 0.0023 mega"):
        Photograph.of(content, max_pixels=2300)


def test_a_photograph_with_a_film_behind_it_is_one() -> None:
    film = np.random.default_rng(1).integers(0, 255, 100_000, np.uint8).tobytes()
    content = encoded("progressive") + b"\0\0\0 ftypmp42" + film
    assert Photograph.of(content, max_pixels=2400).decode().shape == (40, 60, 3)


@pytest.mark.parametrize(
    "content", [b"", b"GIF89a" + bytes(100), b"BM" + bytes(100), b"%PDF-1.7", b"\xff\xd8", b"RIFF"]
)
def test_other_formats_are_refused(content: bytes) -> None:
    with pytest.raises(UnknownFormat):
        Photograph.of(content, max_pixels=1e6)


@pytest.mark.parametrize("kind", KINDS)
def test_no_truncated_file_is_decoded(kind: str) -> None:
    content = encoded(kind)
    for size in range(8, len(content) - 2, 97):
        with pytest.raises(MeglocError):
            Photograph.of(content[:size], max_pixels=1e6).decode()


@given(kind=st.sampled_from(sorted(KINDS)), data=st.data())
def test_a_changed_file_is_decoded_or_refused(kind: str, data: st.DataObject) -> None:
    content = bytearray(encoded(kind))
    places = st.tuples(st.integers(2, len(content) - 1), st.integers(0, 255))
    for at, byte in data.draw(st.lists(places, min_size=1, max_size=30)):
        content[at] = byte
    try:
        found = Photograph.of(bytes(content), max_pixels=1e6)
        assert found.decode().shape == (found.height, found.width, 3)
    except MeglocError as error:
        assert "/" not in str(error)


@given(st.binary(max_size=300))
def test_any_bytes_are_refused(content: bytes) -> None:
    for start in (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", b""):
        with pytest.raises(MeglocError):
            Photograph.of(start + content, max_pixels=1e6).decode()


def test_scans_and_segments_that_no_camera_writes_are_not_decoded() -> None:
    content = encoded("baseline")
    scan = content.index(b"\xff\xda")
    again = content[scan:-2]
    with pytest.raises(TooManyPixels, match="scans"):
        Photograph.of(content[:-2] + 40 * again + b"\xff\xd9", max_pixels=1e6)
    with pytest.raises(TooManyPixels, match="segments"):
        Photograph.of(b"\xff\xd8" + b"\xff\xfe\0\2" * 1_000_000, max_pixels=1e6)
    frame = content.index(b"\xff\xc0")
    two = content[:frame] + content[frame : frame + 19] + content[frame:]
    with pytest.raises(DataError, match="one frame"):
        Photograph.of(two, max_pixels=1e6)


def test_a_bomb_is_not_unpacked() -> None:
    def chunk(name: bytes, content: bytes) -> bytes:
        checked = name + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(10_000_000), 9)
    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels)
    with pytest.raises(TooManyPixels, match="100000x100000"):
        Photograph.of(bomb + chunk(b"IEND", b""), max_pixels=32e6)
    with pytest.raises(DataError, match="ends with IEND"):
        Photograph.of(bomb, max_pixels=32e6)
