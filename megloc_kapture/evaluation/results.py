"""Results as they lie on disk: a localized kapture, a pose file, the files of an MLAD challenge."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.mlad_file import read_mlad_file, timestamp_of
from megloc_kapture.evaluation.pose_file import poses_by_image, read_pose_file
from megloc_kapture.evaluation.rules import Rules
from megloc_kapture.evaluation.surroundings import side_tables_near
from megloc_kapture.io.challenge_tables import RelocalizationPair
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.io.side_tables import World, read_world
from megloc_kapture.io.status_table import STATUS_FILE, QueryStatus, read_status
from megloc_kapture.values import RigidTransform

Poses = Mapping[str, RigidTransform]


@dataclass(frozen=True, eq=False)
class Result:
    """One result, in the frame of the truth.

    Attributes
    ----------
    label : what it is called in tables.
    poses : image -> ``cam_from_world``.
    images : every query the result is about, with or without a pose; sorted. A pose file tells
        only those that have one.
    statuses : rows of ``status.csv``; None without one.
    by_pair : of MLAD's pose files, the query's ``cam_from_world`` of each row; None of others.
    """

    label: str
    poses: Poses
    images: tuple[str, ...]
    statuses: Mapping[str, QueryStatus] | None = None
    by_pair: Mapping[RelocalizationPair, RigidTransform] | None = None

    def poses_of_pairs(
        self, pairs: Iterable[RelocalizationPair]
    ) -> Mapping[RelocalizationPair, RigidTransform]:
        """The ``cam_from_world`` of each pair's query; pairs without a pose are absent."""
        if self.by_pair is not None:
            return self.by_pair
        return {pair: self.poses[pair.query] for pair in pairs if pair.query in self.poses}


def read_result(
    source: Path | str,
    rules: Rules,
    *,
    images: Iterable[str] = (),
    references: Poses | None = None,
    label: str = "",
) -> Result:
    """Read a result.

    Parameters
    ----------
    source : a localized kapture folder, a pose file, or (where the rules have MLAD's pairs) a pose
        file of the MLAD challenges or a folder with several.
    images : those that the short names of a pose file may stand for.
    references : ``cam_from_world`` of the map's images, for MLAD's pose files.

    Raises
    ------
    DataError : broken, or of another kind; names file and line.
    """
    path = Path(source)
    if rules.protocol.pose_file == "mlad" and rules.pairs and not _is_kapture(path):
        by_pair = _read_mlad(path, rules.pairs, references or {}, rules.world)
        poses = {pair.query: pose for pair, pose in by_pair.items()}
        return Result(label, poses, tuple(sorted(poses)), by_pair=by_pair)
    if path.is_dir():
        data = KaptureFolder(path).read()
        found = _in_frame_of(rules.world, data.poses(), path)
        return Result(label, found, tuple(sorted(data.image_names())), load_statuses(path))
    poses = load_poses(path, images=images, world=rules.world, names=rules.names)
    return Result(label, poses, tuple(sorted(poses)))


def load_poses(
    source: Path | str,
    *,
    images: Iterable[str] = (),
    world: World | None = None,
    names: Mapping[str, str] | None = None,
) -> dict[str, RigidTransform]:
    """``cam_from_world`` by image, of a kapture folder or a pose file.

    Parameters
    ----------
    images : the images that the short names of a pose file may stand for.
    world : of the workspace; a pose file stands in the official frame and is brought to the local
        one. A kapture folder is in the local frame already.
    names : image -> its name in a pose file, by the challenge's list.
    """
    path = Path(source)
    if path.is_dir():
        return KaptureFolder(path).read().poses()
    poses = poses_by_image(read_pose_file(path), images, names)
    if world is None or world == World():
        return poses
    return {image: world.pose_in_local(pose) for image, pose in poses.items()}


def load_statuses(result: Path | str) -> dict[str, QueryStatus] | None:
    """The rows of ``status.csv`` in a result folder; None where there is none."""
    path = Path(result) / STATUS_FILE
    return read_status(path) if path.is_file() else None


def distinct_labels(sources: Sequence[Path]) -> list[str]:
    """Short names that tell paths apart: without the folders that all of them begin or end with."""
    if len(sources) < 2:
        return [str(source) for source in sources]
    parts = [source.parts for source in sources]
    shortest = min(map(len, parts))
    same = [len({p[i] for p in parts}) == 1 for i in range(shortest)]
    head = same.index(False) if False in same else shortest
    ends = [len({p[-1 - i] for p in parts}) == 1 for i in range(shortest - head)]
    tail = ends.index(False) if False in ends else len(ends)
    labels = ["/".join(p[head : len(p) - tail]) for p in parts]
    return labels if all(labels) else [str(source) for source in sources]


def _is_kapture(path: Path) -> bool:
    return (path / "sensors").is_dir()


def _in_frame_of(world: World, poses: dict[str, RigidTransform], result: Path) -> Poses:
    """Poses of a workspace that was recentred in another way, brought to the truth's frame."""
    tables = side_tables_near(result)
    own = world if tables is None else read_world(tables)
    if own.official_from_local == world.official_from_local:
        return poses
    return {i: world.pose_in_local(own.pose_in_official(pose)) for i, pose in poses.items()}


def _read_mlad(
    path: Path, pairs: Sequence[RelocalizationPair], references: Poses, world: World
) -> dict[RelocalizationPair, RigidTransform]:
    files = {pair.file for pair in pairs}
    if path.is_dir():
        places = {file: path / file for file in sorted(files) if (path / file).is_file()}
        if not places:
            raise DataError(
                f"neither a kapture folder nor one with pose files ({min(files)})", path=path
            )
    else:
        if path.name not in files and len(files) > 1:
            raise DataError(
                f"which relocalization file it answers is not clear; call it as that one: "
                f"{', '.join(sorted(files))}",
                path=path,
            )
        places = {path.name if path.name in files else min(files): path}
    found: dict[RelocalizationPair, RigidTransform] = {}
    for file, place in places.items():
        asked = {
            (timestamp_of(pair.reference), timestamp_of(pair.query)): pair
            for pair in pairs
            if pair.file == file
        }
        for row in read_mlad_file(place):
            pair = asked.get((row.reference, row.query))
            if pair is None:
                raise DataError(f"pair {row.reference} {row.query} is not asked for", path=place)
            if row.query_from_reference is None:
                raise DataError("has pairs without poses, as a relocalization file", path=place)
            if pair.reference not in references:
                raise DataError(f"reference {pair.reference!r} has no pose in the map", path=place)
            pose = _in_local_units(row.query_from_reference, world.official_from_local.scale)
            found[pair] = pose @ references[pair.reference]
    return found


def _in_local_units(pose: RigidTransform, metres_per_unit: float) -> RigidTransform:
    if metres_per_unit == 1.0:
        return pose
    x, y, z = (np.array(pose.translation) / metres_per_unit).tolist()
    return RigidTransform(pose.quat_wxyz, (x, y, z))
