"""Prepared references are kept by their content, up to a number of bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.references import (
    PyramidKind,
    ReferenceCache,
    RenderingReference,
    prepare,
)
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 80, 60, (70.0, 70.0, 40.0, 30.0))
HERE = RigidTransform.identity()
KIND = PyramidKind(levels=2, max_side_px=640, appearance="intensity")


def reference(seed: int) -> RenderingReference:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (60, 80, 3), np.uint8)
    depth_m = rng.uniform(2.0, 2.001, (60, 80)).astype(np.float32)
    return RenderingReference(image, CAMERA, HERE, DepthView(CAMERA, depth_m, HERE))


def test_the_same_content_is_prepared_once() -> None:
    cache = ReferenceCache(2**24)
    first = cache.prepared(reference(0), KIND)
    assert cache.prepared(reference(0), KIND) is first
    expected = prepare(reference(0), KIND)
    np.testing.assert_array_equal(first.points.points, expected.points.points)
    np.testing.assert_array_equal(first.pyramid[1].values, expected.pyramid[1].values)
    cache.clear()
    assert cache.prepared(reference(0), KIND) is not first


def test_any_other_content_is_prepared_anew() -> None:
    cache = ReferenceCache(2**24)
    one = reference(0)
    first = cache.prepared(one, KIND)
    pixel = one.image.copy()
    pixel[30, 40, 1] ^= 1
    further = replace(one.depth, depth_m=one.depth.depth_m + np.float32(1e-3))
    there = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1e-9))
    wider = replace(CAMERA, params=(69.0, 70.0, 40.0, 30.0))
    others = [
        replace(one, image=pixel),
        replace(one, mask=np.ones((60, 80), bool)),
        replace(one, depth=further),
        replace(one, depth=replace(one.depth, image_from_depth=there)),
        replace(one, depth=replace(one.depth, camera=wider)),
        replace(one, camera=wider),
        replace(one, cam_from_world=there),
    ]
    found = [cache.prepared(each, KIND) for each in others]
    found += [cache.prepared(one, replace(KIND, levels=1))]
    assert len({id(each) for each in (first, *found)}) == 9
    assert cache.prepared(one, KIND) is first


def test_those_used_longest_ago_go_first() -> None:
    size = prepare(reference(0), KIND).nbytes
    cache = ReferenceCache(int(2.5 * size))
    first, second = (cache.prepared(reference(seed), KIND) for seed in (0, 1))
    assert cache.prepared(reference(0), KIND) is first
    cache.prepared(reference(2), KIND)
    assert cache.prepared(reference(0), KIND) is first
    assert cache.prepared(reference(1), KIND) is not second


def test_feature_maps_are_not_kept() -> None:
    calls = []

    def maps(image: NDArray[np.uint8]) -> NDArray[np.float32]:
        calls.append(image)
        return np.ones((2, 30, 40), np.float32)

    cache = ReferenceCache(2**24)
    for _ in range(2):
        cache.prepared(reference(0), replace(KIND, features=maps))
    assert len(calls) == 2


def test_images_of_another_size_are_refused() -> None:
    one = reference(0)
    with pytest.raises(DataError, match="does not fit a camera"):
        ReferenceCache(2**24).prepared(replace(one, image=one.image[:50]), KIND)
