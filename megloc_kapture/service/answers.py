"""What a service is asked and answers, as JSON; the models are those of its OpenAPI page."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from megloc_kapture.errors import DataError
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, ONE_FOCAL_MODELS, Camera, Failure, Pose

_MAX_SIDE_PX = 100_000
# beyond these no lens is, and the solvers' numbers overflow
_FOCAL_OF_SIDE, _CENTRE_OF_SIDE, _MAX_DISTORTION = (0.01, 1000.0), 10.0, 100.0

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class CameraModel(BaseModel):
    """A camera as COLMAP describes it; the centre of the first pixel is (0.5, 0.5)."""

    model_config = ConfigDict(extra="forbid", strict=True)

    model: str = Field(description=f"one of {', '.join(CAMERA_MODEL_NUM_PARAMS)}", max_length=40)
    width: int = Field(ge=1, le=_MAX_SIDE_PX, description="of the image as it is stored, pixels")
    height: int = Field(ge=1, le=_MAX_SIDE_PX)
    params: list[float] = Field(
        max_length=12, description="in COLMAP's order; focal lengths and principal point in pixels"
    )

    def camera(self) -> Camera:
        """The camera; raises DataError where there can be none of this kind."""
        camera = Camera(self.model, self.width, self.height, tuple(self.params))
        num_focals = 1 if self.model in ONE_FOCAL_MODELS else 2
        side = max(self.width, self.height)
        focals, centre = self.params[:num_focals], self.params[num_focals : num_focals + 2]
        least, most = (times * side for times in _FOCAL_OF_SIDE)
        if not least <= min(focals) <= max(focals) <= most:
            raise DataError(f"camera: no lens of this image has a focal length of {focals} px")
        if max(map(abs, centre)) > _CENTRE_OF_SIDE * side:
            raise DataError(f"camera: the principal point {centre} is far out of the image")
        if max(map(abs, self.params[num_focals + 2 :]), default=0.0) > _MAX_DISTORTION:
            raise DataError("camera: no lens distorts like this")
        return camera


class Transform(BaseModel):
    """A rigid transform: x_cam = R x_world + t; axes as in COLMAP: x right, y down, z forward."""

    quat_wxyz: Annotated[list[float], Field(min_length=4, max_length=4)]
    translation: Vector = Field(description="in the unit of the map")


class Answer(BaseModel):
    """What became of an image: a pose, or the reason why there is none."""

    localized: bool
    reason: str | None = Field(description="why there is no pose")
    cam_from_world: Transform | None
    camera_center: Vector | None = Field(description="in the map")
    covariance: list[list[float]] | None = Field(
        description="6 by 6: rotation in radians, then translation in the unit of the map, of a "
        "left perturbation of cam_from_world"
    )
    confidence: float | None = Field(description="the probability that the pose is right")
    num_matches: int
    num_inliers: int
    candidates: list[str] = Field(description="map images that took part, best first")
    remarks: list[str]
    frame: str | None = Field(
        description="the coordinate frame of the pose, where the map has some"
    )
    camera: CameraModel = Field(
        description="the camera of the pose: that of the request; without one by EXIF, its focal "
        "length estimated with the pose, of the image the right way up"
    )


class Refused(BaseModel):
    """Why a request has no answer."""

    error: str


def read_camera(text: str) -> Camera:
    """A camera from JSON; raises DataError, which says what is wrong."""
    try:
        return CameraModel.model_validate_json(text).camera()
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"][:2])
        raise DataError(f"camera{f'.{where[:40]}' if where else ''}: {first['msg']}") from error


def answer_of(found: Pose | Failure, camera: Camera, frame: str = "") -> dict[str, Any]:
    """What :class:`Answer` holds of a result; numbers as they are, none that JSON cannot say.

    Parameters
    ----------
    frame : of the pose; "" where the map has only one.
    """
    pose = found.cam_from_world if isinstance(found, Pose) else None
    if isinstance(found, Pose) and found.camera is not None:
        camera = found.camera
    covariance = found.covariance if isinstance(found, Pose) else None
    return {
        "localized": bool(found),
        "reason": found.reason if isinstance(found, Failure) else None,
        "cam_from_world": None
        if pose is None
        else {"quat_wxyz": list(pose.quat_wxyz), "translation": list(pose.translation)},
        "camera_center": None if pose is None else [float(x) for x in pose.center()],
        "covariance": None if covariance is None else _finite(covariance.tolist()),
        "confidence": _finite(found.confidence),
        "num_matches": int(found.num_matches),
        "num_inliers": int(found.num_inliers),
        "candidates": list(found.candidates),
        "remarks": list(found.remarks),
        "frame": frame or None,
        "camera": {
            "model": camera.model,
            "width": camera.width,
            "height": camera.height,
            "params": list(camera.params),
        },
    }


def _finite(value: Any) -> Any:
    """The value, or None where any number of it is infinite or NaN."""
    rows = value if isinstance(value, list) else [[value]]
    known = value is not None and all(math.isfinite(x) for row in rows for x in row)
    return value if known else None
