"""Pairs by sequence against a walk through each camera's images."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.mapping.pairs_by_sequence import PairsBySequenceOptions, pairs_by_sequence


def by_loops(
    cameras: list[str], timestamps: list[int], options: PairsBySequenceOptions
) -> list[list[int]]:
    found = set()
    for camera in set(cameras):
        own = [image for image in range(len(cameras)) if cameras[image] == camera]
        own.sort(key=lambda image: timestamps[image])
        for place, image in enumerate(own):
            for step in range(1, options.window + 1):
                if options.loop or place + step < len(own):
                    other = own[(place + step) % len(own)]
                    found.add((min(image, other), max(image, other)))
    return [list(pair) for pair in sorted(found) if pair[0] != pair[1]]


@given(
    st.lists(
        st.tuples(st.sampled_from(["a", "b", "c"]), st.integers(-(2**62), 2**62)),
        max_size=30,
        unique=True,
    ),
    st.integers(1, 8),
    st.booleans(),
)
def test_equal_to_a_walk(records: list[tuple[str, int]], window: int, loop: bool) -> None:
    cameras, timestamps = [camera for camera, _ in records], [time for _, time in records]
    options = PairsBySequenceOptions(window=window, loop=loop)
    found = pairs_by_sequence(cameras, timestamps, options)
    assert found.shape[1] == 2
    assert found.tolist() == by_loops(cameras, timestamps, options)


def test_two_cameras_in_turn_and_the_loop() -> None:
    cameras, timestamps = ["left", "right"] * 4, [0, 0, 1, 1, 2, 2, 3, 3]
    found = pairs_by_sequence(cameras, timestamps, PairsBySequenceOptions(window=1))
    assert found.tolist() == [[0, 2], [1, 3], [2, 4], [3, 5], [4, 6], [5, 7]]
    closed = pairs_by_sequence(cameras, timestamps, PairsBySequenceOptions(window=1, loop=True))
    assert {tuple(p) for p in closed.tolist()} - {tuple(p) for p in found.tolist()} == {
        (0, 6),
        (1, 7),
    }
