"""What the MLAD challenges' relocalization files say: pairs, permitted map images, true poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from megloc_kapture.datasets.fourseasons_recordings import CAMERAS, Recording, RelocalizationFile
from megloc_kapture.datasets.grammars.fourseasons_relocalization import RelocalizationRow
from megloc_kapture.datasets.official import Count
from megloc_kapture.io.challenge_tables import RelocalizationPair
from megloc_kapture.io.kapture_store import KaptureData
from megloc_kapture.values import RigidTransform

# a query may be matched with the map images of so many keyframes before and after its reference
NEIGHBOURS = 20

# pairs of source and target -> their number, from the challenges' pages
PUBLISHED_PAIRS = {
    ("recording_2020-10-08_09-57-28", "recording_2021-01-07_14-03-57"): 227,
    ("recording_2020-10-08_11-53-41", "recording_2021-05-10_19-51-14"): 227,
    ("recording_2021-02-25_13-25-15", "recording_2021-05-10_18-26-26"): 129,
    ("city_loop_2_train", "city_loop_2_test"): 690,
    ("old_town_2_train", "old_town_3_test"): 630,
    ("parking_garage_2_train", "parking_garage_1_test"): 113,
}


@dataclass(frozen=True)
class Task:
    """A relocalization file with its pairs."""

    file: RelocalizationFile
    rows: Sequence[RelocalizationRow]

    def count(self) -> Count:
        """Its pairs, beside those published."""
        published = PUBLISHED_PAIRS.get((self.file.source, self.file.target))
        return Count(f"pairs in {self.file.name}", len(self.rows), published)


@dataclass
class ChallengeTables:
    """What the tasks mean in terms of imported images.

    Attributes
    ----------
    pairs : in the files' order.
    priors : query image -> map images around its reference keyframes.
    truth : (recording, timestamp) of a query -> ``cam0_from_local``, where a file has it.
    lost : pairs whose reference has no pose or image, or whose query has no image.
    """

    pairs: list[RelocalizationPair] = field(default_factory=list)
    priors: dict[str, tuple[str, ...]] = field(default_factory=dict)
    truth: dict[tuple[str, int], RigidTransform] = field(default_factory=dict)
    lost: int = 0


def challenge_tables(
    tasks: Sequence[Task],
    recordings: Mapping[str, Recording],
    cams_from_local: Mapping[str, Mapping[int, RigidTransform]],
    mapping: KaptureData,
    query: KaptureData,
) -> ChallengeTables:
    """Pairs, priors and true poses of relocalization files.

    Parameters
    ----------
    cams_from_local : of the reference recordings' keyframes: recording -> timestamp -> pose of the
        left camera.
    mapping, query : what was imported; a pair counts only where both of its images were.
    """
    tables = ChallengeTables()
    map_images, query_images = set(mapping.image_names()), set(query.image_names())
    around: dict[tuple[str, int], set[str]] = {}
    for task in tasks:
        source, target = recordings[task.file.source], recordings[task.file.target]
        poses = cams_from_local[source.name]
        # only what is in the map can be a neighbour
        times = [t for t in sorted(poses) if source.image(t, CAMERAS[0]) in map_images]
        place = {timestamp: index for index, timestamp in enumerate(times)}
        for row in task.rows:
            image = target.image(row.query, CAMERAS[0])
            if row.reference not in place or image not in query_images:
                tables.lost += 1
                continue
            reference = source.image(row.reference, CAMERAS[0])
            tables.pairs.append(RelocalizationPair(task.file.name, reference, image))
            index = place[row.reference]
            near = times[max(0, index - NEIGHBOURS) : index + NEIGHBOURS + 1]
            names = {source.image(t, camera) for t in near for camera in CAMERAS}
            around.setdefault((target.name, row.query), set()).update(names & map_images)
            if row.query_from_reference is not None:
                pose = row.query_from_reference @ poses[row.reference]
                tables.truth.setdefault((target.name, row.query), pose)
    for (name, timestamp), permitted in around.items():
        for camera in CAMERAS:
            image = recordings[name].image(timestamp, camera)
            if image in query_images:
                tables.priors[image] = tuple(sorted(permitted))
    return tables
