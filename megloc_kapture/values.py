"""Plain value types that all layers share: cameras, rigid transforms, features."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import UnionType
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from megloc_kapture.errors import DataError

# numbers of parameters of COLMAP's camera models (formats: colmap doc/cameras.rst)
CAMERA_MODEL_NUM_PARAMS: dict[str, int] = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
}

# the parameters of these models begin with f, cx, cy; those of the other models with fx, fy, cx, cy
ONE_FOCAL_MODELS = frozenset(
    {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
)

# a focal length below this fraction of the image's longer side is not in pixels; that of a
# 220-degree fisheye lens is 0.13
_SHORTEST = 0.02

# `megloc localize`, `Localizer` and `megloc serve` reject poses with a lower confidence;
# benchmarks keep every pose
MIN_CONFIDENCE = 0.6

Device = Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]
"""Device of a network: auto (a GPU if available), cpu, cuda, or cuda:N."""
Precision = Literal["full", "half"]
PixelOriginChoice = Literal["auto", "corner", "centre"]


def listed(value: Any) -> Any:
    """Convert comma-separated names, or a single table, to a tuple."""
    if isinstance(value, str):
        return tuple(name.strip() for name in value.split(","))
    return (value,) if isinstance(value, dict) else value


class Options(BaseModel):
    """Base of all option models: frozen and validated; unknown keys are rejected."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    @model_validator(mode="before")
    @classmethod
    def _as_typed(cls, values: Any) -> Any:
        """Read ``none`` as None where allowed, and comma-separated names as a list."""
        if not isinstance(values, dict):
            return values
        read: dict[str, Any] = {}
        for key, value in values.items():
            annotation = cls.model_fields[key].annotation if key in cls.model_fields else None
            is_union = get_origin(annotation) in (Union, UnionType)
            kinds = get_args(annotation) if is_union else (annotation,)
            # "none" may also be the name of a choice
            may_be_none = type(None) in kinds and not any("none" in get_args(k) for k in kinds)
            if isinstance(value, str) and value == "none" and may_be_none:
                read[key] = None
            elif any(get_origin(k) is tuple and get_args(k)[-1] is Ellipsis for k in kinds):
                read[key] = listed(value)
            else:
                read[key] = value
        return read


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of one camera, as COLMAP defines them.

    Parameters
    ----------
    model : name of a COLMAP camera model, e.g. ``"PINHOLE"``.
    width, height : image size in pixels.
    params : the model's parameters in COLMAP's order; pixels for focal lengths and principal point.
        The centre of the first pixel is (0.5, 0.5).
    focal_deviation : relative standard deviation of the focal length. 0 means that it is known and
        fixed; otherwise the focal length is estimated with the pose.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")  # for cameras in JSON

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    focal_deviation: float = 0.0

    def __post_init__(self) -> None:
        expected = CAMERA_MODEL_NUM_PARAMS.get(self.model)
        if expected is None:
            known = ", ".join(CAMERA_MODEL_NUM_PARAMS)
            raise DataError(f"unknown camera model {self.model!r}; known: {known}")
        try:
            object.__setattr__(self, "width", int(self.width))
            object.__setattr__(self, "height", int(self.height))
            object.__setattr__(self, "params", tuple(float(p) for p in self.params))
            object.__setattr__(self, "focal_deviation", float(self.focal_deviation))
        except (TypeError, ValueError, OverflowError) as error:  # for example a matrix K
            message = f"camera model {self.model}: sizes, params and deviation must be numbers"
            raise DataError(message) from error
        if len(self.params) != expected:
            raise DataError(
                f"camera model {self.model} takes {expected} parameters, got {len(self.params)}"
            )
        if self.width <= 0 or self.height <= 0:
            raise DataError(f"image size {self.width}x{self.height} is not positive")
        if not np.isfinite(self.params).all():
            raise DataError("camera parameters must be finite")
        focals = self.params[: 1 if self.model in ONE_FOCAL_MODELS else 2]
        if min(focals) <= 0:
            raise DataError(f"focal length {min(focals)} is not positive")
        if not (math.isfinite(self.focal_deviation) and self.focal_deviation >= 0):
            raise DataError(f"focal_deviation {self.focal_deviation} is negative or not finite")

    @classmethod
    def pinhole(cls, width: int, height: int, focal: float) -> Camera:
        """Create a camera without distortion and with a centred principal point; focal in px."""
        return cls("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))

    @classmethod
    def from_colmap(cls, camera: Any) -> Camera:
        """Convert a ``pycolmap.Camera``; DataError for an unsupported model."""
        return cls(camera.model.name, camera.width, camera.height, tuple(camera.params))


def check_camera(camera: Any) -> None:
    """Raise DataError for a matrix K or anything else that is not a :class:`Camera` in pixels."""
    if not isinstance(camera, Camera):
        raise DataError(
            "a camera must be a megloc_kapture.Camera (Camera.from_colmap converts pycolmap's), "
            f"got {type(camera)}"
        )
    if camera.params[0] < _SHORTEST * max(camera.width, camera.height):
        raise DataError(
            f"focal length {camera.params[0]:g} of a {camera.width}x{camera.height} image: give "
            "pixels, not millimetres or fractions of the image's size"
        )


@dataclass(frozen=True, slots=True)
class RigidTransform:
    """Rotation and translation: ``x_a = R x_b + t`` for a transform named ``a_from_b``.

    Parameters
    ----------
    quat_wxyz : unit quaternion (Hamilton), w first.
    translation : in the unit of the world (metres for metric maps).
    """

    quat_wxyz: tuple[float, float, float, float]
    translation: tuple[float, float, float]

    @classmethod
    def identity(cls) -> RigidTransform:
        return cls((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    @classmethod
    def from_matrix(
        cls, rotation: NDArray[np.float64], translation: NDArray[np.float64]
    ) -> RigidTransform:
        """Create a transform from a rotation matrix (3, 3) and a translation (3,)."""
        matrix = np.asarray(rotation, dtype=np.float64)
        if matrix.shape != (3, 3):
            raise DataError(f"a rotation matrix must have the shape (3, 3), got {matrix.shape}")
        is_orthonormal = np.abs(matrix.T @ matrix - np.eye(3)).max() <= 0.01  # False for nan
        if not is_orthonormal or np.linalg.det(matrix) < 0:
            raise DataError(f"not a rotation matrix: {matrix.tolist()}")
        (a, b, c), (d, e, f), (g, h, i) = matrix
        # the quaternion is the eigenvector of the largest eigenvalue of a symmetric 4x4 matrix;
        # this is numerically stable for every rotation
        k = np.array(
            [
                [a + e + i, 0.0, 0.0, 0.0],
                [h - f, a - e - i, 0.0, 0.0],
                [c - g, b + d, e - a - i, 0.0],
                [d - b, c + g, f + h, i - a - e],
            ]
        )
        _, vectors = np.linalg.eigh(k / 3.0)  # reads the lower triangle
        quat = vectors[:, -1]
        quat = quat if quat[0] >= 0 else -quat
        qw, qx, qy, qz = (quat / np.linalg.norm(quat)).tolist()
        tx, ty, tz = np.asarray(translation, dtype=np.float64).reshape(3).tolist()
        return cls((qw, qx, qy, qz), (tx, ty, tz))

    def rotation_matrix(self) -> NDArray[np.float64]:
        """Return the rotation as float64 (3, 3)."""
        w, x, y, z = self.quat_wxyz
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )

    def matrix(self) -> NDArray[np.float64]:
        """Return the transform as float64 (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation_matrix(), self.translation
        return matrix

    def inverse(self) -> RigidTransform:
        """Return ``b_from_a`` for a transform ``a_from_b``."""
        w, x, y, z = self.quat_wxyz
        turned = RigidTransform((w, -x, -y, -z), (0.0, 0.0, 0.0))
        tx, ty, tz = turned._applied(self.translation)
        return RigidTransform(turned.quat_wxyz, (-tx, -ty, -tz))

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """Compose: ``a_from_b @ b_from_c`` is ``a_from_c``."""
        w1, x1, y1, z1 = self.quat_wxyz
        w2, x2, y2, z2 = other.quat_wxyz
        w = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2
        x = w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
        y = w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2
        z = w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        translation = self._applied(other.translation)
        return RigidTransform((w / norm, x / norm, y / norm, z / norm), translation)

    def scaled(self, scale: float) -> RigidTransform:
        """Return the transform between frames whose coordinates are ``scale`` times as large."""
        x, y, z = (scale * float(value) for value in self.translation)
        return RigidTransform(self.quat_wxyz, (x, y, z))

    def _applied(self, point: tuple[float, float, float]) -> tuple[float, float, float]:
        """Transform one point, bit-identical on every processor (unlike BLAS)."""
        px, py, pz = point
        (tx, ty, tz), rotation = self.translation, self.rotation_matrix().tolist()
        x, y, z = (row[0] * px + row[1] * py + row[2] * pz for row in rotation)
        return x + tx, y + ty, z + tz

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform points of shape (N, 3)."""
        # einsum, not BLAS, whose last bits depend on the processor
        turned = np.einsum("...j,ij->...i", points, self.rotation_matrix())
        return turned + np.array(self.translation)

    def center(self) -> NDArray[np.float64]:
        """Return the camera centre of a ``cam_from_world``, float64 (3,), in the world frame."""
        return np.array(self.inverse().translation)


@dataclass(frozen=True, slots=True)
class LocalFeatures:
    """Local features of one image.

    Parameters
    ----------
    keypoints_px : float32 (N, 2 or more); x, y first. The first pixel's centre is (0.5, 0.5).
    scores : float32 (N,), higher is better; all arrays are sorted by score, best first.
    descriptors : (N, D), float32 or uint8.
    num_masked : number of keypoints that the mask removed, before the best were selected.
    """

    keypoints_px: NDArray[np.float32]
    scores: NDArray[np.float32]
    descriptors: NDArray[Any]
    num_masked: int = 0


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """Features of one image as a matcher's input.

    Parameters
    ----------
    keypoints_px : float32 (N, 2 or more); x, y first, then other stored columns, such as the score
        of SuperPoint. The first pixel's centre is (0.5, 0.5).
    descriptors : (N, D).
    width, height : size of the image in pixels.
    """

    keypoints_px: NDArray[np.float32]
    descriptors: NDArray[Any]
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class PoseRefinement:
    """Result of a pose refinement.

    Attributes
    ----------
    cam_from_world : the refined pose, or the old one if rejected.
    reason : reason for rejection; empty if accepted.
    measures : numbers by name for tables, such as residuals before and after.
    covariance : as in :class:`Pose`, or None.
    method : name of the refiner.
    before : ``cam_from_world`` before the refinement.
    moved_m, turned_deg : displacement of the pose by the refinement, 0 if it is rejected.

    The last four fields are set by :mod:`megloc_kapture.stages.pose_refinement`, not by refiners.
    """

    cam_from_world: RigidTransform
    reason: str = ""
    measures: Mapping[str, float] = field(default_factory=dict)
    covariance: NDArray[np.float64] | None = None
    method: str = ""
    before: RigidTransform | None = None
    moved_m: float = 0.0
    turned_deg: float = 0.0

    @property
    def accepted(self) -> bool:
        return not self.reason


Fallback = Literal["none", "retrieval", "rig"]


@dataclass(frozen=True, kw_only=True)
class LocalizationResult:
    """Outcome of localizing one query: a :class:`Pose` or a :class:`Failure`.

    The tables of results are written from it (:mod:`megloc_kapture.io.tables`). A result that is
    read from ``status.csv`` alone has neither pose nor arrays.

    Attributes
    ----------
    cam_from_world : the pose, COLMAP axes; None if there is no pose.
    reason : reason why the query has no trusted pose; empty for a pose.
    num_matches, num_inliers : numbers of 2D-3D matches and of inliers among them. For a failure,
        those of the cluster that ranks first. None if the result comes from a pose file.
    confidence : probability that the pose is correct: the pose before refinement, or the rejected
        pose of a failure. None if not requested.
    candidates : matched map images of the result's cluster, best first.
    clusters : results of all tried clusters of candidates, before refinement; the cluster of the
        best candidate comes first.
    cluster : index of the result's cluster in ``clusters``.
    score : ranking score of a cluster's pose, higher is better.
    refinements : results of the pose refiners, in their order.
    remarks : skipped steps, with the data that the query or map lacks, and doubts about the focal
        length.
    fallback : source of the pose that a failed query gets: ``retrieval`` for the pose of its best
        candidate, ``rig`` for the pose of another camera of its rig, moved by the rig's geometry.
    seconds : duration of each step by name, from feature extraction on.
    name : name of the query.
    """

    cam_from_world: RigidTransform | None = None
    reason: str = ""
    num_matches: int | None = None
    num_inliers: int | None = None
    confidence: float | None = None
    candidates: tuple[str, ...] = ()
    clusters: tuple[LocalizationResult, ...] = ()
    cluster: int | None = None
    score: float | None = None
    refinements: tuple[PoseRefinement, ...] = ()
    remarks: tuple[str, ...] = ()
    fallback: Fallback = "none"
    seconds: Mapping[str, float] = field(default_factory=dict, compare=False)
    name: str = field(default="", compare=False)

    @property
    def status(self) -> Literal["localized", "failed"]:
        return "failed" if self.reason else "localized"


@dataclass(frozen=True, eq=False)
class Pose(LocalizationResult):
    """A localized query; truthy. See :class:`LocalizationResult`.

    Attributes
    ----------
    inliers : bool (num_matches,) or None.
    inlier_points_px, inlier_points_world : float64 (num_inliers, 2) and (num_inliers, 3), in the
        query's pixels and in the map; None if not kept.
    covariance : float64 (6, 6) or None: rotation in radians, then translation in the map's unit, of
        a left perturbation of ``cam_from_world``. It covers noise of keypoints and points, but no
        errors of map poses and calibration, which are larger on real scenes.
    camera : camera with the focal length that was estimated with the pose, and its deviation; None
        if the focal length was known.
    evidence : terms of the confidence, see :mod:`megloc_kapture.localization.confidence`.
    """

    cam_from_world: RigidTransform
    num_matches: int = 0
    num_inliers: int = 0
    inliers: NDArray[np.bool_] | None = None
    inlier_points_px: NDArray[np.float64] | None = None
    inlier_points_world: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None
    camera: Camera | None = None
    evidence: Mapping[str, float] = field(default_factory=dict)

    def __bool__(self) -> Literal[True]:
        return True

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Return ``cam_from_world`` as a matrix (4, 4)."""
        return self.cam_from_world.matrix()


@dataclass(frozen=True)
class Failure(LocalizationResult):
    """A query without a trusted pose; falsy, with a ``reason``. See :class:`LocalizationResult`."""

    reason: str
    num_matches: int = 0
    num_inliers: int = 0

    def __bool__(self) -> Literal[False]:
        return False
