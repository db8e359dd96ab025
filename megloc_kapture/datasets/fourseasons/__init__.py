"""4Seasons' recordings on disk, their text files, and those of the MLAD challenges.

Fields are separated by commas or blanks; ``#`` begins a comment line. Timestamps are integers (ns)
and are never converted to float, which would lose digits. Quaternions are x y z w.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from megloc_kapture.datasets.official import Missing, kapture_hint
from megloc_kapture.errors import DataError, OptionError, require
from megloc_kapture.evaluation.pose_files import parse_timestamp
from megloc_kapture.io.files import named
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.io.text_lines import fields_of, numbers_of, read_transform, reading_lines
from megloc_kapture.values import Camera, RigidTransform

CAMERA_FILES = ("undistorted_calib_0.txt", "undistorted_calib_1.txt")
STEREO_FILE = "undistorted_calib_stereo.txt"

_TIMESTAMP = re.compile(r"[1-9][0-9]{0,18}")
# relocalization files of 2021, 2020 (in the source's folder) and 2022
_RELOCALIZATION_NAMES = (
    re.compile(r"relocalizationFile_(?P<source>.+)_to_(?P<target>.+)\.txt"),
    re.compile(r"relocalizationFile_(?P<target>.+?)(?:_(?:easy|moderate|hard))?\.txt"),
    re.compile(r"reloc_(?P<source>.+)_to_(?P<target>.+)\.txt"),
)

Row = TypeVar("Row")
# timestamps of reference and query -> ``query_from_reference``, None if the row has no pose
RelativePoses = dict[tuple[int, int], RigidTransform | None]

# the two cameras by name, each with its cam_from_cam0 in metres
Calibration = Mapping[str, tuple[Camera, RigidTransform]]


def read_calibration(folder: Path) -> Calibration:
    """Read the cameras of the undistorted images: cam0, the left one, and cam1.

    The dataset's page says that the stereo file has the transform "from the right to the left
    camera", but camchain.yaml, the sign of the translation and all users of the data agree on cam1
    from cam0.
    """
    cam0, cam1 = (read_pinhole(folder / name) for name in CAMERA_FILES)
    cam1_from_cam0 = read_transform(folder / STEREO_FILE, comments=True)
    return {"cam0": (cam0, RigidTransform.identity()), "cam1": (cam1, cam1_from_cam0)}


def read_pinhole(path: Path) -> Camera:
    """Read ``undistorted_calib_N.txt``: ``Pinhole fx fy cx cy 0 0 0 0``, then the size, twice."""
    with reading_lines(path, comments=True) as lines:
        (model, *values), *sizes = map(fields_of, lines)
        params = list(map(float, values))
        require(
            model == "Pinhole" and len(params) in (4, 8) and not any(params[4:]),
            "expected 'Pinhole fx fy cx cy', without distortion, as images are undistorted",
        )
        width, height = map(int, sizes[0])
        return Camera("PINHOLE", width, height, tuple(params[:4]))


# pose of the undistorted left camera in SLAM units; metres per SLAM unit and fusion quality (2
# fused with GNSS, 1 interpolated, 0 none), each None if the row lacks it
GnssPose = tuple[RigidTransform, float | None, float | None]


def read_gnss_poses(path: Path) -> dict[int, GnssPose]:
    """Read ``slam_from_cam``, scale and fusion quality of ``GNSSPoses.txt`` by timestamp (ns).

    A row is ``timestamp tx ty tz qx qy qz qw [scale [fusion_quality [v3]]]``. Published rows have
    10 fields, although their header names 11.
    """

    def parse(fields: list[str]) -> GnssPose:
        scale = float(fields[7]) if len(fields) > 7 else None
        quality = float(fields[8]) if len(fields) > 8 else None
        return _transform(fields[:7]), scale, quality

    return _by_timestamp(path, parse)


def read_poses(path: Path) -> dict[int, RigidTransform]:
    """Read ``poses.txt`` (ECCV 2020 challenge): ``world_from_cam`` by timestamp (ns), metres."""
    return _by_timestamp(path, _transform)


def _by_timestamp(path: Path, parse: Callable[[list[str]], Row]) -> dict[int, Row]:
    rows: dict[int, Row] = {}
    with reading_lines(path, comments=True) as lines:
        for timestamp, *fields in map(fields_of, lines):
            rows[parse_timestamp(timestamp)] = parse(fields)
    return rows


def _transform(fields: Sequence[str]) -> RigidTransform:
    tx, ty, tz, qx, qy, qz, qw = numbers_of(fields, "tx ty tz qx qy qz qw")
    return RigidTransform(unit_quaternion((qw, qx, qy, qz)), (tx, ty, tz))


def read_transformations(path: Path) -> tuple[RigidTransform, RigidTransform, float | None]:
    """Read ``Transformations.txt``: a line ``# name: ...`` before each line of numbers.

    Return ``scene_from_slam`` without scale (the scene's axes are east, north and up),
    ``earth_from_scene`` (ECEF), and metres per SLAM unit or None.
    """
    texts: dict[str, str] = {}
    name = ""
    with reading_lines(path) as lines:
        for line in lines:
            if line.startswith("#"):
                name = line[1:].partition(":")[0].strip()
            else:
                texts[name] = line
    transforms = []
    for name in ("transform_S_AS", "transform_w_gpsw", "transform_e_gpsw"):
        with named(path, about=name):
            transforms.append(_transform(fields_of(texts.get(name, ""))))
    scale = float(texts["GNSS scale"]) if "GNSS scale" in texts else None
    world_from_slam, world_from_scene, earth_from_scene = transforms
    return world_from_scene.inverse() @ world_from_slam, earth_from_scene, scale


def parse_relocalization_name(name: str) -> tuple[str | None, str] | None:
    """Return source and target recording of a file name, the source None if the name lacks it."""
    for pattern in _RELOCALIZATION_NAMES:
        if match := pattern.fullmatch(name):
            parts = match.groupdict()
            return parts.get("source"), parts["target"]
    return None


def read_relocalization(path: Path) -> RelativePoses:
    rows: RelativePoses = {}
    with reading_lines(path, comments=True) as lines:
        for fields in map(fields_of, lines):
            require(len(fields) in (2, 9), f"{len(fields)} columns instead of 2 or 9")
            reference, query = map(parse_timestamp, fields[:2])
            pose = _transform(fields[2:]) if fields[2:] else None
            rows.setdefault((reference, query), pose)
    return rows


CAMERAS = ("cam0", "cam1")
CALIBRATION_FOLDERS = ("calibration", "Calibration")
GNSS_POSES, POSES, TRANSFORMATIONS = "GNSSPoses.txt", "poses.txt", "Transformations.txt"

_IMAGES = "undistorted_images"
_MARKS = (_IMAGES, GNSS_POSES, POSES, "times.txt")
_RELOCALIZATION_FOLDERS = (".", "*", "*/RelocalizationFiles*")
# number of pairs by (source, target), from the challenges' pages
PUBLISHED_PAIRS = {
    ("recording_2020-10-08_09-57-28", "recording_2021-01-07_14-03-57"): 227,
    ("recording_2020-10-08_11-53-41", "recording_2021-05-10_19-51-14"): 227,
    ("recording_2021-02-25_13-25-15", "recording_2021-05-10_18-26-26"): 129,
    ("city_loop_2_train", "city_loop_2_test"): 690,
    ("old_town_2_train", "old_town_3_test"): 630,
    ("parking_garage_2_train", "parking_garage_1_test"): 113,
}


@dataclass(frozen=True)
class Recording:
    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def has_poses(self) -> bool:
        return (self.folder / GNSS_POSES).is_file() or (self.folder / POSES).is_file()

    def image(self, timestamp: int, camera: str) -> str:
        """Return the name of an image below the dataset's root."""
        return f"{self.name}/{_IMAGES}/{camera}/{timestamp}.png"

    def image_file(self, timestamp: int, camera: str) -> Path:
        return self.folder / _IMAGES / camera / f"{timestamp}.png"

    def times_on_disk(self, camera: str) -> list[int]:
        """Return the timestamps (ns) of a camera's images, sorted."""
        images = (self.folder / _IMAGES / camera).glob("*.png")
        return sorted(int(path.stem) for path in images if _TIMESTAMP.fullmatch(path.stem))

    def calibration(self, root: Path) -> Calibration:
        for folder in (self.folder, root):
            for name in CALIBRATION_FOLDERS:
                if (folder / name).is_dir():
                    return read_calibration(folder / name)
        raise DataError(
            f"no folder {' or '.join(CALIBRATION_FOLDERS)} here or in {self.name}; it is a "
            "separate download (calibration.zip)",
            path=root,
        )


@dataclass(frozen=True)
class RelocalizationFile:
    """A list of pairs requested by a challenge; the pose file to submit has the same name."""

    path: Path
    source: str
    target: str

    @cached_property
    def rows(self) -> RelativePoses:
        return read_relocalization(self.path)


def find_recordings(root: Path) -> dict[str, Recording]:
    recordings = {
        folder.name: Recording(folder)
        for folder in _folders(root)
        if any((folder / mark).exists() for mark in _MARKS)
    }
    if not recordings:
        found = next(root.glob(f"*/*/{_IMAGES}"), root.resolve() / _IMAGES)
        found_in = f"; there is one in {found.parent.parent}/: give it as the root"
        hint = found_in if found.exists() else kapture_hint(root)
        reason = f"no recording here (a folder with {_IMAGES}/ or {GNSS_POSES}){hint}"
        raise DataError(reason, path=root)
    return recordings


def _folders(root: Path) -> list[Path]:
    require(root.is_dir(), "no such folder", path=root)
    return sorted(path for path in root.iterdir() if path.is_dir())


def find_relocalization_files(root: Path, recordings: Iterable[str]) -> list[RelocalizationFile]:
    """Find relocalization files; one whose name lacks the source must be in the source's folder."""
    known = set(recordings)
    files: dict[str, RelocalizationFile] = {}
    for folder in _RELOCALIZATION_FOLDERS:
        for path in sorted(root.glob(f"{folder}/reloc*.txt")):
            parsed = parse_relocalization_name(path.name)
            if parsed is None or not path.is_file():
                continue
            source, target = parsed
            owner = path.relative_to(root).parts[0]
            if source is None and owner in known:
                source = owner
            if source is None:
                raise DataError(
                    "the file name does not say which recording is the reference; move the file "
                    "into that recording's folder",
                    path=path,
                )
            if path.name in files:
                raise DataError(f"has the same file name as {files[path.name].path}", path=path)
            files[path.name] = RelocalizationFile(path, source, target)
    return sorted(files.values(), key=lambda file: (file.source, file.path.name))


# listed as a missing file if the only recordings are those of the map
ANOTHER_RECORDING = "<another recording, for the queries>"


@dataclass(frozen=True)
class Selection:
    """All ``recordings`` by name, those imported as map and queries, and relocalization files."""

    recordings: dict[str, Recording]
    references: list[Recording]
    queries: list[Recording]
    files: list[RelocalizationFile]


def select(
    root: Path, reference: Sequence[str], queries: Sequence[str], missing: Missing
) -> Selection:
    """Choose recordings by name, or by relocalization files.

    Without names or files, the first recording with poses is the map and all others are queries.
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
        targets = [name for name in recordings if name not in sources] or [ANOTHER_RECORDING]
    absent = [name for name in (*sources, *targets) if name not in recordings]
    missing.files += [root / name for name in absent]
    sources, targets = ([n for n in names if n in recordings] for names in (sources, targets))
    require(
        sources,
        f"{len(recordings)} recordings, none for the map; a recording with published poses "
        "(GNSSPoses.txt or poses.txt) and another one for the queries are needed"
        + (f"; the relocalization files refer to {absent[0]}" if files and absent else ""),
        path=root,
    )
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
        raise OptionError(f"option {option}: no recording {unknown[0]!r} in {root}; known: {known}")


def _default_references(
    recordings: Mapping[str, Recording], files: Sequence[RelocalizationFile], queries: set[str]
) -> list[str]:
    sources = sorted({file.source for file in files} - queries)
    with_poses = (name for name, recording in recordings.items() if recording.has_poses)
    return sources or [name for name in with_poses if name not in queries][:1]
