"""Guided pyramid matching: a pair with few matches is tried again at other scales and turns.

MegLoc, section "Guided pyramid matching". Where a pair has fewer than 100 matches, features are
extracted from the image scaled and turned, and matched with the other image as it is. The paper
counts the matcher's matches; counting those that verification leaves suits any matcher. The matches
are put together (``all``), or the richest variant's are kept (``max``).

With verification each variant is verified by itself: most of them are turned the wrong way and
have matches by chance only, in which a two-view model over all variants together would drown. But
without poses a few matches fit some model by chance, a different one for each variant, so all must
then agree with that of the richest. Only keypoints that take part in a match are added to an image,
for a variant has as many keypoints as the image itself.

The array functions here know of no file; extraction, matching and verification are given to them.
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
# an enlargement that the bound cuts down to less than this beyond the next smaller one is left out
_MIN_STEP = 1.2

Extract = Callable[[NDArray[np.uint8], NDArray[np.bool_] | None], LocalFeatures]
PairMatches = tuple[NDArray[np.int64], NDArray[np.floating[Any]]]
Match = Callable[[ImageFeatures, Sequence[ImageFeatures]], Sequence[PairMatches]]


@dataclass(frozen=True, order=True)
class ImageVariant:
    """An image scaled and turned by quarters, and the exact map of its pixels to the original's.

    Pixel coordinates are continuous, the first pixel's centre at (0.5, 0.5): an image of size (w,
    h) covers [0, w] x [0, h]. A variant covers the same scene from edge to edge, so that
    coordinates scale by the ratio of the sizes, which is not exactly ``scale`` where a size had to
    be rounded. After scaling it is turned by 0, 90, 180 or 270 degrees, counter-clockwise as one
    sees it.
    """

    scale: float = 1.0
    rotation_deg: int = 0

    def __post_init__(self) -> None:
        if self.rotation_deg not in (0, 90, 180, 270):
            raise ValueError(f"a rotation is 0, 90, 180 or 270 degrees, got {self.rotation_deg}")
        if not 0 < self.scale < np.inf:
            raise ValueError(f"scale {self.scale} is not positive")

    def __str__(self) -> str:
        return f"{self.scale:.4g}@{self.rotation_deg}"

    @property
    def is_identity(self) -> bool:
        """True if it is the image as it is."""
        return self == ImageVariant()

    def scaled_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height before turning."""
        return max(1, round(width * self.scale)), max(1, round(height * self.scale))

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the variant of an image of this size."""
        scaled = self.scaled_size(width, height)
        return scaled if self.rotation_deg % 180 == 0 else (scaled[1], scaled[0])

    def of_image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The variant of an image, uint8 (H, W) or (H, W, 3).

        A smaller pixel is the mean of the area it covers, so that nothing aliases; a larger image
        is interpolated linearly, rounded the same way on every processor.
        """
        import cv2  # 0.1 s, and most that imports this never looks at an image

        height, width = image.shape[:2]
        size = self.scaled_size(width, height)
        if size != (width, height):
            smaller = size[0] <= width and size[1] <= height
            how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR_EXACT
            image = np.asarray(cv2.resize(image, size, interpolation=how), dtype=np.uint8)
        return np.ascontiguousarray(np.rot90(image, self.rotation_deg // 90))

    def of_mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The variant of a mask (H, W): True where every pixel it covers a part of is True."""
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
        """Pixels (N, 2) of the variant, in the original of this size; float64 (N, 2)."""
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
    """First pixel, and the one behind the last, that each of ``scaled`` pixels covers a part of."""
    at = np.arange(scaled, dtype=np.int64)
    return at * length // scaled, -((at + 1) * -length // scaled)


# an image is not enlarged beyond this; memory grows with the pixels
_MAX_SIDE_PX = 1600


class GuidedPyramidOptions(Options):
    """Options of guided pyramid matching."""

    mode: Literal["off", "all", "max"] = Field(
        default="off", description="matches of all variants together, or of the richest"
    )
    min_matches: int = Field(
        default=100, gt=0, description="a pair with fewer matches is tried again"
    )
    count: Literal["matches", "verified"] = Field(
        default="verified",
        description="matches that min_matches counts: all that the matcher returns, or those that "
        "verification leaves",
    )
    scales: tuple[float, ...] = Field(
        default=(1 / 3, 0.5, 1.0, 2.0, 3.0),
        min_length=1,
        description="sizes at which the images of a pair with few matches are matched again",
    )
    rotations_deg: tuple[int, ...] = Field(
        default=(0, 90, 180, 270), min_length=1, description="multiples of 90"
    )

    @field_validator("scales")
    @classmethod
    def _positive(cls, scales: tuple[float, ...]) -> tuple[float, ...]:
        if not all(0 < scale <= 16 for scale in scales):
            raise ValueError("a scale is greater than 0 and at most 16")
        return tuple(sorted(set(scales)))

    @field_validator("rotations_deg")
    @classmethod
    def _quarters(cls, rotations: tuple[int, ...]) -> tuple[int, ...]:
        if any(rotation % 90 for rotation in rotations):
            raise ValueError("rotations are multiples of 90 degrees")
        return tuple(sorted({rotation % 360 for rotation in rotations}))

    def is_hard(self, num_found: int, num_verified: int) -> bool:
        """Whether a pair with so many matches, before and after verification, is tried again."""
        count = num_found if self.count == "matches" else num_verified
        return self.mode != "off" and count < self.min_matches

    def variants(self, width: int, height: int) -> list[ImageVariant]:
        """List the variants of an image of this size, sorted; not the image as it is.

        A scale that would enlarge it beyond ``_MAX_SIDE_PX`` is reduced to it, and left out where
        that is hardly more than the next smaller scale.
        """
        limit = max(1.0, _MAX_SIDE_PX / max(width, height))
        scales = [scale for scale in self.scales if scale <= limit]
        if len(scales) < len(self.scales) and limit >= _MIN_STEP * max([1.0, *scales[-1:]]):
            scales.append(limit)
        every = (ImageVariant(*each) for each in product(scales, self.rotations_deg))
        return [variant for variant in every if not variant.is_identity]


def pyramid_type(local_type: str) -> str:
    """Name of the keypoints type that has a type's keypoints first, then those that were added."""
    return local_type + _SUFFIX


def base_type(local_type: str) -> str:
    """The type a pyramid's keypoints begin with; the type itself where it is none of a pyramid."""
    return local_type.removesuffix(_SUFFIX)


def equivalent_types(local_type: str) -> tuple[str, ...]:
    """The types whose features of a query serve matches of a type, the fitting first.

    A pyramid begins with the features of its base: a query that brings either lacks nothing.
    """
    base = base_type(local_type)
    return tuple(dict.fromkeys((local_type, base, pyramid_type(base))))


@dataclass(frozen=True, eq=False)
class VariantFeatures:
    """Features of an image's variant, as the matcher gets them, in the variant's own pixels.

    ``keypoints_px`` float32 (N, C) are x and y in pixels of the original; other columns as found.
    """

    variant: ImageVariant
    features: ImageFeatures
    keypoints_px: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class VariantMatches:
    """Verified matches of a variant with another image.

    Keypoints float32 (K, C), in pixels of the original, descriptors (K, D), scores float32 (K,),
    and the other image's keypoints int64 (K,).
    """

    variant: ImageVariant
    keypoints_px: NDArray[np.float32]
    descriptors: NDArray[Any]
    other_rows: NDArray[np.int64]
    scores: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.other_rows)

    def only(self, good: NDArray[np.bool_]) -> VariantMatches:
        """Those of a mask (K,)."""
        return VariantMatches(
            self.variant,
            self.keypoints_px[good],
            self.descriptors[good],
            self.other_rows[good],
            self.scores[good],
        )


@dataclass(frozen=True)
class PairVerifier:
    """Verifies an image's matches with another one.

    ``verify`` says which matches (K, 2) of a variant, rows of it and of the other image, best
    first, are right; ``agree`` what remains of several variants' verified matches that need not
    agree.
    """

    verify: Callable[[VariantFeatures, NDArray[np.int64]], NDArray[np.bool_]]
    agree: Callable[[list[VariantMatches]], list[VariantMatches]] = list


def verify_best_first(
    verify: Callable[[NDArray[np.int64]], NDArray[np.bool_]],
    matches: NDArray[np.int64],
    scores: NDArray[np.floating[Any]],
) -> NDArray[np.bool_]:
    """The mask (N,) that ``verify`` gives of matches (N, 2) that it gets by falling scores (N,)."""
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
    """Extract features of an image's variants; of those without any, say why.

    Parameters
    ----------
    image, mask : uint8 (H, W, 3), RGB; bool (H, W), True = use, changed along with the image.
    extract : image and mask to features. A DataError that names no file is about the image, for
        example one that is too small for the network: that variant is skipped.
    like : features of the image as it is: what is added has as many columns, else it is a
        DataError.
    """
    height, width = image.shape[:2]
    found, skipped = [], {}
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
                f"the image's features have {columns} numbers per keypoint and {values} per "
                f"descriptor, the extractor's {px.shape[1]} and {features.descriptors.shape[1]}"
            )
        size = variant.size(width, height)
        own = ImageFeatures(px[:, :columns], features.descriptors, *size)
        original_px = px[:, :columns].copy()
        original_px[:, :2] = variant.px_in_original(px[:, :2], width, height)
        found.append(VariantFeatures(variant, own, original_px))
    return found, skipped


def match_variants(
    variants: Sequence[VariantFeatures],
    others: Sequence[ImageFeatures],
    match: Match,
    judgements: Sequence[PairVerifier],
) -> list[list[VariantMatches]]:
    """Match an image's variants with each of several other images, and verify the matches.

    ``match`` gives matches of one image with each of several, see ``plugins.Matcher``; there is a
    verifier for each of ``others``.
    """
    found: list[list[VariantMatches]] = [[] for _ in others]
    for variant in variants:
        matched = match(variant.features, others)
        for into, judgement, (matches, scores) in zip(found, judgements, matched, strict=True):
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
    return [judgement.agree(matches) for judgement, matches in zip(judgements, found, strict=True)]
