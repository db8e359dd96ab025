"""Guided pyramid matching: pairs with few matches are matched again at other scales and rotations.

MegLoc, section "Guided pyramid matching": for pairs with fewer than 100 matches, features of scaled
and rotated variants of one image are matched with the other image. All matches are combined
(``all``), or those of the variant with the most matches are kept (``max``). The paper counts all
matches of the matcher; a count of verified matches, the default, suits any matcher.

Each variant is verified separately: most have the wrong rotation, and their random matches would
outnumber the inliers of a common two-view model. Without known poses, even a few random matches fit
some model; so only matches that also fit the model of the best variant (or of the original images)
are kept. Only matched keypoints are added to an image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from megloc_kapture.errors import DataError
from megloc_kapture.values import ImageFeatures, LocalFeatures, Options

_SUFFIX = "-pyramid"
# a scale reduced to _MAX_SIDE_PX is dropped if it is less than this times the next smaller scale
_MIN_STEP = 1.2

Extract = Callable[[NDArray[np.uint8], NDArray[np.bool_] | None], LocalFeatures]
PairMatches = tuple[NDArray[np.int64], NDArray[np.floating[Any]]]
Match = Callable[[ImageFeatures, Sequence[ImageFeatures]], Sequence[PairMatches]]


@dataclass(frozen=True, order=True)
class ImageVariant:
    """An image scaled, then rotated counter-clockwise by multiples of 90 degrees.

    A variant covers the image from edge to edge, so pixel coordinates scale by the ratio of the
    rounded sizes. The first pixel's centre is (0.5, 0.5).
    """

    scale: float = 1.0
    rotation_deg: int = 0

    def __str__(self) -> str:
        return f"{self.scale:.4g}@{self.rotation_deg}"

    @property
    def is_identity(self) -> bool:
        return self == ImageVariant()

    def scaled_size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height before rotation."""
        return max(1, round(width * self.scale)), max(1, round(height * self.scale))

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height of the variant."""
        scaled = self.scaled_size(width, height)
        return scaled if self.rotation_deg % 180 == 0 else (scaled[1], scaled[0])

    def of_image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Transform an image, uint8 (H, W) or (H, W, 3)."""
        import cv2  # takes 0.1 s, and is rarely needed

        height, width = image.shape[:2]
        size = self.scaled_size(width, height)
        if size != (width, height):
            smaller = size[0] <= width and size[1] <= height
            how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR_EXACT
            image = np.asarray(cv2.resize(image, size, interpolation=how), dtype=np.uint8)
        return np.ascontiguousarray(np.rot90(image, self.rotation_deg // 90))

    def of_mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Transform a mask (H, W); True where all covered pixels are True."""
        height, width = mask.shape
        scaled_width, scaled_height = self.scaled_size(width, height)
        ignored = np.zeros((height + 1, width + 1), dtype=np.int64)
        np.cumsum(np.cumsum(~mask, axis=0), axis=1, out=ignored[1:, 1:])
        top, bottom = _covered(height, scaled_height)
        left, right = _covered(width, scaled_width)
        count = (
            ignored[np.ix_(bottom, right)]
            - ignored[np.ix_(top, right)]
            - ignored[np.ix_(bottom, left)]
            + ignored[np.ix_(top, left)]
        )
        return np.ascontiguousarray(np.rot90(count == 0, self.rotation_deg // 90))

    def px_in_original(
        self, px: NDArray[np.floating[Any]], width: int, height: int
    ) -> NDArray[np.float64]:
        """Transform pixels (N, 2) of the variant to pixels of the original of this size."""
        scaled = self.scaled_size(width, height)
        x, y = np.asarray(px, dtype=np.float64).T
        back = {
            0: (x, y),
            90: (scaled[0] - y, x),
            180: (scaled[0] - x, scaled[1] - y),
            270: (y, scaled[1] - x),
        }
        return np.stack(back[self.rotation_deg], axis=1) * (
            np.array([width, height]) / np.array(scaled)
        )


def _covered(length: int, scaled: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and the past-the-end pixel that each of ``scaled`` pixels covers."""
    at = np.arange(scaled, dtype=np.int64)
    return at * length // scaled, -((at + 1) * -length // scaled)


# an image is not enlarged beyond this, which limits memory
_MAX_SIDE_PX = 1600


class GuidedPyramidOptions(Options):
    """Options of guided pyramid matching."""

    mode: Literal["off", "all", "max"] = Field(
        default="off",
        description="all: use the matches of all variants; max: only those of the best variant",
    )
    min_matches: int = Field(
        default=100, gt=0, description="pairs with fewer matches are matched again"
    )
    count: Literal["matches", "verified"] = Field(
        default="verified",
        description="matches that min_matches counts: all matches, or the verified ones",
    )
    scales: tuple[float, ...] = Field(
        default=(1 / 3, 0.5, 1.0, 2.0, 3.0),
        min_length=1,
        description="scales at which pairs with few matches are matched again",
    )
    rotations_deg: tuple[int, ...] = Field(
        default=(0, 90, 180, 270),
        min_length=1,
        description="rotations at which pairs with few matches are matched again, multiples of 90",
    )

    @field_validator("scales")
    @classmethod
    def _positive(cls, scales: tuple[float, ...]) -> tuple[float, ...]:
        if not all(0 < scale <= 16 for scale in scales):
            raise ValueError("scales must be greater than 0 and at most 16")
        return tuple(sorted(set(scales)))

    @field_validator("rotations_deg")
    @classmethod
    def _quarters(cls, rotations: tuple[int, ...]) -> tuple[int, ...]:
        if any(rotation % 90 for rotation in rotations):
            raise ValueError("rotations must be multiples of 90 degrees")
        return tuple(sorted({rotation % 360 for rotation in rotations}))

    def is_hard(self, num_found: int, num_verified: int) -> bool:
        """Return True if a pair with these numbers of matches is matched again."""
        count = num_found if self.count == "matches" else num_verified
        return self.mode != "off" and count < self.min_matches

    def variants(self, width: int, height: int) -> list[ImageVariant]:
        """List the variants of an image of this size, without the identity.

        Scales that would enlarge the longer side beyond ``_MAX_SIDE_PX`` are replaced by the scale
        that reaches it, unless the next smaller scale is close to it.
        """
        limit = max(1.0, _MAX_SIDE_PX / max(width, height))
        scales = [scale for scale in self.scales if scale <= limit]
        if len(scales) < len(self.scales) and limit >= _MIN_STEP * max([1.0, *scales[-1:]]):
            scales.append(limit)
        every = (ImageVariant(*each) for each in product(scales, self.rotations_deg))
        return [variant for variant in every if not variant.is_identity]


def pyramid_type(local_type: str) -> str:
    """Return the keypoints type of a pyramid: keypoints of ``local_type``, then added ones."""
    return local_type + _SUFFIX


def base_type(local_type: str) -> str:
    """Return the keypoints type on which a pyramid type is based; other types unchanged."""
    return local_type.removesuffix(_SUFFIX)


def equivalent_types(local_type: str) -> tuple[str, ...]:
    """Return the types of query features that can be matched with a map's type, best first."""
    base = base_type(local_type)
    return tuple(dict.fromkeys((local_type, base, pyramid_type(base))))


@dataclass(frozen=True, eq=False)
class VariantFeatures:
    """Features in pixels of the variant; ``keypoints_px``, float32 (N, C), in the original's."""

    variant: ImageVariant
    features: ImageFeatures
    keypoints_px: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class VariantMatches:
    """Verified matches of a variant with another image.

    Keypoints float32 (K, C) in pixels of the original, descriptors (K, D), rows of the other
    image's keypoints int64 (K,) and scores float32 (K,).
    """

    variant: ImageVariant
    keypoints_px: NDArray[np.float32]
    descriptors: NDArray[Any]
    other_rows: NDArray[np.int64]
    scores: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.other_rows)

    def only(self, good: NDArray[np.bool_]) -> VariantMatches:
        return VariantMatches(
            self.variant,
            self.keypoints_px[good],
            self.descriptors[good],
            self.other_rows[good],
            self.scores[good],
        )


@dataclass(frozen=True)
class PairVerifier:
    """Verifier of the matches of an image's variants with another image.

    ``verify`` returns a mask (K,) of the matches (K, 2) of a variant, given best first; ``agree``
    filters the verified matches of all variants.
    """

    verify: Callable[[VariantFeatures, NDArray[np.int64]], NDArray[np.bool_]]
    agree: Callable[[list[VariantMatches]], list[VariantMatches]] = list


def verify_best_first(
    verify: Callable[[NDArray[np.int64]], NDArray[np.bool_]],
    matches: NDArray[np.int64],
    scores: NDArray[np.floating[Any]],
) -> NDArray[np.bool_]:
    """Verify matches (N, 2), passed to ``verify`` in the order of descending scores (N,).

    The returned mask (N,) is in the order of ``matches``.
    """
    order = np.argsort(-scores, kind="stable")
    good = np.zeros(len(matches), dtype=bool)
    good[order] = verify(matches[order])
    return good


def extract_variants(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    variants: Sequence[ImageVariant],
    extract: Extract,
    *,
    like: ImageFeatures,
) -> tuple[list[VariantFeatures], dict[ImageVariant, str]]:
    """Extract features of an image's variants; also return reasons for variants without features.

    Parameters
    ----------
    image, mask : uint8 (H, W, 3), RGB; bool (H, W), True = use.
    extract : if it raises a DataError without a path, as for an image too small for the network,
        the variant is skipped.
    like : features of the image itself, which define the number of columns.
    """
    height, width = image.shape[:2]
    extracted, skipped = [], {}
    for variant in variants:
        try:
            features = extract(
                variant.of_image(image), None if mask is None else variant.of_mask(mask)
            )
        except DataError as error:
            if error.path is not None:
                raise
            skipped[variant] = error.message
            continue
        if len(features.keypoints_px) == 0:
            skipped[variant] = "no keypoints"
            continue
        px, columns = features.keypoints_px, like.keypoints_px.shape[1]
        values = like.descriptors.shape[1]
        if px.shape[1] < columns or features.descriptors.shape[1] != values:
            raise DataError(
                f"expected {columns} numbers per keypoint and {values} per descriptor, but the "
                f"extractor returns {px.shape[1]} and {features.descriptors.shape[1]}"
            )
        size = variant.size(width, height)
        in_variant = ImageFeatures(px[:, :columns], features.descriptors, *size)
        original_px = px[:, :columns].copy()
        original_px[:, :2] = variant.px_in_original(px[:, :2], width, height)
        extracted.append(VariantFeatures(variant, in_variant, original_px))
    return extracted, skipped


def match_variants(
    variants: Sequence[VariantFeatures],
    others: Sequence[ImageFeatures],
    match: Match,
    judgements: Sequence[PairVerifier],
) -> list[list[VariantMatches]]:
    """Match an image's variants with several other images, each with its verifier."""
    matches_of: list[list[VariantMatches]] = [[] for _ in others]
    for variant in variants:
        matched = match(variant.features, others)
        for into, judgement, (matches, scores) in zip(matches_of, judgements, matched, strict=True):
            if len(matches) == 0:
                continue
            verify = partial(judgement.verify, variant)
            good = verify_best_first(verify, matches, scores)
            if good.any():
                rows = matches[good]
                into.append(
                    VariantMatches(
                        variant.variant,
                        variant.keypoints_px[rows[:, 0]],
                        variant.features.descriptors[rows[:, 0]],
                        rows[:, 1],
                        np.asarray(scores[good], dtype=np.float32),
                    )
                )
    return [
        judgement.agree(matches) for judgement, matches in zip(judgements, matches_of, strict=True)
    ]
