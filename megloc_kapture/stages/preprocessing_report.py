"""What pre-processing did to a kapture, kept beside its sensors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from megloc_kapture.io.files import read_json_model
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.preprocessing.frames import FramePlan
from megloc_kapture.preprocessing.resampling import PixelMap

REPORT_FILE = "preprocessing.json"


class CameraReport(BaseModel):
    """One camera before and after: model, width, height and its parameters, as in sensors.txt."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    images: int
    original: tuple[str, ...]
    processed: tuple[str, ...]


class PreprocessingReport(BaseModel):
    """``sensors/preprocessing.json``: what was done to a kapture.

    ``masked`` is the share of the pixels of all images that each source of masks ignores, ``all``
    that they ignore together; ``remarks`` say what was asked for and could not be done.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    images: int
    images_changed: int
    images_masked: int
    cameras: dict[str, CameraReport]
    masked: dict[str, float]
    remarks: tuple[str, ...]


def camera_reports(data: KaptureData, plans: Mapping[str, FramePlan]) -> dict[str, CameraReport]:
    """Every camera that took an image, by sensor id."""
    numbers: dict[str, int] = {}
    for _, sensor_id in data.records_camera:
        numbers[sensor_id] = numbers.get(sensor_id, 0) + 1
    return {
        sensor_id: CameraReport(
            images=numbers[sensor_id],
            original=Sensor.from_camera(plan.original).params,
            processed=Sensor.from_camera(plan.processed).params,
        )
        for sensor_id, plan in plans.items()
    }


def read_report(root: Path) -> PreprocessingReport | None:
    """What was done to a kapture; None where nothing was.

    Raises
    ------
    DataError : the report is broken.
    """
    path = root / "sensors" / REPORT_FILE
    return read_json_model(path, PreprocessingReport) if path.is_file() else None


def pixel_maps(report: PreprocessingReport) -> dict[str, PixelMap]:
    """By sensor id: what carries keypoints between the original images and the processed ones."""
    return {
        sensor_id: PixelMap(
            *(Sensor("", "camera", params).camera() for params in (row.original, row.processed))
        )
        for sensor_id, row in report.cameras.items()
    }
