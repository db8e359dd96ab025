"""Mirrored images: reflected descriptors against those of the mirrored image, and what is asked."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binomtest

from megloc_kapture.errors import DataError
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions
from megloc_kapture.localization.cluster_poses import localize_in_clusters
from megloc_kapture.localization.confidence import MIRROR_ASKED, MIRRORED
from megloc_kapture.localization.map_index import MapIndex, QueryView, TypedMatches
from megloc_kapture.localization.mirrored import (
    chance_of,
    is_mirrored,
    mirror_matches,
    reflected,
)
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

Image = NDArray[np.uint8]


def texture(seed: int, size: tuple[int, int] = (320, 480)) -> Image:
    """Blobs of all sizes, RGB uint8."""
    rng = np.random.default_rng(seed)
    total = np.zeros(size, np.float32)
    for deviation in (2.0, 4.0, 8.0, 16.0):
        smooth = cv2.GaussianBlur(rng.normal(size=size).astype(np.float32), (0, 0), deviation)
        total += smooth / smooth.std()
    grey = np.clip(128 + 30 * total, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def symmetric(seed: int, share: float) -> Image:
    """A facade: both halves the same in a mirror, but for so much of what is on them."""
    own = texture(seed).astype(np.float64)
    even = (own + own[:, ::-1]) / 2
    return np.clip(even + share * (own - even), 0, 255).astype(np.uint8)


def mirrored(image: Image) -> Image:
    return np.ascontiguousarray(image[:, ::-1])


class Scene:
    """A query and map images, as arrays; which of these were looked at."""

    def __init__(self, query: Image, images: dict[str, Image]) -> None:
        self.query, self.images = query, images
        self.seen: list[str] = []

    def query_image(self, name: str) -> Image:
        return self.query

    def map_image(self, name: str) -> Image:
        self.seen.append(name)
        if name not in self.images:
            raise DataError(f"no pixels of {name}")
        return self.images[name]


def asked(scene: Scene, images: Sequence[str] = ("a",)) -> tuple[int, int]:
    return mirror_matches([("q", images)], scene)  # type: ignore[arg-type]


def test_reflected_descriptors_are_those_of_the_mirrored_image() -> None:
    """OpenCV's of both images, at the same places."""
    image = texture(0)[..., 0]
    sift = cv2.SIFT.create(nfeatures=400, enable_precise_upscale=True)
    (here, ours), (there, theirs) = (
        sift.detectAndCompute(one, None) for one in (image, mirrored(image))
    )
    places = np.array([[319.0 + 160 - k.pt[0], k.pt[1], k.size] for k in there])
    turned = reflected(np.asarray(ours, np.float32))
    likeness = {"reflected": [], "as it is": []}  # type: dict[str, list[float]]
    for row, keypoint in enumerate(here):
        gap = np.abs(places - [*keypoint.pt, keypoint.size]).max(axis=1)
        # of several directions of a place the mirror has others
        wanted = (180 - keypoint.angle) % 360
        turn = np.array([abs((k.angle - wanted + 180) % 360 - 180) for k in there])
        at = int(np.argmin(gap + turn))
        if gap[at] < 0.5 and turn[at] < 5:
            for name, own in (("reflected", turned[row]), ("as it is", ours[row])):
                norm = np.linalg.norm(own) * np.linalg.norm(theirs[at])
                likeness[name].append(float(own @ theirs[at] / norm))
    assert len(likeness["reflected"]) > 200
    assert np.median(likeness["reflected"]) > 0.99
    assert np.median(likeness["as it is"]) < 0.8
    np.testing.assert_array_equal(reflected(turned), ours)


def test_an_image_and_its_mirror_image() -> None:
    image = symmetric(1, 0.7)
    as_it_is, other = asked(Scene(image, {"a": image}))
    assert as_it_is > 200 and not is_mirrored(as_it_is, other)
    # the same image of either hand: the same numbers, nearly, in the other order
    swapped = asked(Scene(mirrored(image), {"a": image}))
    assert is_mirrored(*swapped)
    assert swapped[1] == pytest.approx(as_it_is, rel=0.1)
    # in a facade that is quite symmetric nothing can be told, nor in another scene
    even = symmetric(1, 0.0)
    for query, shown in ((mirrored(even), even), (texture(5), image)):
        assert not is_mirrored(*asked(Scene(query, {"a": shown})))


def test_map_images_are_looked_at_until_it_is_clear() -> None:
    image = texture(2)
    others = {f"other{at}": texture(10 + at) for at in range(20)}
    scene = Scene(mirrored(image), {**others, "same": image})
    # what agrees most with a wrong pose need not show the place
    assert is_mirrored(*asked(scene, ["other0", "other1", "same", "other2"]))
    assert scene.seen == ["other0", "other1", "same"]
    scene.seen.clear()
    names = list(others)
    assert not is_mirrored(*asked(scene, [*names, "same"]))
    assert scene.seen == [*names[:4], names[4], names[9], names[14], names[19]]
    # nor the most of them: the others are asked too
    scene.seen.clear()
    assert is_mirrored(*asked(scene, [*names[:9], "same", *names[9:]]))
    assert scene.seen == [*names[:5], "same"]
    # what lacks pixels says nothing, and takes nothing back
    scene.seen.clear()
    assert asked(scene, ["lost", "same"]) == (0, 0)
    assert asked(scene, []) == (0, 0)
    assert asked(Scene(np.full_like(image, 90), {"a": image})) == (0, 0)
    assert asked(Scene(image, {"a": np.zeros((1, 2000, 3), np.uint8)})) == (0, 0)
    # the cameras of a rig are mirrored together
    one, both = (mirror_matches([("q", ["same"])] * n, scene) for n in (1, 2))  # type: ignore[arg-type]
    assert both == (2 * one[0], 2 * one[1])


def test_what_chance_does() -> None:
    assert [is_mirrored(0, 0), is_mirrored(0, 16), is_mirrored(0, 17)] == [False, False, True]
    assert not is_mirrored(30, 60) and is_mirrored(30, 72) and not is_mirrored(72, 30)
    for as_it_is, other in ((5, 40), (30, 72), (12, 12), (0, 1)):
        expected = binomtest(other, as_it_is + other, 0.5, "greater").pvalue
        assert chance_of(as_it_is, other) == pytest.approx(expected)
    assert chance_of(7, 0) == 1.0


# ------------------------------------------------------------------------------- of a pose

CAMERA = Camera.pinhole(480, 320, 400.0)
POSE = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.1, 0.0, 0.2))


def localize(
    scene: Scene | None, min_confidence: float, right: int = 34, wrong: int = 120
) -> Pose | Failure:
    """A pose that so many of the matches with one map image agree with."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (right + wrong, 3))
    ahead = POSE.apply(points)
    px = 400 * ahead[:, :2] / ahead[:, 2:] + [240, 160] + rng.normal(0, 0.5, (right + wrong, 2))
    px[right:] = rng.uniform((0, 0), (480, 320), (wrong, 2))
    rows = np.arange(right + wrong)
    index = MapIndex.build(points, ("a",), np.zeros(len(rows), np.int64), rows, rows)
    named = [("a", np.stack([rows, rows], axis=1), np.full(len(rows), 0.9))]
    view = QueryView("q", CAMERA, (TypedMatches(index, px.astype(np.float32), named),))
    return localize_in_clusters(
        [view],
        [("a",)],
        AbsolutePoseOptions(),
        rank=lambda hypotheses: np.zeros(len(hypotheses)),
        max_clusters=10,
        centers={"a": np.zeros(3)},
        min_confidence=min_confidence,
        scene=scene,  # type: ignore[arg-type]
    )[0]


def test_a_mirrored_image_gets_no_pose() -> None:
    image = symmetric(1, 0.7)
    alone = localize(None, 0.5)
    assert isinstance(alone, Pose) and alone.confidence is not None
    assert 0.5 < alone.confidence < MIRROR_ASKED[1]
    upright = localize(Scene(image, {"a": image}), 0.5)
    assert isinstance(upright, Pose) and upright.confidence == alone.confidence
    assert upright.remarks == alone.remarks
    refused = localize(Scene(mirrored(image), {"a": image}), 0.5)
    assert isinstance(refused, Failure)
    assert refused.confidence is not None and refused.confidence < 1e-6
    assert "the image seems to be mirrored: " in refused.reason
    assert refused.reason.endswith(" reflected")
    # who wants every pose is told that it is hardly right
    kept = localize(Scene(mirrored(image), {"a": image}), 0.0)
    assert isinstance(kept, Pose) and kept.confidence == refused.confidence
    assert any("seems to be mirrored" in remark for remark in kept.remarks)
    assert kept.evidence[MIRRORED] < 1e-6 and MIRRORED not in upright.evidence


@pytest.mark.parametrize(("right", "wrong"), [(6, 300), (160, 0)])
def test_nobody_looks_where_the_pose_is_refused_anyway_or_beyond_doubt(
    right: int, wrong: int
) -> None:
    image = texture(2)
    scene = Scene(mirrored(image), {"a": image})
    found = localize(scene, 0.5, right, wrong)
    assert scene.seen == []
    confidence = found.confidence
    assert confidence is None or confidence < 0.5 or confidence >= MIRROR_ASKED[1]
