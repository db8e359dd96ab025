"""Plugin protocols; ``plugin_loading.py`` loads plugins by name.

A plugin is a class registered under one of the entry-point groups below, like those of this
package. It must be picklable, and may have ``Options``, a frozen pydantic model for its
constructor, and ``weights() -> dict[str, str]``, the sha256 of each weight file by name, which is
part of a stage's fingerprint and manifest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from megloc_kapture.plugin_names import STAGES as STAGES
from megloc_kapture.values import Camera, ImageFeatures, LocalFeatures, Options, RigidTransform
from megloc_kapture.values import PoseRefinement as PoseRefinement

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


class PluginChoice(Options):
    """A plugin by its registered name, and its options; a string is the name alone."""

    name: str
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value


def chosen_by_name(known: Iterable[PluginChoice], names: Iterable[str]) -> list[dict[str, Any]]:
    """Choose plugins by name, with their known settings."""
    of_name = {choice.name: choice.model_dump() for choice in known}
    return [of_name.get(name, {"name": name}) for name in names]


@runtime_checkable
class LocalFeatureExtractor(Protocol):
    """Group ``megloc_kapture.local_features``: image to local features.

    An optional ``extract_many(images, masks)`` extracts from images of one size at once and returns
    a list in their order.
    """

    name: str
    """The kapture type name its features are stored under."""

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image, uint8 (H, W, 3), only on True pixels of the mask (H, W).

        Raise DataError to reject an image, for example if it is too small; guided pyramid matching
        then skips that scale.
        """
        ...


@runtime_checkable
class GlobalFeatureExtractor(Protocol):
    """Group ``megloc_kapture.global_features``: image to one vector, compared by cosine.

    An optional ``describe_many(images)`` returns the vectors, float32 (B, D), of B images of one
    size.
    """

    name: str
    """The kapture type name its vectors are stored under, which identifies the model."""

    def describe(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Describe an RGB image, uint8 (H, W, 3): float32 (D,), unit length."""
        ...


@runtime_checkable
class Matcher(Protocol):
    """Group ``megloc_kapture.matchers``: features of two images to matches.

    An optional ``match_many(a, others)`` returns the matches of one image with each of several, in
    order.
    """

    def match(
        self, a: ImageFeatures, b: ImageFeatures
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return matches int64 (K, 2), rows of a and b, each at most once, and scores (K,).

        Verification begins with the highest scores.
        """
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Group ``megloc_kapture.segmenters``: image to a class per pixel."""

    name: str
    """The network, for reports."""
    classes: tuple[str, ...]
    """Name of each label."""
    dynamic: frozenset[str]
    """Classes that are masked by default."""

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return labels uint8 (H, W) of an RGB image, uint8 (H, W, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class HypothesisView:
    """One camera of a query under a pose hypothesis.

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
    views : the query's cameras: one, or those of a rig.
    max_error_px : inlier threshold of the reprojection error.
    """

    images: tuple[str, ...]
    views: tuple[HypothesisView, ...]
    max_error_px: float


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth map of an image.

    Attributes
    ----------
    camera : of the depth sensor.
    depth_m : float32 (H, W), along the optical axis; 0, negative or NaN where unknown.
    image_from_depth : from the depth camera's frame to that of the image.
    """

    camera: Camera
    depth_m: NDArray[np.float32]
    image_from_depth: RigidTransform


@dataclass(frozen=True, eq=False)
class StereoView:
    """An undistorted image for stereo.

    Attributes
    ----------
    image : uint8 (H, W, 3), RGB.
    camera : PINHOLE, of that size.
    mask : bool (H, W), True = use; None means no mask.
    """

    image: NDArray[np.uint8]
    camera: Camera
    cam_from_world: RigidTransform
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class DepthEstimate:
    """Depth of an image by stereo; 0 in all three where unknown.

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
    """Group ``megloc_kapture.depth_estimators``: an image and its neighbours to depth."""

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        """Estimate the depth of the reference's pixels.

        Raise MeglocError for unusable views; the image then stays without depth, with the reason.

        Parameters
        ----------
        sources : at least one, best first.
        depth_range_m : nearest and farthest possible depth.
        """
        ...


class RankingScene(Protocol):
    """Data for rankers and refiners, read on demand."""

    def query_image(self, name: str) -> NDArray[np.uint8]:
        """Return RGB pixels (H, W, 3) of a query image; raise DataError if it has none."""
        ...

    def query_mask(self, name: str) -> NDArray[np.bool_] | None:
        """Return the mask (H, W) of a query image, True = use, or None."""
        ...

    def query_depth(self, name: str) -> DepthView | None:
        """Return the depth map of a query image, or None."""
        ...

    def map_image(self, name: str) -> NDArray[np.uint8]:
        """Return RGB pixels (H, W, 3) of a map image; raise DataError if it has none."""
        ...

    def map_mask(self, name: str) -> NDArray[np.bool_] | None:
        """Return the mask (H, W) of a map image, True = use, or None."""
        ...

    def map_depth(self, name: str) -> DepthView | None:
        """Return the depth map of a map image, or None."""
        ...

    def map_points(self, name: str) -> NDArray[np.float64]:
        """Return the map points observed by an image, in the world, (N, 3)."""
        ...

    def map_camera(self, name: str) -> Camera:
        """Return the camera of a map image."""
        ...

    def map_pose(self, name: str) -> RigidTransform:
        """Return ``cam_from_world`` of a map image."""
        ...


@runtime_checkable
class PoseRanker(Protocol):
    """Group ``megloc_kapture.pose_rankers``: pose hypotheses of one query to scores."""

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """Return one score (H,) per hypothesis, higher is better; the first wins a tie."""
        ...


@runtime_checkable
class ImageDistance(Protocol):
    """Group ``megloc_kapture.image_distances``: two aligned images to a distance."""

    name: str
    """The measure, for reports."""

    def distance(
        self, a: NDArray[np.uint8], b: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> float:
        """Return the distance of two RGB images, uint8 (H, W, 3), over valid pixels (H, W).

        Lower is more similar; infinite for too few valid pixels.
        """
        ...


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

        ``references`` are map images that may overlap with it, best first.
        """
        ...


@runtime_checkable
class DatasetAdapter(Protocol):
    """Group ``megloc_kapture.datasets``: a dataset's official layout to kapture folders.

    ``card`` is a ``megloc_kapture.datasets.official.DatasetCard``, ``read`` returns an
    ``OfficialDataset`` of the same module. ``root`` is read-only.
    """

    name: str
    """The dataset, as on the command line."""
    card: Any
    """Its source and its layout on disk."""

    def check(self, root: Path) -> None:
        """Check quickly whether ``root`` can be this dataset; DataError if not."""
        ...

    def read(self, root: Path, *, allow_missing: bool = False) -> Any:
        """Read the dataset; DataError names file and line."""
        ...


@runtime_checkable
class RenderedDataset(Protocol):
    """Group ``megloc_kapture.rendered_datasets``: a synthetic dataset with its true poses.

    The name is that of the dataset with the same official layout, or ``synthetic`` for kapture
    folders.
    """

    version: int
    """Version of the files; increase it when equal options give other files."""

    @property
    def options(self) -> Options:
        """Return all parameters of its files."""
        ...

    def write(self, root: Path, work: Any) -> Mapping[str, float]:
        """Render it below ``root``, with a ``megloc_kapture.stages.work.Work``; return counts.

        The bytes depend on the options alone. OutputError if the files cannot be written.
        """
        ...


@runtime_checkable
class StageOfAPlan(Protocol):
    """Group ``megloc_kapture.stages``: a step of a run, see ``megloc_kapture.stages.stage.Stage``.

    A subclass of that class defines name, inputs, outputs and work of the stage.
    """

    name: str
    """Name in its manifest, its command and its options, ``stages.NAME``."""
    reads: Sequence[str]
    """Paths in the workspace; it runs after the stages that write them."""
    writes: Sequence[str]
    """Paths in the workspace."""

    def run(self, work: Any) -> Mapping[str, float]:
        """Run it with a ``megloc_kapture.stages.stage.StageWork``; return counts for the log."""
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
