"""Stage: a kapture map without the points that do it no good, and with their uncertainties.

What is wrong is dropped, nothing is moved: points keep their coordinates and colours. What each
filter removed stands in ``reconstruction/refinement.json`` of the new map, the points' covariances
in ``reconstruction/point_covariances.npy``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import link_images, write_json_model
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import (
    KaptureFolder,
    write_observations,
    write_ply,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.points import write_point_covariances
from megloc_kapture.mapping.depth import DepthVerificationOptions, contradicted_by_depth
from megloc_kapture.mapping.uncertainty import (
    ConsistencyOptions,
    UncertaintyOptions,
    mean_depths,
    point_deviations,
    reprojection_errors_px,
    seen_at_angle,
    too_uncertain,
    track_lengths,
)
from megloc_kapture.stages.layout import UNREFINED
from megloc_kapture.stages.map_selection import FilterReport, Floats, MapSelection, Mask
from megloc_kapture.stages.rigs import DepthRecord, depth_records
from megloc_kapture.stages.stage import PipelineStage, StageWork
from megloc_kapture.stages.triangulation import copy_features
from megloc_kapture.stages.work import HERE, FolderSpec, Work
from megloc_kapture.values import Options

REPORT_FILE = "refinement.json"
KEPT_FILE, REJECTED_FILE = "refinement_kept.ply", "refinement_rejected.ply"

# from sure to unsure, as viewers show a temperature; and what is not known
_RAMP = np.array([(49, 54, 149), (116, 173, 209), (255, 255, 191), (244, 109, 67), (165, 0, 38)])
_UNKNOWN_COLOUR = (128, 128, 128)


class MapRefinementOptions(Options):
    """What is taken out of a map; defaults: docs/experiments/map-refinement.md."""

    depth: DepthVerificationOptions = DepthVerificationOptions()
    consistency: ConsistencyOptions = ConsistencyOptions()
    uncertainty: UncertaintyOptions = UncertaintyOptions()
    min_observations: int = Field(
        default=2, ge=1, description="a point that lost some goes when it has fewer left"
    )
    ply: bool = Field(
        default=False, description="write the kept and the rejected points as PLY files"
    )


class RefinementReport(BaseModel):
    """``reconstruction/refinement.json``: a map's points and observations before and after."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    points_before: int
    observations_before: int
    points_after: int
    observations_after: int
    filters: tuple[FilterReport, ...]
    options: MapRefinementOptions


@dataclass(frozen=True)
class _DepthJob:
    folder: FolderSpec
    depth: DepthRecord
    points_in_image: Floats
    deviations: Floats
    options: DepthVerificationOptions


def refine_map(
    source: KaptureFolder,
    output: Path,
    options: MapRefinementOptions | None = None,
    *,
    link_features: bool = False,
    work: Work = HERE,
) -> dict[str, float]:
    """Write a map without the points and observations that the options reject.

    Points of any keypoints type, renumbered without gaps, and of several at once. Observations by
    images without a pose cannot be judged; they stay as long as their point does.

    Parameters
    ----------
    link_features : the features in the source's own folder may become hard links (they are a map
        of ours, not somebody's data); those beside it always do.

    Returns
    -------
    Counts for the log: points and observations after, and what each filter removed.

    Raises
    ------
    DataError : no points, or something broken; names the file.
    """
    options = options or MapRefinementOptions()
    if not source.has_points():
        raise DataError(
            "no map to refine: reconstruction/points3d.txt or observations.txt is missing",
            path=source.root,
        )
    selection = MapSelection(source, options.min_observations)
    before = selection.covariances() if options.ply else None
    _verify_depth(selection, options.depth, work)
    _check_consistency(selection, options.consistency)
    _reject_uncertain(selection, options.uncertainty)
    report = RefinementReport(
        points_before=len(selection.xyz),
        observations_before=len(selection.kept),
        points_after=int(selection.kept_points.sum()),
        observations_after=int(selection.kept.sum()),
        filters=tuple(selection.reports),
        options=options,
    )

    write_sensors(output, selection.data)
    link_images(source.root, output)
    for type_name in sorted({*source.types("keypoints"), *source.types("descriptors")}):
        copy_features(source, output, type_name, link_own=link_features)
    kept = selection.kept_points
    write_points3d(output, source.points3d()[kept])
    write_observations(output, selection.observations())
    covariances = selection.covariances()
    write_point_covariances(output, covariances[kept])
    write_json_model(output / "reconstruction" / REPORT_FILE, report)
    if before is not None:
        deviations = point_deviations(np.where(kept[:, None], covariances, before))[:, 2]
        _write_pictures(output / "reconstruction", source.points3d(), deviations, kept)
    counts: dict[str, float] = {
        "points": report.points_after,
        "observations": report.observations_after,
    }
    for removed in report.filters:
        counts[f"points_removed_by_{removed.name}"] = removed.points
        counts[f"observations_removed_by_{removed.name}"] = removed.observations
    return counts


def _verify_depth(
    selection: MapSelection,
    options: DepthVerificationOptions,
    work: Work,
) -> None:
    records = depth_records(selection.data) if options.max_sigmas is not None else {}
    folder = selection.source
    with_depth = {
        row: records[image]
        for row, image in enumerate(selection.images)
        if image in records and folder.depth_path(records[image].path).is_file()
    }
    if not with_depth:
        return
    covariances = selection.covariances()
    observed, placed = selection.observed()
    spec = FolderSpec(folder)
    rows_of = [(image, rows) for image, rows in observed.by_image() if image in with_depth]

    def job(image: int, rows: NDArray[np.int64]) -> _DepthJob:
        points, depth = observed.point_ids[rows], with_depth[image]
        pose = observed.cams_from_world[image]
        axis = (depth.image_from_depth.inverse() @ pose).rotation_matrix()[2]
        variances = _quadratic_form(covariances[points], axis)
        return _DepthJob(spec, depth, pose.apply(observed.xyz[points]), np.sqrt(variances), options)

    dropped = np.zeros(len(selection.kept), dtype=bool)
    num_checked = 0
    jobs = (job(image, rows) for image, rows in rows_of)
    results = work.map(_compare, jobs, "depth", len(rows_of))
    for (_, rows), (contradicted, checked) in zip(rows_of, results, strict=True):
        dropped[placed[rows[contradicted]]] = True
        num_checked += checked
    selection.drop_observations("depth", dropped, num_checked)


def _quadratic_form(covariances: Floats, axis: Floats) -> Floats:
    """Variances (N,) along an axis (3,) of covariances (N, 6); never negative, NaN stays."""
    x, y, z = axis
    weights = np.array([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z])
    return np.maximum(covariances @ weights, 0.0)


def _compare(job: _DepthJob) -> tuple[Mask, int]:
    camera = job.depth.camera
    depth_m = read_depth_map(
        job.folder.open().depth_path(job.depth.path), width=camera.width, height=camera.height
    )
    contradicted, checked = contradicted_by_depth(
        job.points_in_image,
        depth_m,
        camera,
        job.depth.image_from_depth,
        job.options,
        deviations=job.deviations,
    )
    return contradicted, int(checked.sum())


def _check_consistency(selection: MapSelection, options: ConsistencyOptions) -> None:
    if options.max_reprojection_error_px is not None:
        keypoints = selection.keypoints_px()
        observed, rows = selection.observed()
        known = np.isfinite(keypoints[rows]).all(axis=1)
        errors = reprojection_errors_px(observed, keypoints[rows])
        dropped = np.zeros(len(selection.kept), dtype=bool)
        dropped[rows[known & (errors > options.max_reprojection_error_px)]] = True
        selection.drop_observations("reprojection_error", dropped, int(known.sum()))
    if options.min_angle_deg is not None:
        observed, _ = selection.observed()
        several = track_lengths(observed) > 1
        narrow = several & ~seen_at_angle(observed, options.min_angle_deg)
        selection.drop_points("triangulation_angle", narrow, int(several.sum()))
    if options.min_track_length is not None:
        lengths = np.bincount(selection.point_ids[selection.kept], minlength=len(selection.xyz))
        inside = selection.kept_points
        short = inside & (lengths < options.min_track_length)
        selection.drop_points("track_length", short, int(inside.sum()))


def _reject_uncertain(selection: MapSelection, options: UncertaintyOptions) -> None:
    if not options.needs_deviations():
        return
    deviations = point_deviations(selection.covariances())[:, 2]
    # who is out already has no share in a quantile of the map
    deviations = np.where(selection.kept_points, deviations, np.nan)
    rejected = too_uncertain(deviations, mean_depths(selection.observed()[0]), options)
    selection.drop_points("uncertainty", rejected, int(np.isfinite(deviations).sum()))


def _write_pictures(folder: Path, points: Floats, deviations: Floats, kept: Mask) -> None:
    """Kept and rejected points, coloured by their deviation on a logarithmic scale."""
    known = np.isfinite(deviations) & (deviations > 0)
    colours = np.empty((len(points), 3), dtype=np.uint8)
    colours[:] = _UNKNOWN_COLOUR
    if known.any():
        logarithms = np.log(deviations[known])
        low, high = np.quantile(logarithms, [0.05, 0.95])
        place = np.clip((logarithms - low) / max(high - low, 1e-12), 0, 1) * (len(_RAMP) - 1)
        steps = np.arange(len(_RAMP))
        colours[known] = np.stack([np.interp(place, steps, c) for c in _RAMP.T], axis=1)
    for name, chosen in ((KEPT_FILE, kept), (REJECTED_FILE, ~kept)):
        write_ply(folder / name, points[chosen, :3], colours[chosen], deviation=deviations[chosen])


class RefineMap(PipelineStage):
    """Take out of the map what its images or their depth contradict, and what is uncertain."""

    name = "map"
    version = 2
    uses = ("refinement",)
    reads = (UNREFINED,)

    @property
    def writes(self) -> Sequence[str]:  # type: ignore[override]
        return (self.layout.sparse_map,)

    def run(self, work: StageWork) -> Mapping[str, float]:
        folder, options = work.folder(UNREFINED), self.options.refinement
        return refine_map(
            folder, work.out / self.layout.sparse_map, options, link_features=True, work=work
        )
