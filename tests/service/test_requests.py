"""The limits of a service, and what it says of photographs and cameras that strangers send."""

from __future__ import annotations

import asyncio
import io
import struct
import zlib
from collections.abc import Coroutine
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from megloc_kapture.errors import DataError, MeglocError
from megloc_kapture.service.requests import (
    Busy,
    Photograph,
    Rates,
    TooManyPixels,
    Turns,
    UnknownFormat,
    client_of,
)


def run(work: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(work, 10))


def test_clients_take_turns() -> None:
    async def work() -> None:
        turns, order = Turns(1, 20), []
        await turns.take("z")
        await turns.take("y")  # the slot that is kept for those who have none

        async def one(client: str) -> None:
            await turns.take(client)
            order.append(client)

        waiting = [asyncio.ensure_future(one(client)) for client in "aaaabbc"]
        await asyncio.sleep(0)
        assert (turns.taken, turns.waiting) == (2, 7)
        for client in ("z", "y", *"abcabaa"):
            turns.give_back(client)
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        assert "".join(order) == "abcabaa" and (turns.taken, turns.waiting) == (0, 0)
        await asyncio.gather(*waiting)

    run(work())


def test_one_client_fills_neither_the_slots_nor_the_lines() -> None:
    async def work() -> None:
        turns = Turns(2, 6)
        await turns.take("a")
        await turns.take("a")
        waiting = [asyncio.ensure_future(turns.take("a")) for _ in range(3)]
        await asyncio.sleep(0)
        with pytest.raises(Busy):
            await turns.take("a")
        await turns.take("b")  # at once
        waiting += [asyncio.ensure_future(turns.take(client)) for client in "bcd"]
        await asyncio.sleep(0)
        with pytest.raises(Busy):
            await turns.take("e")
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)
        assert (turns.taken, turns.waiting) == (3, 0)

    run(work())


@given(st.lists(st.tuples(st.sampled_from(["take", "give", "cancel"]), st.sampled_from("abc"))))
def test_no_slot_is_lost(steps: list[tuple[str, str]]) -> None:
    async def work() -> None:
        turns, waiting, held = Turns(2, 8), [], []

        async def one(client: str) -> None:
            await turns.take(client)
            held.append(client)

        for step, client in steps:
            if step == "take":
                waiting.append(asyncio.ensure_future(one(client)))
            elif step == "give" and held:
                turns.give_back(held.pop())
            elif waiting:
                waiting.pop().cancel()
            if len(steps) % 2:  # or all at once
                await asyncio.sleep(0)
                assert turns.taken <= 3
        for _ in range(200):
            await asyncio.sleep(0)
            if held:
                turns.give_back(held.pop())
        await asyncio.gather(*waiting, return_exceptions=True)
        assert (turns.taken, turns.waiting, turns._lines) == (0, 0, {})

    run(work())


def test_a_bucket_fills_evenly() -> None:
    now = 0.0
    rates = Rates(60.0, clock=lambda: now)
    assert [rates.wait_s("a") for _ in range(60)] == [0.0] * 60
    assert rates.wait_s("a") == 1.0 and rates.wait_s("b") == 0.0
    now = 0.5
    assert rates.wait_s("a") == pytest.approx(0.5)
    now = 2.5
    assert [rates.wait_s("a") for _ in range(3)] == [0.0, 0.0, pytest.approx(0.5)]
    assert Rates(0.0).wait_s("a") == 0.0


def test_buckets_of_many_clients_take_no_more_memory() -> None:
    rates = Rates(60.0)
    for number in range(20_000):
        rates.wait_s(str(number))
    assert len(rates._left) == 10_000


@pytest.mark.parametrize(
    "address, client",
    [
        ("10.0.0.7", "10.0.0.7"),
        ("::ffff:10.0.0.7", "10.0.0.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("testclient", ""),
        (None, ""),
    ],
)
def test_clients_are_told_apart_by_address(address: str | None, client: str) -> None:
    assert client_of(address) == client


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
