"""One query image as the options' pre-processing leaves it, in memory."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.pipeline.queries import Query
from megloc_kapture.plugins import (
    SEGMENTERS,
    DepthView,
    GlobalFeatureExtractor,
    LocalFeatureExtractor,
    load_plugin,
)
from megloc_kapture.preprocessing.frames import (
    FrameOptions,
    FramePlan,
    plan_frame,
)
from megloc_kapture.preprocessing.masks import with_margin
from megloc_kapture.stages.global_features import describe_images
from megloc_kapture.stages.image_masks import ClassMasks, MaskOptions, ProcessedFrame
from megloc_kapture.stages.local_features import extract_checked
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import Camera, LocalFeatures


class Preprocessor:
    """Pre-processes query images as the stage of :mod:`megloc_kapture.stages.preprocessing` does.

    Raises
    ------
    OptionError : masks of cameras or files, which belong to folders; a query brings its own.
    """

    def __init__(self, options: PipelineOptions) -> None:
        self._options = options
        masks = options.preprocessing.masks
        if masks != MaskOptions(segmenter=masks.segmenter, dynamic=masks.dynamic):
            raise OptionError(
                "preprocessing.masks.fixed, unchanging and user_masks are for folders of images: "
                "make one with `megloc preprocess`; a query brings its own mask: Query(mask=...)"
            )

    def of(self, query: Query) -> QueryImage:
        """What becomes of a query's image; nothing is read yet.

        The image of a query that brings local features stays as it is, for they are in its pixels.

        Raises
        ------
        OptionError : the image is too small for the options.
        """
        frame = FrameOptions() if query.features else self._options.preprocessing
        return QueryImage(query, plan_frame(query.camera, frame), self)

    @cached_property
    def classes(self) -> ClassMasks | None:
        """What tells classes of pixels apart; raises PluginError, MissingWeightsError."""
        masks = self._options.preprocessing.masks
        if masks.segmenter is None:
            return None
        segmenter = load_plugin(SEGMENTERS, masks.segmenter.name, masks.segmenter.options)
        return ClassMasks.of(segmenter, masks.dynamic)

    @property
    def mask_margin_px(self) -> float:
        """Features nearer than this to a masked pixel are left out."""
        return self._options.mask_margin_px


class QueryImage:
    """Camera, pixels, mask and depth of a query after pre-processing, made when first asked for.

    Attributes
    ----------
    camera : the one that would have taken the new image.
    """

    def __init__(self, query: Query, plan: FramePlan, preprocessor: Preprocessor) -> None:
        self.query, self._preprocessor = query, preprocessor
        self.camera: Camera = plan.processed
        self._frame = ProcessedFrame(
            query.name, plan, query.read_image, self._own_mask, lambda: preprocessor.classes
        )

    def _own_mask(self) -> dict[str, NDArray[np.bool_]]:
        own = self.query.read_mask()
        return {} if own is None else {"own": own}

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """The image, uint8 (H, W, 3) RGB; raises DataError."""
        return self._frame.stored

    @cached_property
    def mask(self) -> NDArray[np.bool_] | None:
        """Its mask bool (H, W), True = use: its own, dynamic classes, what the original shows.

        None where all of it is used.

        Raises
        ------
        DataError : the mask cannot be read, or is not of the camera's size.
        """
        return self._frame.mask

    @property
    def feature_mask(self) -> NDArray[np.bool_] | None:
        """The mask as the extraction of features gets it: with its margin."""
        mask = self.mask
        return None if mask is None else with_margin(mask, self._preprocessor.mask_margin_px)

    def extract(self, extractor: LocalFeatureExtractor) -> LocalFeatures:
        """Its local features.

        Raises
        ------
        DataError : the image or its mask cannot be read, or is not of its camera's size.
        PluginError : the extractor returns something else.
        """
        return extract_checked(extractor, self.pixels, self.feature_mask, self.query.name)

    def describe(self, extractor: GlobalFeatureExtractor) -> NDArray[np.float32]:
        """Its global feature, float32 (D,); raises as :meth:`extract`."""
        return describe_images(extractor, [self.pixels], self.query.name)[0]


class QueryImages:
    """Images by their names, as a :class:`~megloc_kapture.stages.ranking_scene.QueryScene`."""

    def __init__(self, images: Iterable[QueryImage]) -> None:
        self._images = {image.query.name: image for image in images}

    def image(self, name: str) -> NDArray[np.uint8]:
        """RGB pixels (H, W, 3); raises DataError."""
        return self._images[name].pixels

    def mask(self, name: str) -> NDArray[np.bool_] | None:
        """Mask (H, W), True = use; None without one."""
        return self._images[name].mask

    def depth(self, name: str) -> DepthView | None:
        """Depth that was taken with the image; None without; raises DataError."""
        return self._images[name].query.read_depth()
