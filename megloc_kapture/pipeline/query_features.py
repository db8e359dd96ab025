"""Features of one query image, pre-processed as a preset's maps are, in its own pixels."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.pipeline.options import PipelineOptions
from megloc_kapture.pipeline.queries import Query
from megloc_kapture.plugins import (
    SEGMENTERS,
    GlobalFeatureExtractor,
    LocalFeatureExtractor,
    load_plugin,
)
from megloc_kapture.preprocessing.frame_plan import plan_frame
from megloc_kapture.preprocessing.frames import processed_image, processed_mask, reached_region
from megloc_kapture.preprocessing.mask_margin import with_margin
from megloc_kapture.stages.class_masks import ClassMasks
from megloc_kapture.stages.global_features import describe_images
from megloc_kapture.stages.image_masks import MaskOptions
from megloc_kapture.stages.local_features import checked_features
from megloc_kapture.values import LocalFeatures


class QueryFeatures:
    """Extracts features of queries.

    Raises
    ------
    OptionError : masks of cameras or files, which belong to folders; a query brings its own.
    PluginError : there is no such segmenter.
    """

    def __init__(self, options: PipelineOptions) -> None:
        self._options = options
        masks = options.preprocessing.masks
        if masks != MaskOptions(segmenter=masks.segmenter, dynamic=masks.dynamic):
            raise OptionError(
                "masks of cameras, files or sequences are for folders of images (megloc "
                "preprocess); a query brings its own mask: Query(mask=...)"
            )

    @cached_property
    def _classes(self) -> ClassMasks | None:
        masks = self._options.preprocessing.masks
        if masks.segmenter is None:
            return None
        chosen = masks.segmenter
        segmenter = load_plugin(SEGMENTERS, chosen.name, chosen.options)
        return ClassMasks.of(segmenter, masks.dynamic)

    def mask(self, query: Query) -> NDArray[np.bool_] | None:
        """The query's own mask and that of its classes together, bool (H, W), margin included."""
        mask = query.read_mask()
        if self._classes is not None:
            classes = self._classes
            used = classes.mask(classes.labels(query.read_image(), query.name))
            mask = used if mask is None else mask & used
        return None if mask is None else with_margin(mask, self._options.mask_margin_px)

    def describe(self, query: Query, extractor: GlobalFeatureExtractor) -> NDArray[np.float32]:
        """The vector of the resized or undistorted image: float32 (D,).

        Raises
        ------
        DataError, OptionError, PluginError : as :meth:`extract`.
        """
        image = query.read_image()
        plan = plan_frame(query.camera, self._options.preprocessing)
        if plan.changes_pixels:
            image = processed_image(image, plan)
        return describe_images(extractor, [image], query.name)[0]

    def extract(self, query: Query, extractor: LocalFeatureExtractor) -> LocalFeatures:
        """Features of the resized or undistorted image, keypoints in pixels of the original.

        Raises
        ------
        DataError : the image or its mask cannot be read, or is not of its camera's size.
        OptionError : the image is too small for the options.
        PluginError : the extractor returns something else.
        """
        image, mask = query.read_image(), self.mask(query)
        plan = plan_frame(query.camera, self._options.preprocessing)
        if not plan.changes_pixels:
            return checked_features(extractor, extractor.extract(image, mask), query.name)
        reached = reached_region(plan)
        if mask is not None:
            mask = processed_mask(mask, plan)
        if reached is not None:
            mask = reached if mask is None else mask & reached
        found = extractor.extract(processed_image(image, plan), mask)
        features = checked_features(extractor, found, query.name)
        carried = plan.pixel_map().original_from_processed(features.keypoints_px[:, :2])
        there = np.isfinite(carried).all(axis=1)
        keypoints = features.keypoints_px[there]
        keypoints[:, :2] = carried[there]
        return replace(
            features,
            keypoints_px=keypoints,
            scores=features.scores[there],
            descriptors=features.descriptors[there],
        )
