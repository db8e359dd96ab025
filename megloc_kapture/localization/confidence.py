"""Confidence of a pose: the probability that it is right, estimated without ground truth.

:func:`evidence_of` measures how far the number of inliers exceeds chance, what share they are of
all matches and of the points that could have been matched, how well they fit compared with the
map's own images, the uncertainty of the pose, and the viewpoints of the map images that observe
them. :class:`Calibration` is a logistic
model of these terms; ``benchmarks/confidence.py`` fits its weights (``confidence.toml``).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import focal_px, project
from megloc_kapture.localization.absolute_pose import center_deviation, match_errors
from megloc_kapture.localization.map_index import Correspondences, PoseProblem, QueryView
from megloc_kapture.values import Failure, Pose, RigidTransform

Floats = NDArray[np.float64]
_SAMPLE = 3  # matches that determine a pose
_CELL = 0.01  # cell size as a share of the image's diagonal; a cell's matches count once
# a few wrong points can agree by accident, so a pose that sees fewer points than this is doubtful
_MIN_VISIBLE = 50
_MAX_PROJECTED = 2048  # number of points that estimate the visible share
_MIN_ERROR_PX = 0.5
_MIN_NOISE_PX = 0.3  # smallest map noise, pixels of the query
# upper end of the normal range of an image's error / the map's noise, given more than _FEW inliers
_USUAL_RATIO, _FEW = 2.9, 20
# tolerated camera shift due to a wrong focal length, relative to the distance to the points
_TOLERATED_SHIFT = 0.03

TERMS: dict[str, str] = {
    "surprise": "hardly more matches agree than would by chance",
    "agreement": "most matches contradict the pose",
    "matched_share": "few of the visible map points were matched",
    "residual": "the inliers fit badly",
    "misfit": "the inliers fit worse than the map's own images do",
    "deviation": "the inliers barely constrain the pose",
    "viewing_angle": "the map's images see these points from other directions",
    "distance_ratio": "the map's images see these points from a very different distance",
    "support": "few map images agree with the pose",
}
"""Terms of the model, with the reason to report if a term's contribution is the lowest."""

MAP_POINTS = "map_points"
"""Ratio of visible map points to those that a trusted pose needs; present only below 1."""


@dataclass(frozen=True, eq=False)
class MatchSources:
    """Origin of the N 2D-3D matches of a pose problem.

    Attributes
    ----------
    support : int64 (N,), number of map images with the match.
    centers, images : float64 (sum of support, 3) and int64, the map images' centres and indices,
        grouped by match.
    num_keypoints : number of the query's keypoints, over all views and types.
    noise : float64 (N, 2), the map's median reprojection error as an angle and in pixels; NaN if
        unknown.
    seen : per view the points (K, 3) observed by the cluster's map images.
    displacements_rad : function that maps a pose to the angle between each inlier's projected point
        and the place where its image patch was found (:func:`~.structure.displacements_rad`); or
        None.
    """

    support: NDArray[np.int64]
    centers: Floats
    images: NDArray[np.int64]
    num_keypoints: int
    noise: Floats
    seen: Sequence[Floats]
    local_types: Collection[str] = ()
    displacements_rad: Callable[[Pose], Floats] | None = None


def evidence_of(
    problem: PoseProblem, pose: Pose, sources: MatchSources, max_error_px: float
) -> dict[str, float]:
    """Return :data:`TERMS` and, if below 1, :data:`MAP_POINTS` for a pose with covariance."""
    assert pose.inliers is not None and pose.covariance is not None
    rig_from_world = pose.cam_from_world
    inliers = pose.inliers
    errors_px, _ = match_errors(problem, rig_from_world)
    count, num = int(inliers.sum()), len(inliers)
    center = rig_from_world.center()
    points = problem.points[inliers] + problem.offset
    distances = np.linalg.norm(points - center, axis=1)
    visible = _num_visible(problem, rig_from_world, sources.seen)
    matchable = min(sources.num_keypoints, visible)
    sighted = np.repeat(inliers, sources.support)
    seen = np.repeat(points, sources.support[inliers], axis=0)
    angles, ratios = _viewpoints(center - seen, sources.centers[sighted] - seen)
    images = np.unique(sources.images[sighted], return_counts=True)[1]
    share = max(visible, count) / _MIN_VISIBLE
    return {
        "surprise": math.log10(1.0 + _surprise(problem, errors_px, max_error_px)),
        "agreement": math.log(count / (num - count + 1.0)),
        "matched_share": math.log(count / max(matchable, count)),
        "residual": math.log(max(float(np.median(errors_px[inliers])), 0.1) / max_error_px),
        "misfit": _misfit(problem, errors_px, pose, sources),
        "deviation": math.log(
            max(center_deviation(pose.covariance) / float(np.median(distances)), 1e-5)
        ),
        "viewing_angle": angles,
        "distance_ratio": ratios,
        "support": math.log(1.0 + float((images >= 5).sum())),
        **({MAP_POINTS: share} if share < 1.0 else {}),
    }


def with_confidence(
    problem: PoseProblem,
    pose: Pose,
    sources: MatchSources,
    max_error_px: float,
    min_confidence: float,
    misfit: tuple[str, float] | None = None,
) -> Pose | Failure:
    """Return the pose with its confidence and evidence, or a Failure if the confidence is too low.

    A wrong focal length shifts the camera (``misfit``, see :func:`~.focal_length.focal_misfit`).
    If this shift exceeds 3 % of the distance to the points, the confidence is multiplied by
    (3 % / shift)^2.
    """
    evidence = evidence_of(problem, pose, sources, max_error_px)
    model = calibration_for(sources.local_types)
    confidence = model.probability(evidence)
    weakest = min(model.weights, key=lambda name: model.weights[name] * evidence[name])
    why, remarks = TERMS[weakest], pose.remarks
    if MAP_POINTS in evidence and confidence >= min_confidence * evidence[MAP_POINTS]:
        why = "the map has too few points in the camera's view"
    if misfit is not None:
        why, shift = misfit
        confidence *= (_TOLERATED_SHIFT / max(shift, _TOLERATED_SHIFT)) ** 2
        remarks = (*remarks, why)
    if confidence >= min_confidence:
        return replace(pose, confidence=confidence, evidence=evidence, remarks=remarks)
    return Failure(
        f"the pose's confidence is {confidence:.2g}, but at least {min_confidence:g} is required: "
        f"{pose.num_inliers} of {pose.num_matches} 2D-3D matches agree, and {why}",
        num_matches=pose.num_matches,
        num_inliers=pose.num_inliers,
        confidence=confidence,
        remarks=() if misfit is None else misfit[:1],
    )


def _surprise(problem: PoseProblem, errors_px: Floats, max_error_px: float) -> float:
    """Return -log10 of the number of false alarms of the inliers, at least 0.

    This is the a-contrario model (Moisan and Stival, IJCV 2004; for poses Moulon et al., ACCV
    2012): a wrong match is within r of its projection with a probability equal to the disc's share
    of the image. The radius with the fewest false alarms is used; matches in one cell count
    once.
    """
    from scipy.special import gammaln

    def log_choose(n: int | NDArray[np.int64], k: int | NDArray[np.int64]) -> Floats:
        return np.asarray(gammaln(np.add(n, 1)) - gammaln(np.add(k, 1)) - gammaln(n - k + 1))

    errors, shares = [], []
    for view, of_view in zip(problem.views, problem.split(errors_px), strict=True):
        width, height = view.camera.width, view.camera.height
        cells = np.floor(view.points_px / max(_CELL * math.hypot(width, height), 1))
        order = np.argsort(of_view, kind="stable")
        kept = order[np.unique(cells[order], axis=0, return_index=True)[1]]
        errors.append(of_view[kept])
        disc = np.pi * np.maximum(errors[-1], _MIN_ERROR_PX) ** 2
        shares.append(np.minimum(disc / (width * height), 1.0))
    error, share = np.concatenate(errors), np.concatenate(shares)
    num = len(error)
    order = np.argsort(error, kind="stable")[: int((error <= max_error_px).sum())]
    counts = np.arange(1, len(order) + 1)
    # largest disc among the k best matches
    shares_of_best = np.maximum.accumulate(share[order])
    many = counts > _SAMPLE
    if not many.any():
        return 0.0
    counts = counts[many]
    log_alarms = (
        math.log(max(num - _SAMPLE, 1))
        + log_choose(num, counts)
        + log_choose(counts, _SAMPLE)
        + (counts - _SAMPLE) * np.log(shares_of_best[many])
    )
    return max(0.0, -float(log_alarms.min()) / math.log(10))


def _misfit(problem: PoseProblem, errors_px: Floats, pose: Pose, sources: MatchSources) -> float:
    """Return how much worse the inliers fit than the map's own images do, at least 0.

    A mirrored or similar scene has hundreds of inliers that almost fit. The ratio is the median of
    the inliers' reprojection errors divided by the errors expected from the noise of the map and
    the covariances of the points. Since detectors fire elsewhere at night, the displacements of the
    inliers' image patches replace the reprojection errors if they are smaller. The result is
    log(ratio / usual ratio) log(number / 20), or 0 if the map's noise is unknown.
    """
    lengths = np.diff(problem.starts)
    focals = np.repeat([focal_px(view.camera) for view in problem.views], lengths)
    # expected noise in the query's pixels; as an angle if the query has more pixels per radian
    noise_rad, noise_px = sources.noise.T
    own_px = np.maximum(noise_rad * focals, np.maximum(noise_px, _MIN_NOISE_PX))
    # points of small parallax have larger errors in images from other viewpoints
    share = (noise_px / own_px)[:, None] ** 2
    relative = replace(problem, covariances=problem.covariances * share[: len(problem.covariances)])
    _, explained = match_errors(relative, pose.cam_from_world)
    known = pose.inliers & np.isfinite(own_px)
    if known.sum() <= _FEW:
        return 0.0
    ratio = float(np.median((explained / own_px)[known]))
    if ratio > _USUAL_RATIO and sources.displacements_rad is not None:
        displaced = sources.displacements_rad(pose)
        if len(displaced) > _FEW:
            per_error = errors_px[known] / np.maximum(explained[known], 1e-9)
            expected = (own_px / focals)[known] * per_error
            ratio = min(ratio, float(np.median(displaced)) / float(np.median(expected)))
    return math.log(max(ratio / _USUAL_RATIO, 1.0)) * math.log(int(known.sum()) / _FEW)


def _num_visible(
    problem: PoseProblem, rig_from_world: RigidTransform, seen: Sequence[Floats]
) -> int:
    total = 0.0
    for view, points in zip(problem.views, seen, strict=True):
        every = max(1, len(points) // _MAX_PROJECTED)
        with np.errstate(invalid="ignore"):
            px = project(view.camera, view.cam_from_rig @ rig_from_world, points[::every])
            size = (view.camera.width, view.camera.height)
            total += every * int(((px >= 0) & (px <= size)).all(axis=1).sum())
    return int(total)


def _viewpoints(ours: Floats, theirs: Floats) -> tuple[float, float]:
    """Return medians over the inliers' map observations.

    They are the viewing angle divided by 90 deg, and |log2| of the distance ratio. ``ours`` and
    ``theirs`` (N, 3) are vectors from the points to the query's camera and to the map's cameras.
    """
    length, other = np.linalg.norm(ours, axis=1), np.linalg.norm(theirs, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosines = np.clip((ours * theirs).sum(axis=1) / (length * other), -1.0, 1.0)
        ratio = float(np.median(length / other))
    angle = float(np.median(np.arccos(cosines))) / (np.pi / 2)
    return angle, abs(math.log2(max(ratio, 1e-6))) if math.isfinite(ratio) else 20.0


@dataclass(frozen=True)
class Calibration:
    """Logistic model of the confidence; terms without a weight are ignored."""

    origin: str
    bias: float
    weights: Mapping[str, float]

    def probability(self, evidence: Mapping[str, float]) -> float:
        """Return the probability in [0, 1] that a pose is right, times :data:`MAP_POINTS` if
        present.
        """
        logit = self.bias + sum(
            weight * evidence[name] for name, weight in sorted(self.weights.items())
        )
        of_terms = 1.0 / (1.0 + math.exp(-min(max(logit, -700.0), 700.0)))
        return of_terms * evidence.get(MAP_POINTS, 1.0)


OF_ALL = "all"


@lru_cache(maxsize=1)
def calibrations() -> Mapping[str, Calibration]:
    """Return the calibrations by prefix of the keypoints type; :data:`OF_ALL` for others."""
    text = resources.files(__package__).joinpath("confidence.toml").read_text(encoding="utf-8")
    return {name: Calibration(**table) for name, table in tomllib.loads(text).items()}


def calibration_for(local_types: Collection[str]) -> Calibration:
    """Return the calibration that the keypoints types share, or else that of :data:`OF_ALL`."""
    known = calibrations()
    names = {
        next((name for name in known if name != OF_ALL and local_type.startswith(name)), OF_ALL)
        for local_type in local_types
    }
    return known[names.pop() if len(names) == 1 else OF_ALL]


def match_sources(
    views: Sequence[QueryView],
    correspondences: Sequence[Sequence[Correspondences]],
    cluster: Sequence[str],
    centers: Mapping[str, Floats],
) -> MatchSources:
    number = {image: at for at, image in enumerate(cluster)}
    center_of = np.array([centers[image] for image in cluster]).reshape(-1, 3)
    support, images, noise, seen = [], [], [], []
    for view, of_types in zip(views, correspondences, strict=True):
        for typed, of_type in zip(view.matches, of_types, strict=True):
            rows = np.array([number.get(image, -1) for image, _, _ in typed.matches], np.int64)
            support.append(of_type.support)
            images.append(rows[of_type.image_rows])
            index = typed.index
            noise.append(np.tile([index.noise_rad, index.noise_px], (len(of_type.support), 1)))
        seen.append(
            np.concatenate([np.zeros((0, 3)), *(m.index.seen_by(cluster) for m in view.matches)])
        )
    rows_of_images = np.concatenate(images)
    return MatchSources(
        support=np.concatenate(support),
        centers=center_of[rows_of_images],
        images=rows_of_images,
        num_keypoints=sum(len(m.keypoints_px) for view in views for m in view.matches),
        noise=np.concatenate(noise),
        seen=seen,
        local_types={of_type.index.local_type for view in views for of_type in view.matches},
    )
