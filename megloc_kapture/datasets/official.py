"""A dataset that an adapter read from its official layout, and its kapture folders.

:func:`write_official` writes ``mapping/``, ``query/``, ``megloc/`` and, if available, ``query_gt/``
and ``reference/`` (the dataset's model); images are linked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from megloc_kapture.datasets.kapture_folders import check_image_size, tell_of_truth_without_query
from megloc_kapture.datasets.reference_map import write_reference_map
from megloc_kapture.errors import DataError, OptionError, require
from megloc_kapture.io.colmap_model import SparsePoints
from megloc_kapture.io.dataset_tables import (
    SIDE_TABLES,
    ImageGroup,
    SideTables,
    World,
    read_side_tables,
    write_side_tables,
)
from megloc_kapture.io.files import find_near, link_records
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, is_kapture, write_sensors
from megloc_kapture.io.output_folders import ARCHIVES
from megloc_kapture.stages.paths import MAPPING, QUERY, QUERY_GT, REFERENCE
from megloc_kapture.values import Camera, Options, RigidTransform

GROUND_TRUTH = "ground_truth"
_MISSING_SHOWN = 5


class DatasetCard(Options):
    """Address and layout of a dataset, for messages; ``folders`` are usual names of its root."""

    title: str
    published_at: str
    size: str
    folders: tuple[str, ...]
    layout: str

    def without(
        self, root: Path, absent: Sequence[str], *, with_locations: bool = False
    ) -> DataError:
        folders = (path for path in root.glob("*") if path.is_dir())
        imported = {path.parent for path in root.glob(f"*/{SIDE_TABLES}")}
        near = root.parent, *sorted(set(folders) - imported - {root / GROUND_TRUTH})
        found = next(
            (
                path
                for path in near
                if all((path / name).is_dir() for name in absent)
                or KaptureForm.find(path, with_locations=with_locations)
            ),
            None,
        )
        packed = next((f"; is {path} extracted?" for path in archives(root)), "")
        remedy = f"the root must contain {self.layout}{packed}"
        if found is not None:
            remedy = f"there is one in {found}/: give it as the root"
        return DataError(
            f"this is not {self.title}, as there is no folder {' or '.join(absent)}; {remedy}",
            path=root,
        )


def kapture_hint(root: Path) -> str:
    """Return a remedy, if any, for kapture folders of a dataset read only in its own layout."""
    has_map = is_kapture(root / MAPPING)
    return "; kapture folders can be evaluated as dataset kapture" if has_map else ""


def archives(root: Path) -> list[Path]:
    """Return the paths of archives near ``root``, relative to it."""
    files = find_near(root, "*")
    return sorted(path.relative_to(root) for path in files if path.name.lower().endswith(ARCHIVES))


@dataclass(frozen=True, slots=True)
class Count:
    """A line of an import's summary."""

    what: str
    found: int
    published: int | None = None

    def __str__(self) -> str:
        text = f"{self.what:44s}{self.found:>8d}"
        if self.published is None or self.published == self.found:
            return text + ("" if self.published is None else "  as published")
        return f"{text}  published: {self.published}, {self.found - self.published:+d}"


@dataclass
class Missing:
    """Missing files, collected so that a single message reports all, unless they are allowed."""

    root: Path
    allowed: bool = False
    files: list[Path] = field(default_factory=list)

    def require(self, file: Path) -> bool:
        """Return whether a file exists; record it if not."""
        if file.exists():
            return True
        self.files.append(file)
        return False

    def by_folder(self) -> list[str]:
        folders: dict[Path, list[str]] = {}
        for file in self.files:
            folders.setdefault(file.parent, []).append(file.name)
        return [
            f"{self._shown(folder / min(names))}"
            + (f" and {len(names) - 1} more in its folder" if len(names) > 1 else "")
            for folder, names in sorted(folders.items())
        ]

    def refuse(self) -> None:
        if not self.files:
            return
        parts = self.by_folder()
        more = len(parts) - _MISSING_SHOWN
        raise DataError(
            f"{len(self.files)} files are missing: {', '.join(parts[:_MISSING_SHOWN])}"
            + (f", and files in {more} more folders" if more > 0 else "")
            + self._found(self._shown(self.files[0]).parts)
            + "; --allow-missing imports the rest",
            path=self.root,
        )

    def _found(self, parts: tuple[str, ...]) -> str:
        """Return where a missing file may be: in an archive, or one or more folders up or down."""
        for path in archives(self.root):
            if path.name.startswith(parts[:-1]):
                return f"; is {path} extracted?"
        for path in self.root.rglob("*"):
            found = self._shown(path).parts
            if path.name.lower() == parts[-1].lower() and (
                _in_order(parts, found) or _in_order(found, parts)
            ):
                return f"; {path.name} is at {self._shown(path.parent)}/"
        return ""

    def _shown(self, file: Path) -> Path:
        return file.relative_to(self.root) if file.is_relative_to(self.root) else file


def _in_order(parts: Sequence[str], others: Sequence[str]) -> bool:
    """Return whether ``others`` contains all ``parts`` in the same order, ignoring case."""
    rest = iter(other.lower() for other in others)
    return all(part.lower() in rest for part in parts)


@dataclass(frozen=True, eq=False, kw_only=True)
class OfficialDataset(SideTables):
    """A dataset with its tables; poses are in the local frame.

    ``links`` maps folders below ``records_data`` to folders of the dataset (``""`` is
    ``records_data`` itself); ``image_files`` maps single images to files. ``reference`` reads the
    image names and points of the dataset's model. ``write_more`` writes further files (depth maps)
    below the output folder.
    """

    mapping: KaptureData
    query: KaptureData
    links: Mapping[str, Path] = field(default_factory=dict)
    image_files: Mapping[str, Path] = field(default_factory=dict)
    query_gt: KaptureData | None = None
    summary: Sequence[Count] = ()
    remarks: Sequence[str] = ()
    missing: Missing | None = None
    reference: Callable[[], tuple[Sequence[str], SparsePoints]] | None = None
    reference_database: Path | None = None
    write_more: Callable[[Path], None] | None = None


def check_official(dataset: OfficialDataset, *, allow_missing: bool = False) -> None:
    if dataset.missing is not None and not allow_missing:
        dataset.missing.refuse()
    root = dataset.missing.root if dataset.missing is not None else None
    if not dataset.mapping.records_camera or not dataset.mapping.trajectories:
        raise DataError("no mapping image with a pose is left to import", path=root)
    require(
        dataset.query.records_camera or allow_missing, "no query image is left to import", path=root
    )
    shared = set(dataset.mapping.image_names()) & set(dataset.query.image_names())
    if shared:
        raise DataError(f"image {min(shared)!r} is both a map image and a query", path=root)


def write_official(dataset: OfficialDataset, output: Path, *, allow_missing: bool = False) -> None:
    check_official(dataset, allow_missing=allow_missing)
    for part, data in ((MAPPING, dataset.mapping), (QUERY, dataset.query)):
        write_sensors(output / part, data)
        link_records(output / part, dataset.links)
        names = set(data.image_names()) if dataset.image_files else set()
        files = {name: file for name, file in dataset.image_files.items() if name in names}
        link_records(output / part, files)
    if dataset.query_gt is not None and dataset.query_gt.trajectories:
        write_sensors(output / QUERY_GT, dataset.query_gt)
    write_side_tables(output / SIDE_TABLES, dataset)
    if dataset.reference is not None:
        model_names, points = dataset.reference()
        write_reference_map(
            output / REFERENCE,
            dataset.mapping,
            dataset.links,
            model_names,
            points,
            database=dataset.reference_database,
        )
    if dataset.write_more is not None:
        dataset.write_more(output)


def read_ground_truth(
    root: Path, query: KaptureData, world: World
) -> tuple[KaptureData | None, Mapping[str, ImageGroup]]:
    """Read true poses (in the local frame) and groups from ``<root>/ground_truth``, if present.

    Its ``query/`` is a kapture folder with poses in the official frame and with the image names of
    the import. Its ``megloc/groups.csv`` has the conditions.
    """
    folder = root / GROUND_TRUTH
    if not (folder / QUERY).exists():
        return None, {}
    true_poses = KaptureFolder(folder / QUERY).read().poses()
    if strange := sorted(true_poses.keys() - set(query.image_names())):
        tell_of_truth_without_query(folder / QUERY, strange)
    poses = {
        record: world.pose_in_local(true_poses[image])
        for record, image in query.records_camera.items()
        if image in true_poses
    }
    truth = with_poses(query, poses)
    return truth, read_side_tables(folder / SIDE_TABLES).groups


def with_poses(data: KaptureData, poses: Mapping[tuple[int, str], RigidTransform]) -> KaptureData:
    """Return ``data`` with these poses, by (timestamp, device), and without depth records."""
    return replace(data, trajectories=dict(poses), records_depth={})


def last_part(image: str) -> str:
    return PurePosixPath(image).name


# kapture's guide to converting Aachen puts the folders into kapture/ next to the official files
_PARENTS = (".", "kapture")
_FOLDERS = ("mapping", "query_day", "query_night", "query")
_FOLDERS_OF_LOCATIONS = ("[0-9][0-9]/mapping", "[0-9][0-9]/query")


@dataclass(frozen=True, slots=True)
class KaptureImage:
    """An image with its kapture data; ``locations`` are three-digit numbers such as ``001``."""

    name: str
    file: Path
    sensor_id: str
    camera: Camera
    cam_from_world: RigidTransform | None
    is_query: bool
    locations: tuple[str, ...]


@dataclass(frozen=True)
class KaptureForm:
    """The kapture folders of a dataset; those of the map, named ``mapping``, come first."""

    root: Path
    folders: tuple[Path, ...]

    @classmethod
    def find(cls, root: Path, *, with_locations: bool = False) -> KaptureForm | None:
        """Find the kapture folders below a root; return None if no folder is a map."""
        patterns = _FOLDERS_OF_LOCATIONS if with_locations else _FOLDERS
        for parent in (Path(root) / name for name in _PARENTS):
            candidates = [
                [path for path in sorted(parent.glob(pattern)) if is_kapture(path)]
                for pattern in patterns
            ]
            if candidates[0]:
                return cls(parent, tuple(path for folders in candidates for path in folders))
        return None

    def read(self, missing: Missing) -> list[KaptureImage]:
        """Read the existing images, sorted by folder and time.

        The size of one image per camera and folder is checked.
        """
        images: dict[str, KaptureImage] = {}
        if all(path.name == MAPPING for path in self.folders):
            missing.files.append(self.folders[0].with_name(QUERY))
        for path in self.folders:
            folder = KaptureFolder(path)
            if path.name == MAPPING:
                missing.require(path / "sensors" / "trajectories.txt")
            data = folder.read()
            number = path.parent.name
            locations = (f"{int(number):03d}",) if number.isdecimal() else ()
            checked: set[str] = set()
            for (timestamp, sensor_id), name in sorted(data.records_camera.items()):
                if (known := images.get(name)) is not None:
                    both = tuple(dict.fromkeys((*known.locations, *locations)))
                    images[name] = replace(known, locations=both)
                    continue
                file, camera = folder.image_path(name), data.camera_of(name)
                if not missing.require(file):
                    continue
                if sensor_id not in checked:
                    check_image_size(file, camera)
                    checked.add(sensor_id)
                pose = data.device_from_world(timestamp, sensor_id)
                is_query = path.name != MAPPING
                images[name] = KaptureImage(
                    name, file, sensor_id, camera, pose, is_query, locations
                )
        return list(images.values())

    def rig(self) -> dict[str, RigidTransform]:
        """Return ``sensor_from_rig`` by sensor id, from the first folder that has the sensor."""
        poses: dict[str, RigidTransform] = {}
        for path in self.folders:
            for members in KaptureFolder(path).read().rigs.values():
                poses = {**members, **poses}
        return poses

    def without_model(self) -> OptionError:
        return OptionError(
            f"the reference model needs the official layout, but {self.root} has kapture "
            "folders; use megloc localize for a kapture map"
        )
