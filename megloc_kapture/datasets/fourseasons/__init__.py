"""4Seasons' recordings on disk, relocalization files, and the selection of both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from megloc_kapture.datasets.formats.fourseasons_files import (
    CAMERA_FILES,
    STEREO_FILE,
    RelocalizationRow,
    StereoCalibration,
    parse_relocalization_name,
    read_calibration,
    read_relocalization,
    timestamp_of_name,
)
from megloc_kapture.datasets.official import Count, Missing
from megloc_kapture.errors import DataError, OptionError

CAMERAS = ("cam0", "cam1")
CALIBRATION_FOLDERS = ("calibration", "Calibration")
GNSS_POSES, POSES, TRANSFORMATIONS = "GNSSPoses.txt", "poses.txt", "Transformations.txt"

_IMAGES = "undistorted_images"
_MARKS = (_IMAGES, GNSS_POSES, POSES, "times.txt")
_RELOCALIZATION_FOLDERS = (".", "RelocalizationFiles*", "*", "*/RelocalizationFiles*")
# number of pairs by (source, target), from the challenges' pages
_PUBLISHED_PAIRS = {
    ("recording_2020-10-08_09-57-28", "recording_2021-01-07_14-03-57"): 227,
    ("recording_2020-10-08_11-53-41", "recording_2021-05-10_19-51-14"): 227,
    ("recording_2021-02-25_13-25-15", "recording_2021-05-10_18-26-26"): 129,
    ("city_loop_2_train", "city_loop_2_test"): 690,
    ("old_town_2_train", "old_town_3_test"): 630,
    ("parking_garage_2_train", "parking_garage_1_test"): 113,
}


@dataclass(frozen=True)
class Recording:
    name: str
    folder: Path

    @property
    def has_poses(self) -> bool:
        return (self.folder / GNSS_POSES).is_file() or (self.folder / POSES).is_file()

    def image(self, timestamp: int, camera: str) -> str:
        """Return the name of an image below the dataset's root."""
        return f"{self.name}/{_IMAGES}/{camera}/{timestamp}.png"

    def file_of(self, image: str) -> Path:
        return self.folder / image.removeprefix(f"{self.name}/")

    def image_file(self, timestamp: int, camera: str) -> Path:
        return self.folder / _IMAGES / camera / f"{timestamp}.png"

    def times_on_disk(self, camera: str) -> list[int]:
        """Return the timestamps (ns) of a camera's images, sorted."""
        images = (self.folder / _IMAGES / camera).glob("*.png")
        times = (timestamp_of_name(path.stem) for path in images)
        return sorted(time for time in times if time is not None)

    def calibration(self, root: Path) -> StereoCalibration:
        return read_calibration(self.calibration_folder(root))

    def calibration_files(self, root: Path) -> list[Path]:
        folder = self.calibration_folder(root)
        return [folder / name for name in (*CAMERA_FILES, STEREO_FILE)]

    def calibration_folder(self, root: Path) -> Path:
        for folder in (self.folder, root):
            for name in CALIBRATION_FOLDERS:
                if (folder / name).is_dir():
                    return folder / name
        raise DataError(
            f"no folder {' or '.join(CALIBRATION_FOLDERS)} here or in {self.name}; it is a "
            "separate download (calibration.zip)",
            path=root,
        )


@dataclass(frozen=True)
class RelocalizationFile:
    """A list of pairs requested by a challenge; the result file has the same name."""

    path: Path
    source: str
    target: str

    @cached_property
    def rows(self) -> list[RelocalizationRow]:
        return read_relocalization(self.path)

    def count(self) -> Count:
        published = _PUBLISHED_PAIRS.get((self.source, self.target))
        return Count(f"pairs in {self.path.name}", len(self.rows), published)


def find_recordings(root: Path) -> dict[str, Recording]:
    found = {
        folder.name: Recording(folder.name, folder)
        for folder in _folders(root)
        if any((folder / mark).exists() for mark in _MARKS)
    }
    if not found:
        raise DataError(
            f"no recording here, a folder with {_IMAGES}/ or {GNSS_POSES} in it",
            path=root,
        )
    return found


def _folders(root: Path) -> list[Path]:
    if not root.is_dir():
        raise DataError("no such folder", path=root)
    return sorted(path for path in root.iterdir() if path.is_dir())


def find_relocalization_files(root: Path, recordings: Iterable[str]) -> list[RelocalizationFile]:
    """Find relocalization files; without a source in their names they lie in its folder."""
    known = set(recordings)
    found: dict[str, RelocalizationFile] = {}
    for folder in _RELOCALIZATION_FOLDERS:
        for path in sorted(root.glob(f"{folder}/reloc*.txt")):
            named = parse_relocalization_name(path.name)
            if named is None or not path.is_file():
                continue
            source, target = named
            owner = path.relative_to(root).parts[0]
            if source is None and owner in known:
                source = owner
            if source is None:
                raise DataError(
                    "the file's name does not say whose map it means; it belongs into the folder "
                    "of the reference recording",
                    path=path,
                )
            if path.name in found:
                raise DataError(f"the same name as {found[path.name].path}", path=path)
            found[path.name] = RelocalizationFile(path, source, target)
    return sorted(found.values(), key=lambda file: (file.source, file.path.name))


# listed as missing if there is only a map recording
ANOTHER_RECORDING = "<another recording, for the queries>"


@dataclass(frozen=True)
class Selection:
    """All ``recordings``, the imported ones, and their relocalization files."""

    recordings: dict[str, Recording]
    references: list[Recording]
    queries: list[Recording]
    files: list[RelocalizationFile]


def select(
    root: Path, reference: Sequence[str], queries: Sequence[str], missing: Missing
) -> Selection:
    """Choose recordings by name, or by relocalization files.

    Without either, the first recording with poses is the map and the others are queries.
    """
    recordings = find_recordings(root)
    files = find_relocalization_files(root, recordings)
    _check_names("reference", reference, recordings, root)
    _check_names("queries", queries, recordings, root)
    both = sorted(set(reference) & set(queries))
    if both:
        raise OptionError(f"recording {both[0]!r} is given for the map and for the queries")
    sources = sorted(set(reference)) or _default_references(recordings, files, set(queries))
    targets = sorted(set(queries))
    if not targets:
        targets = sorted({f.target for f in files if f.source in sources} - set(sources))
    if not targets:
        targets = [name for name in recordings if name not in sources]
    missing.files += [root / name for name in (*sources, *targets) if name not in recordings]
    sources, targets = ([n for n in names if n in recordings] for names in (sources, targets))
    if not sources:
        raise DataError(
            f"{len(recordings)} recordings, none for the map; needed are one with published poses "
            "(GNSSPoses.txt or poses.txt) and another for the queries",
            path=root,
        )
    if not targets:
        missing.files.append(root / ANOTHER_RECORDING)
    return Selection(
        recordings,
        [recordings[name] for name in sources],
        [recordings[name] for name in targets],
        [file for file in files if file.source in sources and file.target in targets],
    )


def _check_names(
    option: str, names: Iterable[str], recordings: Mapping[str, Recording], root: Path
) -> None:
    unknown = sorted(set(names) - set(recordings))
    if unknown:
        known = ", ".join(recordings)
        raise OptionError(
            f"option {option}: no recording {unknown[0]!r} in {root}; there are {known}"
        )


def _default_references(
    recordings: Mapping[str, Recording], files: Sequence[RelocalizationFile], queries: set[str]
) -> list[str]:
    sources = sorted({file.source for file in files} - queries)
    with_poses = (name for name, recording in recordings.items() if recording.has_poses)
    return sources or [name for name in with_poses if name not in queries][:1]
