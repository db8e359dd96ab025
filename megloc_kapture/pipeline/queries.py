"""Preprocessed queries of the localizer: images, or given features."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.images import read_image_rgb, turned_upright
from megloc_kapture.localization.focal_length import estimate_remark
from megloc_kapture.plugins import DepthView, GlobalFeatureExtractor, LocalFeatureExtractor
from megloc_kapture.preprocessing.frames import carry_points
from megloc_kapture.preprocessing.masks import with_margin
from megloc_kapture.stages.global_features import describe_images
from megloc_kapture.stages.local_features import check_size, extract_all, read_mask
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.preprocessing import ClassMasks, PreprocessingOptions, ProcessedFrame
from megloc_kapture.values import Camera, LocalFeatures, Pose, RigidTransform, check_camera


def check_image(image: Any) -> None:
    """Raise DataError for a tensor, None from cv2.imread, or anything else that is not an image."""
    from PIL import Image

    kind = type(image).__name__
    if isinstance(image, np.ndarray):
        kind = f"{image.dtype} {image.shape}"
        fits = image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3 and image.size
    else:
        fits = isinstance(image, str | Path | Image.Image)
    require(fits, f"an image must be a file, uint8 (H, W, 3) RGB or a pillow image, got {kind}")


def _names(images: Sequence[str] | None) -> tuple[str, ...] | None:
    """Return names of map images as a tuple; a single name becomes a tuple of one."""
    single = isinstance(images, str | Path)
    return None if images is None else tuple(map(str, (images,) if single else images))


@dataclass(frozen=True, eq=False)
class Query:
    """One image to localize; camera and keypoints are in COLMAP's convention.

    Parameters
    ----------
    image : uint8 (H, W, 3) RGB or the path of an image file; optional if features are given.
    features, global_features : given features, keyed by the map's types; missing local ones
        are extracted.
    prior : map images that may be matched, or the name of one; None means all.
    candidates : map images to match, best first, instead of retrieval.
    mask : bool (H, W), True = use, or the path of a mask image (0 = ignore), which may be missing.
    depth : depth map taken with the image, or a function that reads one; for ``icp``.
    orientation : EXIF orientation of an image file, which is turned upright when it is read;
        ``camera`` describes the upright image.
    """

    camera: Camera
    image: Path | str | NDArray[np.uint8] | None = None
    name: str = "query"
    features: Mapping[str, LocalFeatures] = field(default_factory=dict)
    global_features: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    prior: Sequence[str] | None = None
    candidates: Sequence[str] | None = None
    mask: Path | str | NDArray[np.bool_] | None = None
    depth: DepthView | Callable[[], DepthView | None] | None = None
    orientation: int = 1

    def __post_init__(self) -> None:
        check_camera(self.camera)
        object.__setattr__(self, "prior", _names(self.prior))
        object.__setattr__(self, "candidates", _names(self.candidates))
        for local_type, local in self.features.items():
            shapes = np.shape(local.keypoints_px), np.shape(local.descriptors)
            require(
                list(map(len, shapes)) == [2, 2] and shapes[0][0] == shapes[1][0],
                f"query {self.name}: {local_type} has keypoints {shapes[0]} and descriptors "
                f"{shapes[1]}, not (N, 2 or more) and (N, D)",
            )

    def read_mask(self) -> NDArray[np.bool_] | None:
        """Return the mask, bool (H, W), True = use, or None."""
        shape = (self.camera.height, self.camera.width)
        if isinstance(self.mask, str | Path):
            return read_mask(Path(self.mask), shape)
        if self.mask is None:
            return None
        mask = np.asarray(self.mask)
        require(
            mask.dtype == np.bool_ and mask.shape == shape,
            f"query {self.name}: the mask must be bool {shape}, got {mask.dtype} {mask.shape}",
        )
        return mask

    def has_image(self) -> bool:
        if isinstance(self.image, str | Path):
            return Path(self.image).is_file()
        return self.image is not None

    def read_image(self) -> NDArray[np.uint8]:
        """Return the image as uint8 (H, W, 3) RGB."""
        if self.image is None:
            raise DataError(
                f"query {self.name} needs an image: features of the map's types are missing, or a "
                "step reads pixels"
            )
        if isinstance(self.image, str | Path):
            image = turned_upright(read_image_rgb(Path(self.image)), self.orientation)
            check_size(image.shape[1::-1], self.camera, self.image)
            return image
        image = np.asarray(self.image)
        shape = (self.camera.height, self.camera.width, 3)
        require(
            image.dtype == np.uint8 and image.shape == shape,
            f"query {self.name}: its camera needs a uint8 image {shape}, got {image.dtype} "
            f"{image.shape}",
        )
        return image


class QueryImage(ProcessedFrame):
    """Preprocessed pixels and mask of a query (lazy), their camera, and the unchanged depth.

    A query with given local features is neither resized nor undistorted.
    """

    def __init__(
        self, query: Query, options: PipelineOptions, classes: Callable[[], ClassMasks | None]
    ) -> None:
        preprocessing = PreprocessingOptions() if query.features else options.preprocessing
        plan = preprocessing.plan(query.camera)
        super().__init__(query.name, plan, query.read_image, self._own_mask, classes)
        self.query, self.camera = query, plan.processed
        self._mask_margin_px = options.mask_margin_px

    def in_original(self, pose: Pose) -> Pose:
        """Convert a pose's camera and inlier pixels to the original image."""
        if pose.camera is not None:
            camera = self.plan.original_of(pose.camera)
            remark = estimate_remark(camera, self.query.camera)
            pose = replace(pose, camera=camera, remarks=(*pose.remarks, remark))
        if pose.inlier_points_px is not None and self.plan.changes_pixels:
            cameras = self.plan.processed, self.plan.original
            carried = carry_points(*cameras, pose.inlier_points_px)
            pose = replace(pose, inlier_points_px=carried)
        return pose

    def _own_mask(self) -> dict[str, NDArray[np.bool_]]:
        with self._failing_alone():
            mask = self.query.read_mask()
        return {} if mask is None else {"own": mask}

    @property
    def depth(self) -> DepthView | None:
        depth = self.query.depth
        with self._failing_alone():
            return depth if depth is None or isinstance(depth, DepthView) else depth()

    @contextmanager
    def _failing_alone(self) -> Iterator[None]:
        """Blame errors of the mask or the depth on the image, whose query then fails alone."""
        try:
            yield
        except DataError as error:
            if error.path is None or not isinstance(self.query.image, str | Path):
                raise
            raise DataError(str(error), path=self.query.image) from error

    @property
    def feature_mask(self) -> NDArray[np.bool_] | None:
        mask = self.mask
        return None if mask is None else with_margin(mask, self._mask_margin_px)

    def extract(self, extractor: LocalFeatureExtractor) -> LocalFeatures:
        file = self.query.image
        try:
            return extract_all(extractor, [(self.pixels, self.feature_mask)], [self.query.name])[0]
        except DataError as error:  # an image that the extractor rejects fails alone
            if error.path is not None or not isinstance(file, str | Path):
                raise
            raise DataError(error.message, path=file) from error

    def describe(self, extractor: GlobalFeatureExtractor) -> NDArray[np.float32]:
        """Return the global feature, float32 (D,)."""
        return describe_images(extractor, [self.pixels], [self.query.name])[0]


Unit = tuple[tuple[Query, RigidTransform], ...]
"""Queries that are localized together, with the ``cam_from_rig`` of each."""
