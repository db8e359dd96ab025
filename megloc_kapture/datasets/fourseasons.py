"""4Seasons and the MLAD challenges on it: one recording localized in another.

A root has recordings, folders of the published names, and ``calibration/`` beside or in them. The
map is made of the keyframes of the reference recordings, whose poses are published; queries are
images of other recordings. Where relocalization files of a challenge lie below the root, they say
which recordings are meant, which of their images are asked for, and near which keyframe each was
taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from megloc_kapture.datasets.fourseasons_challenge import Task, challenge_tables
from megloc_kapture.datasets.fourseasons_frames import (
    KeyframePoses,
    LocalFrame,
    read_keyframe_poses,
)
from megloc_kapture.datasets.fourseasons_images import CarNames, ImageRecords, write_depth_maps
from megloc_kapture.datasets.fourseasons_recordings import (
    ACCURACY,
    CAMERAS,
    GNSS_POSES,
    POSES,
    TIMES,
    TRANSFORMATIONS,
    Recording,
)
from megloc_kapture.datasets.fourseasons_report import image_groups, protocol, remarks, summary
from megloc_kapture.datasets.fourseasons_selection import Selection, select
from megloc_kapture.datasets.official import (
    DatasetCard,
    Missing,
    OfficialDataset,
    ground_truth_files,
    read_ground_truth,
    with_poses,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_store import KaptureData
from megloc_kapture.values import Options, RigidTransform

NAME = "4seasons"


class FourSeasonsOptions(Options):
    """What of 4Seasons is imported."""

    reference: tuple[str, ...] = Field(
        default=(),
        description="recordings of the map; unless given, those that relocalization files name as "
        "source, without such files the first by name that has poses",
    )
    queries: tuple[str, ...] = Field(
        default=(),
        description="recordings of the queries; unless given, those that relocalization files ask "
        "for, without such files all others",
    )
    frames: Literal["keyframes", "all"] = Field(
        default="keyframes",
        description="images: those of keyframes with a pose, or all that are on disk; of a query "
        "recording the keyframes that relocalization files ask for, or all where nothing tells",
    )
    stereo: bool = Field(default=True, description="take the right camera too")
    depth: bool = Field(
        default=False, description="the map keyframes' point clouds as sparse depth maps"
    )
    min_fusion_quality: int = Field(
        default=1,
        ge=0,
        le=2,
        description="keyframes with less are dropped: 2 fused with GNSS, 1 interpolated, 0 none",
    )

    @field_validator("reference", "queries", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        # one name, or several between commas, as a command line gives them
        return tuple(name.strip() for name in value.split(",")) if isinstance(value, str) else value


class FourSeasons:
    """Adapter of 4Seasons (group ``megloc_kapture.datasets``)."""

    name = NAME
    Options = FourSeasonsOptions
    card = DatasetCard(
        title="4Seasons",
        published_at="https://www.4seasons-dataset.com",
        size="several GB per recording: its undistorted stereo images and reference poses, and "
        "calibration.zip once",
        folders=("4Seasons",),
        layout="ROOT/calibration/ and ROOT/<recording>/{undistorted_images/,GNSSPoses.txt,"
        "Transformations.txt,times.txt} of two recordings or more; relocalization files of a "
        "challenge in ROOT or the reference recording's folder; or the recordings as "
        "kapture_import_4seasons converts them, in ROOT/records/",
    )

    def __init__(self, options: FourSeasonsOptions | None = None) -> None:
        self.options = options or FourSeasonsOptions()

    def check(self, root: Path) -> None:
        """Raise DataError, quickly, when ``root`` has not the recordings or no calibration."""
        chosen = self._select(root, Missing(root))
        for recording in (*chosen.references, *chosen.queries):
            recording.calibration(root)

    def input_files(self, root: Path) -> Iterator[Path]:
        """Every file an import depends on: text files, images, point clouds where asked for."""
        dataset = self.read(root, allow_missing=True)
        chosen = self._select(root, Missing(root))
        yield from (file.path for file in chosen.files)
        recordings = (*chosen.references, *chosen.queries)
        yield from dict.fromkeys(f for r in recordings for f in r.calibration_files(root))
        for recording in recordings:
            for name in (GNSS_POSES, TRANSFORMATIONS, POSES, ACCURACY, TIMES):
                if (recording.folder / name).is_file():
                    yield recording.folder / name
        for data in (dataset.mapping, dataset.query):
            for image in data.image_names():
                yield chosen.recordings[image.partition("/")[0]].file_of(image)
        if self.options.depth:
            taken = {timestamp for timestamp, _ in dataset.mapping.records_depth}
            for recording in chosen.references:
                files = (recording.keyframe_file(timestamp) for timestamp in sorted(taken))
                yield from (file for file in files if file.is_file())
        yield from ground_truth_files(root)

    def read(self, root: Path, *, allow_missing: bool = False) -> OfficialDataset:
        """Read the selected recordings.

        Raises
        ------
        DataError : something is broken, or there is nothing to import; names file and line.
        OptionError : an option names a recording that is not here, or one for both parts.
        """
        missing, names = Missing(root), CarNames()
        chosen = self._select(root, missing)
        tasks = [Task(file, file.rows()) for file in chosen.files]
        poses = self._reference_poses(chosen.references, missing)
        frame = LocalFrame.around(poses[chosen.references[0].name])
        local = {name: frame.cams_from_local(of) for name, of in poses.items()}
        mapping = ImageRecords(names, missing, self.options.stereo)
        for recording in chosen.references:
            self._add_map(mapping, recording, root, poses[recording.name], local[recording.name])
        query = ImageRecords(names, missing, self.options.stereo)
        truth: dict[tuple[int, str], RigidTransform] = {}
        cars: dict[str, str] = {}
        for recording in chosen.queries:
            known = self._query_poses(recording, frame, missing)
            times = self._query_times(recording, known, tasks, missing)
            calibration = recording.calibration(root)
            cars[recording.name] = query.add(recording, calibration, times)
            truth |= {(time, cars[recording.name]): pose for time, pose in known.items()}
        tables = challenge_tables(tasks, chosen.recordings, local, mapping.data, query.data)
        truth |= {(time, cars[name]): pose for (name, time), pose in tables.truth.items()}
        groups = image_groups(chosen, tasks, mapping.data, query.data)
        beside, beside_groups = read_ground_truth(root, query.data, frame.world())
        for image in groups.keys() & beside_groups.keys():
            condition = beside_groups[image].condition or groups[image].condition
            groups[image] = groups[image].model_copy(update={"condition": condition})
        query_gt = _known_poses(query.data, truth, beside)
        used = (*chosen.references, *chosen.queries)
        return OfficialDataset(
            mapping=mapping.data,
            query=query.data,
            query_gt=query_gt,
            links={recording.name: recording.folder for recording in used},
            protocol=protocol(NAME, chosen.queries, challenge=bool(tasks)),
            groups=groups,
            priors=tables.priors,
            relocalization=tables.pairs,
            world=frame.world(),
            summary=summary(chosen, tasks, poses, mapping.data, query.data, query_gt),
            remarks=remarks(poses, frame, tables, self.options.min_fusion_quality),
            missing=missing,
            write_more=partial(write_depth_maps, mapping.depth_jobs)
            if self.options.depth
            else None,
        )

    def _select(self, root: Path, missing: Missing) -> Selection:
        return select(root, self.options.reference, self.options.queries, missing)

    def _reference_poses(
        self, references: Sequence[Recording], missing: Missing
    ) -> dict[str, KeyframePoses]:
        found = {}
        for recording in references:
            # the frame of a poses.txt is its recording's own
            poses = read_keyframe_poses(
                recording,
                min_fusion_quality=self.options.min_fusion_quality,
                on_earth=None if len(references) == 1 else True,
                missing=missing,
            )
            if poses is None:
                raise DataError(
                    f"no poses for the map: {GNSS_POSES} and {TRANSFORMATIONS} are needed"
                    + (f", or {POSES}" if len(references) == 1 else ""),
                    path=recording.folder,
                )
            found[recording.name] = poses
        return found

    def _add_map(
        self,
        mapping: ImageRecords,
        recording: Recording,
        root: Path,
        poses: KeyframePoses,
        cams_from_local: Mapping[int, RigidTransform],
    ) -> None:
        times: Iterable[int] = sorted(cams_from_local)
        if self.options.frames == "all":
            times = recording.times_on_disk(CAMERAS[0])
        calibration = recording.calibration(root)
        car = mapping.add(recording, calibration, times)
        taken = {timestamp for timestamp, _ in mapping.data.records_camera}
        for timestamp, pose in cams_from_local.items():
            if timestamp in taken:
                mapping.data.trajectories[timestamp, car] = pose
        if self.options.depth:
            scales = {t: s for t, s in poses.scales.items() if t in cams_from_local}
            if not scales:
                raise DataError(
                    f"depth needs the scale of the keyframes, which is in {GNSS_POSES}",
                    path=recording.folder,
                )
            mapping.add_depth(recording, calibration, scales)

    def _query_poses(
        self, recording: Recording, frame: LocalFrame, missing: Missing
    ) -> dict[int, RigidTransform]:
        if frame.earth_from_scene is None:
            return {}
        poses = read_keyframe_poses(
            recording,
            min_fusion_quality=self.options.min_fusion_quality,
            on_earth=True,
            missing=missing,
        )
        return {} if poses is None else frame.cams_from_local(poses)

    def _query_times(
        self,
        recording: Recording,
        poses: Mapping[int, RigidTransform],
        tasks: Sequence[Task],
        missing: Missing,
    ) -> list[int]:
        of_tasks = (task.rows for task in tasks if task.file.target == recording.name)
        asked = {row.query for rows in of_tasks for row in rows}
        wanted = asked or set(poses)
        if self.options.frames == "all" or not wanted:
            wanted = asked | set(recording.times_on_disk(CAMERAS[0]))
        if not wanted:
            missing.require(recording.image_file(0, CAMERAS[0]).parent)
        return sorted(wanted)


def _known_poses(
    query: KaptureData,
    published: Mapping[tuple[int, str], RigidTransform],
    beside: KaptureData | None,
) -> KaptureData | None:
    """The queries with the poses that are published; where none is, with those beside the data."""
    times = {timestamp for timestamp, _ in query.records_camera}
    poses = {key: pose for key, pose in published.items() if key[0] in times}
    known = with_poses(query, poses)
    if beside is not None:
        for (timestamp, device), pose in beside.trajectories.items():
            if known.device_from_world(timestamp, device) is None:
                poses[timestamp, device] = pose
    return with_poses(query, poses) if poses else None
