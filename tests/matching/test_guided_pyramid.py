"""Guided pyramid: keypoints of variants, their verification, and matches combined with theirs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from images import blobs
from pydantic import ValidationError

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.matching.guided_pyramid import (
    GuidedPyramidOptions,
    ImageVariant,
    PairVerifier,
    VariantFeatures,
    VariantMatches,
    base_type,
    extract_variants,
    match_variants,
    pyramid_type,
)
from megloc_kapture.matching.nearest_neighbours import match_nearest
from megloc_kapture.matching.pyramid_combination import SAME_KEYPOINT_PX, KeypointUnion, combine
from megloc_kapture.matching.verification import (
    KnownPoseOptions,
    TwoViewOptions,
    known_pose_of_variants,
    ray_slopes,
    two_view_of_variants,
    verify_two_view,
)
from megloc_kapture.values import Camera, ImageFeatures, LocalFeatures, RigidTransform

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
ALL_VARIANTS = GuidedPyramidOptions().variants(320, 240)


def test_variants_are_all_scales_and_rotations() -> None:
    options = GuidedPyramidOptions(scales=(2.0, 0.5, 1.0), rotations_deg=(-90, 360, 630))
    half, same, twice = (ImageVariant(scale, 270) for scale in (0.5, 1.0, 2.0))
    expected = [ImageVariant(0.5), half, same, ImageVariant(2.0), twice]
    assert options.variants(640, 480) == expected
    assert pyramid_type("rootsift") == "rootsift-pyramid"
    assert base_type("rootsift-pyramid") == base_type("rootsift") == "rootsift"


@pytest.mark.parametrize(
    ("side", "expected"),
    [
        (400, [0.5, 1.0, 2.0, 3.0]),
        (640, [0.5, 1.0, 2.0, 2.5]),  # 3 is reduced
        (1000, [0.5, 1.0, 1.6]),  # 2 and 3 are reduced to the same
        (1500, [0.5, 1.0]),  # hardly larger: left out
        (4000, [0.5, 1.0]),  # a larger image is still rotated
    ],
)
def test_no_variant_is_larger_than_the_bound(side: int, expected: list[float]) -> None:
    options = GuidedPyramidOptions(scales=(0.5, 1.0, 2.0, 3.0), rotations_deg=(0, 90))
    for width, height in ((side, side // 2), (side // 2, side)):
        variants = options.variants(width, height)
        assert sorted({variant.scale for variant in variants} | {1.0}) == expected
        assert all(max(v.size(width, height)) <= max(1600, side) for v in variants)


@pytest.mark.parametrize(
    ("name", "values"),
    [("scales", [(), (0.0,), (-1.0,), (float("nan"),), (100.0,)]), ("rotations_deg", [(45,), ()])],
)
def test_wrong_options_are_refused(name: str, values: list[Any]) -> None:
    for value in values:
        with pytest.raises(ValidationError):
            GuidedPyramidOptions(**{name: value})


GRID = np.stack(np.meshgrid(np.arange(40, 300, 54), np.arange(40, 220, 54)), axis=-1).reshape(-1, 2)
CENTRES = GRID + np.random.default_rng(0).uniform(-5, 5, GRID.shape)
IMAGE = blobs(CENTRES, 6.0, amplitude=160.0, size=(240, 320))


# rounding causes weak keypoints on smooth spots
SIFT = RootSift(RootSiftOptions(contrast_threshold=0.05))
ITSELF = SIFT.extract(IMAGE)
LIKE = ImageFeatures(ITSELF.keypoints_px, ITSELF.descriptors, 320, 240)


def extract(image: np.ndarray, mask: np.ndarray | None) -> LocalFeatures:
    return SIFT.extract(image, mask)


def test_masked_pixels_have_no_keypoints_in_any_variant() -> None:
    mask = np.ones((240, 320), bool)
    mask[50:150, 100:250] = False
    actual, _ = extract_variants(IMAGE, mask, ALL_VARIANTS[1::3], extract, like=LIKE)
    assert len(actual) == len(ALL_VARIANTS[1::3])
    for each in actual:
        x, y = np.floor(each.keypoints_px[:, :2]).astype(int).T
        assert len(x) > 5
        # a keypoint on the variant's edge is on the image's edge
        assert mask[np.clip(y, 0, 239), np.clip(x, 0, 319)].all()


def test_variants_without_keypoints_are_skipped_with_a_reason() -> None:
    def picky(image: np.ndarray, mask: np.ndarray | None) -> LocalFeatures:
        if min(image.shape[:2]) < 100:
            raise DataError("too small for me")
        if image.shape[0] > image.shape[1]:
            empty = np.zeros((0, 2), np.float32)
            return LocalFeatures(empty, empty[:, 0], np.zeros((0, 128), np.float32))
        return extract(image, mask)

    variants = [ImageVariant(0.5), ImageVariant(1 / 3), ImageVariant(0.5, 90)]
    actual, skipped = extract_variants(IMAGE, None, variants, picky, like=LIKE)
    assert [each.variant for each in actual] == variants[:1]
    assert list(skipped.items()) == [
        (variants[1], "too small for me"),
        (variants[2], "no keypoints"),
    ]


@pytest.mark.parametrize("error", [DataError("damaged", path="net.pth"), PluginError("no")])
def test_errors_that_do_not_concern_the_image_are_raised(error: Exception) -> None:
    def broken(image: np.ndarray, mask: np.ndarray | None) -> LocalFeatures:
        raise error

    with pytest.raises(type(error), match=str(error)):
        extract_variants(IMAGE, None, ALL_VARIANTS[:1], broken, like=LIKE)


def test_pairs_with_few_matches_are_hard() -> None:
    by_count = {"matches": [(99, 0), (99, 99)], "verified": [(99, 99), (500, 99), (99, 0)]}
    for count, hard in by_count.items():
        options = GuidedPyramidOptions(mode="all", count=count)
        assert all(options.is_hard(*pair) for pair in hard)
        assert not options.is_hard(100, 100)
        assert not GuidedPyramidOptions(count=count).is_hard(0, 0)  # the mode is off
    assert not GuidedPyramidOptions(mode="all", count="matches").is_hard(100, 0)


def test_further_keypoint_columns_are_kept_and_must_fit() -> None:
    def scored(image: np.ndarray, mask: np.ndarray | None) -> LocalFeatures:
        actual = extract(image, mask)
        wide = np.column_stack([actual.keypoints_px, actual.scores, actual.scores])
        return LocalFeatures(wide, actual.scores, actual.descriptors)

    like = ImageFeatures(np.zeros((1, 3), np.float32), LIKE.descriptors, 320, 240)
    (actual,), _ = extract_variants(IMAGE, None, [ImageVariant(0.5, 90)], scored, like=like)
    assert actual.keypoints_px.shape[1] == actual.features.keypoints_px.shape[1] == 3
    np.testing.assert_array_equal(actual.keypoints_px[:, 2], actual.features.keypoints_px[:, 2])
    other = ImageFeatures(LIKE.keypoints_px, np.zeros((1, 64), np.float32), 320, 240)
    messages = {"3 numbers per keypoint and 128 .* 2 and 128": like, "64 per descriptor": other}
    for match, wrong in messages.items():
        with pytest.raises(DataError, match=match):
            extract_variants(IMAGE, None, ALL_VARIANTS[:1], extract, like=wrong)


def test_only_verified_rows_are_kept() -> None:
    (actual,), _ = extract_variants(IMAGE, None, [ImageVariant(0.5, 90)], extract, like=LIKE)

    def match(a: ImageFeatures, others: Any) -> Any:
        assert (a.width, a.height) == (120, 160)
        return [match_nearest(a.descriptors, other.descriptors) for other in others]

    even = PairVerifier(lambda _, matches: matches[:, 0] % 2 == 0)
    none = PairVerifier(lambda _, matches: np.zeros(len(matches), bool))
    nothing = ImageFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), 9, 9)
    others = [LIKE, LIKE, nothing]
    (result,), *rest = match_variants([actual], others, match, [even, none, none])
    assert rest == [[], []]
    matches, scores = match_nearest(actual.features.descriptors, LIKE.descriptors)
    assert result.variant == ImageVariant(0.5, 90)
    rows, other_rows = matches[kept_rows := matches[:, 0] % 2 == 0].T
    np.testing.assert_array_equal(result.other_rows, other_rows)
    np.testing.assert_array_equal(result.keypoints_px, actual.keypoints_px[rows])
    np.testing.assert_array_equal(result.descriptors, actual.features.descriptors[rows])
    np.testing.assert_array_equal(result.scores, scores[kept_rows])


def two_views(error_px: float) -> tuple[np.ndarray, np.ndarray, RigidTransform]:
    """Return pixels of 60 points in two views; the first's are off their epipolar lines."""
    rng = np.random.default_rng(1)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (60, 3))
    other_from_image = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    px = [500 * p[:, :2] / p[:, 2:] + (320, 240) for p in (points, other_from_image.apply(points))]
    # the camera moves sideways: the epipolar lines are horizontal
    px[0][:, 1] += np.where(np.arange(60) % 2, error_px, -error_px)
    return px[0].astype(np.float32), px[1].astype(np.float32), other_from_image


def variant_at(scale: float, px: np.ndarray) -> VariantFeatures:
    nothing = ImageFeatures(px, np.zeros((len(px), 1), np.float32), 1, 1)
    return VariantFeatures(ImageVariant(scale), nothing, px)


ROWS = np.stack([np.arange(60)] * 2, axis=1)


@pytest.mark.parametrize("scale", [1 / 3, 3.0])
# both measurements share the error: it counts e / sqrt(2)
@pytest.mark.parametrize(("error_px", "good"), [(5.5, True), (5.8, False)])
def test_known_poses_count_in_original_pixels(scale: float, error_px: float, good: bool) -> None:
    px, other_px, other_from_image = two_views(error_px)
    rays = bearing_rays(CAMERA, other_px)
    slopes = ray_slopes(CAMERA, other_px, rays)
    judgement = known_pose_of_variants(
        CAMERA, rays, slopes, other_from_image, KnownPoseOptions(max_error_px=4.0)
    )
    assert (judgement.verify(variant_at(scale, px), ROWS) == good).all()


def test_two_views_count_in_pixels_of_the_variant() -> None:
    px, other_px, _ = two_views(0.0)
    px[:, 1] += np.random.default_rng(2).normal(0, 3.0, 60).astype(np.float32)
    options = TwoViewOptions(max_error_px=1.5)
    judgement = two_view_of_variants(CAMERA, px, CAMERA, other_px, ROWS[:0], options)

    def kept(max_error_px: float) -> np.ndarray:
        asked = TwoViewOptions(max_error_px=max_error_px)
        return verify_two_view(px, CAMERA, other_px, CAMERA, asked)

    # the mean focal length of the variant's camera and the other one is 0.6 times what it was
    np.testing.assert_array_equal(judgement.verify(variant_at(0.2, px), ROWS), kept(1.5 / 0.6))
    for scale in (1.0, 4.0):
        np.testing.assert_array_equal(judgement.verify(variant_at(scale, px), ROWS), kept(1.5))
    assert kept(1.5 / 0.6).sum() > kept(1.5).sum() > 15


@pytest.mark.parametrize("rich", ["variant", "base"])
def test_variants_that_agree_with_the_richest_remain(rich: str) -> None:
    px, other_px, _ = two_views(0.0)
    rng = np.random.default_rng(3)
    by_chance = two_views(0.0)[0][:, ::-1].copy()  # another model: everything mirrored

    def matches(places: np.ndarray, rows: np.ndarray) -> VariantMatches:
        scores = np.ones(len(rows), np.float32)
        return VariantMatches(ImageVariant(0.5), places[rows], scores[:, None], rows, scores)

    some = rng.permutation(60)
    right, wrong = matches(px, some[:20]), matches(by_chance, some[20:40])
    partly = matches(np.concatenate([px[:40], by_chance[40:]]), np.arange(25, 55))
    base = ROWS[:50] if rich == "base" else ROWS[:0]
    most = [] if rich == "base" else [matches(px, np.arange(50))]
    judgement = two_view_of_variants(CAMERA, px, CAMERA, other_px, base, TwoViewOptions())
    kept = judgement.agree([wrong, *most, right, partly])
    # half of it agrees, and a few others by chance
    sizes = [len(each) for each in kept]
    assert sizes[:-1] == [*map(len, most), 20] and 15 <= sizes[-1] <= 18
    assert set(range(25, 40)) <= set(kept[-1].other_rows.tolist())
    assert judgement.agree([]) == []


@pytest.mark.parametrize("rotation", (0, 90, 180, 270))
@pytest.mark.parametrize("scale", (1 / 3, 3.0))
def test_pixels_are_mapped_to_their_positions_in_the_original(scale: float, rotation: int) -> None:
    # a pixel's value is its position in the original, which interpolation preserves
    width, height = 241, 161
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.arange(width)[None]
    image[..., 1] = np.arange(height)[:, None]
    variant = ImageVariant(scale, rotation)
    changed = variant.of_image(image).astype(np.float64)
    rows, columns = np.mgrid[: changed.shape[0], : changed.shape[1]]
    assert (changed.shape[1], changed.shape[0]) == variant.size(width, height)
    px = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
    original = variant.px_in_original(px, width, height)
    shown = changed[..., :2].reshape(-1, 2) + 0.5
    # nothing can be interpolated beyond the outermost pixels' centres
    inside = ((original > 1) & (original < [width - 1, height - 1])).all(axis=1)
    error = (shown - original)[inside]
    assert np.abs(error).max() <= 0.51  # values are whole numbers
    assert np.abs(error.mean(axis=0)).max() < 0.05  # half a pixel too much would be 0.17 or more


@given(
    size=st.tuples(st.integers(1, 16), st.integers(1, 16)),
    variant=st.builds(ImageVariant, st.floats(0.1, 3.0), st.sampled_from((0, 90, 180, 270))),
    seed=st.integers(0, 100),
)
def test_a_masks_pixel_needs_all_it_covers(size: Any, variant: ImageVariant, seed: int) -> None:
    width, height = size
    mask = np.random.default_rng(seed).random((height, width)) > 0.1
    changed = variant.of_mask(mask)
    w, h = variant.size(width, height)
    assert changed.shape == (h, w) and changed.dtype == np.bool_
    for y in range(h):
        for x in range(w):
            corners = variant.px_in_original(np.array([(x, y), (x + 1, y + 1)]), width, height)
            (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
            columns = slice(int(left + 1e-9), int(np.ceil(right - 1e-9)))
            rows = slice(int(top + 1e-9), int(np.ceil(bottom - 1e-9)))
            assert changed[y, x] == mask[rows, columns].all()


def test_the_identity_changes_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3), np.uint8)
    assert ImageVariant().is_identity
    np.testing.assert_array_equal(ImageVariant().of_image(image), image)
    assert not ImageVariant(1.0, 90).is_identity and not ImageVariant(0.5).is_identity
    # a small image keeps a pixel
    assert ImageVariant(0.1).of_image(np.zeros((2, 30, 3), np.uint8)).shape == (1, 3, 3)


Positions = list[tuple[float, float]]
# a grid of quarter pixels: distances of exactly one pixel, and equal ones, are common
POSITIONS = st.lists(
    st.tuples(st.integers(-20, 20), st.integers(-20, 20)).map(lambda xy: (xy[0] / 4, xy[1] / 4)),
    max_size=25,
)


def array(positions: Positions) -> np.ndarray:
    xy = np.array(positions, np.float32).reshape(-1, 2)
    return np.concatenate([xy, np.arange(len(xy), dtype=np.float32)[:, None]], axis=1)


DESCRIPTOR = np.zeros(4, np.float32)


def union_of(base: np.ndarray, added: np.ndarray) -> KeypointUnion:
    union = KeypointUnion(base)
    for keypoint in added:
        union.append(keypoint, DESCRIPTOR)
    return union


def nearest(keypoint: np.ndarray, among: np.ndarray) -> int:
    if len(among) == 0:
        return -1
    distance = np.linalg.norm(among[:, :2].astype(np.float64) - keypoint[:2], axis=1)
    row = int(distance.argmin())
    return row if distance[row] <= SAME_KEYPOINT_PX else -1


@given(base=POSITIONS, more=POSITIONS)
def test_the_union_equals_a_search_of_all_keypoints(base: Positions, more: Positions) -> None:
    union = KeypointUnion(array(base))
    kept = array(base)
    for keypoint in array(more):
        expected = nearest(keypoint, kept[: len(base)])  # the base comes first
        if expected < 0:
            behind = nearest(keypoint, kept[len(base) :])
            expected = behind if behind < 0 else behind + len(base)
        (result,) = union.find(keypoint[None]).tolist()
        assert result == expected
        if result < 0:
            assert union.append(keypoint, DESCRIPTOR) == len(kept)
            kept = np.concatenate([kept, keypoint[None]])
    assert len(union) == len(kept)
    np.testing.assert_array_equal(union.added(), kept[len(base) :])
    assert union.find(np.zeros((0, 3), np.float32)).shape == (0,)
    # a union with the added keypoints finds the same
    again = union_of(array(base), union.added())
    np.testing.assert_array_equal(again.find(array(more)), union.find(array(more)))


@given(base=POSITIONS, more=POSITIONS, taken_back=st.integers(0, 25))
def test_truncation_removes_keypoints(base: Positions, more: Positions, taken_back: int) -> None:
    union = KeypointUnion(array(base))
    for keypoint in array(more):
        if union.find(keypoint[None])[0] < 0:
            union.append(keypoint, DESCRIPTOR)
    length = max(len(base), len(union) - taken_back)
    expected = union_of(array(base), union.added()[: length - len(base)])
    union.truncate(length)
    np.testing.assert_array_equal(union.added(), expected.added())
    assert len(union.descriptors) == len(union) - len(base)
    np.testing.assert_array_equal(union.find(array(more)), expected.find(array(more)))


def variant_matches(
    positions: Positions, others: list[int], scores: list[float] | None = None
) -> VariantMatches:
    return VariantMatches(
        ImageVariant(0.5),
        np.array(positions, np.float32).reshape(-1, 2),
        np.tile(np.arange(len(positions), dtype=np.float32)[:, None], (1, 4)),
        np.array(others, np.int64),
        np.array(scores or [1.0] * len(others), np.float32),
    )


def grid(count: int) -> np.ndarray:
    return np.stack([np.arange(count) * 10.0, np.zeros(count)], axis=1).astype(np.float32)


BASE = (np.array([[0, 0], [1, 1]]), np.array([0.9, 0.8]))


def test_mode_all_adds_new_matches() -> None:
    keypoints = KeypointUnion(grid(5))
    tried = [
        # at keypoint 2; new; new, but its partner is matched; at keypoint 1, which is matched
        variant_matches([(20.5, 0.5), (5, 5), (6, 50), (10, 0)], [7, 8, 0, 9], [0.1, 0.2, 1, 1]),
        variant_matches([(5, 5.9)], [10]),  # its keypoint equals (5, 5), which is matched
    ]
    matches, scores = combine(BASE, [(0, each) for each in tried], "all", [keypoints])
    assert matches.tolist() == [[0, 0], [1, 1], [5, 8], [2, 7]]
    np.testing.assert_allclose(scores, [0.9, 0.8, 0.2, 0.1])
    np.testing.assert_array_equal(keypoints.descriptors, [tried[0].descriptors[1]])
    np.testing.assert_array_equal(keypoints.added(), [(5, 5)])


def test_variants_of_both_images_add_to_both() -> None:
    first, second = KeypointUnion(grid(3)), KeypointUnion(grid(4))
    tried = [(0, variant_matches([(5, 5)], [3])), (1, variant_matches([(6, 6), (7, 60)], [2, 1]))]
    matches, scores = combine(BASE, tried, "all", (first, second))
    # the variant with more matches comes first; row 1 of the first image is matched
    assert matches.tolist() == [[0, 0], [1, 1], [2, 4], [3, 3]]
    for union, (_, variant) in zip((first, second), tried, strict=True):
        np.testing.assert_array_equal(union.descriptors, variant.descriptors[:1])


def test_mode_max_takes_the_variant_with_most_matches() -> None:
    rich = variant_matches([(5, 5), (0, 0.5), (15, 5)], [0, 5, 6])
    richer = variant_matches([(5, 45), (10, 40), (15, 45), (20, 40)], [0, 5, 6, 7])
    keypoints = KeypointUnion(grid(5))
    matches, scores = combine(BASE, [(0, rich), (0, richer)], "max", [keypoints])
    assert matches.tolist() == [[5, 0], [6, 5], [7, 6], [8, 7]]
    matches, scores = combine(BASE, [(0, rich)], "max", [KeypointUnion(grid(5))])
    assert matches.tolist() == [[5, 0], [0, 5], [6, 6]]


def test_mode_max_keeps_the_base_unless_a_variant_has_more() -> None:
    keypoints = KeypointUnion(grid(5))
    # as many matches; three matches, two of which share a keypoint
    some = variant_matches([(5, 5), (15, 5)], [4, 5])
    seemingly = variant_matches([(5, 5), (5, 5.5), (15, 5)], [4, 5, 6])
    for tried in ([], [(0, some)], [(0, seemingly)]):
        matches, scores = combine(BASE, tried, "max", [keypoints])
        assert matches.tolist() == BASE[0].tolist()
        assert not keypoints.descriptors and len(keypoints) == 5
