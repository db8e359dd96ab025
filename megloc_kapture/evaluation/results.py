"""Results on disk (kapture folders, pose files) and the workspace data around them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.pose_files import (
    checked_pose,
    poses_by_image,
    read_confidences,
    read_mlad_file,
    read_pose_file,
    timestamp_of,
)
from megloc_kapture.evaluation.protocols import Benchmark
from megloc_kapture.io.colmap_model import read_colmap_model
from megloc_kapture.io.dataset_tables import (
    METRES,
    PROTOCOL_FILE,
    SIDE_TABLES,
    RelocalizationPair,
    World,
    read_groups,
    read_world,
    unit_of,
)
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import (
    CONSISTENCY_FILE,
    COVARIANCE_FILE,
    REFINEMENT_FILE,
    STATUS_FILE,
    ConsistencyRow,
    QueryStatus,
    read_consistency,
    read_covariances,
    read_refinement,
    read_status,
)
from megloc_kapture.stages.localized_folder import query_status
from megloc_kapture.values import Camera, Failure, Pose, RefinementRow, RigidTransform

Read = TypeVar("Read")
Poses = Mapping[str, RigidTransform]

# parts of a workspace; datasets and the pipeline write them
# the map's own keypoints are what queries were matched with; before there is one, its images do
_MAPS = ("map", "preprocessed/mapping", "mapping")
_QUERY, _QUERY_MATCHES = "query", "matches/query"
_QUERY_PYRAMID, _MAPPING_PYRAMID = "pyramid/query", "pyramid/mapping"
_SENSORS = "sensors/sensors.txt"
_MODELS = ("images.bin", "images.txt")
# images that were prepared for features, with masks; keypoints stand in their pixels
_PREPARED, _ROLES, _MASKS = "preprocessed", ("mapping", "query"), "sensors/masks"


@dataclass(frozen=True)
class ResultContext:
    """Kapture folders that a report can show something of; each may be absent.

    Attributes
    ----------
    queries : images and cameras of the queries, their keypoints, their matches with the map.
    mapping : images, cameras and poses of the map.
    side_tables : the tables of the dataset.
    refinements : query -> what each step of refining its pose came to.
    consistency : what the map's own images said of it, before poses were refined.
    masked : folders whose images have masks, with the keypoints that were found in them.
    localized : image -> what localizing gave, of results in memory.
    cameras : image -> its camera, of queries that are in no folder.
    unit : of the map; thresholds in metres say nothing where it is another one.
    """

    queries: KaptureFolder | None = None
    mapping: KaptureFolder | None = None
    side_tables: Path | None = None
    refinements: Mapping[str, Sequence[RefinementRow]] = field(default_factory=dict)
    consistency: Sequence[ConsistencyRow] = ()
    masked: Sequence[KaptureFolder] = ()
    localized: Mapping[str, Pose] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    unit: str = METRES

    @cached_property
    def frames(self) -> dict[str, str]:
        """Map image or query -> its coordinate frame, where a dataset has several."""
        groups = {} if self.side_tables is None else read_groups(self.side_tables)
        return {image: group.frame for image, group in groups.items() if group.frame}

    def map_poses(self) -> dict[str, RigidTransform]:
        return {} if self.mapping is None else self.mapping.read().poses()

    def query_images(self) -> list[str]:
        return [] if self.queries is None else self.queries.read().image_names()


def first_map_poses(contexts: Iterable[ResultContext]) -> dict[str, RigidTransform]:
    """``cam_from_world`` of the images of the first map with any; empty where there is none."""
    return next((poses for context in contexts if (poses := context.map_poses())), {})


def workspace_of(result: Path | str) -> Path | None:
    """The workspace that a result (``localized/``, or a file in ``submissions/``) lies in."""
    for folder in Path(result).resolve().parents[:2]:
        if (folder / SIDE_TABLES / PROTOCOL_FILE).is_file():
            return folder
    return None


def side_tables_near(result: Path | str) -> Path | None:
    """The side tables of the workspace a result lies in; None outside a workspace."""
    workspace = workspace_of(result)
    return None if workspace is None else workspace / SIDE_TABLES


def context_of(result: Path | str, *, mapping: Path | str | None = None) -> ResultContext:
    """Find what a report of a localized kapture folder or a pose file can show.

    ``mapping`` is the kapture folder of the map, if it is not the workspace's.

    """
    workspace, found = workspace_of(result), Path(result)
    features, candidates, maps = [], [found], []
    if workspace is not None:
        # where pairs with few matches were tried again, those matches hold
        pyramids = (workspace / name for name in (_QUERY_PYRAMID, _MAPPING_PYRAMID))
        there = [folder for folder in pyramids if folder.is_dir()]
        features = [workspace, *there, workspace / _QUERY_MATCHES]
        # the keypoints stand in the images that features were extracted from
        candidates = [workspace / _PREPARED / _QUERY, workspace / _QUERY, found]
        maps = [workspace / name for name in _MAPS]
    queries = next((path for path in candidates if (path / _SENSORS).is_file()), None)
    map_path = next((path for path in maps if (path / _SENSORS).is_file()), None)
    if mapping is not None:
        map_path = Path(mapping)
    refinements: dict[str, list[RefinementRow]] = {}
    for row in _if_there(read_refinement, found / REFINEMENT_FILE) or ():
        refinements.setdefault(row.image, []).append(row)
    return ResultContext(
        queries=None if queries is None else KaptureFolder(queries, features_dirs=features),
        mapping=None if map_path is None else KaptureFolder(map_path, features_dirs=features),
        side_tables=None if workspace is None else workspace / SIDE_TABLES,
        refinements=refinements,
        consistency=_if_there(read_consistency, found / CONSISTENCY_FILE) or (),
        unit=unit_of(result),
        masked=[] if workspace is None else _masked(workspace),
    )


def _if_there(read: Callable[[Path], Read], path: Path) -> Read | None:
    return read(path) if path.is_file() else None


def _masked(workspace: Path) -> list[KaptureFolder]:
    found = []
    for role in _ROLES:
        prepared = workspace / _PREPARED / role
        folder = prepared if (prepared / _SENSORS).is_file() else workspace / role
        if (folder / _MASKS).is_dir() and (folder / _SENSORS).is_file():
            found.append(KaptureFolder(folder, features_dirs=[workspace]))
    return found


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
    confidences : image -> probability that its pose is right, where the provenance beside a pose
        file says it; ``statuses`` have their own.
    covariances : image -> covariance (6, 6) of its pose, as of ``Pose``, where there is one.
    by_pair : of MLAD's pose files, the query's ``cam_from_world`` of each row; None of others.
    context : what a report of it can show.
    """

    label: str
    poses: Poses
    images: tuple[str, ...]
    statuses: Mapping[str, QueryStatus] | None = None
    confidences: Mapping[str, float] = field(default_factory=dict)
    covariances: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    by_pair: Mapping[RelocalizationPair, RigidTransform] | None = None
    context: ResultContext = field(default_factory=ResultContext)

    def poses_of_pairs(
        self, pairs: Iterable[RelocalizationPair]
    ) -> Mapping[RelocalizationPair, RigidTransform]:
        """The ``cam_from_world`` of each pair's query; pairs without a pose are absent."""
        if self.by_pair is not None:
            return self.by_pair
        return {pair: self.poses[pair.query] for pair in pairs if pair.query in self.poses}


def read_result(
    source: Path | str,
    benchmark: Benchmark,
    *,
    images: Iterable[str] = (),
    references: Poses | None = None,
    label: str = "",
) -> Result:
    """Read a result.

    Parameters
    ----------
    source : a localized kapture folder, a pose file, a COLMAP model, or (where the benchmark has
        MLAD's pairs) a pose file of the MLAD challenges or a folder with several.
    images : those that the short names of a pose file may stand for.
    references : ``cam_from_world`` of the map's images, for MLAD's pose files.
    """
    path = Path(source)
    is_mlad = benchmark.protocol.pose_file == "mlad"
    if is_mlad and benchmark.pairs and not (path / "sensors").is_dir():
        by_pair = _read_mlad(path, benchmark.pairs, references or {}, benchmark.world)
        poses = {pair.query: pose for pair, pose in by_pair.items()}
        return Result(label, poses, tuple(sorted(poses)), by_pair=by_pair)
    if path.is_dir() and model_of(path) is None:
        data = KaptureFolder(path).read()
        found = _in_frame_of(benchmark.world, data.poses(), path)
        rows = _if_there(read_status, path / STATUS_FILE)
        covariances = _if_there(read_covariances, path / COVARIANCE_FILE) or {}
        images = tuple(sorted(data.image_names()))
        return Result(label, found, images, rows, covariances=covariances)
    poses = poses_by_image(read_poses(path), images, benchmark.names)
    if benchmark.world != World():
        poses = {image: benchmark.world.pose_in_local(pose) for image, pose in poses.items()}
    return Result(label, poses, tuple(sorted(poses)), confidences=read_confidences(path))


def read_poses(source: Path) -> dict[str, RigidTransform]:
    """Read ``cam_from_world`` by name of a kapture folder, a COLMAP model or a pose file."""
    if not source.exists():
        raise DataError("no such file or folder", path=source)
    if (model := model_of(source)) is not None:
        if (model / "images.txt").is_file():
            return read_pose_file(model / "images.txt")
        images = read_colmap_model(model, with_points=False).images
        return {image.name: image.cam_from_world for image in images}
    return KaptureFolder(source).read().poses() if source.is_dir() else read_pose_file(source)


def model_of(folder: Path) -> Path | None:
    """Return the folder of the COLMAP model in a folder, if any."""
    if (folder / _SENSORS).is_file():
        return None
    places = (folder, folder / "sparse", folder / "sparse" / "0")
    return next((p for p in places for n in _MODELS if (p / n).is_file()), None)


def result_in_memory(
    estimated: Mapping[str, Pose | Failure] | Mapping[str, RigidTransform], *, label: str = ""
) -> Result:
    """A result of poses by image: those of the localizer, or ``cam_from_world`` alone."""
    poses: dict[str, RigidTransform] = {}
    statuses: dict[str, QueryStatus] = {}
    covariances = {}
    for image, found in estimated.items():
        if isinstance(found, RigidTransform):
            poses[image] = checked_pose(found.quat_wxyz, found.translation, repr(image))
            continue
        statuses[image] = query_status(image, found)
        if isinstance(found, Pose):
            poses[image] = found.cam_from_world
            if found.covariance is not None:
                covariances[image] = found.covariance
    images = tuple(sorted(estimated))
    return Result(label, poses, images, statuses or None, covariances=covariances)


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
    if not references:
        reason = "its poses are relative to the map's images: give the map with --map"
        raise DataError(reason, path=path)
    files = {pair.file for pair in pairs}
    found_files = {path.name if path.name in files else min(files): path}
    if path.is_dir():
        found_files = {file: path / file for file in sorted(files) if (path / file).is_file()}
        if not found_files:
            raise DataError(
                f"neither a kapture folder nor one with pose files ({min(files)})", path=path
            )
    elif path.name not in files and len(files) > 1:
        raise DataError(
            "which relocalization file it answers is not clear; call it as that one: "
            f"{', '.join(sorted(files))}",
            path=path,
        )
    found: dict[RelocalizationPair, RigidTransform] = {}
    for file, pose_file in found_files.items():
        asked = {
            (timestamp_of(pair.reference), timestamp_of(pair.query)): pair
            for pair in pairs
            if pair.file == file
        }
        for row in read_mlad_file(pose_file):
            pair = asked.get((row.reference, row.query))
            if pair is None:
                problem = f"pair {row.reference} {row.query} is not asked for"
            elif row.query_from_reference is None:
                problem = "has pairs without poses, as a relocalization file"
            elif pair.reference not in references:
                problem = f"reference {pair.reference!r} has no pose in the map"
            else:
                pose = _in_local_units(row.query_from_reference, world.official_from_local.scale)
                # a dummy is no pose: the file must have every row
                if row.query_from_reference != RigidTransform.identity():
                    found[pair] = pose @ references[pair.reference]
                continue
            raise DataError(problem, path=pose_file)
    return found


def _in_local_units(pose: RigidTransform, metres_per_unit: float) -> RigidTransform:
    if metres_per_unit == 1.0:
        return pose
    x, y, z = (np.array(pose.translation) / metres_per_unit).tolist()
    return RigidTransform(pose.quat_wxyz, (x, y, z))
