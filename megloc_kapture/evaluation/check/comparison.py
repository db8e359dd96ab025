"""Poses compared with the map's cameras: the mistake that explains them, and those that are far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.evaluation.check.cameras import (
    CameraSets,
    Nearness,
    Neighbourhood,
    camera_sets,
    storey_offset,
)
from megloc_kapture.evaluation.check.findings import Finding, plural, some
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
from megloc_kapture.evaluation.check.reading import MapCameras, Reference
from megloc_kapture.io.dataset_tables import World

# a mistake of the whole file shows in this many of its poses
_SAMPLE = 240
# of the spacing of the map's cameras: how much off the path between its neighbours a query counts
_PATH_SCALE = 0.2
# how much better a pose has to fit another floor to be taken for one of it
_OTHER_FLOOR_GAIN = 2.0
_MOST = 0.5
# of the poses' median distance to the map, what is not far yet; up to so many of its extents
_USUAL, _USUAL_EXTENTS = 4.0, 3.0


def path_scores(
    centers: NDArray[np.float64], times: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Scores (N,) of each query's position between its neighbours in time: 0 is best.

    The queries of a file come from one drive, and a wrong hypothesis throws each of them to another
    side of its reference: the path gets ragged, which the distance to the map cannot show.

    Parameters
    ----------
    centers : float64 (N, 3).
    times : float64 (N,), of the queries, from any origin; queries of one time have no part in it.
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


def compare_poses(
    keys: Sequence[str],
    quats: NDArray[np.float64],
    translations: NDArray[np.float64],
    queries: Sequence[str | None],
    reference: Reference,
) -> list[Finding]:
    """Findings about the poses of a file (one per query, absolute), compared with the map.

    Parameters
    ----------
    keys : per row its name in the file.
    quats, translations : float64 (N, 4) and (N, 3), in the order of the file's columns.
    queries : per row its query, None where the name is unknown.
    reference : with cameras.
    """
    cameras, world = reference.cameras, reference.world
    if cameras is None or not len(keys):
        return []
    if len(cameras.images) < MIN_POSES:
        message = f"the map has {plural(len(cameras.images), 'camera')}: too few to compare with"
        return [Finding("note", "too-few", message)]
    sets = camera_sets(reference, cameras, queries)
    hood = Neighbourhood(cameras, sets.members)
    # spread evenly over the file: its conditions and drives all have a part in them
    spread = np.linspace(0, len(keys) - 1, min(len(keys), _SAMPLE))
    sample = np.unique(spread.round().astype(np.int64))
    floors = bool(sets.has_other[sample].mean() > _MOST)
    everything = np.arange(len(keys))

    def look(hypothesis: Hypothesis, rows: NDArray[np.int64], *, other: bool = False) -> Nearness:
        poses = restore_absolute(hypothesis, quats[rows], translations[rows], world)
        own = sets.other if other or "floor" in hypothesis else sets.own
        return hood.look(*poses, own[rows])

    findings, explained = _explained(
        absolute_hypotheses(frames=world != World(), floors=floors),
        lambda hypothesis: look(hypothesis, sample),
        len(keys),
    )
    if explained:
        return findings
    as_is = look(Hypothesis(), everything)
    frames = {reference.groups[i].frame for i in cameras.images if i in reference.groups}
    if sets.has_other.any():
        findings += _other_floor(keys, as_is, look(Hypothesis(), everything, other=True), sets)
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
        _, centers = restore_absolute(Hypothesis(), quats, translations, world)
        findings += _storeys(cameras, centers, sets)
    return findings


def compare_relative(
    keys: Sequence[str],
    quats: NDArray[np.float64],
    translations: NDArray[np.float64],
    pairs: Sequence[tuple[str, str | None]],
    reference: Reference,
) -> list[Finding]:
    """Findings about the rows of an MLAD file, compared with the map.

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
        left = plural(len(keys) - len(rows), "row")
        message = f"{left} not compared: the map has no pose of the reference"
        findings.append(Finding("note", "no-reference", message))
    if not len(rows):
        return findings
    where = np.array([position[pairs[i][0]] for i in rows])
    references = (cameras.quats[where], cameras.centers[where])
    sets = camera_sets(reference, cameras, [pairs[i][1] for i in rows])
    hood = Neighbourhood(cameras, sets.members)
    stamps = [int(keys[i].split(" ")[1]) for i in rows]
    times = np.array([float(stamp - min(stamps)) for stamp in stamps])
    scale = _PATH_SCALE * hood.spacing[sets.own]
    quats, translations = quats[rows], translations[rows]

    def look(hypothesis: Hypothesis) -> Nearness:
        poses = restore_relative(hypothesis, quats, translations, references, reference.world)
        found = hood.look(*poses, sets.own)
        return replace(found, score=found.score + path_scores(poses[1], times, scale))

    about_all, explained = _explained(relative_hypotheses(), look, len(rows))
    findings += about_all
    if explained:
        return findings
    return findings + _far([keys[i] for i in rows], look(Hypothesis()), reference.world.unit)


def _explained(
    hypotheses: Sequence[Hypothesis], look: Callable[[Hypothesis], Nearness], number: int
) -> tuple[list[Finding], bool]:
    """The mistake that explains the file, or what cannot be ruled out; and whether one does."""
    found = [look(hypothesis) for hypothesis in hypotheses]
    scores = np.array([nearness.score for nearness in found])
    fits = np.array([nearness.fits for nearness in found])
    explanation = explain(scores, fits, [hypothesis.cost for hypothesis in hypotheses])
    if explanation is not None:
        best = hypotheses[explanation.best]
        message = (
            f"{best} (read so, {explanation.fitting:.0%} of the poses fit the map, as they stand "
            f"{explanation.fitting_as_is:.0%})"
        )
        others = [str(hypotheses[other]) for other in explanation.as_good]
        if others:
            message += f"; what the map cannot tell from it: {'; or: '.join(others[:3])}"
            message += f", and {len(others) - 3} more readings" if len(others) > 3 else ""
        return [Finding("error", best.kind, message)], True
    if number < MIN_POSES:
        message = f"{plural(number, 'pose')}: too few to tell whether they are all wrong in one way"
        return [Finding("note", "too-few", message)], False
    simple = [i for i, hypothesis in enumerate(hypotheses) if hypothesis.cost <= 1]
    kinds = [hypotheses[simple[i]].kind for i in undecided(scores[simple])]
    if not kinds:
        return [], False
    message = (
        "the map's cameras do not rule out every mistake; the poses fit as well when they are "
        f"taken for: {', '.join(kinds)}"
    )
    return [Finding("note", "undecided", message)], False


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


def _storeys(cameras: MapCameras, centers: NDArray[np.float64], sets: CameraSets) -> list[Finding]:
    findings = []
    for number, (members, label) in enumerate(zip(sets.members, sets.labels, strict=True)):
        rows = sets.own == number
        if rows.sum() < MIN_POSES:
            continue
        # without names, which heights do not need
        own = MapCameras((), cameras.quats[members], cameras.centers[members])
        offset = storey_offset(own, centers[rows])
        if offset is not None:
            message = (
                f"most poses stand {abs(offset):.1f} m {'above' if offset > 0 else 'below'} the "
                f"map's cameras{f' of {label}' if label else ''} around them: another storey, or "
                "heights from another zero"
            )
            findings.append(Finding("error", "height", message))
    return findings
