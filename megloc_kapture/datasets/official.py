"""A dataset as its adapter read it from the official layout, and its kapture folders.

An adapter (group ``megloc_kapture.datasets``) reads; :func:`write_official` writes, the same way
for every dataset: ``mapping/``, ``query/``, ``query_gt/`` where truth is known, ``megloc/`` and,
where asked for, ``reference/``, the model the dataset ships. Images are linked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from megloc_kapture.datasets.kapture_folders import (
    MAPPING,
    QUERY,
    QUERY_GT,
    tell_of_truth_without_query,
)
from megloc_kapture.datasets.reference_map import ReferenceModel, write_reference_map
from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import (
    SIDE_TABLES,
    ImageGroup,
    SideTables,
    World,
    read_groups,
    write_side_tables,
)
from megloc_kapture.io.files import link_records
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, write_sensors
from megloc_kapture.values import Options, RigidTransform

GROUND_TRUTH = "ground_truth"
REFERENCE = "reference"
_MISSING_SHOWN = 5


class DatasetCard(Options):
    """The address of a dataset and its layout on disk, for messages.

    ``folders`` are names that the root usually has, below MEGLOC_DATA.
    """

    title: str
    published_at: str
    size: str
    folders: tuple[str, ...]
    layout: str

    def without(self, root: Path, absent: Sequence[str]) -> DataError:
        """Return the error for a folder that lacks folders of the dataset."""
        return DataError(
            f"not {self.title}, no folder {' and '.join(absent)}; it has to lie as {self.layout}",
            path=root,
        )


@dataclass(frozen=True, slots=True)
class Count:
    """A line of an import's summary: what was found, beside what is published."""

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
    """Files that should be there and are not; collected, then refused or let pass."""

    root: Path
    files: list[Path] = field(default_factory=list)

    def require(self, file: Path) -> bool:
        """Return whether a file exists; else remember it."""
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
        """Raise DataError where files are missing."""
        if not self.files:
            return
        parts = self.by_folder()
        more = len(parts) - _MISSING_SHOWN
        raise DataError(
            f"{len(self.files)} files are missing: {', '.join(parts[:_MISSING_SHOWN])}"
            + (f", and files of {more} more folders" if more > 0 else "")
            + "; --allow-missing imports what is there",
            path=self.root,
        )

    def _shown(self, file: Path) -> Path:
        return file.relative_to(self.root) if file.is_relative_to(self.root) else file


@dataclass(frozen=True, eq=False, kw_only=True)
class OfficialDataset(SideTables):
    """A dataset as its adapter read it, with its tables.

    Parameters
    ----------
    mapping : sensors, records and poses of the map's images, in the local frame.
    query : sensors and records of the queries; without poses.
    query_gt : the queries' true poses where they are known, in the local frame; else None.
    links : folder below ``records_data`` -> folder of the dataset it is a link to; ``""`` makes
        ``records_data`` itself the link.
    image_files : image -> its file, for images that lie in no such folder; linked one by one.
    summary : what was found beside what is published.
    remarks : what a user should know, a sentence each.
    missing : what is not there.
    reference : the model the dataset ships, where it is asked for.
    write_more : writes what else belongs to the dataset (depth maps below ``mapping``) below the
        folder it is given.
    """

    mapping: KaptureData
    query: KaptureData
    links: Mapping[str, Path] = field(default_factory=dict)
    image_files: Mapping[str, Path] = field(default_factory=dict)
    query_gt: KaptureData | None = None
    world: World = World()
    summary: Sequence[Count] = ()
    remarks: Sequence[str] = ()
    missing: Missing | None = None
    reference: ReferenceModel | None = None
    write_more: Callable[[Path], None] | None = None


def check_official(dataset: OfficialDataset, *, allow_missing: bool = False) -> None:
    """Check that a dataset is complete enough to be written."""
    if dataset.missing is not None and not allow_missing:
        dataset.missing.refuse()
    root = dataset.missing.root if dataset.missing is not None else None
    if not dataset.mapping.records_camera or not dataset.mapping.trajectories:
        raise DataError("no mapping image with a pose is left to import", path=root)
    if not dataset.query.records_camera and not allow_missing:
        raise DataError("no query image is left to import", path=root)
    shared = set(dataset.mapping.image_names()) & set(dataset.query.image_names())
    if shared:
        raise DataError(f"image {min(shared)!r} is in the map and a query", path=root)


def write_official(dataset: OfficialDataset, output: Path, *, allow_missing: bool = False) -> None:
    """Write a dataset below ``output``: mapping/, query/, query_gt/ and megloc/."""
    check_official(dataset, allow_missing=allow_missing)
    for part, data in ((MAPPING, dataset.mapping), (QUERY, dataset.query)):
        write_sensors(output / part, data)
        link_records(output / part, dataset.links)
        own = set(data.image_names()) if dataset.image_files else set()
        link_records(output / part, {n: f for n, f in dataset.image_files.items() if n in own})
    if dataset.query_gt is not None and dataset.query_gt.trajectories:
        write_sensors(output / QUERY_GT, dataset.query_gt)
    write_side_tables(output / SIDE_TABLES, dataset)
    if dataset.reference is not None:
        names, points = dataset.reference.read()
        write_reference_map(
            output / REFERENCE,
            dataset.mapping,
            dataset.links,
            names,
            points,
            database=dataset.reference.database,
        )
    if dataset.write_more is not None:
        dataset.write_more(output)


def ground_truth_files(root: Path) -> Iterator[Path]:
    """The files :func:`read_ground_truth` depends on."""
    folder = root / GROUND_TRUTH
    yield from sorted((folder / QUERY / "sensors").glob("*.txt"))
    yield from sorted((folder / SIDE_TABLES).glob("*.csv"))


def read_ground_truth(
    root: Path, query: KaptureData, world: World
) -> tuple[KaptureData | None, dict[str, ImageGroup]]:
    """True poses that lie beside a dataset, for those of ``query`` that have one.

    The challenges keep theirs; rendered twins bring them, and a user may put his own there:
    ``<root>/ground_truth/query`` is a kapture folder with poses in the official frame and the
    image names of the import, ``<root>/ground_truth/megloc/groups.csv`` the queries' conditions.

    Returns
    -------
    The poses in the local frame (with ``query``'s sensors and records) or None, and the groups.
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
    return truth, read_groups(folder / SIDE_TABLES)


def with_poses(data: KaptureData, poses: Mapping[tuple[int, str], RigidTransform]) -> KaptureData:
    """``data`` with these trajectories, by (timestamp, device), instead of its own."""
    return replace(data, trajectories=dict(poses), records_depth={})


def last_part(image: str) -> str:
    """The file name of an image path."""
    return PurePosixPath(image).name
