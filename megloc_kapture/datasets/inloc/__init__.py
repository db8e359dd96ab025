"""Files of InLoc: floors, scans, cutouts with scanned points, queries.

``<BLD>_cutout_<SCAN>_<YAW>_<PITCH>.jpg`` is cut out of a scan's panorama; ``<image>.mat`` has the
scanned point of each pixel in the scan's frame (metres, z up). ``<BLD>_trans_<SCAN>.txt`` has the
pose of the scan in the frame of its floor.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.official import Missing, kapture_hint
from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import named, read_text, reading
from megloc_kapture.io.text_lines import reading_lines, transform_of
from megloc_kapture.values import RigidTransform

FLOORS = ("DUC1", "DUC2")
DISTRACTOR_FLOORS = ("CSE3", "CSE4", "CSE5")
YAWS_DEG = tuple(range(0, 360, 30))
PITCHES_DEG = (-30, 0, 30)
POINTS_SUFFIX = ".mat"  # appended to the image's name

LAYOUT = (
    "database/cutouts/DUC1/000/DUC_cutout_000_0_0.jpg (and .jpg.mat), "
    "database/alignments/DUC1/transformations/DUC_trans_000.txt, query/iphone7/IMG_0000.JPG"
)

# folder names in archives and redistributions, most official first
_ROOTS = ("", "dataset", "InLoc")
_CUTOUTS = ("database/cutouts", "cutouts", "database/cutouts_imageonly", "cutouts_imageonly")
_ALIGNMENTS = ("database/alignments", "alignments")
_QUERIES = ("query/iphone7", "queries/iphone7", "iphone7")
# the file name in the published archive lacks the "n", that in the documentation has it
_WRONG_SCANS = ("know_incorrect.txt", "known_incorrect.txt")
_SCAN = re.compile(r"[0-9]{3}")
_PHOTOGRAPH = (".jpg", ".jpeg")
POINTS = "XYZcut"
COLOURS = "RGBcut"

_CUTOUT = re.compile(r"([A-Za-z]+)_cutout_([0-9]{3})_([0-9]{1,3})_(-?[0-9]{1,2})\.jpg")
_SCAN_NUMBER = re.compile(r"(?<![0-9])[0-9]{1,3}(?![0-9])")


@dataclass(frozen=True, slots=True)
class Cutout:
    """A cutout as described by its name; yaw is counted from the scan's -x axis, to the right."""

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
            reason = "a MAT file of version 7.3, which scipy cannot read; in MATLAB save it by -v7"
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
