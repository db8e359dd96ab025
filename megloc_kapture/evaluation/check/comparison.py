"""Poses compared with the map's cameras: which classic mistake explains them, and which are far."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.evaluation.check.explanation import (
    MIN_POSES,
    Explanation,
    explain,
    undecided,
)
from megloc_kapture.evaluation.check.findings import Finding, plural, some
from megloc_kapture.evaluation.check.heights import storey_offset
from megloc_kapture.evaluation.check.neighbourhood import Nearness, Neighbourhood
from megloc_kapture.evaluation.check.pools import Pools, pools_of
from megloc_kapture.evaluation.check.readings import Reading, readings
from megloc_kapture.evaluation.check.reference import MapCameras, Reference
from megloc_kapture.evaluation.check.relative_readings import (
    RelativeReading,
    path_scores,
    relative_readings,
)
from megloc_kapture.io.side_tables import World

# a mistake of the whole file shows in this many of its poses
_SAMPLE = 240
# of the spacing of the map's cameras: how much off the path between its neighbours a query counts
_PATH_SCALE = 0.2
# how much better a pose has to fit another floor to be taken for one of it
_OTHER_FLOOR_GAIN = 2.0
_MOST = 0.5
# of the poses' median distance to the map, what is not far yet; up to so many of its extents
_USUAL, _USUAL_EXTENTS = 4.0, 3.0


def compare_poses(
    keys: Sequence[str],
    quats: NDArray[np.float64],
    translations: NDArray[np.float64],
    queries: Sequence[str | None],
    reference: Reference,
) -> list[Finding]:
    """What the map shows about the poses of a file (one per query, absolute).

    Parameters
    ----------
    keys : per row its name in the file.
    quats, translations : float64 (N, 4) and (N, 3), in the order of the file's columns.
    queries : per row its query, None where the name is unknown.
    reference : with cameras.
    """
    cameras = reference.cameras
    if cameras is None or not len(keys):
        return []
    if len(cameras.images) < MIN_POSES:
        message = f"the map has {plural(len(cameras.images), 'camera')}: too few to compare with"
        return [Finding("note", "too-few", message)]
    pools = pools_of(reference, queries)
    hood = Neighbourhood(cameras, pools.members)
    sample = _sample(len(keys))
    tried = list(
        readings(
            frames=reference.world != World(),
            floors=bool(pools.has_other[sample].mean() > _MOST),
        )
    )

    def look(reading: Reading, rows: NDArray[np.int64]) -> Nearness:
        own = pools.own if reading.floor == "own" else pools.other
        poses = reading.cam_from_local(quats[rows], translations[rows], reference.world)
        return hood.look(*poses, own[rows])

    found = [look(reading, sample) for reading in tried]
    scores = np.array([nearness.score for nearness in found])
    fits = np.array([nearness.fits for nearness in found])
    explanation = explain(scores, fits, [reading.mistakes for reading in tried])
    if explanation is not None:
        return [_explained(explanation, tried)]
    findings = _doubts(scores, tried, len(keys))
    everything = np.arange(len(keys))
    as_is = look(Reading(), everything)
    if pools.has_other.any():
        other = look(Reading(floor="other"), everything)
        findings += _other_floor(keys, as_is, other, pools)
    elif len({reference.groups[i].frame for i in cameras.images if i in reference.groups}) > 1:
        findings.append(
            Finding(
                "note",
                "floor-unknown",
                "which floor a query belongs to is not known here: a pose may be of the other one",
            )
        )
    _, centers = Reading().cam_from_local(quats, translations, reference.world)
    findings += _far(keys, as_is, reference.world.unit)
    findings += _unlike(as_is, len(keys))
    if reference.world.unit == "m":
        findings += _storeys(cameras, centers, pools)
    return findings


def compare_relative(
    keys: Sequence[str],
    quats: NDArray[np.float64],
    translations: NDArray[np.float64],
    pairs: Sequence[tuple[str, str | None]],
    reference: Reference,
) -> list[Finding]:
    """What the map shows about the rows of an MLAD file.

    Parameters
    ----------
    keys : per row its two timestamps.
    quats, translations : float64 (N, 4) and (N, 3), in the order of the file's columns.
    pairs : per row the reference's image (of the map) and the query's, None where it is unknown.
    reference : with cameras.
    """
    cameras = reference.cameras
    if cameras is None or not len(keys):
        return []
    position = {image: number for number, image in enumerate(cameras.images)}
    rows = np.array([i for i, (image, _) in enumerate(pairs) if image in position], dtype=np.int64)
    findings = []
    if len(rows) < len(keys):
        left = len(keys) - len(rows)
        message = f"{plural(left, 'row')} not compared: the map has no pose of the reference"
        findings.append(Finding("note", "no-reference", message))
    if not len(rows):
        return findings
    where = np.array([position[pairs[i][0]] for i in rows])
    references = (cameras.quats[where], cameras.centers[where])
    pools = pools_of(reference, [pairs[i][1] for i in rows])
    hood = Neighbourhood(cameras, pools.members)
    stamps = [int(keys[i].split(" ")[1]) for i in rows]
    times = np.array([float(stamp - min(stamps)) for stamp in stamps])
    scale = _PATH_SCALE * hood.spacing[pools.own]
    tried = list(relative_readings())
    scores, fits, found = [], [], []
    for reading in tried:
        own = (quats[rows], translations[rows], references, reference.world)
        poses = reading.cam_from_local(*own)
        nearness = hood.look(*poses, pools.own)
        scores.append(nearness.score + path_scores(poses[1], times, scale))
        fits.append(nearness.fits)
        found.append(nearness)
    mistakes = [reading.mistakes for reading in tried]
    explanation = explain(np.array(scores), np.array(fits), mistakes)
    if explanation is not None:
        return [*findings, _explained(explanation, tried)]
    named = [keys[i] for i in rows]
    findings += _doubts(np.array(scores), tried, len(rows))
    return findings + _far(named, found[0], reference.world.unit)


def _sample(number: int) -> NDArray[np.int64]:
    """Rows spread evenly over the file: its conditions and drives all have a part in them."""
    return np.unique(np.linspace(0, number - 1, min(number, _SAMPLE)).round().astype(np.int64))


def _explained(
    explanation: Explanation, tried: Sequence[Reading] | Sequence[RelativeReading]
) -> Finding:
    reading = tried[explanation.reading]
    message = (
        f"{reading} (read so, {explanation.fitting:.0%} of the poses fit the map, as they stand "
        f"{explanation.fitting_as_is:.0%})"
    )
    others = [str(tried[other]) for other in explanation.as_good]
    if others:
        shown = "; or: ".join(others[:3])
        message += f"; what the map cannot tell from it: {shown}"
        message += f", and {len(others) - 3} more readings" if len(others) > 3 else ""
    return Finding("error", reading.kind, message)


def _doubts(
    scores: NDArray[np.float64],
    tried: Sequence[Reading] | Sequence[RelativeReading],
    number: int,
) -> list[Finding]:
    """What the comparison cannot rule out."""
    if number < MIN_POSES:
        message = f"{plural(number, 'pose')}: too few to tell whether they are all wrong in one way"
        return [Finding("note", "too-few", message)]
    simple = [i for i in range(len(tried)) if i == 0 or tried[i].mistakes == 1]
    open_ones = [tried[simple[i]].kind for i in undecided(scores[simple])]
    if not open_ones:
        return []
    message = (
        "the map's cameras do not rule out every mistake; the poses fit as well when they are "
        f"taken for: {', '.join(open_ones)}"
    )
    return [Finding("note", "undecided", message)]


def _other_floor(
    keys: Sequence[str], own: Nearness, other: Nearness, pools: Pools
) -> list[Finding]:
    with np.errstate(invalid="ignore"):
        better = np.nan_to_num(other.score - own.score) > _OTHER_FLOOR_GAIN
    wrong = np.flatnonzero(pools.has_other & better & other.fits & ~own.fits).tolist()
    if not wrong:
        return []
    names = tuple(keys[i] for i in wrong)
    first = wrong[0]
    most = len(wrong) > _MOST * pools.has_other.sum()
    message = (
        f"{plural(len(wrong), 'pose')} on the wrong floor: {some(names)}; {keys[first]} fits the "
        f"cameras of {pools.labels[pools.other[first]]}, and its query belongs to "
        f"{pools.labels[pools.own[first]]}"
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
    names = tuple(keys[i] for i in far)
    told = some(f"{keys[i]} ({nearness.distance[i]:.4g} {unit})" for i in far)
    if len(far) > _MOST * len(keys):
        message = (
            f"{len(far)} of {len(keys)} poses are far from every map camera they may be near, and "
            f"no classic mistake explains it; is it another frame, or another scale? {told}"
        )
        return [Finding("error", "far", message, names=names)]
    message = f"{plural(len(far), 'pose')} far from every map camera they may be near: {told}"
    return [Finding("warning", "far", message, names=names)]


def _unlike(nearness: Nearness, number: int) -> list[Finding]:
    unlike = (~nearness.fits & (nearness.distance <= nearness.near)).sum()
    if number < MIN_POSES or unlike <= _MOST * number:
        return []
    message = (
        f"{unlike} of {number} poses look where no map camera around them looks; they are right "
        "only if the queries were taken so"
    )
    return [Finding("warning", "orientation", message)]


def _storeys(cameras: MapCameras, centers: NDArray[np.float64], pools: Pools) -> list[Finding]:
    findings = []
    for number, members in enumerate(pools.members):
        rows = pools.own == number
        if rows.sum() < MIN_POSES:
            continue
        part = MapCameras(
            tuple(cameras.images[i] for i in members),
            cameras.quats[members],
            cameras.centers[members],
        )
        offset = storey_offset(part, centers[rows])
        if offset is not None:
            of = f" of {pools.labels[number]}" if pools.labels[number] else ""
            message = (
                f"most poses stand {abs(offset):.1f} m {'above' if offset > 0 else 'below'} the "
                f"map's cameras{of} around them: another storey, or heights from another zero"
            )
            findings.append(Finding("error", "height", message))
    return findings
