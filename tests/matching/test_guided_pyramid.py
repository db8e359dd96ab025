"""Guided pyramid matching on arrays: what is extracted lands on the true place, what is kept."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.geometry.image_variants import ImageVariant
from megloc_kapture.matching.guided_pyramid import (
    GuidedPyramidOptions,
    PairVerifier,
    VariantFeatures,
    VariantMatches,
    base_type,
    extract_variants,
    match_probed,
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


# ---------------------------------------------------------------------------- options


def test_the_variants_are_all_scales_with_all_turns_but_the_image_itself() -> None:
    options = GuidedPyramidOptions(scales=(2.0, 0.5, 1.0), rotations_deg=(270, 0))
    assert options.variants(640, 480) == [
        ImageVariant(0.5, 0), ImageVariant(0.5, 270), ImageVariant(1.0, 270),
        ImageVariant(2.0, 0), ImageVariant(2.0, 270),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("side", "expected"),
    [
        (400, [0.5, 1.0, 2.0, 3.0]),
        (800, [0.5, 1.0, 2.0]),  # 3 is cut down to 2, which is there
        (640, [0.5, 1.0, 2.0, 2.5]),  # 3 is cut down
        (1000, [0.5, 1.0, 1.6]),  # 2 and 3 are cut down to one
        (1500, [0.5, 1.0]),  # hardly larger: left out
        (1600, [0.5, 1.0]),
        (4000, [0.5, 1.0]),  # an image that is larger than the bound is still turned
    ],
)
def test_no_variant_is_larger_than_the_bound(side: int, expected: list[float]) -> None:
    options = GuidedPyramidOptions(scales=(0.5, 1.0, 2.0, 3.0), rotations_deg=(0, 90))
    for width, height in ((side, side // 2), (side // 2, side)):
        variants = options.variants(width, height)
        assert sorted({variant.scale for variant in variants} | {1.0}) == expected
        assert all(max(v.size(width, height)) <= max(1600, side) for v in variants)


@pytest.mark.parametrize(
    "wrong",
    [
        {"scales": ()}, {"scales": (0.0,)}, {"scales": (-1.0,)}, {"scales": (float("nan"),)},
        {"scales": (100.0,)}, {"rotations_deg": (45,)}, {"rotations_deg": ()}, {"mode": "some"},
        {"min_matches": 0}, {"max_side_px": 0},
    ],
)  # fmt: skip
def test_wrong_options_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        GuidedPyramidOptions(**wrong)


def test_turns_are_counted_round() -> None:
    assert GuidedPyramidOptions(rotations_deg=(-90, 360, 450)).rotations_deg == (0, 90, 270)


def test_the_type_of_a_pyramid_says_what_it_begins_with() -> None:
    assert pyramid_type("rootsift") == "rootsift-pyramid"
    assert base_type("rootsift-pyramid") == base_type("rootsift") == "rootsift"


# ---------------------------------------------------------------------------- extraction


def blobs() -> tuple[np.ndarray, np.ndarray]:
    """An image of round spots whose centres are known to a fraction of a pixel."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(40, 300, 54), np.arange(40, 220, 54)), axis=-1)
    centers = grid.reshape(-1, 2) + rng.uniform(-5, 5, (grid.size // 2, 2))
    columns, rows = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    image = np.full((240, 320), 60.0)
    for x, y in centers:
        image += 160 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 6.0**2))
    return np.repeat(np.round(image).astype(np.uint8)[..., None], 3, axis=2), centers


IMAGE, CENTERS = blobs()
# rounding makes weak keypoints on smooth spots
SIFT = RootSift(RootSiftOptions(contrast_threshold=0.05))
ITSELF = SIFT.extract(IMAGE)
LIKE = ImageFeatures(ITSELF.keypoints_px, ITSELF.descriptors, 320, 240)


def extract(image: np.ndarray, mask: np.ndarray | None) -> LocalFeatures:
    return SIFT.extract(image, mask)


@pytest.mark.parametrize("variant", ALL_VARIANTS, ids=str)
def test_what_a_variant_shows_is_carried_back_to_its_true_place(variant: ImageVariant) -> None:
    (found,), skipped = extract_variants(IMAGE, None, [variant], extract, like=LIKE)
    assert not skipped
    assert (found.features.width, found.features.height) == variant.size(320, 240)
    inside = found.features.keypoints_px / variant.size(320, 240)
    assert (inside >= 0).all() and (inside <= 1).all()
    distance = np.linalg.norm(found.keypoints_px[None] - CENTERS[:, None], axis=2)
    shift = found.keypoints_px[distance.argmin(axis=1)] - CENTERS
    # half a pixel of the variant, in the original 0.17 at three times the size, would be seen
    assert (np.linalg.norm(shift, axis=1) < 0.5).mean() > 0.9
    assert np.abs(np.median(shift, axis=0)).max() < 0.08


def test_a_masked_pixel_gives_no_keypoint_in_any_variant() -> None:
    mask = np.ones((240, 320), bool)
    mask[50:150, 100:250] = False
    found, _ = extract_variants(IMAGE, mask, ALL_VARIANTS[::2], extract, like=LIKE)
    assert len(found) == len(ALL_VARIANTS[::2])
    for each in found:
        x, y = np.floor(each.keypoints_px[:, :2]).astype(int).T
        assert len(x) > 5
        # a keypoint at the very edge of the variant is one at the edge of the image
        assert mask[np.clip(y, 0, 239), np.clip(x, 0, 319)].all()


def test_a_variant_that_cannot_be_extracted_is_skipped_and_says_why() -> None:
    def picky(image: np.ndarray, mask: np.ndarray | None) -> LocalFeatures:
        if min(image.shape[:2]) < 100:
            raise cv2.error("too small\nfor me")
        if image.shape[0] > image.shape[1]:
            empty = np.zeros((0, 2), np.float32)
            return LocalFeatures(empty, empty[:, 0], np.zeros((0, 128), np.float32))
        return extract(image, mask)

    variants = [ImageVariant(0.5), ImageVariant(1 / 3), ImageVariant(0.5, 90)]
    found, skipped = extract_variants(IMAGE, None, variants, picky, like=LIKE)
    assert [each.variant for each in found] == variants[:1]
    assert [(each.variant, each.reason) for each in skipped] == [
        (variants[1], "error: too small"),
        (variants[2], "no keypoints"),
    ]


def test_features_that_do_not_fit_those_of_the_image_are_refused() -> None:
    more = ImageFeatures(np.zeros((1, 3), np.float32), np.zeros((1, 128), np.float32), 320, 240)
    with pytest.raises(DataError, match="3 numbers per keypoint and 128 .* 2 and 128"):
        extract_variants(IMAGE, None, ALL_VARIANTS[:1], extract, like=more)
    other = ImageFeatures(np.zeros((1, 2), np.float32), np.zeros((1, 64), np.float32), 320, 240)
    with pytest.raises(DataError, match="64 per descriptor"):
        extract_variants(IMAGE, None, ALL_VARIANTS[:1], extract, like=other)


def test_columns_beside_the_place_are_kept_as_they_are_stored() -> None:
    def scored(image: np.ndarray, mask: np.ndarray | None) -> LocalFeatures:
        found = extract(image, mask)
        wide = np.concatenate(
            [found.keypoints_px, found.scores[:, None], found.scores[:, None]], axis=1
        )
        return LocalFeatures(wide, found.scores, found.descriptors)

    like = ImageFeatures(np.zeros((1, 3), np.float32), LIKE.descriptors, 320, 240)
    (found,), _ = extract_variants(IMAGE, None, [ImageVariant(0.5, 90)], scored, like=like)
    assert found.keypoints_px.shape[1] == found.features.keypoints_px.shape[1] == 3
    np.testing.assert_array_equal(found.keypoints_px[:, 2], found.features.keypoints_px[:, 2])


# ---------------------------------------------------------------------------- matching


def test_the_verified_rows_are_what_is_found() -> None:
    found, _ = extract_variants(IMAGE, None, [ImageVariant(0.5, 90)], extract, like=LIKE)

    def match(a: ImageFeatures, others: Any) -> Any:
        assert (a.width, a.height) == (120, 160)
        return [match_nearest(a.descriptors, other.descriptors) for other in others]

    def even(variant: VariantFeatures, matches: np.ndarray) -> np.ndarray:
        return matches[:, 0] % 2 == 0

    def none(variant: VariantFeatures, matches: np.ndarray) -> np.ndarray:
        return np.zeros(len(matches), bool)

    nothing = ImageFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), 9, 9)
    kept, refused, empty = match_variants(
        found,
        [LIKE, LIKE, nothing],
        match,
        [PairVerifier(even), PairVerifier(none), PairVerifier(none)],
    )
    assert refused == empty == []
    (result,) = kept
    matches, scores = match_nearest(found[0].features.descriptors, LIKE.descriptors)
    assert result.variant == ImageVariant(0.5, 90)
    rows, other_rows = matches[kept_rows := matches[:, 0] % 2 == 0].T
    np.testing.assert_array_equal(result.other_rows, other_rows)
    np.testing.assert_array_equal(result.keypoints_px, found[0].keypoints_px[rows])
    np.testing.assert_array_equal(result.descriptors, found[0].features.descriptors[rows])
    np.testing.assert_array_equal(result.scores, scores[kept_rows])


# ---------------------------------------------------------------------------- verification


def two_views(error_px: float) -> tuple[np.ndarray, np.ndarray, RigidTransform]:
    """Pixels of 60 points in two views, the first's off by so much at right angles to its lines."""
    rng = np.random.default_rng(1)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (60, 3))
    other_from_image = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    px = [500 * p[:, :2] / p[:, 2:] + (320, 240) for p in (points, other_from_image.apply(points))]
    # moved sideways: the epipolar lines are level
    px[0][:, 1] += np.where(np.arange(60) % 2, error_px, -error_px)
    return px[0].astype(np.float32), px[1].astype(np.float32), other_from_image


def variant_at(scale: float, px: np.ndarray) -> VariantFeatures:
    nothing = ImageFeatures(px, np.zeros((len(px), 1), np.float32), 1, 1)
    return VariantFeatures(ImageVariant(scale), nothing, px)


ROWS = np.stack([np.arange(60)] * 2, axis=1)


@pytest.mark.parametrize("scale", [1 / 3, 1.0, 3.0])
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
    # half of it agrees: of the others only what is right by chance
    sizes = [len(each) for each in kept]
    assert sizes[:-1] == [*map(len, most), 20] and 15 <= sizes[-1] <= 18
    assert set(range(25, 40)) <= set(kept[-1].other_rows.tolist())
    assert judgement.agree([]) == []


# ---------------------------------------------------------------------------- what is not tried


def matched_by(variant: VariantFeatures, count: int) -> VariantMatches:
    zeros = np.zeros((count, 2), np.float32)
    return VariantMatches(
        variant.variant, zeros, zeros, np.arange(count), np.ones(count, np.float32)
    )


@pytest.mark.parametrize(("enough", "left"), [(29, 0), (30, 1), (31, 1)])
def test_on_the_rest_only_what_matched_a_probed_pair_is_tried(enough: int, left: int) -> None:
    empty = ImageFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32), 8, 8)
    variants = [
        VariantFeatures(variant, empty, np.zeros((0, 2), np.float32)) for variant in ALL_VARIANTS
    ]
    asked: list[tuple[int, range]] = []

    def match(some: Any, which: range) -> list[list[VariantMatches]]:
        asked.append((len(some), which))
        # the third of them matches the second image, all the rest by chance
        return [
            [matched_by(one, enough if one is variants[2] and at == 1 else 20) for one in some]
            for at in which
        ]

    options = GuidedPyramidOptions(mode="all", probed_pairs=3)
    found, num_left = match_probed(variants, 10, match, options)
    assert num_left == left
    assert asked == [(len(variants), range(3)), *([(1, range(3, 10))] if left else [])]
    assert [len(of_pair) for of_pair in found] == [len(variants)] * 3 + [left] * 7
    # fewer pairs than are probed, and none
    assert len(match_probed(variants, 2, match, options)[0]) == 2
    assert match_probed(variants, 0, match, options)[0] == []
