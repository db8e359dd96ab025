"""Files of InLoc: floors, scans and their cutouts, queries.

kapture's download has the poses of the cutouts, as ``mapping/sensors/trajectories.txt``, and none
of the images: ``DUC1/`` and ``DUC2/`` of the official cutouts belong into its ``records_data``,
``iphone7/`` of the queries into that of ``query/``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.formats.inloc_files import (
    Cutout,
    parse_cutout_name,
    read_transformation,
    read_wrong_scans,
)
from megloc_kapture.datasets.kapture_folders import MAPPING, QUERY
from megloc_kapture.datasets.kapture_form import kapture_parent
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import has_control_characters
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import RigidTransform

FLOORS = ("DUC1", "DUC2")
DISTRACTOR_FLOORS = ("CSE3", "CSE4", "CSE5")
YAWS_DEG = tuple(range(0, 360, 30))
PITCHES_DEG = (-30, 0, 30)
POINTS_SUFFIX = ".mat"  # behind the image's name

LAYOUT = (
    "database/cutouts/DUC1/000/DUC_cutout_000_0_0.jpg (and .jpg.mat), "
    "database/alignments/DUC1/transformations/DUC_trans_000.txt, query/iphone7/IMG_0000.JPG; or "
    "as kapture's downloader leaves it, the images put into mapping/sensors/records_data/DUC1/ "
    "and query/sensors/records_data/iphone7/"
)

# what archives and their redistributions call the folders, most official first
_ROOTS = ("", "dataset")
_CUTOUTS = ("database/cutouts", "cutouts", "database/cutouts_imageonly", "cutouts_imageonly")
_ALIGNMENTS = ("database/alignments", "alignments")
KAPTURE_QUERIES = "iphone7"  # below records_data
_QUERIES = ("query/iphone7", "queries/iphone7", "iphone7")
# the published archive spells it without the "n", the documentation with it
_WRONG_SCANS = ("know_incorrect.txt", "known_incorrect.txt")
_SCAN = re.compile(r"[0-9]{3}")
_PHOTOGRAPH = (".jpg", ".jpeg")


@dataclass(frozen=True)
class Layout:
    """The folders of an InLoc download.

    Parameters
    ----------
    alignments : has a folder for each floor.
    kapture : the map's kapture folder, where poses come from there and not from the alignments.
    """

    cutouts: Path
    alignments: Path
    query: Path
    kapture: KaptureFolder | None = None

    @classmethod
    def find(cls, root: Path) -> Layout:
        """The folders below ``root``.

        Raises
        ------
        DataError : it is no folder, or one of the three is not there.
        """
        if not root.is_dir():
            raise DataError("no such folder", path=root)
        parent = kapture_parent(root)
        if parent is not None and _first(root, _CUTOUTS) is None:
            return cls._of_kapture(parent)
        for name in _ROOTS:
            cutouts, alignments, query = (
                _first(root / name, names) for names in (_CUTOUTS, _ALIGNMENTS, _QUERIES)
            )
            if cutouts is None:
                continue
            if alignments is None:
                raise DataError(f"{_ALIGNMENTS[0]}/ is missing; InLoc lies as {LAYOUT}", path=root)
            if query is None:
                raise DataError(f"{_QUERIES[0]}/ is missing; InLoc lies as {LAYOUT}", path=root)
            return cls(cutouts, alignments, query)
        raise DataError(f"{_CUTOUTS[0]}/ is missing; InLoc lies as {LAYOUT}", path=root)

    @classmethod
    def _of_kapture(cls, parent: Path) -> Layout:
        """The folders of a kapture download."""
        mapping = parent / MAPPING
        query = KaptureFolder(parent / QUERY).image_path(KAPTURE_QUERIES)
        if not query.is_dir():
            raise DataError(f"no folder of queries; InLoc lies as {LAYOUT}", path=query)
        folder = KaptureFolder(mapping)
        # the download has them in mapping/, an older guide showed them beside it
        beside = next((p for p in (mapping, parent) if (p / "DUC1_alignment").is_dir()), mapping)
        cutouts = folder.root / "sensors" / "records_data"
        return cls(cutouts, beside, query, folder)

    def alignment(self, floor: str) -> Path:
        """The folder of what is known about where a floor's scans stand."""
        return self.alignments / (floor if self.kapture is None else f"{floor}_alignment")

    def queries(self) -> list[str]:
        """File names of the query images, sorted.

        Raises
        ------
        DataError : a name that no pose file can hold.
        """
        names = [name for name in _listed(self.query) if name.lower().endswith(_PHOTOGRAPH)]
        for name in names:
            if name.split() != [name] or "," in name or has_control_characters(name):
                raise DataError(
                    "a query's name has no blanks, commas and control characters",
                    path=self.query / name,
                )
        return names

    def scans(self, floor: str, missing: Missing) -> list[Scan]:
        """The scans of a floor, sorted; what should be there and is not goes to ``missing``.

        Raises
        ------
        DataError : an image that lies or is named otherwise than cutouts are.
        """
        folder = self.cutouts / floor
        if not missing.require(folder):
            return []
        return [
            self._scan(floor, number, missing)
            for number in _listed(folder)
            if _SCAN.fullmatch(number) and (folder / number).is_dir()
        ]

    def wrong_scans(self, floor: str) -> frozenset[str]:
        """The scans whose transformations the authors call wrong."""
        path = _first(self.alignment(floor), _WRONG_SCANS)
        return frozenset() if path is None else read_wrong_scans(path)

    def input_files(self, floors: tuple[str, ...], *, with_points: bool) -> Iterator[Path]:
        """All files of these floors and of the queries that an import may read."""
        if self.kapture is not None:
            yield from sorted((self.kapture.root / "sensors").glob("*.txt"))
        for floor in floors:
            alignments = self.alignment(floor)
            yield from sorted(alignments.glob("transformations/*.txt"))
            yield from (alignments / n for n in _WRONG_SCANS if (alignments / n).is_file())
            yield from sorted((self.cutouts / floor).glob("[0-9][0-9][0-9]/*.jpg"))
            if with_points:
                pattern = f"[0-9][0-9][0-9]/*.jpg{POINTS_SUFFIX}"
                yield from sorted((self.cutouts / floor).glob(pattern))
        yield from (self.query / name for name in self.queries())

    def _scan(self, floor: str, number: str, missing: Missing) -> Scan:
        folder = self.cutouts / floor / number
        names = _listed(folder)
        cutouts = [_cutout(folder, name) for name in names if name.endswith(".jpg")]
        building = cutouts[0].building if cutouts else _building(floor)
        there = {cutout.image for cutout in cutouts}
        points = {n.removesuffix(POINTS_SUFFIX) for n in names if n.endswith(POINTS_SUFFIX)}
        expected = {
            Cutout(building, number, yaw, pitch).image for yaw in YAWS_DEG for pitch in PITCHES_DEG
        }
        missing.files += [folder / image for image in sorted((expected | points) - there)]
        first = Cutout(building, number, 0, 0)
        transformation = self.alignment(floor) / "transformations" / first.transformation
        if self.kapture is None:
            missing.require(transformation)
        return Scan(
            floor, number, folder, tuple(cutouts), frozenset(points), transformation, self.kapture
        )


@dataclass(frozen=True)
class Scan:
    """One scan of a floor.

    Parameters
    ----------
    number : three digits.
    folder : of its cutouts.
    cutouts : those there are, sorted by name.
    with_points : images whose points lie beside them.
    transformation : its file, which may be missing.
    kapture : has the cutouts' poses instead of it.
    """

    floor: str
    number: str
    folder: Path
    cutouts: tuple[Cutout, ...]
    with_points: frozenset[str]
    transformation: Path
    kapture: KaptureFolder | None = None

    def poses(self) -> dict[str, RigidTransform]:
        """``cam_from_floor`` by image, of the cutouts whose pose is known.

        Raises
        ------
        DataError : a broken transformation or trajectory.
        """
        if self.kapture is not None:
            data = self.kapture.read()
            recorded = set(data.records_camera.values())
            names = {c.image: f"{self.location}/{c.image}" for c in self.cutouts}
            poses = {i: data.cam_from_world(n) for i, n in names.items() if n in recorded}
            return {image: pose for image, pose in poses.items() if pose is not None}
        if not self.transformation.exists():
            return {}
        scan_from_floor = read_transformation(self.transformation).inverse()
        return {c.image: c.cam_from_scan() @ scan_from_floor for c in self.cutouts}

    @property
    def location(self) -> str:
        """Its name in groups."""
        return f"{self.floor}/{self.number}"


def _cutout(folder: Path, name: str) -> Cutout:
    try:
        cutout = parse_cutout_name(name)
    except DataError as error:
        raise DataError(error.message, path=folder / name) from error
    floor = folder.parent.name
    if cutout.scan != folder.name or not floor.upper().startswith(cutout.building.upper()):
        raise DataError(
            f"named as a cutout of {cutout.building}, scan {cutout.scan}, but lies in {floor}, "
            f"scan {folder.name}",
            path=folder / name,
        )
    return cutout


def _building(floor: str) -> str:
    return "cse" if floor in DISTRACTOR_FLOORS else "DUC"


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).exists()), None)


def _listed(folder: Path) -> list[str]:
    """Names in a folder, sorted; hidden ones (an archiver's leavings) do not count."""
    try:
        return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise DataError(f"cannot be listed: {error.strerror}", path=folder) from error
