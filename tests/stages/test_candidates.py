"""Candidates by several global features, against rankings made by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.io.dataset_tables import ImageGroup, write_groups, write_priors
from megloc_kapture.io.kapture import (
    KaptureFolder,
)
from megloc_kapture.retrieval.search import FusionOptions, fuse
from megloc_kapture.stages.image_pairs import (
    UNRESTRICTED,
    QueryPairsOptions,
    Restrictions,
    Retrieval,
    pair_queries,
)

Folders = tuple[KaptureFolder, KaptureFolder]
SIZES = {"short": 3, "long": 8}


@pytest.fixture
def folders(world: Any, write_features: Any, tmp_path: Path) -> Folders:
    rng = np.random.default_rng(4)
    images = [*sorted(world.map_poses), *sorted(world.query_poses)]
    for name, size in SIZES.items():
        vectors = {image: rng.normal(size=size).astype(np.float32) for image in images}
        write_features(tmp_path, "global_features", name, vectors)
    return world.mapping().with_features([tmp_path]), world.query().with_features([tmp_path])


def cosines(folders: Folders, name: str) -> np.ndarray:
    def rows(folder: KaptureFolder) -> np.ndarray:
        reader = folder.global_features(name)
        found = np.stack([reader.read(i).reshape(-1) for i in folder.read().image_names()])
        found = found.astype(np.float64)
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))

    return np.asarray(rows(folders[1]) @ rows(folders[0]).T)


@pytest.mark.parametrize("method", ["ghm", "mean", "early"])
@pytest.mark.parametrize("weights", [(), (1.0, 3.0)])
def test_fused_pairs_are_those_of_the_fused_similarities(
    folders: Folders, method: Any, weights: tuple[float, ...]
) -> None:
    fusion = FusionOptions(method=method)
    retrieval = Retrieval(("short", "long"), weights, fusion)
    found = pair_queries(*folders, QueryPairsOptions(top_k=2), retrieval=retrieval)
    images, queries = (folder.read().image_names() for folder in folders)
    fused = fuse([cosines(folders, name) for name in SIZES], fusion, weights or None)
    expected = [
        (query, images[at], row[at])
        for query, row in zip(queries, fused, strict=True)
        for at in np.argsort(-row, kind="stable")[:2]
    ]
    assert [(p.query, p.map) for p in found] == [(q, m) for q, m, _ in expected]
    np.testing.assert_allclose([p.score for p in found], [s for _, _, s in expected], atol=1e-6)


# ----------------------------------------------------------------------------------- restrictions


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


def test_a_prior_names_images_locations_and_frames(tmp_path: Path) -> None:
    everything = {"free": [0, 1, 2, 3]}
    assert (
        pools(UNRESTRICTED, ["free"]) == pools(Restrictions.read(tmp_path), ["free"]) == everything
    )
    write_groups(tmp_path, GROUPS)
    priors = {
        "by location": ["001/rear"],
        "by frame": ["DUC1"],
        "by image": ["d.jpg"],
        "by several": ["d.jpg", "001/rear", "a.jpg"],
        "by nothing": ["099/rear"],
    }
    write_priors(tmp_path, priors)
    frames = [members.tolist() for members in Restrictions(GROUPS).frames(IMAGES)]
    assert frames == [[3], [0, 1], [2]]
    assert [members.tolist() for members in UNRESTRICTED.frames(IMAGES)] == [[0, 1, 2, 3]]
    assert pools(Restrictions.read(tmp_path), [*priors, "free"]) == {
        "by location": [0, 2],
        "by frame": [0, 1],
        "by image": [3],
        "by several": [0, 2, 3],
        "by nothing": [],
        "free": [0, 1, 2, 3],
    }


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
