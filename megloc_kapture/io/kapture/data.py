"""Sensors, rigs, trajectories and records of one kapture, in memory."""

from __future__ import annotations

from dataclasses import dataclass, field

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.text import parse_float
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

CAMERA_SENSOR_TYPES = ("camera", "depth")
UNKNOWN_CAMERA = "UNKNOWN_CAMERA"


@dataclass(frozen=True, slots=True)
class Sensor:
    """One row of ``sensors.txt``.

    Parameters
    ----------
    name : free text, may be empty.
    sensor_type : ``"camera"``, ``"depth"``, ``"gnss"``, ...
    params : the remaining fields as text; for cameras the model, width, height and the model's
        parameters.
    """

    name: str
    sensor_type: str
    params: tuple[str, ...]

    def camera(self) -> Camera:
        """The intrinsics of a sensor of type camera or depth.

        Raises DataError: another type of sensor, an uncalibrated one (``UNKNOWN_CAMERA``), or
        parameters that :class:`Camera` refuses.
        """
        if self.sensor_type not in CAMERA_SENSOR_TYPES:
            raise DataError(f"a sensor of type {self.sensor_type!r} has no camera model")
        if not self.params:
            raise DataError("camera without a model")
        model = self.params[0]
        if model == UNKNOWN_CAMERA:
            raise DataError("camera is not calibrated (UNKNOWN_CAMERA); give it intrinsics first")
        if model not in CAMERA_MODEL_NUM_PARAMS:
            known = ", ".join([*CAMERA_MODEL_NUM_PARAMS, UNKNOWN_CAMERA])
            raise DataError(f"unknown camera model {model!r}; known: {known}")
        expected = CAMERA_MODEL_NUM_PARAMS[model] + 2
        if len(self.params) != expected + 1:
            raise DataError(
                f"camera model {model} takes {expected} parameters "
                f"(width and height included), got {len(self.params) - 1}"
            )
        width, height = (_pixels(text) for text in self.params[1:3])
        params = tuple(parse_float(text, "camera parameter") for text in self.params[3:])
        return Camera(model, width, height, params)

    @classmethod
    def from_camera(cls, camera: Camera, *, name: str = "", sensor_type: str = "camera") -> Sensor:
        """The sensor whose :meth:`camera` is exactly ``camera``."""
        params = (camera.model, str(int(camera.width)), str(int(camera.height)))
        return cls(name, sensor_type, params + tuple(_shortest(p) for p in camera.params))


@dataclass
class KaptureData:
    """Sensors, rigs, trajectories and image records of one kapture.

    The dicts may be changed freely until poses are asked for; then, members of a rig that is there
    already stay.

    Parameters
    ----------
    sensors : by sensor id.
    rigs : rig id -> sensor id (or the id of another rig) -> ``sensor_from_rig``.
    trajectories : (timestamp, device id) -> ``device_from_world``; a device is a sensor or a rig.
    records_camera, records_depth : (timestamp, sensor id) -> path below ``records_data``.
    """

    sensors: dict[str, Sensor] = field(default_factory=dict)
    rigs: dict[str, dict[str, RigidTransform]] = field(default_factory=dict)
    trajectories: dict[tuple[int, str], RigidTransform] = field(default_factory=dict)
    records_camera: dict[tuple[int, str], str] = field(default_factory=dict)
    records_depth: dict[tuple[int, str], str] = field(default_factory=dict)
    _record_by_image: dict[str, tuple[int, str]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _rigs_of: dict[str, list[str]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _num_rigs: int = field(default=0, init=False, repr=False, compare=False)

    def image_names(self) -> list[str]:
        """Paths of all camera images, sorted."""
        return sorted(self.records_camera.values())

    def record_of(self, image: str) -> tuple[int, str]:
        """``(timestamp, sensor id)`` of an image.

        Raises DataError: no such image, or two records of that name.
        """
        index = self._record_by_image
        key = index.get(image)
        # the entry proves itself; the index is built again after any change that matters
        if (
            key is None
            or len(index) != len(self.records_camera)
            or self.records_camera.get(key) != image
        ):
            index = {}
            for record, name in self.records_camera.items():
                if name in index:
                    raise DataError(f"image {name!r} has two records: {index[name]} and {record}")
                index[name] = record
            self._record_by_image = index
            key = index.get(image)
        if key is None:
            raise DataError(f"no image {image!r} in the camera records")
        return key

    def camera_of(self, image: str) -> Camera:
        """Intrinsics of the camera that took an image.

        Raises DataError: no such image or sensor, or see :meth:`Sensor.camera`.
        """
        sensor_id = self.record_of(image)[1]
        if sensor_id not in self.sensors:
            raise DataError(f"image {image!r} was taken by the unknown sensor {sensor_id!r}")
        try:
            return self.sensors[sensor_id].camera()
        except DataError as error:
            raise DataError(f"sensor {sensor_id!r} of image {image!r}: {error.message}") from error

    def cam_from_world(self, image: str) -> RigidTransform | None:
        """Pose of an image: its camera's own, else through the (nested) rigs that carry it.

        None where the trajectories say nothing. Of several rigs with a pose at that time, the
        first by id counts.
        """
        return self.device_from_world(*self.record_of(image))

    def device_from_world(self, timestamp: int, device_id: str) -> RigidTransform | None:
        """Pose of a sensor or rig at a time, own or through rigs; None where there is none."""
        return self._device_from_world(timestamp, device_id, frozenset())

    def poses(self) -> dict[str, RigidTransform]:
        """``cam_from_world`` of every image that has one, by image name, sorted."""
        poses = {image: self.cam_from_world(image) for image in self.image_names()}
        return {image: pose for image, pose in poses.items() if pose is not None}

    def _device_from_world(
        self, timestamp: int, device_id: str, seen: frozenset[str]
    ) -> RigidTransform | None:
        own = self.trajectories.get((timestamp, device_id))
        if own is not None:
            return own
        for rig_id in self._parents().get(device_id, ()):
            if rig_id in seen:
                raise DataError(f"rig {rig_id!r} contains itself")
            rig_from_world = self._device_from_world(timestamp, rig_id, seen | {rig_id})
            if rig_from_world is not None:
                return self.rigs[rig_id][device_id] @ rig_from_world
        return None

    def _parents(self) -> dict[str, list[str]]:
        if self._num_rigs != len(self.rigs):
            self._rigs_of = {}
            self._num_rigs = len(self.rigs)
            for rig_id in sorted(self.rigs):
                for sensor_id in self.rigs[rig_id]:
                    self._rigs_of.setdefault(sensor_id, []).append(rig_id)
        return self._rigs_of


def _pixels(text: str) -> int:
    value = parse_float(text, "camera parameter")
    if value != int(value):
        raise DataError(f"image size {text!r} is not a whole number of pixels")
    return int(value)


def _shortest(value: float) -> str:
    """Shortest text that reads back as the same float64; whole numbers as kapture has them."""
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
