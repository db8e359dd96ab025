"""What lies around a result in its workspace: side tables, map, images, matches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from megloc_kapture.io.cluster_table import CLUSTERS_FILE, ClusterRow, read_clusters
from megloc_kapture.io.consistency_table import (
    CONSISTENCY_FILE,
    ConsistencyRow,
    read_consistency,
)
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.io.refinement_table import REFINEMENT_FILE, read_refinement
from megloc_kapture.io.side_tables import PROTOCOL_FILE, SIDE_TABLES, read_groups
from megloc_kapture.values import RefinementRow, RigidTransform

# parts of a workspace; datasets and the pipeline write them
# the map's own keypoints are what queries were matched with; before there is one, its images do
_MAPS = ("map", "preprocessed/mapping", "mapping")
_QUERY, _QUERY_MATCHES = "query", "matches/query"
_QUERY_PYRAMID, _MAPPING_PYRAMID = "pyramid/query", "pyramid/mapping"
_SENSORS = "sensors/sensors.txt"
# images that were prepared for features, with masks; keypoints stand in their pixels
_PREPARED, _ROLES, _MASKS = "preprocessed", ("mapping", "query"), "sensors/masks"


@dataclass(frozen=True)
class Surroundings:
    """Kapture folders that a report can show something of; each may be absent.

    Attributes
    ----------
    queries : images and cameras of the queries, their keypoints, their matches with the map.
    mapping : images, cameras and poses of the map.
    frames : map image or query -> its coordinate frame, where a dataset has several.
    clusters : query -> the clusters of candidates it was tried in.
    refinements : query -> what each step of refining its pose came to.
    consistency : what the map's own images said of it, before poses were refined.
    masked : folders whose images have masks, with the keypoints that were found in them.
    """

    queries: KaptureFolder | None = None
    mapping: KaptureFolder | None = None
    frames: Mapping[str, str] = field(default_factory=dict)
    clusters: Mapping[str, Sequence[ClusterRow]] = field(default_factory=dict)
    refinements: Mapping[str, Sequence[RefinementRow]] = field(default_factory=dict)
    consistency: Sequence[ConsistencyRow] = ()
    masked: Sequence[KaptureFolder] = ()

    def map_poses(self) -> dict[str, RigidTransform]:
        """``cam_from_world`` of the map's images; empty without a map.

        Raises
        ------
        DataError : the map is broken.
        """
        return {} if self.mapping is None else self.mapping.read().poses()

    def query_images(self) -> list[str]:
        """Names of the queries; empty where they are not known.

        Raises
        ------
        DataError : the folder is broken.
        """
        return [] if self.queries is None else self.queries.read().image_names()


def workspace_of(result: Path | str) -> Path | None:
    """The workspace that a result (``localized/``, or a file in ``submissions/``) lies in."""
    place = Path(result).resolve()
    for folder in place.parents[:2]:
        if (folder / SIDE_TABLES / PROTOCOL_FILE).is_file():
            return folder
    return None


def side_tables_near(result: Path | str) -> Path | None:
    """The side tables of the workspace a result lies in; None outside a workspace."""
    workspace = workspace_of(result)
    return None if workspace is None else workspace / SIDE_TABLES


def surroundings_of(result: Path | str, *, mapping: Path | str | None = None) -> Surroundings:
    """Find what a report of ``result`` can show.

    Parameters
    ----------
    result : a localized kapture folder or a pose file.
    mapping : kapture folder of the map, where it is not the workspace's.

    Raises
    ------
    DataError : broken side tables, or a broken table of clusters, of refinement or of consistency.
    """
    clusters = Path(result) / CLUSTERS_FILE
    refinement = Path(result) / REFINEMENT_FILE
    consistency = Path(result) / CONSISTENCY_FILE
    workspace = workspace_of(result)
    features = []
    if workspace is not None:
        # where pairs with few matches were tried again, those matches hold
        pyramids = [workspace / name for name in (_QUERY_PYRAMID, _MAPPING_PYRAMID)]
        there = [folder for folder in pyramids if folder.is_dir()]
        features = [workspace, *there, workspace / _QUERY_MATCHES]
    candidates = [Path(result)]
    if workspace is not None:
        # the keypoints stand in the images that features were extracted from
        candidates = [workspace / _PREPARED / _QUERY, workspace / _QUERY, Path(result)]
    queries = next((place for place in candidates if (place / _SENSORS).is_file()), None)
    map_place = None if mapping is None else Path(mapping)
    if map_place is None and workspace is not None:
        places = (workspace / name for name in _MAPS)
        map_place = next((place for place in places if (place / _SENSORS).is_file()), None)
    groups = {} if workspace is None else read_groups(workspace / SIDE_TABLES)
    return Surroundings(
        queries=None if queries is None else KaptureFolder(queries, features_dirs=features),
        mapping=None if map_place is None else KaptureFolder(map_place, features_dirs=features),
        frames={image: group.frame for image, group in groups.items() if group.frame},
        clusters=read_clusters(clusters) if clusters.is_file() else {},
        refinements=_by_image(read_refinement(refinement)) if refinement.is_file() else {},
        consistency=read_consistency(consistency) if consistency.is_file() else (),
        masked=[] if workspace is None else _masked(workspace),
    )


def _by_image(rows: Iterable[RefinementRow]) -> dict[str, list[RefinementRow]]:
    found: dict[str, list[RefinementRow]] = {}
    for row in rows:
        found.setdefault(row.image, []).append(row)
    return found


def _masked(workspace: Path) -> list[KaptureFolder]:
    found = []
    for role in _ROLES:
        prepared = workspace / _PREPARED / role
        folder = prepared if (prepared / _SENSORS).is_file() else workspace / role
        if (folder / _MASKS).is_dir() and (folder / _SENSORS).is_file():
            found.append(KaptureFolder(folder, features_dirs=[workspace]))
    return found
