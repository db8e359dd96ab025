"""A small 4Seasons in its official layout, written by hand, and readers of the result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from aachen_files import put

from megloc_kapture.datasets.fourseasons.adapter import FourSeasons, FourSeasonsOptions
from megloc_kapture.datasets.official import OfficialDataset
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureData
from megloc_kapture.values import Camera, RigidTransform

# odd nanoseconds, which a 64-bit float cannot represent
A, B = 1600000000000000001, 1600000000033333339
DAY, SNOW, RAIN = (f"recording_{date}_10-00-00" for date in ("2020-05-01", "2021-01-02", "2021-03"))
CAMERA = Camera("PINHOLE", 8, 4, (5.0, 5.0, 4.25, 1.75))
# 90 degrees about z; a shift; 90 degrees about x
TRANSFORMATIONS = """# transform_S_AS: translation vector, rotation quaternion
0,0,0,0,0,0.7071067811865476,0.7071067811865476
# transform_w_gpsw: translation vector, rotation quaternion
10,20,30,0,0,0,1
# transform_e_gpsw: translation vector, rotation quaternion
4000000,800000,4700000,0.7071067811865476,0,0,0.7071067811865476
# GNSS scale
0.125
"""
ROWS = (f"{A},2,0,0,0,0,0,1,0.5,2", f"{B},2,4,0,0,0,0,1,0.25,2,0.5")


def write_calibration(folder: Path, baseline: float = -0.3) -> None:
    pinhole = "Pinhole 5.0 5.0 4.25 1.75 0.0 0.0 0.0 0.0\n8 4\ncrop\n8 4\n"
    put(folder / "undistorted_calib_0.txt", pinhole)
    put(folder / "undistorted_calib_1.txt", pinhole)
    put(
        folder / "undistorted_calib_stereo.txt",
        f"1.0 0.0 0.0 {baseline}\n0.0 1.0 0.0 0.0\n0.0 0.0 1.0 0.0\n0.0 0.0 0.0 1.0\n",
    )


def write_recording(
    root: Path, name: str, times: Sequence[int], rows: Sequence[str] | None = ROWS
) -> Path:
    folder = root / name
    for timestamp in times:
        for camera in ("cam0", "cam1"):
            path = folder / f"undistorted_images/{camera}/{timestamp}.png"
            write_image(path, np.full((4, 8, 3), 9, np.uint8))
    put(folder / "times.txt", "".join(f"{t} {t / 1e9:.10f} 0.25\n" for t in (*times, 17)))
    if rows is not None:
        put(folder / "GNSSPoses.txt", "# header\n" + "\n".join(rows) + "\n")
        put(folder / "Transformations.txt", TRANSFORMATIONS)
    return folder


def write_two_recordings(root: Path) -> Path:
    write_calibration(root / "calibration")
    write_recording(root, DAY, (A, B))
    write_recording(root, SNOW, (A + 5, B + 5), rows=None)
    return root


def read(root: Path, **options: Any) -> OfficialDataset:
    adapter = FourSeasons(FourSeasonsOptions(**options))
    adapter.check(root)
    return adapter.read(root)


def image(recording: str, timestamp: int, camera: str = "cam0") -> str:
    return f"{recording}/undistorted_images/{camera}/{timestamp}.png"


def times_of(data: KaptureData) -> set[int]:
    return {timestamp for timestamp, _ in data.records_camera}


def pose_of(dataset: OfficialDataset, name: str) -> RigidTransform:
    poses = dataset.mapping.poses() | (dataset.query_gt.poses() if dataset.query_gt else {})
    return poses[name]


def official(dataset: OfficialDataset, name: str) -> RigidTransform:
    return dataset.world.pose_in_official(pose_of(dataset, name))


def missing_of(dataset: OfficialDataset) -> list[Path]:
    assert dataset.missing is not None
    return dataset.missing.files
