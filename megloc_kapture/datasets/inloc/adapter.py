"""InLoc: cutouts of laser scans with depth as the map, phone images as queries.

``<BLD>_cutout_<SCAN>_<YAW>_<PITCH>.jpg`` is cut out of a scan's panorama; ``<image>.mat`` has the
scanned point of each pixel in the scan's frame (metres, z up). ``<BLD>_trans_<SCAN>.txt`` has the
pose of the scan in the frame of its floor; each floor has a separate frame. A cutout's pose follows
from its name and the pose of its scan, its depth from the scanned points.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.official import (
    Count,
    DatasetCard,
    Missing,
    OfficialDataset,
    kapture_hint,
    last_part,
    read_ground_truth,
)
from megloc_kapture.errors import DataError, require
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import ImageGroup, World
from megloc_kapture.io.files import named, read_text, reading
from megloc_kapture.io.images import image_size, write_depth_map
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.io.text_lines import reading_lines, transform_of
from megloc_kapture.values import Camera, Options, RigidTransform

FLOORS = ("DUC1", "DUC2")
DISTRACTOR_FLOORS = ("CSE3", "CSE4", "CSE5")
YAWS_DEG = tuple(range(0, 360, 30))
PITCHES_DEG = (-30, 0, 30)
POINTS_SUFFIX = ".mat"  # appended to the image's name

LAYOUT = (
    "database/cutouts/DUC1/000/DUC_cutout_000_0_0.jpg (and .jpg.mat), "
    "database/alignments/DUC1/transformations/DUC_trans_000.txt, query/iphone7/IMG_0000.JPG"
)

# folder names in archives and redistributions, official ones first
_ROOTS = ("", "dataset", "InLoc")
_CUTOUTS = ("database/cutouts", "cutouts", "database/cutouts_imageonly", "cutouts_imageonly")
_ALIGNMENTS = ("database/alignments", "alignments")
_QUERIES = ("query/iphone7", "queries/iphone7", "iphone7")
# the name in the published archive, which lacks an "n", and in the documentation
_WRONG_SCANS = ("know_incorrect.txt", "known_incorrect.txt")
_SCAN = re.compile(r"[0-9]{3}")
_PHOTOGRAPH = (".jpg", ".jpeg")
POINTS = "XYZcut"  # variable in a file of points

_CUTOUT = re.compile(r"([A-Za-z]+)_cutout_([0-9]{3})_([0-9]{1,3})_(-?[0-9]{1,2})\.jpg")
_SCAN_NUMBER = re.compile(r"(?<![0-9])[0-9]{1,3}(?![0-9])")


@dataclass(frozen=True, slots=True)
class Cutout:
    """A cutout as described by its name; yaw is measured from the scan's -x axis to the right."""

    building: str
    scan: str
    yaw_deg: int
    pitch_deg: int

    @property
    def image(self) -> str:
        return f"{self.building}_cutout_{self.scan}_{self.yaw_deg}_{self.pitch_deg}.jpg"

    @property
    def transformation(self) -> str:
        return f"{self.building}_trans_{self.scan}.txt"

    def cam_from_scan(self) -> RigidTransform:
        """Return the cutout's pose in its scan; both have the same origin.

        At zero yaw and pitch, the camera looks along the scan's -x axis (z up). The yaw rotates it
        to the right, the pitch upwards.
        """
        pano_from_scan = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
        turn = Rotation.from_euler("yx", [-self.yaw_deg, -self.pitch_deg], degrees=True)
        return RigidTransform.from_matrix(turn.as_matrix() @ pano_from_scan, np.zeros(3))


def parse_cutout_name(name: str) -> Cutout:
    match = _CUTOUT.fullmatch(name)
    if match is None or int(match[3]) >= 360 or abs(int(match[4])) > 90:
        raise DataError(f"{name!r} is not named <BUILDING>_cutout_<SCAN>_<YAW>_<PITCH>.jpg")
    return Cutout(match[1], match[2], int(match[3]), int(match[4]))


def read_transformation(path: Path | str) -> RigidTransform:
    """Read ``floor_from_scan``: the second 4x4 matrix of the file, which is the refined one."""
    with reading_lines(Path(path)) as lines:
        rows = [fields for fields in map(str.split, lines) if _are_numbers(fields)]
    with named(path):
        require(len(rows) == 8, f"expected two matrices of four rows each, got {len(rows)} rows")
        return transform_of([field for row in rows[4:] for field in row])


def read_wrong_scans(path: Path | str) -> frozenset[str]:
    """Read the numbers of wrongly placed scans; return them with three digits."""
    return frozenset(number.zfill(3) for number in _SCAN_NUMBER.findall(read_text(path)))


def read_cutout_points(path: Path | str, width: int, height: int) -> NDArray[np.float64]:
    """Read float64 (height, width, 3): scanned points in the scan's frame (metres), or NaN."""
    from scipy.io import loadmat

    with reading(path, f"a MAT file with {POINTS}"):
        try:
            points = np.asarray(loadmat(path, variable_names=[POINTS])[POINTS], np.float64)
        except NotImplementedError as error:
            reason = "scipy cannot read MAT files of version 7.3; in MATLAB, save it with -v7"
            raise DataError(reason, path=path) from error
    if points.shape != (height, width, 3):
        shape = "x".join(map(str, points.shape))
        raise DataError(f"{POINTS} is {shape}, expected {height}x{width}x3", path=path)
    return points


def _are_numbers(fields: list[str]) -> bool:
    try:
        return len(list(map(float, fields))) == 4
    except ValueError:
        return False


@dataclass(frozen=True)
class Layout:
    """The folders of an InLoc download; ``alignments`` has a folder per floor."""

    cutouts: Path
    alignments: Path
    query: Path

    @classmethod
    def find(cls, root: Path) -> Layout:
        require(root.is_dir(), "no such folder", path=root)
        for name in _ROOTS:
            cutouts, alignments, query = (
                _first(root / name, names) for names in (_CUTOUTS, _ALIGNMENTS, _QUERIES)
            )
            query = query or _first(root, _QUERIES)
            if cutouts is None:
                continue
            if alignments is None or query is None:
                absent = (_ALIGNMENTS if alignments is None else _QUERIES)[0]
                raise DataError(f"{absent}/ is missing; the layout of InLoc is {LAYOUT}", path=root)
            return cls(cutouts, alignments, query)
        reason = f"{_CUTOUTS[0]}/ is missing; the layout of InLoc is {LAYOUT}{kapture_hint(root)}"
        raise DataError(reason, path=root)

    def queries(self, missing: Missing) -> list[str]:
        names = [name for name in _listed(self.query) if name.lower().endswith(_PHOTOGRAPH)]
        missing.files += [] if names else [self.query / "<photographs>.JPG"]
        return names

    def scans(self, floor: str, missing: Missing) -> list[Scan]:
        folder = self.cutouts / floor
        if not missing.require(folder):
            return []
        scans = [
            self._scan(floor, number, missing)
            for number in _listed(folder)
            if _SCAN.fullmatch(number) and (folder / number).is_dir()
        ]
        missing.files += [] if scans else [folder / "<scans>"]
        return scans

    def wrong_scans(self, floor: str) -> frozenset[str]:
        path = _first(self.alignments / floor, _WRONG_SCANS)
        return frozenset() if path is None else read_wrong_scans(path)

    def _scan(self, floor: str, number: str, missing: Missing) -> Scan:
        folder = self.cutouts / floor / number
        names = _listed(folder)
        with named(folder):
            cutouts = [parse_cutout_name(name) for name in names if name.endswith(".jpg")]
        building = cutouts[0].building if cutouts else _building(floor)
        images = {cutout.image for cutout in cutouts}
        points = {n.removesuffix(POINTS_SUFFIX) for n in names if n.endswith(POINTS_SUFFIX)}
        expected = {
            Cutout(building, number, yaw, pitch).image for yaw in YAWS_DEG for pitch in PITCHES_DEG
        }
        missing.files += [folder / image for image in sorted((expected | points) - images)]
        first = Cutout(building, number, 0, 0)
        transformation = self.alignments / floor / "transformations" / first.transformation
        missing.require(transformation)
        return Scan(floor, number, folder, tuple(cutouts), frozenset(points), transformation)


@dataclass(frozen=True)
class Scan:
    """A scan of a floor: its sorted cutouts, and the names of those with points."""

    floor: str
    number: str
    folder: Path
    cutouts: tuple[Cutout, ...]
    with_points: frozenset[str]
    transformation: Path

    def poses(self) -> dict[str, RigidTransform]:
        """Return ``cam_from_floor`` by image, for cutouts with a known pose."""
        if not self.transformation.exists():
            return {}
        scan_from_floor = read_transformation(self.transformation).inverse()
        return {c.image: c.cam_from_scan() @ scan_from_floor for c in self.cutouts}

    @property
    def location(self) -> str:
        return f"{self.floor}/{self.number}"


def _building(floor: str) -> str:
    return "cse" if floor in DISTRACTOR_FLOORS else "DUC"


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).exists()), None)


def _listed(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


# --------------------------------------------------------------------------------- adapter


CUTOUTS, QUERIES, DEPTH = "database/cutouts", "query/iphone7", "depth"
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
        default=False, description="also import CSE3, CSE4 and CSE5, which have no queries"
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

    name = "inloc"
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
            f"no cutout has a file of points (.jpg{POINTS_SUFFIX}); to import without "
            "points, set the option depth = false",
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
            protocol=protocol_of(self.name),
            summary=self._summary(map_, groups),
            remarks=[f"Omitted as wrongly placed: scans {', '.join(left_out)}."]
            if left_out
            else [],
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
    """Return the camera of an image with only every ``step``-th row and column.

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
