"""Guided pyramid matching on arrays: positions of extracted keypoints, verification of matches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
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


def blobs() -> tuple[np.ndarray, np.ndarray]:
    """Return an image of round spots and their centres."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(40, 300, 54), np.arange(40, 220, 54)), axis=-1)
    centers = grid.reshape(-1, 2) + rng.uniform(-5, 5, (grid.size // 2, 2))
    columns, rows = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    image = np.full((240, 320), 60.0)
    for x, y in centers:
        image += 160 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 6.0**2))
    return np.repeat(np.round(image).astype(np.uint8)[..., None], 3, axis=2), centers


IMAGE, CENTERS = blobs()
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
def test_known_poses_count_in_pixels_of_the_original(
    scale: float, error_px: float, good: bool
) -> None:
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
def test_a_masks_pixel_is_true_if_all_covered_pixels_are(
    size: tuple[int, int], variant: ImageVariant, seed: int
) -> None:
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
