"""Which cameras a pose is compared with."""

from __future__ import annotations

import numpy as np
import pytest

from megloc_kapture.evaluation.check.pools import pools_of
from megloc_kapture.evaluation.check.reference import MapCameras, Reference
from megloc_kapture.io.side_tables import ImageGroup

IMAGES = ("m1", "m2", "m3", "m4")
CAMERAS = MapCameras(IMAGES, np.tile([1.0, 0, 0, 0], (4, 1)), np.zeros((4, 3)))
FLOORS = {
    "m1": ImageGroup(frame="DUC1", location="a"),
    "m2": ImageGroup(frame="DUC1", location="b"),
    "m3": ImageGroup(frame="DUC2"),
    "m4": ImageGroup(frame="DUC2"),
}


def test_without_tables_everything_is_compared_with_everything() -> None:
    pools = pools_of(Reference(place="", cameras=CAMERAS), ["q1", None])
    assert pools.own.tolist() == [0, 0] and not pools.has_other.any()
    assert pools.members[0].tolist() == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="without a map"):
        pools_of(Reference(place=""), ["q1"])


def test_priors_frames_and_conditions() -> None:
    groups = FLOORS | {
        "by condition": ImageGroup(condition="DUC2"),
        "day": ImageGroup(condition="day"),
    }
    priors = {
        "by location": ("b",),
        "by two": ("a", "DUC2"),
        "by frame": ("DUC1",),
        "by image": ("m4",),
        "by nothing there": ("c",),
    }
    reference = Reference(place="", cameras=CAMERAS, groups=groups, priors=priors)
    expected: dict[str | None, tuple[list[int], list[int]]] = {
        "by location": ([1], [2, 3]),
        "by two": ([0, 2, 3], [0, 2, 3]),
        "by frame": ([0, 1], [2, 3]),
        "by image": ([2, 3], [0, 1]),
        "by condition": ([2, 3], [0, 1]),
        "by nothing there": ([0, 1, 2, 3], [0, 1, 2, 3]),
        "day": ([0, 1, 2, 3], [0, 1, 2, 3]),
        None: ([0, 1, 2, 3], [0, 1, 2, 3]),
    }
    pools = pools_of(reference, list(expected))
    for number, (query, (own, other)) in enumerate(expected.items()):
        assert pools.members[pools.own[number]].tolist() == own, query
        assert pools.members[pools.other[number]].tolist() == other, query
    assert pools.has_other.tolist() == [own != other for own, other in expected.values()]
    assert pools.labels[pools.own[2]] == "DUC1" and pools.labels[pools.other[2]] == "DUC2"
