"""Who is next, and who has asked too often."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.service.limits import Busy, Rates, Turns, client_of


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
