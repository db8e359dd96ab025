"""Queries of the localizer: images or given features, pre-processed; those of kapture folders."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.kapture_folders import check_image
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.files import link_images
from megloc_kapture.io.images import read_image_rgb, turned_upright
from megloc_kapture.io.kapture import KaptureData, KaptureFolder
from megloc_kapture.localization.focal_length import estimate_remark
from megloc_kapture.matching.guided_pyramid import equivalent_types
from megloc_kapture.pipeline.kapture_map import KaptureMap, check_lengths
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import (
    SEGMENTERS,
    DepthView,
    GlobalFeatureExtractor,
    LocalFeatureExtractor,
)
from megloc_kapture.preprocessing.frames import FrameOptions, FramePlan, carry_points, plan_frame
from megloc_kapture.preprocessing.masks import with_margin
from megloc_kapture.stages.global_features import describe_images
from megloc_kapture.stages.image_masks import ClassMasks, MaskOptions, ProcessedFrame
from megloc_kapture.stages.local_features import check_size, extract_all, mask_path, read_mask
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.scene import depth_of, query_units
from megloc_kapture.values import Camera, LocalFeatures, Pose, RigidTransform


@dataclass(frozen=True, eq=False)
class Query:
    """One image to localize.

    Parameters
    ----------
    camera : in COLMAP's convention.
    image : uint8 (H, W, 3) RGB or the path of an image file; may be absent where the features
        are given.
    name : what to call it.
    features : keypoints type of the map to local features, keypoints in COLMAP's convention.
        Types that it does not bring are extracted.
    global_features : type name to vector, of the map's types.
    prior : names of the map images it may be matched with; None: all.
    candidates : names of the map images it is matched with, best first, instead of retrieval.
    mask : bool (H, W), True = use, or the path of a mask image (0 = ignore), which may be absent.
    depth : a depth map that was taken with the image, or what reads one; for ``icp``.
    orientation : EXIF's, by which the pixels of an image file are turned upright; the camera is of
        the turned image. 1: they stay as they are stored.
    """

    camera: Camera
    image: Path | str | NDArray[np.uint8] | None = None
    name: str = "query"
    features: Mapping[str, LocalFeatures] = field(default_factory=dict)
    global_features: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    prior: tuple[str, ...] | None = None
    candidates: tuple[str, ...] | None = None
    mask: Path | NDArray[np.bool_] | None = None
    depth: DepthView | Callable[[], DepthView | None] | None = None
    orientation: int = 1

    def read_mask(self) -> NDArray[np.bool_] | None:
        """The mask, bool (H, W), True = use; None where there is none. Raises DataError."""
        shape = (self.camera.height, self.camera.width)
        if isinstance(self.mask, Path):
            return read_mask(self.mask, shape)
        if self.mask is None:
            return None
        mask = np.asarray(self.mask)
        if mask.dtype != np.bool_ or mask.shape != shape:
            raise DataError(
                f"query {self.name}: a mask is bool {shape}, got {mask.dtype} {mask.shape}"
            )
        return mask

    def read_depth(self) -> DepthView | None:
        """The depth map that was taken with the image; None without. Raises DataError."""
        if self.depth is None or isinstance(self.depth, DepthView):
            return self.depth
        return self.depth()

    def has_image(self) -> bool:
        """Whether there is an image to look at, or a file that should be one."""
        if isinstance(self.image, str | Path):
            return Path(self.image).is_file()
        return self.image is not None

    def read_image(self) -> NDArray[np.uint8]:
        """The image as uint8 (H, W, 3) RGB; raises DataError when there is none or it is broken."""
        if self.image is None:
            raise DataError(
                f"query {self.name} has no image, and lacks features of the map's types or is to "
                "be looked at"
            )
        if isinstance(self.image, str | Path):
            image = turned_upright(read_image_rgb(Path(self.image)), self.orientation)
            check_size(image.shape[1::-1], self.camera, self.image)
            return image
        image = np.asarray(self.image)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise DataError(
                f"query {self.name}: an image is uint8 (H, W, 3), got {image.dtype} {image.shape}"
            )
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise DataError(
                f"query {self.name}: the image is {image.shape[1]}x{image.shape[0]}, its camera "
                f"says {self.camera.width}x{self.camera.height}"
            )
        return image


class Preprocessor:
    """Pre-processes query images as the stage of :mod:`megloc_kapture.stages.preprocessing` does.

    Raises
    ------
    OptionError : masks of cameras or files, which belong to folders; a query brings its own.
    """

    def __init__(self, options: PipelineOptions) -> None:
        self._options = options
        self.mask_margin_px = options.mask_margin_px
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


class QueryImage:
    """Camera, pixels, mask and depth of a query after pre-processing, made when first asked for.

    Attributes
    ----------
    camera : the one that would have taken the new image.
    """

    def __init__(self, query: Query, plan: FramePlan, preprocessor: Preprocessor) -> None:
        self.query, self._preprocessor = query, preprocessor
        self.camera: Camera = plan.processed
        self._plan = plan
        self._frame = ProcessedFrame(
            query.name, plan, query.read_image, self._own_mask, lambda: preprocessor.classes
        )

    def in_original(self, pose: Pose) -> Pose:
        """The pose with its camera and its inliers' pixels in the original image."""
        if pose.camera is not None:
            camera = self._plan.original_of(pose.camera)
            remark = estimate_remark(camera, self.query.camera)
            pose = replace(pose, camera=camera, remarks=(*pose.remarks, remark))
        if pose.inlier_points_px is not None and self._plan.changes_pixels:
            cameras = self._plan.processed, self._plan.original
            carried = carry_points(*cameras, pose.inlier_points_px)
            pose = replace(pose, inlier_points_px=carried)
        return pose

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

        None where all of it is used. Raises DataError.
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
        return extract_all(extractor, [(self.pixels, self.feature_mask)], [self.query.name])[0]

    def describe(self, extractor: GlobalFeatureExtractor) -> NDArray[np.float32]:
        """Its global feature, float32 (D,); raises as :meth:`extract`."""
        return describe_images(extractor, [self.pixels], [self.query.name])[0]


class QueryImages:
    """Images by their names, as a :class:`~megloc_kapture.stages.scene.QueryScene`."""

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


Unit = tuple[tuple[Query, RigidTransform], ...]
"""Queries that are localized together, with the ``cam_from_rig`` of each."""


class KaptureQueries:
    """The images of a kapture folder as queries, with the features it brings; read one by one.

    Its cameras and keypoints are taken to be described as the map describes its own.

    Attributes
    ----------
    names : of the images that can be used, sorted; iterating yields the queries in this order.
    unreadable : names of images that are needed and absent, broken or not of their camera's size,
        to the reason; known after :meth:`check`, so far as headers say it.
    faults : why the features that a query brings cannot be used, known when they have been read;
        such a query has neither features nor candidates.
    """

    def __init__(self, folder: KaptureFolder, kapture_map: KaptureMap) -> None:
        self._folder, self._map = folder, kapture_map
        self._data = folder.read()
        self.names = self._data.image_names()
        self.unreadable: dict[str, str] = {}
        self.faults: dict[str, str] = {}
        self._stored = stored = kapture_map.stored_types()
        wanted = {other for name in stored for other in equivalent_types(name)}
        brought = set(folder.types("keypoints")).intersection(folder.types("descriptors"))
        self._local = {
            name: (folder.keypoints(name), folder.descriptors(name))
            for name in sorted(wanted & brought)
        }
        # what the map says of keypoints of each type; looked up here, not for every query
        self._like = {
            name: kapture_map.keypoints_of(
                next(other for other in equivalent_types(name) if other in stored)
            )
            for name in self._local
        }
        self._globals = {
            name: folder.global_features(name)
            for name in kapture_map.global_types()
            if name in folder.types("global_features")
        }

    def lacking(self, local_type: str) -> str | None:
        """The first image without features that serve a type; None where all bring them."""
        types = [name for name in equivalent_types(local_type) if name in self._local]
        return next(
            (name for name in self.names if not any(name in self._local[t][0] for t in types)), None
        )

    def check(self) -> None:
        """Check all that can be checked without reading features or pixels.

        Raises
        ------
        DataError : there are no images, or none that can be used; features are not as wide as the
            map's, or would be taken for those of a map image.
        """
        self._map.folder.check_features_apart(self._folder)
        if not self.names:
            raise DataError("there are no query images", path=self._folder.root)
        self._check_widths()
        errors = []
        for name in self.names:
            if any(name in keypoints for keypoints, _ in self._local.values()):
                continue
            try:
                check_image(self._folder, name)
            except DataError as error:
                self.unreadable[name] = error.message
                errors.append(error)
        self.names = [name for name in self.names if name not in self.unreadable]
        if not self.names:
            raise errors[0]

    def data(self) -> KaptureData:
        """Sensors, rigs and records."""
        return self._data

    def write_images(self, output: Path) -> None:
        """Make the images and masks of a kapture folder links to these."""
        link_images(self._folder.root, output)

    def _check_widths(self) -> None:
        pairs = [
            (vectors, self._map.folder.global_features(name))
            for name, vectors in self._globals.items()
        ]
        for name, (_, descriptors) in self._local.items():
            described = self._map.folder.types("descriptors")
            theirs = next((other for other in equivalent_types(name) if other in described), None)
            if theirs is not None:
                pairs.append((descriptors, self._map.folder.descriptors(theirs)))
        for own, other in pairs:
            if own.config.dsize != other.config.dsize:
                raise DataError(
                    f"{own.kind} of type {own.type_name!r} have {own.config.dsize} values, "
                    f"the map's {other.config.dsize}",
                    path=self._folder.root,
                )

    def types_of_all(self) -> list[str]:
        """Global-feature types that all queries bring and the map has."""
        return [
            name
            for name, vectors in self._globals.items()
            if all(image in vectors for image in self.names)
        ]

    def units(self, *, rigs: bool) -> list[tuple[str, ...]]:
        """Names of the images that are localized together: with ``rigs`` those of one rig and
        moment, else every image by itself."""
        return [tuple(image for image, _ in unit) for unit in self._units(rigs=rigs)]

    def read_units(self, *, rigs: bool) -> Iterator[Unit]:
        """The queries of :meth:`units`, read one after another."""
        for unit in self._units(rigs=rigs):
            yield tuple((self.query(image), cam_from_rig) for image, cam_from_rig in unit)

    def _units(self, *, rigs: bool) -> Iterator[tuple[tuple[str, RigidTransform], ...]]:
        for unit in query_units(self._data, rigs=rigs):
            if usable := tuple(one for one in unit if one[0] not in self.unreadable):
                yield usable

    def __iter__(self) -> Iterator[Query]:
        return map(self.query, self.names)

    def query(self, name: str) -> Query:
        """The query of a name."""
        candidates: tuple[str, ...] | None = None
        try:
            features = self._features(name)
            of_image = {t: one.read(name) for t, one in self._globals.items() if name in one}
        except DataError as error:
            self.faults[name] = str(error)
            features, of_image, candidates = self._no_features(), {}, ()
        return Query(
            camera=self._map.to_colmap(self._data.camera_of(name)),
            image=self._folder.image_path(name),
            name=name,
            features=features,
            global_features=of_image,
            prior=self._priors[name] if name in self._map.restrictions.priors else None,
            candidates=candidates,
            mask=mask_path(self._folder, name),
            depth=partial(depth_of, self._folder, name) if self._data.records_depth else None,
        )

    @cached_property
    def _priors(self) -> dict[str, tuple[str, ...]]:
        """What the map's dataset permits; queries of one pool share their tuple."""
        images = self._map.images
        found = {}
        for positions, permitted in self._map.restrictions.pools(self.names, images):
            prior = tuple(images[position] for position in permitted)
            found.update(dict.fromkeys((self.names[at] for at in positions), prior))
        return found

    def _features(self, name: str) -> dict[str, LocalFeatures]:
        found = {}
        for needed in self._stored:
            serving = (one for one in equivalent_types(needed) if one in self._local)
            local_type = next((one for one in serving if name in self._local[one][0]), None)
            if local_type is None or local_type in found:
                continue
            keypoints, descriptors = self._local[local_type]
            check_lengths(keypoints, descriptors, name)
            stored = keypoints.read(name)
            found[local_type] = LocalFeatures(
                self._like[local_type].to_colmap(stored),
                np.zeros(len(stored), np.float32),
                descriptors.read(name),
            )
        return found

    def _no_features(self) -> dict[str, LocalFeatures]:
        return {
            local_type: LocalFeatures(
                np.zeros((0, 2), np.float32),
                np.zeros(0, np.float32),
                np.zeros((0, descriptors.config.dsize), descriptors.config.dtype),
            )
            for local_type, (_, descriptors) in self._local.items()
        }
