"""InLoc: cutouts of laser scans with depth as the map, phone images as queries.

Each floor has a separate coordinate frame. A cutout's pose follows from its name and the pose of
its scan in the floor's frame; its depth comes from the scanned points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.datasets.inloc import (
    DISTRACTOR_FLOORS,
    FLOORS,
    LAYOUT,
    PITCHES_DEG,
    POINTS_SUFFIX,
    YAWS_DEG,
    Cutout,
    Layout,
    Scan,
    read_cutout_points,
)
from megloc_kapture.datasets.official import (
    Count,
    DatasetCard,
    Missing,
    OfficialDataset,
    last_part,
    read_ground_truth,
)
from megloc_kapture.errors import DataError, require
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import ImageGroup, World
from megloc_kapture.io.images import image_size, write_depth_map
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import Camera, Options, RigidTransform

CUTOUTS, QUERIES, DEPTH = "database/cutouts", "query/iphone7", "depth"
DATASET = "inloc"
# focal length over the longer side: the iPhone 7's is equivalent to 28 mm on film 36 mm wide
_FOCAL_SHARE = 28 / 36
# focal length over width, for a horizontal field of view of 60 degrees: 0.5 / tan(30 deg)
_CUTOUT_FOCAL_SHARE = 3**0.5 / 2
# the 277 scans of the paper's 9,972 cutouts, by floor as published by the authors
_PUBLISHED_SCANS = {"DUC1": 50, "DUC2": 80, "CSE3": 7, "CSE4": 75, "CSE5": 65}
_PUBLISHED_QUERIES = 356


class InLocOptions(Options):
    """The part of InLoc to import."""

    distractor_floors: bool = Field(
        default=False, description="also import CSE3, CSE4 and CSE5, without queries"
    )
    depth: bool = Field(default=True, description="import the scanned points as depth maps")
    depth_step: int = Field(
        default=1,
        ge=1,
        le=64,
        description="keep every N-th row and column of the scanned points",
    )


class InLoc:
    """Adapter of InLoc's official layout."""

    name = DATASET
    Options = InLocOptions
    card = DatasetCard(
        title="InLoc",
        published_at="https://github.com/HajimeTaira/InLoc_dataset",
        size="356 queries, 9,972 cutouts of 1600x1200 with points; hundreds of GB, far less "
        "without the points (depth = false)",
        folders=("InLoc", "inloc"),
        layout=LAYOUT,
    )

    def __init__(self, options: InLocOptions | None = None) -> None:
        self.options = options or InLocOptions()

    @property
    def floors(self) -> tuple[str, ...]:
        return FLOORS + DISTRACTOR_FLOORS * self.options.distractor_floors

    def check(self, root: Path) -> None:
        layout = Layout.find(root)
        if not any((layout.cutouts / floor).is_dir() for floor in self.floors):
            raise DataError(f"none of {', '.join(self.floors)} exists", path=layout.cutouts)

    def read(self, root: Path, *, allow_missing: bool = False) -> OfficialDataset:
        self.check(root)
        layout, missing = Layout.find(root), Missing(root, allow_missing)
        map_ = _Map(self.options)
        wrong = {floor: layout.wrong_scans(floor) for floor in self.floors}
        left_out = []
        for floor in self.floors:
            for scan in layout.scans(floor, missing):
                if scan.number in wrong[floor]:
                    left_out.append(scan.location)
                else:
                    map_.add(scan, missing)
        require(
            not self.options.depth or not map_.groups or map_.depth or missing.allowed,
            f"no cutout has its points (.jpg{POINTS_SUFFIX}); the download without "
            "them is imported with the option depth = false",
            path=layout.cutouts,
        )
        names = [f"{QUERIES}/{name}" for name in layout.queries(missing)]
        query = _queries(names, layout.query)
        truth, true_groups = read_ground_truth(root, query, World())
        groups = {image: true_groups.get(image, ImageGroup()) for image in names}
        records = Path("mapping") / "sensors" / "records_data"
        return OfficialDataset(
            mapping=map_.data,
            query=query,
            query_gt=truth,
            links={CUTOUTS: layout.cutouts, QUERIES: layout.query},
            groups=map_.groups | groups,
            names={image: last_part(image) for image in names},
            protocol=protocol_of(DATASET),
            summary=self._summary(map_, groups),
            remarks=[f"Omitted, wrongly placed: scans {', '.join(left_out)}."] if left_out else [],
            missing=missing,
            write_more=lambda output: map_.write_depth_maps(output / records),
        )

    def _summary(self, map_: _Map, groups: Mapping[str, ImageGroup]) -> list[Count]:
        cutouts = len(YAWS_DEG) * len(PITCHES_DEG)
        published = sum(_PUBLISHED_SCANS[floor] for floor in self.floors)
        counts = [
            Count("map images (cutouts of scans)", len(map_.groups), published * cutouts),
            Count("query images", len(groups), _PUBLISHED_QUERIES),
        ]
        if self.options.depth:
            counts.append(Count("map images with depth", len(map_.depth)))
        for floor in self.floors:
            scans = {g.location for g in map_.groups.values() if g.frame == floor}
            counts.append(Count(f"scans of {floor}", len(scans), _PUBLISHED_SCANS[floor]))
        return counts


def _camera(path: Path, focal_share: float, *, longer: bool) -> Camera:
    width, height = image_size(path)
    focal = focal_share * (max(width, height) if longer else width)
    return Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))


@dataclass
class _Map:
    options: InLocOptions
    data: KaptureData = field(default_factory=KaptureData)
    groups: dict[str, ImageGroup] = field(default_factory=dict)
    # record of a depth map -> file of points, cutout, and camera of the cutout
    depth: dict[str, tuple[Path, Cutout, Camera]] = field(default_factory=dict)

    def add(self, scan: Scan, missing: Missing) -> None:
        without = [c.image for c in scan.cutouts if c.image not in scan.with_points]
        if self.options.depth:
            missing.files += [scan.folder / f"{image}{POINTS_SUFFIX}" for image in without]
        poses = scan.poses()
        for cutout in scan.cutouts:
            if cutout.image not in poses:
                continue
            pose = poses[cutout.image]
            image = f"{CUTOUTS}/{scan.location}/{cutout.image}"
            camera = _camera(scan.folder / cutout.image, _CUTOUT_FOCAL_SHARE, longer=False)
            timestamp = _timestamp(scan, cutout)
            self.groups[image] = ImageGroup(frame=scan.floor, location=scan.location)
            sensor = self._sensor(camera)
            self.data.records_camera[timestamp, sensor] = image
            if not self.options.depth:
                self.data.trajectories[timestamp, sensor] = pose
                continue
            self.data.trajectories[timestamp, _rig(sensor)] = pose
            if cutout.image in scan.with_points:
                record = f"{DEPTH}/{scan.location}/{cutout.image.removesuffix('.jpg')}.depth"
                self.data.records_depth[timestamp, _depth(sensor)] = record
                points = scan.folder / f"{cutout.image}{POINTS_SUFFIX}"
                self.depth[record] = points, cutout, camera

    def write_depth_maps(self, records: Path) -> None:
        for record, job in self.depth.items():
            write_depth_map(records / record, cutout_depth(*job, self.options.depth_step))

    def _sensor(self, camera: Camera) -> str:
        sensor = f"cutout_{camera.width}x{camera.height}"
        if sensor not in self.data.sensors:
            self.data.sensors[sensor] = Sensor.from_camera(camera, name=sensor)
            if self.options.depth:
                depth = depth_camera(camera, self.options.depth_step)
                self.data.sensors[_depth(sensor)] = Sensor.from_camera(
                    depth, name=_depth(sensor), sensor_type="depth"
                )
                self.data.rigs[_rig(sensor)] = {
                    sensor: RigidTransform.identity(),
                    _depth(sensor): RigidTransform.identity(),
                }
        return sensor


def _depth(sensor: str) -> str:
    return f"{sensor}_depth"


def _rig(sensor: str) -> str:
    return f"{sensor}_rig"


def _timestamp(scan: Scan, cutout: Cutout) -> int:
    """Return a unique timestamp that does not depend on the other images."""
    floor = (FLOORS + DISTRACTOR_FLOORS).index(scan.floor) + 1
    return ((floor * 1000 + int(scan.number)) * 1000 + cutout.yaw_deg) * 1000 + (
        cutout.pitch_deg + 90
    )


def _queries(names: list[str], folder: Path) -> KaptureData:
    data = KaptureData()
    for timestamp, name in enumerate(names):
        camera = _camera(folder / last_part(name), _FOCAL_SHARE, longer=True)
        sensor = f"iphone7_{camera.width}x{camera.height}"
        data.sensors[sensor] = Sensor.from_camera(camera, name=sensor)
        data.records_camera[timestamp, sensor] = name
    return data


# ----------------------------------------------------------------------------------- depth


def depth_camera(camera: Camera, step: int) -> Camera:
    """Return the camera of an image of every ``step``-th row and column.

    The rays through the centres of these pixels stay the same.
    """
    focal, cx, cy = camera.params
    return Camera(
        "SIMPLE_PINHOLE",
        -(-camera.width // step),
        -(-camera.height // step),
        (focal / step, (cx - 0.5) / step + 0.5, (cy - 0.5) / step + 0.5),
    )


def cutout_depth(path: Path, cutout: Cutout, camera: Camera, step: int) -> NDArray[np.float32]:
    """Return the depth along the optical axis, float32 (H, W), metres; 0 where not measured."""
    points = read_cutout_points(path, camera.width, camera.height)
    z = points[::step, ::step] @ cutout.cam_from_scan().rotation_matrix()[2]
    return np.where(np.isfinite(z) & (z > 0), z, 0.0).astype(np.float32)
