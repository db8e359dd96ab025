"""The protocols of plugins; ``plugin_loading.py`` finds a plugin by its name.

A plugin is a class registered under one of the entry-point groups below; our own are registered
in the same way. A class may carry ``Options``, a frozen pydantic model its constructor takes, and
``weights() -> dict[str, str]``, the sha256 of each file of weights it uses by name: part of what a
stage's result depends on, and kept in its manifest. Plugins are sent to worker processes, so they
must be picklable.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from megloc_kapture.values import Camera, ImageFeatures, LocalFeatures, Options, RigidTransform

LOCAL_FEATURES = "megloc_kapture.local_features"
MATCHERS = "megloc_kapture.matchers"
GLOBAL_FEATURES = "megloc_kapture.global_features"
SEGMENTERS = "megloc_kapture.segmenters"
DEPTH_ESTIMATORS = "megloc_kapture.depth_estimators"
POSE_RANKERS = "megloc_kapture.pose_rankers"
IMAGE_DISTANCES = "megloc_kapture.image_distances"
POSE_REFINERS = "megloc_kapture.pose_refiners"
DATASETS = "megloc_kapture.datasets"
RENDERED_DATASETS = "megloc_kapture.rendered_datasets"
STAGES = "megloc_kapture.stages"


class PluginChoice(Options):
    """A plugin by its registered name, and its options; a text stands for the name alone."""

    name: str
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value


def chosen_by_name(known: Iterable[PluginChoice], names: Iterable[str]) -> list[dict[str, Any]]:
    """Choices of plugins by their names, each with the settings that it is known with, if any."""
    of_name = {one.name: one.model_dump() for one in known}
    return [of_name.get(name, {"name": name}) for name in names]


@runtime_checkable
class LocalFeatureExtractor(Protocol):
    """Group ``megloc_kapture.local_features``: image to local features.

    An extractor that is faster on several images at once may have ``extract_many(images, masks)``,
    the features of images of one size, as a list in their order.
    """

    name: str
    """The kapture type name its features are stored under."""

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Features of an RGB image, uint8 (H, W, 3); none on False pixels of the mask (H, W).

        Raises DataError where it refuses an image, for example one that is too small: guided
        pyramid matching then does without that scale.
        """
        ...


@runtime_checkable
class GlobalFeatureExtractor(Protocol):
    """Group ``megloc_kapture.global_features``: image to one vector that is compared by cosine.

    An extractor that is faster on several images at once may have ``describe_many(images)``, the
    vectors float32 (B, D) of B images of one size, in their order.
    """

    name: str
    """The kapture type name its vectors are stored under; it tells the model as well."""

    def describe(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The vector of an RGB image, uint8 (H, W, 3): float32 (D,), unit length."""
        ...


@runtime_checkable
class Matcher(Protocol):
    """Group ``megloc_kapture.matchers``: the features of two images to matches.

    A matcher that is faster on several pairs at once may have ``match_many(a, others)``, the
    matches of one image with each of several, as a list in their order.
    """

    def match(
        self, a: ImageFeatures, b: ImageFeatures
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Matches int64 (K, 2), rows of a and b, each row at most once, and scores (K,): the surest
        matches have the greatest, with which verification begins."""
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Group ``megloc_kapture.segmenters``: image to a class per pixel."""

    name: str
    """The network, for reports."""
    classes: tuple[str, ...]
    """Name of each label."""
    dynamic: frozenset[str]
    """Classes whose pixels are masked unless the options say otherwise."""

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Labels uint8 (H, W) of an RGB image, uint8 (H, W, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class HypothesisView:
    """One camera of a query under a pose that might be right.

    Attributes
    ----------
    name : of the query image.
    points_px, points_world : float64 (N, 2) and (N, 3), the 2D-3D matches.
    errors_px : float64 (N,), reprojection errors; infinite behind the camera.
    inliers : bool (N,).
    """

    name: str
    camera: Camera
    cam_from_world: RigidTransform
    points_px: NDArray[np.float64]
    points_world: NDArray[np.float64]
    errors_px: NDArray[np.float64]
    inliers: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """The pose of one cluster of map images.

    Attributes
    ----------
    images : the cluster's map images that match the query, best first.
    views : the cameras of the query: one, or those of a rig.
    max_error_px : reprojection error of an inlier.
    """

    images: tuple[str, ...]
    views: tuple[HypothesisView, ...]
    max_error_px: float


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth map that was taken with an image.

    Attributes
    ----------
    camera : of the depth sensor.
    depth_m : float32 (H, W), along the optical axis; 0, less or NaN where nothing is known.
    image_from_depth : from the depth camera's frame to that of the image.
    """

    camera: Camera
    depth_m: NDArray[np.float32]
    image_from_depth: RigidTransform


@dataclass(frozen=True, eq=False)
class StereoView:
    """An image without distortion, for stereo.

    Attributes
    ----------
    image : uint8 (H, W, 3), RGB.
    camera : PINHOLE, of that size.
    mask : bool (H, W), True = use; None: all of it.
    """

    image: NDArray[np.uint8]
    camera: Camera
    cam_from_world: RigidTransform
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class DepthEstimate:
    """Depth of an image by stereo; 0 in all three where nothing is known.

    Attributes
    ----------
    depth_m : float32 (H, W), along the optical axis, in the map's unit.
    sigma_m : float32 (H, W), its standard deviation.
    normals : float32 (H, W, 3), unit length, in the camera's frame, towards the camera.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    normals: NDArray[np.float32]


@runtime_checkable
class DepthEstimator(Protocol):
    """Group ``megloc_kapture.depth_estimators``: an image and its neighbours to its depth."""

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        """Depth of the reference's pixels.

        Parameters
        ----------
        sources : at least one, best first.
        depth_range_m : nearest and farthest depth there may be.

        Raises
        ------
        MeglocError : the views cannot be used; the image stays without depth, with the reason.
        """
        ...


class RankingScene(Protocol):
    """What rankers and refiners may look at beside the matches; read only when asked for."""

    def query_image(self, name: str) -> NDArray[np.uint8]:
        """RGB pixels (H, W, 3) of a query image; raises DataError where there are none."""
        ...

    def query_mask(self, name: str) -> NDArray[np.bool_] | None:
        """Mask (H, W) of a query image, True = use; None without one."""
        ...

    def query_depth(self, name: str) -> DepthView | None:
        """Depth that was taken with a query image; None without."""
        ...

    def map_image(self, name: str) -> NDArray[np.uint8]:
        """RGB pixels (H, W, 3) of a map image; raises DataError where there are none."""
        ...

    def map_mask(self, name: str) -> NDArray[np.bool_] | None:
        """Mask (H, W) of a map image, True = use; None without one."""
        ...

    def map_depth(self, name: str) -> DepthView | None:
        """Depth that was taken with a map image; None without."""
        ...

    def map_points(self, name: str) -> NDArray[np.float64]:
        """Points of the map that an image observes, in the world, (N, 3)."""
        ...

    def map_camera(self, name: str) -> Camera:
        """Camera of a map image."""
        ...

    def map_pose(self, name: str) -> RigidTransform:
        """``cam_from_world`` of a map image."""
        ...


@runtime_checkable
class PoseRanker(Protocol):
    """Group ``megloc_kapture.pose_rankers``: which of several poses of one query is right."""

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """One score (H,) per hypothesis, higher is better; of equals the first wins."""
        ...


@runtime_checkable
class ImageDistance(Protocol):
    """Group ``megloc_kapture.image_distances``: how different two aligned images look."""

    name: str
    """The measure, for reports."""

    def distance(
        self, a: NDArray[np.uint8], b: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> float:
        """Distance of two RGB images of one size, uint8 (H, W, 3), over valid pixels (H, W).

        Lower is more alike; infinite where too little is valid to tell.
        """
        ...


@dataclass(frozen=True, eq=False)
class PoseRefinement:
    """What refining a pose came to.

    Attributes
    ----------
    cam_from_world : the better pose, or the old one where ``reason`` says why it stays.
    reason : empty where the new pose is accepted.
    measures : numbers by name, e.g. residuals and overlap before and after; for tables.
    covariance : as of :class:`~megloc_kapture.values.Pose`, or None.
    """

    cam_from_world: RigidTransform
    reason: str = ""
    measures: Mapping[str, float] = field(default_factory=dict)
    covariance: NDArray[np.float64] | None = None

    @property
    def accepted(self) -> bool:
        """Whether the pose is a new one."""
        return not self.reason


@runtime_checkable
class PoseRefiner(Protocol):
    """Group ``megloc_kapture.pose_refiners``: a pose to a better one, or a reason to keep it."""

    name: str
    """The method, for tables."""

    def refine(
        self,
        query: str,
        camera: Camera,
        cam_from_world: RigidTransform,
        references: Sequence[str],
        scene: RankingScene,
    ) -> PoseRefinement:
        """Refine the pose of one query image.

        Parameters
        ----------
        references : map images that may show the same, best first.
        """
        ...


@runtime_checkable
class DatasetAdapter(Protocol):
    """Group ``megloc_kapture.datasets``: a dataset's official layout to kapture folders.

    ``card`` is a ``megloc_kapture.datasets.official.DatasetCard``, ``read`` returns an
    ``OfficialDataset`` of the same module. Nothing is ever written below ``root``.
    """

    name: str
    """The dataset, as on the command line."""
    card: Any
    """Where it is published and how it lies on disk."""

    def check(self, root: Path) -> None:
        """Raise DataError, quickly, when ``root`` cannot be this dataset."""
        ...

    def input_files(self, root: Path) -> Iterator[Path]:
        """Every file an import of ``root`` may depend on, images included; cheap to list."""
        ...

    def read(self, root: Path, *, allow_missing: bool = False) -> Any:
        """Read the dataset; raises DataError that names file and line."""
        ...


@runtime_checkable
class RenderedDataset(Protocol):
    """Group ``megloc_kapture.rendered_datasets``: a dataset that is drawn, its true poses with it.

    Registered under the name of the dataset in whose official layout it is written, or
    ``synthetic`` for kapture folders.
    """

    version: int
    """Of the files; raised when the same options draw others than before."""

    @property
    def options(self) -> Options:
        """Everything that determines its files."""
        ...

    def write(self, root: Path, work: Any) -> Mapping[str, float]:
        """Render it below ``root``, with a ``megloc_kapture.stages.work.Work``; returns counts.

        The bytes depend on the options alone. Raises OutputError where nothing can be written.
        """
        ...


@runtime_checkable
class StageOfAPlan(Protocol):
    """Group ``megloc_kapture.stages``: a step of a run, see ``megloc_kapture.stages.stage.Stage``.

    Deriving from that class leaves four things to say: what the stage is called, what it reads and
    writes in a workspace, and what it does.
    """

    name: str
    """Of its manifest, its command and its options, ``stages.NAME``."""
    reads: Sequence[str]
    """Paths in the workspace; it runs behind the stages that write them."""
    writes: Sequence[str]
    """Paths in the workspace."""

    def run(self, work: Any) -> Mapping[str, float]:
        """Do it, with a ``megloc_kapture.stages.stage.StageWork``; returns counts for the log."""
        ...


PROTOCOLS: dict[str, type] = {
    LOCAL_FEATURES: LocalFeatureExtractor,
    GLOBAL_FEATURES: GlobalFeatureExtractor,
    MATCHERS: Matcher,
    SEGMENTERS: Segmenter,
    DEPTH_ESTIMATORS: DepthEstimator,
    POSE_RANKERS: PoseRanker,
    IMAGE_DISTANCES: ImageDistance,
    POSE_REFINERS: PoseRefiner,
    DATASETS: DatasetAdapter,
    RENDERED_DATASETS: RenderedDataset,
    STAGES: StageOfAPlan,
}
