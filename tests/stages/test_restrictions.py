"""Priors and frames: who may be matched with whom."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.io.dataset_tables import ImageGroup, write_groups, write_priors
from megloc_kapture.stages.candidates import UNRESTRICTED, Restrictions

IMAGES = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
GROUPS = {
    "a.jpg": ImageGroup(location="001/rear", frame="DUC1"),
    "b.jpg": ImageGroup(location="001/left", frame="DUC1"),
    "c.jpg": ImageGroup(location="001/rear", frame="DUC2"),
}


def pools(restrictions: Restrictions, queries: list[str]) -> dict[str, list[int]]:
    return {
        queries[at]: images.tolist()
        for positions, images in restrictions.pools(queries, IMAGES)
        for at in positions
    }


def test_without_tables_everything_is_permitted(tmp_path: Path) -> None:
    assert pools(UNRESTRICTED, ["q", "r"]) == {"q": [0, 1, 2, 3], "r": [0, 1, 2, 3]}
    assert pools(Restrictions.read(tmp_path), ["q"]) == {"q": [0, 1, 2, 3]}
    assert [members.tolist() for members in UNRESTRICTED.frames(IMAGES)] == [[0, 1, 2, 3]]


def test_a_prior_names_images_locations_and_frames(tmp_path: Path) -> None:
    write_groups(tmp_path, GROUPS)
    priors = {
        "by location": ["001/rear"],
        "by frame": ["DUC1"],
        "by image": ["d.jpg"],
        "by several": ["d.jpg", "001/rear", "a.jpg"],
        "by nothing": ["099/rear"],
    }
    write_priors(tmp_path, priors)
    assert pools(Restrictions.read(tmp_path), [*priors, "free"]) == {
        "by location": [0, 2],
        "by frame": [0, 1],
        "by image": [3],
        "by several": [0, 2, 3],
        "by nothing": [],
        "free": [0, 1, 2, 3],
    }


def test_frames_part_the_images() -> None:
    frames = [members.tolist() for members in Restrictions(GROUPS).frames(IMAGES)]
    assert frames == [[3], [0, 1], [2]]


@given(st.lists(st.sampled_from(["", "x", "y"]), max_size=12), st.data())
def test_every_query_has_one_pool_and_every_image_one_frame(
    prior_of: list[str], data: st.DataObject
) -> None:
    names = [f"q{number}" for number in range(len(prior_of))]
    restrictions = Restrictions(
        {"a.jpg": ImageGroup(location="x"), "c.jpg": ImageGroup(location="y", frame="f")},
        {name: (prior,) for name, prior in zip(names, prior_of, strict=True) if prior},
    )
    order = data.draw(st.permutations(names))
    found = list(restrictions.pools(order, IMAGES))
    assert sorted(at for positions, _ in found for at in positions) == list(range(len(names)))
    for positions, images in found:
        for at in positions:
            prior = prior_of[names.index(order[at])]
            assert images.tolist() == {"": [0, 1, 2, 3], "x": [0], "y": [2]}[prior]
    assert sorted(np.concatenate(restrictions.frames(IMAGES)).tolist()) == [0, 1, 2, 3]
