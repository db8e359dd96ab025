"""One image's share of guided pyramid matching: its variants with the images it matches badly."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.image_variants import ImageVariant
from megloc_kapture.matching.guided_pyramid import (
    Extract,
    GuidedPyramidOptions,
    PairVerifier,
    SkippedVariant,
    VariantFeatures,
    VariantMatches,
    extract_variants,
    match_probed,
    match_variants,
)
from megloc_kapture.matching.verification import (
    KnownPoseOptions,
    TwoViewOptions,
    known_pose_of_variants,
    two_view_of_variants,
)
from megloc_kapture.plugins import LocalFeatureExtractor, Matcher
from megloc_kapture.stages.local_features import checked_features, read_image_of, read_mask
from megloc_kapture.stages.matches import (
    BATCH,
    Features,
    batched,
    cached_features,
    match_all,
)
from megloc_kapture.stages.work import FolderSpec
from megloc_kapture.values import LocalFeatures


@dataclass(frozen=True)
class HowToRetry:
    """What is the same for all images of a run.

    Attributes
    ----------
    first, second : where images that are extracted again, and those they are matched with, are.
    first_type, second_type : keypoints types of their features.
    mask_margin_px : keypoints nearer than this to a masked pixel of the original go too.
    """

    first: FolderSpec
    second: FolderSpec
    first_type: str
    second_type: str
    extractor: LocalFeatureExtractor
    matcher: Matcher
    verification: KnownPoseOptions | TwoViewOptions
    options: GuidedPyramidOptions
    mask_margin_px: float


@dataclass(frozen=True)
class Retry:
    """One image to extract again, and whom to match its variants with.

    Attributes
    ----------
    others : matched with all variants; those with most matches first, as they are probed first.
    only_scaled : matched with those of another scale only; in the same order.
    """

    how: HowToRetry
    image: str
    others: tuple[str, ...]
    only_scaled: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Retried:
    """What came of it.

    Attributes
    ----------
    found : for each of ``others``, then of ``only_scaled``, the variants that match.
    num_variants : that were tried with each of these, the skipped ones among them.
    """

    found: list[list[VariantMatches]]
    num_variants: list[int]
    skipped: list[SkippedVariant]
    seconds: float


def retry(job: Retry) -> Retried:
    """Extract the variants of an image, and match them; the image is read once."""
    started = time.perf_counter()
    how = job.how
    first, second = how.first.open(), how.second.open()
    camera = first.read().camera_of(job.image)
    image = read_image_of(first.image_path(job.image), camera)
    mask = read_mask(
        first.root / "sensors" / "masks" / f"{job.image}.png",
        image.shape[:2],
        margin_px=how.mask_margin_px,
    )
    itself = cached_features(how.first, first, how.first_type, job.image)
    every = how.options.variants(camera.width, camera.height)
    scaled = [variant for variant in every if variant.scale != 1.0]
    variants, skipped = extract_variants(
        image,
        mask,
        every if job.others else scaled,
        extraction(how.extractor, job.image),
        like=itself.for_matcher(),
    )
    scaled_only = [one for one in variants if one.variant.scale != 1.0]
    found: list[list[VariantMatches]] = []
    counts: list[int] = []
    for names, used, num_tried in (
        (job.others, variants, len(every)),
        (job.only_scaled, scaled_only, len(scaled)),
    ):
        matches, num_left = match_in_batches(
            used,
            names,
            lambda name: cached_features(how.second, second, how.second_type, name),
            how.matcher,
            lambda name, other: _judgement(job, itself, name, other),
            how.options,
        )
        probed = min(len(names), how.options.probed_pairs)
        found += matches
        counts += [num_tried] * probed + [num_left] * (len(names) - probed)
    return Retried(found, counts, skipped, seconds=time.perf_counter() - started)


def match_in_batches(
    variants: Sequence[VariantFeatures],
    names: Sequence[str],
    load: Callable[[str], Features],
    matcher: Matcher,
    judge: Callable[[str, Features], PairVerifier],
    options: GuidedPyramidOptions,
) -> tuple[list[list[VariantMatches]], int]:
    """The variants that match each of several images, whose features are not all loaded at once.

    Parameters
    ----------
    names : of the images, the most promising first.
    load : features of an image.
    judge : of the matches with an image, by its name and features.

    Returns
    -------
    See :func:`megloc_kapture.matching.guided_pyramid.match_probed`.
    """

    def match(some: Sequence[VariantFeatures], which: range) -> list[list[VariantMatches]]:
        found = []
        for batch in batched(names[which.start : which.stop], BATCH):
            others = [load(name) for name in batch]
            found += match_variants(
                some,
                [other.for_matcher() for other in others],
                partial(match_all, matcher),
                [judge(name, other) for name, other in zip(batch, others, strict=True)],
            )
        return found

    return match_probed(variants, len(names), match, options)


def extraction(extractor: LocalFeatureExtractor, name: str) -> Extract:
    """An extractor as a function, its results checked; ``name`` of the image, for messages."""

    def extract(image: NDArray[np.uint8], mask: NDArray[np.bool_] | None) -> LocalFeatures:
        return checked_features(extractor, extractor.extract(image, mask), name)

    return extract


def _judgement(job: Retry, itself: Features, name: str, other: Features) -> PairVerifier:
    how, first = job.how, job.how.first.open()
    if isinstance(how.verification, TwoViewOptions):
        base, _ = first.matches(how.first_type).read(job.image, name)
        return two_view_of_variants(
            itself.camera, itself.keypoints_px, other.camera, other.keypoints_px, base,
            how.verification,
        )  # fmt: skip
    image_from_world = first.read().cam_from_world(job.image)
    other_from_world = how.second.open().read().cam_from_world(name)
    if image_from_world is None or other_from_world is None:
        raise DataError(f"{job.image} or {name} has no pose, and is to be verified with it")
    return known_pose_of_variants(
        itself.camera,
        other.rays,
        other.slopes,
        other_from_world @ image_from_world.inverse(),
        how.verification,
    )


def described(skipped: Sequence[SkippedVariant]) -> str:
    """The variants that gave nothing, and why, as one line; those of one reason together."""
    by_reason: dict[str, list[ImageVariant]] = {}
    for each in skipped:
        by_reason.setdefault(each.reason, []).append(each.variant)
    return "; ".join(
        f"{' '.join(map(str, variants))}: {reason}" for reason, variants in by_reason.items()
    )
