"""Stage: map refinement, which removes wrong and uncertain points and writes point covariances.

``reconstruction/refinement.json`` lists the removals of each filter.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import depth_noise
from megloc_kapture.io.dataset_tables import (
    NO_TABLES,
    SIDE_TABLES,
    SideTables,
    read_side_tables,
)
from megloc_kapture.io.files import write_json
from megloc_kapture.io.kapture import KaptureFolder, Observations
from megloc_kapture.io.kapture.points import rows_by_id, write_point_covariances
from megloc_kapture.mapping.depth import (
    KEYPOINT_NOISE_PX,
    DepthVerificationOptions,
    compare_with_depth,
)
from megloc_kapture.mapping.uncertainty import (
    UncertaintyOptions,
    left_with_too_few,
    mean_depths,
    point_covariances,
    point_deviations,
    too_uncertain,
)
from megloc_kapture.stages import paths
from megloc_kapture.stages.map_features import copy_features, write_map
from megloc_kapture.stages.scene import check_points, depth_and_pose, depth_records
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Options

# a point that loses observations is dropped if fewer than this remain
_MIN_OBSERVATIONS = 2
# images with the same centre form a scan; points lifted from a depth map are compared with the
# nearest other scans
_SAME_CENTRE_M = 1e-3
_NEIGHBOURING_SCANS = 10

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class MapSelection:
    """Points and observations of a map, with masks of those that are kept."""

    def __init__(self, source: KaptureFolder) -> None:
        self.source = source
        self.data = source.read()
        self.xyz = np.ascontiguousarray(source.points3d()[:, :3])
        self._of_type = source.observations()
        types = list(self._of_type.values())
        # localization does not use observations by images without a pose
        poses = self.data.poses()
        observing = {image for seen in types for image in seen.image_names}
        self.images = sorted(observing.intersection(poses))
        self.cameras = [self.data.camera_of(image) for image in self.images]
        self.cams_from_world = [poses[image] for image in self.images]
        row_of = {image: row for row, image in enumerate(self.images)}
        rows = [
            np.array([row_of.get(i, -1) for i in seen.image_names], dtype=np.int32)[seen.image_ids]
            for seen in types
        ]
        self._sizes = [len(seen) for seen in types]
        self.point_ids = _joined([seen.point_ids for seen in types], np.int64)
        self.image_ids = _joined(rows, np.int32)
        self.kept_points = np.ones(len(self.xyz), dtype=bool)
        self.kept = self.image_ids >= 0
        # per filter: the number of points or observations that it could check and that it removed
        self.reports: list[dict[str, Any]] = []
        self._covariances: Floats | None = None

    def covariances(self) -> Floats:
        """Return point covariances (N, 6) from the kept observations; NaN where undetermined."""
        if self._covariances is None:
            ids = self.point_ids[self.kept], self.image_ids[self.kept]
            views = self.cameras, self.cams_from_world
            self._covariances = point_covariances(self.xyz, *ids, *views)
        return self._covariances

    def depths(self) -> Floats:
        """Return mean depths (N,) of the points in the images of their kept observations."""
        ids = self.point_ids[self.kept], self.image_ids[self.kept]
        return mean_depths(self.xyz, *ids, self.cams_from_world)

    def drop_observations(self, name: str, dropped: Mask, num_checked: int) -> None:
        """Drop observations (O,), and points that are left with too few."""
        dropped = dropped & self.kept
        ids = self.point_ids[self.kept]
        points = left_with_too_few(ids, dropped[self.kept], len(self.xyz), _MIN_OBSERVATIONS)
        self._remove(name, dropped, points, num_checked)

    def drop_points(self, name: str, dropped: Mask, num_checked: int) -> None:
        """Drop points (N,) with their observations."""
        self._remove(name, np.zeros(len(self.kept), dtype=bool), dropped, num_checked)

    def _remove(self, name: str, observations: Mask, points: Mask, num_checked: int) -> None:
        removed = self.kept & (observations | points[self.point_ids])
        self.reports.append(
            {
                "name": name,
                "checked": num_checked,
                "points": int((points & self.kept_points).sum()),
                "observations": int(removed.sum()),
            }
        )
        if self._covariances is not None and (removed & ~points[self.point_ids]).any():
            self._covariances = None  # points that lose some observations become less certain
        self.kept &= ~removed
        self.kept_points &= ~points

    def observations(self) -> dict[str, Observations]:
        """Return the kept observations by type, with renumbered points."""
        new_ids = np.cumsum(self.kept_points) - 1
        parts = np.split(self.kept, np.cumsum(self._sizes)[:-1]) if self._sizes else []
        return {
            name: replace(
                seen,
                point_ids=new_ids[seen.point_ids[part]],
                image_ids=seen.image_ids[part],
                keypoint_ids=seen.keypoint_ids[part],
            )
            for (name, seen), part in zip(self._of_type.items(), parts, strict=True)
            if part.any()
        }


def _joined(parts: Sequence[NDArray[Any]], dtype: type) -> NDArray[Any]:
    return np.concatenate([np.zeros(0, dtype), *(part.ravel() for part in parts)], dtype=dtype)


REPORT_FILE = "refinement.json"


class MapRefinementOptions(Options):
    """Map refinement options; defaults: docs/experiments/map-refinement.md."""

    depth: DepthVerificationOptions = DepthVerificationOptions()
    uncertainty: UncertaintyOptions = UncertaintyOptions()


def refine_map(
    source: KaptureFolder,
    output: Path,
    options: MapRefinementOptions,
    *,
    tables: SideTables = NO_TABLES,
    link_features: bool = False,
    work: Work = HERE,
) -> dict[str, float]:
    """Write a map without the points and observations that the options reject.

    Points are renumbered. Observations by images without a pose are dropped. ``link_features``
    allows hard links to the features in the source folder; set it only if these are not user data.
    Return counts for the log.
    """
    check_points(source, "refine")
    selection = MapSelection(source)
    _verify_depth(selection, options.depth, tables, work)
    if options.uncertainty.max_robust_sigmas is not None:
        _reject_uncertain(selection, options.uncertainty.max_robust_sigmas)
    kept = selection.kept_points
    num_points, num_observations = int(kept.sum()), int(selection.kept.sum())
    write_map(source, output, source.points3d()[kept], selection.observations())
    copy_features(source, output, link_own=link_features)
    write_point_covariances(output, selection.covariances()[kept])
    report = {
        "points_before": len(selection.xyz),
        "observations_before": len(selection.kept),
        "points_after": num_points,
        "observations_after": num_observations,
        "filters": selection.reports,
        "options": options.model_dump(mode="json"),
    }
    write_json(output / "reconstruction" / REPORT_FILE, report)
    counts: dict[str, float] = {"points": num_points, "observations": num_observations}
    for removed in selection.reports:
        counts[f"checked_by_{removed['name']}"] = removed["checked"]
        counts[f"points_removed_by_{removed['name']}"] = removed["points"]
        counts[f"observations_removed_by_{removed['name']}"] = removed["observations"]
    return counts


def _verify_depth(
    selection: MapSelection,
    options: DepthVerificationOptions,
    tables: SideTables,
    work: Work,
) -> None:
    """Drop observations and points that depth maps contradict.

    A point with one observation, by an image with depth, was lifted (backprojected) from that depth
    and agrees with it. It is compared with nearby scans instead, and dropped if more of them see
    through it than have a surface at its position.
    """
    records = depth_records(selection.data) if options.max_sigmas is not None else {}
    folder = selection.source
    with_depth = {
        row
        for row, image in enumerate(selection.images)
        if image in records and folder.depth_path(records[image].path).is_file()
    }
    if not with_depth:
        return
    covariances = selection.covariances()
    kept, point_ids = selection.kept, selection.point_ids
    seen_once = np.bincount(point_ids[kept], minlength=len(selection.xyz))[point_ids] == 1
    lifted = kept & seen_once & np.isin(selection.image_ids, list(with_depth))
    triangulated = np.flatnonzero(kept & ~lifted)
    observing = selection.image_ids[triangulated]
    rows_of = [
        (image, triangulated[rows])
        for image, rows in enumerate(rows_by_id(observing, len(selection.images)))
        if image in with_depth and len(rows)
    ]

    def job(image: int, rows: NDArray[np.int64]) -> tuple[str, Floats, Floats]:
        points = point_ids[rows]
        return selection.images[image], selection.xyz[points], covariances[points]

    dropped = np.zeros(len(kept), dtype=bool)
    num_checked = 0
    jobs = (job(image, rows) for image, rows in rows_of)
    compare = partial(_compare, folder, options)
    results = work.map(compare, jobs, "depth", len(rows_of))
    for (_, rows), (contradicted, checked) in zip(rows_of, results, strict=True):
        dropped[rows[contradicted]] = True
        num_checked += checked
    if lifted.any():
        scans, neighbours = _scans(selection, sorted(with_depth), tables)
        rows = np.flatnonzero(lifted)
        votes, judged = _votes_of_other_scans(selection, rows, scans, neighbours, options, work)
        dropped[rows[votes < 0]] = True
        num_checked += int(judged.sum())
    selection.drop_observations("depth", dropped, num_checked)


def _scans(
    selection: MapSelection, images: Sequence[int], tables: SideTables
) -> tuple[list[list[int]], list[set[int]]]:
    """Return the images with depth of each scan, and the other scans nearest to it."""
    scans: list[list[int]] = []
    neighbours: list[set[int]] = []
    for members in tables.frames([selection.images[row] for row in images]):
        rows = [images[member] for member in members]
        centres = np.array([selection.cams_from_world[row].center() for row in rows])
        pairs = cKDTree(centres).query_pairs(_SAME_CENTRE_M, output_type="ndarray")
        links = csr_array((np.ones(len(pairs)), pairs.T), shape=(len(rows), len(rows)))
        count, scan_of = connected_components(links, directed=False)
        first = len(scans)
        scans += [[] for _ in range(count)]
        for scan, row in zip(scan_of.tolist(), rows, strict=True):
            scans[first + scan].append(row)
        centres = centres[np.unique(scan_of, return_index=True)[1]]
        # the nearest scan is the scan itself, which is removed below
        ranks = range(1, min(_NEIGHBOURING_SCANS + 1, count) + 1)
        nearest = cKDTree(centres).query(centres, k=ranks)[1] + first
        neighbours += [set(near) - {scan} for scan, near in enumerate(nearest.tolist(), first)]
    return scans, neighbours


def _votes_of_other_scans(
    selection: MapSelection,
    lifted: NDArray[np.int64],
    scans: Sequence[Sequence[int]],
    neighbours: Sequence[Collection[int]],
    options: DepthVerificationOptions,
    work: Work,
) -> tuple[NDArray[np.int64], Mask]:
    """Return sums of votes (L,) of nearby scans on lifted points, and a mask of points with votes.

    ``lifted`` (L,) are the rows of the points' observations. A scan votes +1 if it has a surface at
    the point, -1 if it sees through the point.
    """
    scan_of = np.full(len(selection.images), -1)
    for number, images in enumerate(scans):
        scan_of[images] = number
    rows_of_scan = rows_by_id(scan_of[selection.image_ids[lifted]], len(scans))
    judged_rows: list[list[NDArray[np.int64]]] = [[] for _ in scans]
    for rows, others in zip(rows_of_scan, neighbours, strict=True):
        for other in others:
            judged_rows[other].append(rows)
    points_of_scans = [
        ([selection.images[row] for row in images], np.concatenate(parts))
        for images, parts in zip(scans, judged_rows, strict=True)
        if parts
    ]
    points = selection.point_ids[lifted]
    sigmas = depth_noise(selection.depths()[points], options.noise)
    jobs = ((images, selection.xyz[points[rows]], sigmas[rows]) for images, rows in points_of_scans)
    judge = partial(_judge, selection.source, options)
    votes, judged = np.zeros(len(lifted), np.int64), np.zeros(len(lifted), bool)
    results = work.map(judge, jobs, "depth of other scans", len(points_of_scans))
    for (_, rows), (through, agreeing) in zip(points_of_scans, results, strict=True):
        votes[rows] += agreeing.astype(np.int64) - through
        judged[rows] |= agreeing | through
    return votes, judged


def _judge(
    folder: KaptureFolder,
    options: DepthVerificationOptions,
    job: tuple[list[str], Floats, Floats],
) -> tuple[Mask, Mask]:
    """Return masks of points (N, 3): those that a scan sees through, and those on its surface."""
    images, xyz, sigmas = job
    through, agreeing = np.zeros((2, len(xyz)), dtype=bool)
    for image in images:
        depth, cam_from_world = depth_and_pose(folder, image)
        points = cam_from_world.apply(xyz)
        in_front, behind, checked = compare_with_depth(points, depth, options, sigmas)
        through |= in_front
        agreeing |= checked & ~in_front & ~behind
    return through & ~agreeing, agreeing


def _compare(
    folder: KaptureFolder,
    options: DepthVerificationOptions,
    job: tuple[str, Floats, Floats],
) -> tuple[Mask, int]:
    """Return a mask of points that an image's depth contradicts, and how many it tests."""
    image, xyz, covariances = job
    depth, cam_from_world = depth_and_pose(folder, image)
    axis = (depth.image_from_depth.inverse() @ cam_from_world).rotation_matrix()[2]
    sigmas = KEYPOINT_NOISE_PX * np.sqrt(_quadratic_form(covariances, axis))
    points = cam_from_world.apply(xyz)
    in_front, behind, checked = compare_with_depth(points, depth, options, sigmas)
    return in_front | behind, int(checked.sum())


def _quadratic_form(covariances: Floats, axis: Floats) -> Floats:
    """Return variances (N,) along an axis (3,), clipped at 0; NaN is kept."""
    x, y, z = axis
    weights = np.array([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z])
    return np.maximum(covariances @ weights, 0.0)


def _reject_uncertain(selection: MapSelection, max_robust_sigmas: float) -> None:
    deviations = point_deviations(selection.covariances())[:, 2]
    # the map's median excludes dropped points
    deviations = np.where(selection.kept_points, deviations, np.nan)
    rejected = too_uncertain(deviations, selection.depths(), max_robust_sigmas)
    selection.drop_points("uncertainty", rejected, int(np.isfinite(deviations).sum()))


class RefineMap(PipelineStage):
    """Remove map points that depth maps contradict, and uncertain points."""

    name = "map"
    version = 3
    uses = ("refinement",)
    explained_by = ("refinement.depth.max_sigmas", "refinement.uncertainty.max_robust_sigmas")
    inputs = (paths.UNREFINED_MAP, SIDE_TABLES)
    outputs = (PipelineStage.sparse_map,)

    def run(self, work: StageWork) -> Mapping[str, float]:
        folder, out = work.folder(paths.UNREFINED_MAP), work.out / self.sparse_map()
        counts = refine_map(
            folder,
            out,
            self.options.refinement,
            tables=read_side_tables(work.path(SIDE_TABLES)),
            link_features=True,
            work=work,
        )
        if not counts["points"]:
            raise DataError(
                f"refinement removed all {len(folder.points3d())} points. Check the map's poses "
                "and cameras, or loosen the limits (--set refinement.KEY=VALUE)"
            )
        return counts
