"""Poses compared with the map's cameras around them: the mistake that explains them, and those that
are far, on another floor or a storey off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.evaluation.check.mistakes import (
    MIN_POSES,
    Hypothesis,
    absolute_hypotheses,
    explain,
    relative_hypotheses,
    restore_absolute,
    restore_relative,
    undecided,
)
from megloc_kapture.evaluation.check.reading import (
    CameraSets,
    Finding,
    MapCameras,
    Reference,
    Rows,
    Severity,
    camera_sets,
    plural,
    some,
)
from megloc_kapture.geometry.poses import rotation_matrices
from megloc_kapture.io.dataset_tables import World

# how many map cameras a pose's orientation is compared with: a panoramic scan has 36 of one centre
_NEIGHBOURS = 48
# a neighbour may be this much farther than the nearest: which one it is does not matter far away,
# and a tree finds it many times faster
_TREE_SLACK = 0.2
# cameras nearer to each other than this share of the extent stand together
_TOGETHER = 1 / 200
# this many spacings, or this share of the extent, from a map camera a pose is still near it
_NEAR_SPACINGS, _NEAR_EXTENT = 10.0, 0.1
# coordinates that no map has; their squares must not overflow
_INFINITE = 1e100
# orientations this near are alike, beyond the second all are equally unlike; what one counts
_ALIKE_DEG, _UNLIKE_DEG, _ANGLE_SCALE_DEG = 45.0, 90.0, 20.0
# the mean of the cameras' up directions is this long where most of them stand upright
_UPRIGHT = 0.8
# no ceiling is lower, and no two ways of holding a camera differ so much
_STOREY_M = 1.5
# this many times the map's own difference in height between neighbours, for this share of poses
_STOREY_HEIGHTS, _STOREY_SHARE, _STOREY_NEIGHBOURS = 4.0, 0.6, 8
# a mistake of the whole file shows in this many of its poses
_SAMPLE = 240
# of the spacing of the map's cameras: how much off the path between its neighbours a query counts
_PATH_SCALE = 0.2
# how much better a pose has to fit another floor to be taken for one of it
_OTHER_FLOOR_GAIN = 2.0
_MOST = 0.5
# of the poses' median distance to the map, what is not far yet; up to so many of its extents
_USUAL, _USUAL_EXTENTS = 4.0, 3.0


@dataclass(frozen=True, eq=False)
class Nearness:
    """N poses among the map's cameras.

    Parameters
    ----------
    distance : float64 (N,), to the nearest camera, in the map's unit; infinite without any.
    score : float64 (N,), how well each pose fits: 0 is best. It is that of the map camera which is
        most alike, in distance and orientation together, and falls with the logarithm of both.
        Distances count in spacings of the map's cameras, so that a table top and a city are alike.
    fits : bool (N,), whether a camera that is near looks alike.
    near : float64 (N,), the distance up to which a camera of its set is near.
    extent : float64 (N,), of the cameras of its set.
    """

    distance: NDArray[np.float64]
    score: NDArray[np.float64]
    fits: NDArray[np.bool_]
    near: NDArray[np.float64]
    extent: NDArray[np.float64]


class Neighbourhood:
    """The map's cameras by sets: each pose is compared with the cameras of its set only.

    The spacing of a set is the median distance from a camera to the next, where cameras that stand
    together (a rig, a panoramic scan) are one; infinite where there is only one. ``sets`` has
    positions in ``cameras``, int64 (K,) each, K > 0.
    """

    def __init__(self, cameras: MapCameras, sets: Sequence[NDArray[np.int64]]) -> None:
        self._rows = np.concatenate(sets)
        self._set_of_row = np.repeat(np.arange(len(sets)), [len(own) for own in sets])
        self._quats, self._centers = cameras.quats, cameras.centers
        # sets lie apart in a fourth dimension, so that one tree and one call serve all of them
        size = float(np.ptp(cameras.centers, axis=0).max()) if len(cameras.centers) else 0.0
        self._gap = 1e4 * (size or 1.0)
        centers = cameras.centers[self._rows]
        self._tree = cKDTree(np.column_stack([centers, self._set_of_row * self._gap]))
        scales = [_scales(cameras.centers[own]) for own in sets]
        self.spacing, self.near, self.extent = np.array(scales).T

    def look(
        self, quats: NDArray[np.float64], centers: NDArray[np.float64], sets: NDArray[np.int64]
    ) -> Nearness:
        """Compare poses with the cameras of their sets.

        Parameters
        ----------
        quats, centers : float64 (N, 4) and (N, 3), of ``cam_from_local``; a centre that is not
            finite is infinitely far.
        sets : int64 (N,).
        """
        count = min(_NEIGHBOURS, len(self._rows))
        with np.errstate(invalid="ignore"):
            finite = np.abs(centers).max(axis=1, initial=0.0) < _INFINITE
        centers = np.where(finite[:, None], centers, 0.0)
        apart = np.column_stack([centers, sets * self._gap])
        _, found = self._tree.query(apart, k=np.arange(1, count + 1), eps=_TREE_SLACK)
        same = (self._set_of_row[found] == sets[:, None]) & finite[:, None]
        cameras = self._rows[found]
        offsets = self._centers[cameras] - centers[:, None]
        distance = np.where(same, np.linalg.norm(offsets, axis=2), np.inf)
        cosine = np.abs(np.einsum("nkd,nd->nk", self._quats[cameras], quats))
        angle_deg = np.rad2deg(2.0 * np.arccos(np.minimum(cosine, 1.0)))
        near = self.near[sets]
        turned = np.log1p((np.minimum(angle_deg, _UNLIKE_DEG) / _ANGLE_SCALE_DEG) ** 2)
        with np.errstate(invalid="ignore"):
            spacings = np.where(same, distance / self.spacing[sets, None], np.inf)
        score = (-np.log1p(spacings) - turned).max(axis=1)
        alike = same & (distance <= near[:, None]) & (angle_deg <= _ALIKE_DEG)
        return Nearness(distance.min(axis=1), score, alike.any(axis=1), near, self.extent[sets])


def _scales(centers: NDArray[np.float64]) -> tuple[float, float, float]:
    """Spacing, the distance that is near, and the extent of the cameras of one set."""
    extent = _extent(centers, np.median(centers, axis=0))
    apart = _one_of_each(centers, extent) if extent > 0.0 else centers[:1]
    if len(apart) < 2:
        return np.inf, np.inf, np.inf
    spacing = float(np.median(cKDTree(apart).query(apart, k=2)[0][:, 1]))
    return spacing, max(_NEAR_SPACINGS * spacing, _NEAR_EXTENT * extent), extent


def _one_of_each(centers: NDArray[np.float64], extent: float) -> NDArray[np.float64]:
    """Centres with one left of those that stand together, or each would be its own neighbour."""
    grid = extent * _TOGETHER
    return np.unique(np.round(centers / grid), axis=0) * grid


def _extent(centers: NDArray[np.float64], middle: NDArray[np.float64]) -> float:
    return float(np.quantile(np.linalg.norm(centers - middle, axis=1), 0.9))


def storey_offset(cameras: MapCameras, centers: NDArray[np.float64]) -> float | None:
    """Height, metres, that most poses have above the map's cameras around them, where it is a
    storey's; negative below. None where heights are usual, or the map does not say which way is up.

    Parameters
    ----------
    cameras : of the map, in metres.
    centers : float64 (N, 3), of the poses, in the same frame.
    """
    up = -rotation_matrices(cameras.quats)[:, 1, :].mean(axis=0)
    length = float(np.linalg.norm(up))
    centers = centers[(np.abs(centers) < _INFINITE).all(axis=1)]
    middle = np.median(cameras.centers, axis=0)
    extent = _extent(cameras.centers, middle)
    if length < _UPRIGHT or not len(centers) or not extent > 0:
        return None
    up /= length
    level = np.linalg.svd(up[None])[2][1:].T  # two directions
    own, given = _one_of_each(cameras.centers - middle, extent), centers - middle
    count = min(_STOREY_NEIGHBOURS, len(own) - 1)
    if count < 1:
        return None
    tree, heights = cKDTree(own @ level), own @ up
    _, found = tree.query(own @ level, k=np.arange(1, count + 2))
    usual = np.quantile(np.abs(heights[found[:, 1:]] - heights[:, None]).min(axis=1), 0.9)
    distance, found = tree.query(given @ level, k=np.arange(1, count + 1))
    near = distance[:, 0] <= extent
    if not near.any():
        return None
    differences = (given @ up)[:, None] - heights[found]
    nearest = np.abs(differences).argmin(axis=1)
    above = differences[np.arange(len(nearest)), nearest][near]
    offset = float(np.median(above))
    alike = np.abs(above - offset) < 0.5 * abs(offset)
    least = max(_STOREY_M, _STOREY_HEIGHTS * float(usual))
    if abs(offset) < least or alike.mean() * near.mean() < _STOREY_SHARE:
        return None
    return offset


def path_scores(
    centers: NDArray[np.float64], times: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Scores (N,) of each query's position between its neighbours in time: 0 is best.

    The queries of a file come from one drive, and a wrong hypothesis throws each of them to another
    side of its reference: the path gets ragged, which the distance to the map cannot show.

    Parameters
    ----------
    centers, times : float64 (N, 3) and (N,); queries of one time have no part in it.
    scale : float64 (N,), the distance that counts.
    """
    order = np.argsort(times, kind="stable")
    times, path = times[order], centers[order]
    scores = np.zeros(len(order))
    if len(order) < 3:
        return scores
    before, span = times[1:-1] - times[:-2], times[2:] - times[:-2]
    usable = (before > 0) & (span > before)
    share = np.where(usable, before, 0.0) / np.where(usable, span, 1.0)
    between = path[:-2] + share[:, None] * (path[2:] - path[:-2])
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.linalg.norm(path[1:-1] - between, axis=1)
        scores[order[1:-1]] = np.where(usable, -np.log1p(off / scale[order][1:-1]), 0.0)
    return scores


def compare_poses(rows: Rows, queries: Sequence[str | None], reference: Reference) -> list[Finding]:
    """Findings about the poses of a file (one per query, absolute), compared with the map;
    ``queries`` has per row its query, None where the name is unknown."""
    cameras, world, keys = reference.cameras, reference.world, rows.keys
    if cameras is None or not keys:
        return []
    if len(cameras.images) < MIN_POSES:
        message = f"the map has {plural(len(cameras.images), 'camera')}: too few to compare with"
        return [Finding("note", "too-few", message)]
    sets = camera_sets(reference, cameras, queries)
    hood = Neighbourhood(cameras, sets.members)
    # spread evenly over the file: its conditions and drives all have a part in them
    spread = np.linspace(0, len(keys) - 1, min(len(keys), _SAMPLE))
    sample = np.unique(spread.round().astype(np.int64))

    def look(hypothesis: Hypothesis, at: NDArray[np.int64], *, other: bool = False) -> Nearness:
        poses = restore_absolute(hypothesis, rows.quats[at], rows.translations[at], world)
        own = sets.other if other or "floor" in hypothesis else sets.own
        return hood.look(*poses, own[at])

    floors = bool(sets.has_other[sample].mean() > _MOST)
    hypotheses = absolute_hypotheses(frames=world != World(), floors=floors)
    findings = _explained(hypotheses, [look(own, sample) for own in hypotheses], len(keys))
    if any(finding.severity == "error" for finding in findings):
        return findings
    everything = np.arange(len(keys))
    as_is = look(Hypothesis(), everything)
    frames = {reference.groups[i].frame for i in cameras.images if i in reference.groups}
    if sets.has_other.any():
        there = look(Hypothesis(), everything, other=True)
        findings += _other_floor(keys, as_is, there, sets)
    elif len(frames) > 1:
        message = "which floor a query belongs to is not known here: a pose may be of the other one"
        findings.append(Finding("note", "floor-unknown", message))
    findings += _far(keys, as_is, world.unit)
    unlike = (~as_is.fits & (as_is.distance <= as_is.near)).sum()
    if len(keys) >= MIN_POSES and unlike > _MOST * len(keys):
        message = (
            f"{unlike} of {len(keys)} poses look where no map camera around them looks; they are "
            "right only if the queries were taken so"
        )
        findings.append(Finding("warning", "orientation", message))
    if world.unit == "m":
        _, centers = restore_absolute(Hypothesis(), rows.quats, rows.translations, world)
        findings += _storeys(cameras, centers, sets)
    return findings


def compare_relative(
    rows: Rows, pairs: Sequence[tuple[str, str | None]], reference: Reference
) -> list[Finding]:
    """Findings about the rows of an MLAD file, compared with the map; ``pairs`` has per row the
    reference's image (of the map) and the query's, None where it is unknown."""
    cameras = reference.cameras
    if cameras is None or not rows.keys:
        return []
    position = {image: number for number, image in enumerate(cameras.images)}
    known = [row for row, (image, _) in enumerate(pairs) if image in position]
    findings = []
    if left := len(pairs) - len(known):
        message = f"{plural(left, 'row')} not compared: the map has no pose of the reference"
        findings.append(Finding("note", "no-reference", message))
    if not known:
        return findings
    rows, pairs = rows.only(np.array(known)), [pairs[row] for row in known]
    where = [position[image] for image, _ in pairs]
    references = (cameras.quats[where], cameras.centers[where])
    sets = camera_sets(reference, cameras, [query for _, query in pairs])
    hood = Neighbourhood(cameras, sets.members)
    stamps = [int(key.split(" ")[1]) for key in rows.keys]
    times = np.array([float(stamp - min(stamps)) for stamp in stamps])
    scale = _PATH_SCALE * hood.spacing[sets.own]

    def look(own: Hypothesis) -> Nearness:
        poses = restore_relative(own, rows.quats, rows.translations, references, reference.world)
        found = hood.look(*poses, sets.own)
        return replace(found, score=found.score + path_scores(poses[1], times, scale))

    hypotheses = relative_hypotheses()
    looks = [look(own) for own in hypotheses]
    findings += _explained(hypotheses, looks, len(known))
    if not any(finding.severity == "error" for finding in findings):
        findings += _far(rows.keys, looks[0], reference.world.unit)
    return findings


def _explained(
    hypotheses: Sequence[Hypothesis], looks: Sequence[Nearness], number: int
) -> list[Finding]:
    """The mistake that explains the file as an error, else what cannot be ruled out."""
    scores = np.array([nearness.score for nearness in looks])
    fits = np.array([nearness.fits for nearness in looks])
    best = explain(scores, fits, [hypothesis.cost for hypothesis in hypotheses])
    if best:
        said, *others = (str(hypotheses[h]) for h in best)
        message = (
            f"{said} (read so, {fits[best[0]].mean():.0%} of the poses fit the map, as they stand "
            f"{fits[0].mean():.0%})"
        )
        if others:
            message += f"; what the map cannot tell from it: {'; or: '.join(others[:3])}"
            message += f", and {len(others) - 3} more readings" if len(others) > 3 else ""
        return [Finding("error", hypotheses[best[0]].kind, message)]
    if number < MIN_POSES:
        message = f"{plural(number, 'pose')}: too few to tell whether they are all wrong in one way"
        return [Finding("note", "too-few", message)]
    simple = [i for i, hypothesis in enumerate(hypotheses) if hypothesis.cost <= 1]
    kinds = [hypotheses[simple[i]].kind for i in undecided(scores[simple])]
    if not kinds:
        return []
    message = (
        "the map's cameras do not rule out every mistake; the poses fit as well when they are "
        f"taken for: {', '.join(kinds)}"
    )
    return [Finding("note", "undecided", message)]


def _other_floor(
    keys: Sequence[str], own: Nearness, other: Nearness, sets: CameraSets
) -> list[Finding]:
    with np.errstate(invalid="ignore"):
        better = np.nan_to_num(other.score - own.score) > _OTHER_FLOOR_GAIN
    wrong = np.flatnonzero(sets.has_other & better & other.fits & ~own.fits).tolist()
    if not wrong:
        return []
    names = tuple(keys[i] for i in wrong)
    first = wrong[0]
    most = len(wrong) > _MOST * sets.has_other.sum()
    message = (
        f"{plural(len(wrong), 'pose')} on the wrong floor: {some(names)}; {keys[first]} fits the "
        f"cameras of {sets.labels[sets.other[first]]}, and its query belongs to "
        f"{sets.labels[sets.own[first]]}"
    )
    return [Finding("error" if most else "warning", "floor", message, names=names)]


def _far(keys: Sequence[str], nearness: Nearness, unit: str) -> list[Finding]:
    # where the queries were taken apart from the map, a distance that most of them have is usual
    usual = np.minimum(_USUAL * np.median(nearness.distance), _USUAL_EXTENTS * nearness.extent)
    limit = np.maximum(np.minimum(nearness.near, nearness.extent), usual)
    order = np.argsort(-nearness.distance, kind="stable")
    far = order[(nearness.distance > limit)[order]].tolist()
    if not far:
        return []
    told = some(f"{keys[i]} ({nearness.distance[i]:.4g} {unit})" for i in far)
    severity: Severity = "warning"
    message = f"{plural(len(far), 'pose')} far from every map camera they may be near: {told}"
    if len(far) > _MOST * len(keys):
        severity = "error"
        message = (
            f"{len(far)} of {len(keys)} poses are far from every map camera they may be near, and "
            f"no classic mistake explains it; is it another frame, or another scale? {told}"
        )
    return [Finding(severity, "far", message, names=tuple(keys[i] for i in far))]


def _storeys(cameras: MapCameras, centers: NDArray[np.float64], sets: CameraSets) -> list[Finding]:
    findings = []
    for number, (members, label) in enumerate(zip(sets.members, sets.labels, strict=True)):
        rows = sets.own == number
        if rows.sum() < MIN_POSES:
            continue
        own = MapCameras((), cameras.quats[members], cameras.centers[members])  # without names
        offset = storey_offset(own, centers[rows])
        if offset is not None:
            message = (
                f"most poses stand {abs(offset):.1f} m {'above' if offset > 0 else 'below'} the "
                f"map's cameras{f' of {label}' if label else ''} around them: another storey, or "
                "heights from another zero"
            )
            findings.append(Finding("error", "height", message))
    return findings
