"""Plugin protocols; ``plugin_loading.py`` loads plugins by name.

A plugin is a class registered under one of the entry-point groups below, as the built-in ones are.
Its instances must be picklable. It may have a class ``Options``, derived from ``values.Options``,
whose instance is the constructor's only argument, and a method ``weights() -> dict[str, str]``: the
sha256 of each weight file by name, which becomes part of a stage's fingerprint and manifest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

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
    """The registered name of a plugin and its options; a plain string sets the name alone.

    A list of one plugin is accepted: ``key=NAME`` and then ``key.options.x=1`` are merged to one.
    """

    name: str
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        if isinstance(value, list | tuple) and len(value) == 1:
            value = value[0]
        return {"name": value} if isinstance(value, str) else value


def chosen_by_name(known: Iterable[PluginChoice], names: Iterable[str]) -> list[dict[str, Any]]:
    """Return the settings of the named plugins: those in ``known``, else the name alone."""
    of_name = {choice.name: choice.model_dump() for choice in known}
    return [of_name.get(name, {"name": name}) for name in names]


class LocalFeatureExtractor(Protocol):
    """Group ``megloc_kapture.local_features``: image to local features.

    An optional ``extract_many(images, masks)`` extracts from images of one size at once and returns
    a list in their order.
    """

    name: str
    """The kapture type name under which its features are stored."""

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        """Extract from an RGB image, uint8 (H, W, 3), only at True pixels of the mask (H, W).

        Raise DataError, without a path, to reject an image, for example if it is too small; guided
        pyramid matching then skips that scale or rotation.
        """


class GlobalFeatureExtractor(Protocol):
    """Group ``megloc_kapture.global_features``: image to one vector, compared by cosine similarity.

    An optional ``describe_many(images)`` returns the vectors, float32 (B, D), of B images of one
    size.
    """

    name: str
    """The kapture type name under which its vectors are stored; it identifies the model."""

    def describe(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Describe an RGB image, uint8 (H, W, 3): float32 (D,), unit length."""


class Matcher(Protocol):
    """Group ``megloc_kapture.matchers``: features of two images to matches.

    An optional ``match_many(a, others)`` returns a list: the matches of image ``a`` with each of
    ``others``, in their order.
    """

    def match(
        self, a: ImageFeatures, b: ImageFeatures
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return matches int64 (K, 2), a row of a and a row of b, and their scores (K,).

        Each row of a or b occurs at most once. Verification begins with the highest scores.
        """


class Segmenter(Protocol):
    """Group ``megloc_kapture.segmenters``: image to a class per pixel."""

    name: str
    """Name of the network, for reports."""
    classes: tuple[str, ...]
    """Name of the class of each label."""
    dynamic: frozenset[str]
    """Classes that are masked by default."""

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return labels uint8 (H, W) of an RGB image, uint8 (H, W, 3)."""


@dataclass(frozen=True, eq=False)
class HypothesisView:
    """One camera of a query under a pose hypothesis.

    Attributes
    ----------
    name : name of the query image.
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
    """A query's pose, estimated from one cluster of map images.

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
    camera : intrinsics of the depth sensor.
    depth_m : float32 (H, W), along the optical axis; 0, negative or NaN where unknown.
    image_from_depth : transform from the frame of the depth camera to the frame of the image's
        camera.
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
    camera : a PINHOLE camera of the image's size.
    mask : bool (H, W), True = use; None means no mask.
    """

    image: NDArray[np.uint8]
    camera: Camera
    cam_from_world: RigidTransform
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class DepthEstimate:
    """Depth of an image by stereo; all three arrays are 0 where the depth is unknown.

    Attributes
    ----------
    depth_m : float32 (H, W), along the optical axis, in the map's unit.
    sigma_m : float32 (H, W), its standard deviation.
    normals : float32 (H, W, 3), unit length, in the camera's frame, towards the camera.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    normals: NDArray[np.float32]


class DepthEstimator(Protocol):
    """Group ``megloc_kapture.depth_estimators``: an image and its neighbours to depth."""

    def estimate(
        self,
        reference: StereoView,
        sources: Sequence[StereoView],
        depth_range_m: tuple[float, float],
    ) -> DepthEstimate:
        """Estimate the depth of the reference's pixels.

        Raise MeglocError for unusable views; the image then gets no depth, and the reason is
        written to ``depth.csv``.

        Parameters
        ----------
        sources : at least one, best first.
        depth_range_m : nearest and farthest possible depth.
        """


class RankingScene(Protocol):
    """Data for rankers and refiners, read on demand."""

    def query_image(self, name: str) -> NDArray[np.uint8]:
        """Return RGB pixels (H, W, 3) of a query image; DataError if they are missing."""

    def query_mask(self, name: str) -> NDArray[np.bool_] | None:
        """Return the mask (H, W) of a query image, True = use, or None."""

    def query_depth(self, name: str) -> DepthView | None:
        """Return the depth map of a query image, or None."""

    def map_image(self, name: str) -> NDArray[np.uint8]:
        """Return RGB pixels (H, W, 3) of a map image; DataError if they are missing."""

    def map_mask(self, name: str) -> NDArray[np.bool_] | None:
        """Return the mask (H, W) of a map image, True = use, or None."""

    def map_depth(self, name: str) -> DepthView | None:
        """Return the depth map of a map image, or None."""

    def map_points(self, name: str) -> NDArray[np.float64]:
        """Return the map points observed by an image, (N, 3), in the world frame."""

    def map_camera(self, name: str) -> Camera:
        """Return the camera of a map image."""

    def map_pose(self, name: str) -> RigidTransform:
        """Return ``cam_from_world`` of a map image."""


class PoseRanker(Protocol):
    """Group ``megloc_kapture.pose_rankers``: pose hypotheses of one query to scores."""

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """Return one score per hypothesis, (H,); higher is better, and the first wins a tie."""


class ImageDistance(Protocol):
    """Group ``megloc_kapture.image_distances``: two aligned images to a distance."""

    def distance(
        self, a: NDArray[np.uint8], b: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> float:
        """Return the distance between two RGB images, uint8 (H, W, 3), over valid pixels (H, W).

        A lower distance means more similar images; it is infinite if too few pixels are valid.
        """


class PoseRefiner(Protocol):
    """Group ``megloc_kapture.pose_refiners``: a pose to a better one, or a reason to keep it."""

    name: str
    """Name of the method, for tables."""

    def refine(
        self,
        query: str,
        camera: Camera,
        cam_from_world: RigidTransform,
        references: Sequence[str],
        scene: RankingScene,
    ) -> PoseRefinement:
        """Refine the pose of one query image.

        ``references`` are map images that may overlap with the query image, best first.
        """


class DatasetAdapter(Protocol):
    """Group ``megloc_kapture.datasets``: a dataset's official layout to kapture folders.

    ``card`` is a ``megloc_kapture.datasets.official.DatasetCard``; ``read`` returns an
    ``OfficialDataset`` of the same module. ``root`` is read-only.
    """

    name: str
    """Name of the dataset on the command line."""
    card: Any
    """Source of the dataset and its layout on disk."""

    def check(self, root: Path) -> None:
        """Check quickly whether ``root`` can be this dataset; DataError if not."""

    def read(self, root: Path, *, allow_missing: bool = False) -> Any:
        """Read the dataset; DataError names the file and line."""


class RenderedDataset(Protocol):
    """Group ``megloc_kapture.rendered_datasets``: a synthetic dataset with its true poses.

    Register it under the name of the dataset whose official layout it writes, or under
    ``synthetic`` if it writes kapture folders.
    """

    version: int
    """Version of the files; increase it when equal options give different files."""

    @property
    def options(self) -> Options:
        """Return all parameters that determine the files."""

    def write(self, root: Path, work: Any) -> Mapping[str, float]:
        """Render the dataset below ``root``; ``work`` is a ``megloc_kapture.stages.work.Work``.

        Return counts for the log. The bytes depend on the options alone. Raise OutputError if the
        files cannot be written.
        """


class StageOfAPlan(Protocol):
    """Group ``megloc_kapture.stages``: a step of a run, see ``megloc_kapture.stages.stage.Stage``.

    Derive a plugin from that class; it then defines the members below.
    """

    name: str
    """Name of the stage in its manifest, its command and its options, ``stages.NAME``."""
    reads: Sequence[str]
    """Inputs, paths in the workspace; the stage runs after the stages that write them."""
    writes: Sequence[str]
    """Outputs, paths in the workspace."""

    def run(self, work: Any) -> Mapping[str, float]:
        """Run the stage with a ``megloc_kapture.stages.stage.StageWork``; return counts."""


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
