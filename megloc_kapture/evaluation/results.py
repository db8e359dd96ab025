"""Results (kapture folders, pose files, COLMAP models, objects) and the workspace around them."""

from __future__ import annotations

import os.path
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.evaluation import pose_files
from megloc_kapture.io import tables
from megloc_kapture.io.colmap_model import read_colmap_model
from megloc_kapture.io.csv_table import read_records
from megloc_kapture.io.dataset_tables import (
    METRES,
    NO_TABLES,
    PROTOCOL_FILE,
    SIDE_TABLES,
    RelocalizationPair,
    SideTables,
    World,
    read_side_tables,
    read_world,
    unit_of,
)
from megloc_kapture.io.files import named
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, is_kapture
from megloc_kapture.io.tables import ConsistencyRow
from megloc_kapture.stages import paths
from megloc_kapture.values import (
    Camera,
    Failure,
    LocalizationResult,
    Pose,
    PoseRefinement,
    RigidTransform,
)

Read = TypeVar("Read")
Poses = Mapping[str, RigidTransform]

_MODELS = ("images.bin", "images.txt")


@dataclass(frozen=True)
class ResultContext:
    """Data of a result that a report can show; each may be absent.

    Attributes
    ----------
    queries, mapping : images and cameras, with keypoints and matches; the map has poses.
    frames : image -> its coordinate frame, if the dataset has several.
    refinements : query -> steps of refining its pose.
    consistency : checks of refiners on the map's own images.
    localized : image -> pose, of results in memory.
    cameras : image -> camera, of queries that are in no folder.
    """

    queries: KaptureFolder | None = None
    mapping: KaptureFolder | None = None
    frames: Mapping[str, str] = field(default_factory=dict)
    refinements: Mapping[str, Sequence[PoseRefinement]] = field(default_factory=dict)
    consistency: Sequence[ConsistencyRow] = ()
    localized: Mapping[str, Pose] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    unit: str = METRES

    def map_poses(self) -> dict[str, RigidTransform]:
        return {} if self.mapping is None else self.mapping.read().poses()

    def query_images(self) -> list[str]:
        return [] if self.queries is None else self.queries.read().image_names()


def first_map_poses(contexts: Iterable[ResultContext]) -> dict[str, RigidTransform]:
    """Return the poses of the first map that has any."""
    return next((poses for context in contexts if (poses := context.map_poses())), {})


def workspace_of(result: Path | str) -> Path | None:
    """Return the workspace of a result (``localized/``, or a file in ``submissions/``)."""
    for folder in Path(result).resolve().parents[:2]:
        if (folder / SIDE_TABLES / PROTOCOL_FILE).is_file():
            return folder
    return None


def side_tables_near(result: Path | str) -> Path | None:
    workspace = workspace_of(result)
    return None if workspace is None else workspace / SIDE_TABLES


def context_of(result: Path | str, *, mapping: Path | str | None = None) -> ResultContext:
    """Find the data around a result; ``mapping`` replaces the workspace's map."""
    workspace, folder = workspace_of(result), Path(result)
    features, queries, maps, side_tables = [], [folder], [], NO_TABLES
    if workspace is not None:
        # matches of a guided pyramid replace those of pairs with few matches
        pyramids = [workspace / name for name in (paths.QUERY_PYRAMID, paths.MAPPING_PYRAMID)]
        features = [workspace, *filter(Path.is_dir, pyramids), workspace / paths.QUERY_MATCHES]
        # keypoints are in the pixels of the preprocessed images
        prepared = workspace / paths.PREPROCESSED
        queries = [prepared / paths.QUERY, workspace / paths.QUERY, folder]
        maps = [workspace / paths.MAP, prepared / paths.MAPPING, workspace / paths.MAPPING]
        side_tables = read_side_tables(workspace / SIDE_TABLES)

    def first(folders: Sequence[Path]) -> KaptureFolder | None:
        path = next((path for path in folders if is_kapture(path)), None)
        return None if path is None else KaptureFolder(path, features_dirs=features)

    units = [unit_of(place) for place in (workspace or folder, mapping) if place is not None]
    return ResultContext(
        queries=first(queries),
        mapping=KaptureFolder(mapping, features_dirs=features) if mapping else first(maps),
        frames={image: g.frame for image, g in side_tables.groups.items() if g.frame},
        refinements=_if_there(_read_refinement, folder / tables.REFINEMENT_FILE) or {},
        consistency=read_records(folder / tables.CONSISTENCY_FILE, ConsistencyRow, missing_ok=True),
        unit=next((unit for unit in units if unit != METRES), METRES),
    )


def _read_refinement(path: Path) -> dict[str, tuple[PoseRefinement, ...]]:
    return tables.read_refinement(path, KaptureFolder(path.parent).read().poses())


def _if_there(read: Callable[[Path], Read], path: Path) -> Read | None:
    return read(path) if path.is_file() else None


@dataclass(frozen=True, eq=False)
class Result:
    """One result; ``poses`` are ``cam_from_world`` in the frame of the true poses.

    Attributes
    ----------
    images : queries of the result, sorted; for a pose file only those with a pose.
    statuses : of a pose file, only the confidences in the JSON file next to it.
    covariances : image -> (6, 6), as in ``Pose``.
    by_pair : pair -> ``cam_from_world`` of its query, if the result consists of MLAD pose files.
    """

    label: str
    poses: Poses
    images: tuple[str, ...]
    statuses: Mapping[str, LocalizationResult] = field(default_factory=dict)
    covariances: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    by_pair: Mapping[RelocalizationPair, RigidTransform] | None = None
    context: ResultContext = field(default_factory=ResultContext)


def read_result(
    source: Path | str,
    benchmark: SideTables,
    *,
    images: Iterable[str] = (),
    references: Poses | None = None,
    label: str = "",
) -> Result:
    """Read a kapture folder, a pose file, a COLMAP model, or MLAD's pose files.

    Names in a pose file that are only the end of an image's path are completed by ``images``.
    MLAD's pose files need ``references``, the poses of the map's images.
    """
    path = Path(source)
    is_mlad = benchmark.protocol.pose_file == "mlad"
    if is_mlad and benchmark.relocalization and not (path / "sensors").is_dir():
        by_pair = _read_mlad(path, benchmark.relocalization, references or {}, benchmark.world)
        poses = {pair.query: pose for pair, pose in by_pair.items()}
        return Result(label, poses, tuple(sorted(poses)), by_pair=by_pair)
    if path.is_dir() and model_of(path) is None:
        data = KaptureFolder(path).read()
        return Result(
            label,
            _in_frame_of(benchmark.world, _poses_of(data, path), path),
            tuple(sorted(data.image_names())),
            _if_there(tables.read_status, path / tables.STATUS_FILE) or {},
            covariances=_if_there(tables.read_covariances, path / tables.COVARIANCE_FILE) or {},
        )
    with named(path):
        poses = pose_files.poses_by_image(read_poses(path), images, benchmark.names)
    if benchmark.world != World():
        poses = {image: benchmark.world.pose_in_local(pose) for image, pose in poses.items()}
    statuses = {
        image: LocalizationResult(name=image, confidence=confidence)
        for image, confidence in pose_files.read_confidences(path).items()
        if image in poses
    }
    return Result(label, poses, tuple(sorted(poses)), statuses)


def with_names_of(result: Result, images: Collection[str]) -> Result:
    """Rename the queries of a result to ``images``, unless one already has such a name."""
    old = {*result.images, *result.statuses}
    if not old.isdisjoint(images):
        return result
    named_as = pose_files.poses_by_image({name: name for name in sorted(old)}, images)
    new = {former: name for name, former in named_as.items()}
    return replace(
        result,
        poses={new[former]: pose for former, pose in result.poses.items()},
        images=tuple(sorted(new[former] for former in result.images)),
        statuses={new[former]: status for former, status in result.statuses.items()},
        covariances={new[former]: matrix for former, matrix in result.covariances.items()},
    )


def read_poses(source: Path) -> dict[str, RigidTransform]:
    """Read ``cam_from_world`` by image from a kapture folder, COLMAP model or pose file."""
    require(source.exists(), "no such file or folder", path=source)
    if source.name == "images.bin":
        source = source.parent
    if (model := model_of(source)) is not None:
        if (model / "images.txt").is_file():
            return pose_files.read_pose_file(model / "images.txt")
        images = read_colmap_model(model, with_points=False).images
        return {image.name: image.cam_from_world for image in images}
    if source.is_dir():
        return _poses_of(KaptureFolder(source).read(), source)
    return pose_files.read_pose_file(source)


def _poses_of(data: KaptureData, folder: Path) -> dict[str, RigidTransform]:
    poses = data.poses()
    require(
        poses or not data.trajectories,
        "no pose of trajectories.txt has the timestamp and sensor of an image in "
        "records_camera.txt",
        path=folder / "sensors",
    )
    return poses


def model_of(folder: Path) -> Path | None:
    """Return the COLMAP model in a folder, if any."""
    if is_kapture(folder):
        return None
    candidates = (folder, folder / "sparse", folder / "sparse" / "0")
    return next((p for p in candidates for n in _MODELS if (p / n).is_file()), None)


def result_in_memory(
    estimated: Mapping[str, Pose | Failure] | Mapping[str, RigidTransform], *, label: str = ""
) -> Result:
    poses: dict[str, RigidTransform] = {}
    statuses: dict[str, LocalizationResult] = {}
    covariances = {}
    by_name: dict[str, Any] = {str(image): pose for image, pose in estimated.items()}
    for image, pose in by_name.items():
        if pose is None:  # the cam_from_world of a Failure
            continue
        if isinstance(pose, RigidTransform):
            poses[image] = pose_files.checked_pose(pose.quat_wxyz, pose.translation, repr(image))
            continue
        require(
            isinstance(pose, Pose | Failure),
            f"{image!r}: {type(pose).__name__} is not a pose; use RigidTransform.from_matrix(R, t)",
        )
        statuses[image] = pose
        if isinstance(pose, Pose):
            poses[image] = pose.cam_from_world
            if pose.covariance is not None:
                covariances[image] = pose.covariance
    images = tuple(sorted(by_name))
    return Result(label, poses, images, statuses, covariances=covariances)


def distinct_labels(sources: Sequence[Path]) -> list[str]:
    """Return the paths without their common leading and trailing folders."""
    if len(sources) < 2:
        return [str(source) for source in sources]
    parts = [source.parts for source in sources]
    head = len(os.path.commonprefix(parts))
    tail = len(os.path.commonprefix([p[head:][::-1] for p in parts]))
    labels = ["/".join(p[head : len(p) - tail]) for p in parts]
    return labels if all(labels) else [str(source) for source in sources]


def _in_frame_of(world: World, poses: dict[str, RigidTransform], result: Path) -> Poses:
    """Transform poses from the local frame of their workspace to that of the truth."""
    side_tables = side_tables_near(result)
    result_world = world if side_tables is None else read_world(side_tables)
    if result_world.official_from_local == world.official_from_local:
        return poses
    return {i: world.pose_in_local(result_world.pose_in_official(p)) for i, p in poses.items()}


def _read_mlad(
    path: Path, pairs: Sequence[RelocalizationPair], references: Poses, world: World
) -> dict[RelocalizationPair, RigidTransform]:
    require(
        references,
        "its poses are relative to the map's images: give the map with --map",
        path=path,
    )
    asked: dict[str, dict[tuple[int, int], RelocalizationPair]] = {}
    for pair in pairs:
        stamps = pose_files.timestamp_of(pair.reference), pose_files.timestamp_of(pair.query)
        asked.setdefault(pair.file, {})[stamps] = pair
    if path.is_dir():
        files = {file: path / file for file in sorted(asked) if (path / file).is_file()}
        names = min(asked)
        require(
            files, f"is neither a kapture folder nor a folder of pose files ({names})", path=path
        )
    else:
        files = {path.name if path.name in asked else min(asked): path}
        require(
            path.name in asked or len(asked) == 1,
            "cannot tell which relocalization file it belongs to; rename it to one of "
            f"{', '.join(sorted(asked))}",
            path=path,
        )
    poses: dict[RelocalizationPair, RigidTransform] = {}
    for file, pose_file in files.items():
        for stamps, pose in pose_files.read_mlad_file(pose_file).items():
            asked_pair = asked[file].get(stamps)
            if asked_pair is None:
                problem = f"pair {stamps[0]} {stamps[1]} is not in the relocalization file"
                raise DataError(problem, path=pose_file)
            require(
                asked_pair.reference in references,
                f"reference {asked_pair.reference!r} has no pose in the map",
                path=pose_file,
            )
            # the identity marks a missing pose, since the file must have every row
            if pose != RigidTransform.identity():
                local = pose.scaled(1 / world.official_from_local.scale)
                poses[asked_pair] = local @ references[asked_pair.reference]
    return poses
