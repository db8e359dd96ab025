"""Ordered and bounded work on executors."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from megloc_kapture.stages.work import FolderSpec, ordered_map


def test_results_are_in_order() -> None:
    first_may_end = threading.Event()

    def work(value: int) -> int:
        if value == 0:
            assert first_may_end.wait(timeout=30)
        if value == 5:
            first_may_end.set()
        return value

    with ThreadPoolExecutor(3) as executor:
        assert list(ordered_map(work, range(20), executor, window=8)) == list(range(20))
        assert list(ordered_map(work, [], executor)) == []
    # without an executor results are computed lazily
    done: list[int] = []
    results = ordered_map(lambda value: done.append(value) or value, [3, 1, 2])
    assert done == []
    assert next(iter(results)) == 3
    assert done == [3]
    assert list(results) == [1, 2]


def test_at_most_a_window_of_items_is_submitted() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for value in range(100):
            taken += 1
            yield value

    with ThreadPoolExecutor(2) as executor:
        results = ordered_map(int, items(), executor, window=5)
        for count, _ in enumerate(results, start=1):
            assert taken <= count + 5


def test_a_folder_is_opened_once_in_a_run(world: Any) -> None:
    spec = FolderSpec(world.mapping())
    assert spec.open() is spec.open()
    # another run opens it again and reads new features
    other = FolderSpec(world.mapping())
    assert other.open() is not spec.open()
