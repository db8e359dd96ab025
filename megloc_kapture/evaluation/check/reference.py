"""What a pose file is compared with: an imported dataset's map, queries and rules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.pose_file import names_in_pose_file
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.io.challenge_tables import (
    RelocalizationPair,
    read_names,
    read_relocalization,
)
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.io.side_tables import (
    SIDE_TABLES,
    ImageGroup,
    Protocol,
    World,
    read_groups,
    read_priors,
    read_protocol,
    read_world,
)

_MAPPING, _QUERY = "mapping", "query"


@dataclass(frozen=True, eq=False)
class MapCameras:
    """The map's images that have a pose, in the workspace's local frame.

    Parameters
    ----------
    images : names, sorted.
    quats : float64 (M, 4), w x y z, of ``cam_from_local``.
    centers : float64 (M, 3).
    """

    images: tuple[str, ...]
    quats: NDArray[np.float64]
    centers: NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """An imported dataset.

    Parameters
    ----------
    place : its folder, as it is told to people.
    expected : what each scored query is called in the pose file -> the query; in the order of the
        challenge's list where it has one (``listed``).
    queries : all query images, also those that are not scored; None where they are not known.
    relocalization : the pairs of an MLAD challenge.
    cameras : of the map; None where there is no map.
    """

    place: str
    protocol: Protocol = field(default_factory=Protocol)
    world: World = field(default_factory=World)
    groups: Mapping[str, ImageGroup] = field(default_factory=dict)
    priors: Mapping[str, Sequence[str]] = field(default_factory=dict)
    expected: Mapping[str, str] = field(default_factory=dict)
    listed: bool = False
    queries: frozenset[str] | None = None
    relocalization: Sequence[RelocalizationPair] = ()
    cameras: MapCameras | None = None


def read_reference(folder: Path) -> Reference:
    """Read what is there of an import or workspace: ``mapping/``, ``query/``, ``megloc/``.

    Raises
    ------
    DataError : none of the three is there, or one is broken.
    """
    tables = folder / SIDE_TABLES
    parts = [folder / name for name in (_MAPPING, _QUERY)]
    there = [part for part in parts if (part / "sensors" / "sensors.txt").is_file()]
    if not there and not tables.is_dir():
        raise DataError(
            "no imported dataset: it has none of mapping/, query/ and megloc/", path=folder
        )
    protocol, groups, names = read_protocol(tables), read_groups(tables), read_names(tables)
    queries: frozenset[str] | None = None
    if folder / _QUERY in there:
        queries = frozenset(KaptureFolder(folder / _QUERY).read().records_camera.values())
    if not names and queries is not None:
        scored = [image for image in queries if groups.get(image, ImageGroup()).scored]
        names = names_in_pose_file(scored, protocol.pose_file_names)
        listed = False
    else:
        listed = bool(names)
    return Reference(
        place=str(folder),
        protocol=protocol,
        world=read_world(tables),
        groups=groups,
        priors=read_priors(tables),
        expected={name: image for image, name in names.items()},
        listed=listed,
        queries=queries,
        relocalization=read_relocalization(tables),
        cameras=_read_cameras(folder / _MAPPING) if folder / _MAPPING in there else None,
    )


def _read_cameras(mapping: Path) -> MapCameras | None:
    poses = KaptureFolder(mapping).read().poses()
    if not poses:
        return None
    quats, translations = stack_poses(poses.values())
    return MapCameras(tuple(poses), quats, camera_centers(quats, translations))
