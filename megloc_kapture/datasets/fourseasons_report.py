"""What an import of 4Seasons tells: protocol, groups, summary, remarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from megloc_kapture.datasets.fourseasons_challenge import ChallengeTables, Task
from megloc_kapture.datasets.fourseasons_frames import KeyframePoses, LocalFrame
from megloc_kapture.datasets.fourseasons_recordings import (
    ACCURACY,
    CAMERAS,
    POSES,
    TIMES,
    Recording,
)
from megloc_kapture.datasets.fourseasons_selection import Selection
from megloc_kapture.datasets.grammars.fourseasons_poses import read_keyframe_accuracy
from megloc_kapture.datasets.grammars.fourseasons_times import read_times
from megloc_kapture.datasets.official import Count
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.kapture_store import KaptureData
from megloc_kapture.io.side_tables import ImageGroup, Protocol

# of other long-term benchmarks, where no challenge asks
GENERAL_THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))


def image_groups(
    chosen: Selection, tasks: Sequence[Task], mapping: KaptureData, query: KaptureData
) -> dict[str, ImageGroup]:
    """Groups of all images: a query's condition is its recording.

    Scored are left images; where relocalization files ask for images of a recording, these.
    """
    groups = {
        image: ImageGroup(location=image.partition("/")[0]) for image in mapping.image_names()
    }
    asked = {
        chosen.recordings[task.file.target].image(row.query, CAMERAS[0])
        for task in tasks
        for row in task.rows
    }
    with_tasks = {task.file.target for task in tasks}
    for (timestamp, _), image in query.records_camera.items():
        name = image.partition("/")[0]
        left = image == chosen.recordings[name].image(timestamp, CAMERAS[0])
        scored = left and (name not in with_tasks or image in asked)
        groups[image] = ImageGroup(condition=name, scored=scored)
    return groups


def protocol(name: str, queries: Sequence[Recording], *, challenge: bool) -> Protocol:
    """How it is scored: as the MLAD challenges where one is there, else as other long-term sets.

    Without a challenge nobody takes a pose file; ours has absolute poses in ECEF then.
    """
    own: dict[str, Any] = {"conditions": tuple(recording.name for recording in queries)}
    if not challenge:
        own |= {"thresholds": GENERAL_THRESHOLDS, "pose_file": "ltvl"}
    return protocol_of(name).model_copy(update=own)


def summary(
    chosen: Selection,
    tasks: Sequence[Task],
    poses: Mapping[str, KeyframePoses],
    mapping: KaptureData,
    query: KaptureData,
    query_gt: KaptureData | None,
) -> list[Count]:
    """What was found, beside what is published."""
    counts = [Count("recordings", len(chosen.recordings))]
    images = [image.partition("/")[0] for data in (mapping, query) for image in data.image_names()]
    for part, recordings in (("map", chosen.references), ("query", chosen.queries)):
        for recording in recordings:
            counts.append(Count(f"{recording.name}: {part} images", images.count(recording.name)))
            if recording.name in poses:
                good = poses[recording.name]
                rows = len(good.scene_from_cam) + len(good.dropped)
                counts.append(Count("  keyframes with a pose", len(good.scene_from_cam), rows))
            if (recording.folder / TIMES).is_file():
                listed = len(read_times(recording.folder / TIMES))
                counts.append(Count(f"  frames in {TIMES}", listed))
                on_disk = len(recording.times_on_disk(CAMERAS[0]))
                counts.append(Count("  frames with a left image", on_disk))
            if (recording.folder / ACCURACY).is_file():
                accurate = read_keyframe_accuracy(recording.folder / ACCURACY)
                counts.append(Count("  keyframes known to 0.05 m", len(accurate)))
    counts += [task.count() for task in tasks]
    counts.append(Count("images with a pose in the map", len(mapping.poses())))
    counts.append(Count("queries", len(query.records_camera)))
    known = 0 if query_gt is None else len(query_gt.poses())
    counts.append(Count("queries with a known pose", known))
    return counts


def remarks(
    poses: Mapping[str, KeyframePoses],
    frame: LocalFrame,
    tables: ChallengeTables,
    min_fusion_quality: int,
) -> list[str]:
    """What a user should know, a sentence each."""
    told = []
    for name, of in poses.items():
        if of.dropped:
            told.append(
                f"{name}: {len(of.dropped)} keyframes are left out, their fusion quality is below "
                f"{min_fusion_quality} (min_fusion_quality)."
            )
    if frame.earth_from_scene is None:
        told.append(
            f"The map's poses are those of {POSES}, whose frame is its own: of the queries only "
            "poses in relocalization files are known."
        )
    if tables.lost:
        told.append(
            f"{tables.lost} pairs of relocalization files are left out: their reference has no "
            "pose or image, or their query no image. A challenge expects every pair."
        )
    return told
