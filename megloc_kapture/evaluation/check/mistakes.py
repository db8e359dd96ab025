"""Classic mistakes in pose files: hypotheses of them, and the one that explains a file.

A hypothesis says what somebody took a pose to be when the file was written. To restore the poses
under it is to read the file in the same way, which gives the right ones back.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.poses import (
    camera_centers,
    compose,
    invert,
    invert_quats,
    multiply_quats,
    rotate,
)
from megloc_kapture.io.dataset_tables import World
from megloc_kapture.values import RigidTransform

Arrays = tuple[NDArray[np.float64], NDArray[np.float64]]

# diag(1, -1, -1): half a turn about x, from y down and z forward to y up and z back
_OPENGL_QUAT = np.array([0.0, 1.0, 0.0, 0.0])
_OPENGL_SIGNS = np.array([1.0, -1.0, -1.0])

# no single pose counts for more than this: a share of truly wrong ones must not decide
_CLIP = 3.0
# no score below this is told from it: it is as far from the map as it takes
_FLOOR = 12.0
# a hypothesis has to gain so much per pose on average, also at the lower end of what is certain
_GAIN, _CERTAIN_GAIN = 0.7, 0.3
# ... for this share of the poses, and this share of them has to fit the map under it: more where
# it takes a rare mistake or several
_SHARE_BETTER, _SHARE_FITTING, _SHARE_FITTING_RARE = 0.6, 0.5, 0.6
# each mistake more has to gain this in all, and this per pose
_PER_MISTAKE, _PER_MISTAKE_AND_POSE = 3.0, 0.6
# hypotheses this near to the best, per pose or in what is certain, explain the file as well
_AS_GOOD = 0.3
# with fewer poses, chance finds a hypothesis for them
MIN_POSES = 3


@dataclass(frozen=True, eq=False)
class Mistake:
    """One thing that is not as the format has it.

    Parameters
    ----------
    kind : a short name that programs can rely on; ``said`` has it in words.
    cost : 1; more where it is rare.
    turn_wxyz : of a mistake about the world's axes: the turn ``file_from_map``, float64 (4,).
    """

    kind: str
    said: str
    cost: float = 1.0
    turn_wxyz: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Mistakes made together in a whole file; none is the right reading."""

    mistakes: tuple[Mistake, ...] = ()

    @property
    def kind(self) -> str:
        """Short names of the mistakes, joined."""
        return "+".join(mistake.kind for mistake in self.mistakes)

    @property
    def cost(self) -> float:
        """The number of mistakes; rare ones count more."""
        return sum(mistake.cost for mistake in self.mistakes)

    def __contains__(self, kind: str) -> bool:
        return any(mistake.kind == kind for mistake in self.mistakes)

    def __str__(self) -> str:
        return "; ".join(mistake.said for mistake in self.mistakes)


def _axis_turns() -> tuple[Mistake, ...]:
    """The 23 turns of the world that take axes to axes, besides none."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) < 0 or (matrix == np.eye(3)).all():
                continue
            axes = ", ".join(
                f"{'-' if sign < 0 else ''}{'xyz'[axis]}"
                for axis, sign in zip(order, signs, strict=True)
            )
            quat = np.array(RigidTransform.from_matrix(matrix, np.zeros(3)).quat_wxyz)
            said = f"the world has other axes than the map: its x, y, z are the map's {axes}"
            turns.append(Mistake("world-axes", said, 1.5, quat))
    return tuple(turns)


# of each group one at most; in the order in which they are told
_ORDER = (Mistake("xyzw", "the quaternions are in the order x y z w; the format has w first"),)
_INVERTED = "the poses are inverted: they are"
_OPENGL = "y up, z back), the format has y down and z forward"
_CONTENT = (
    Mistake("inverted", f"{_INVERTED} world_from_cam, the format has cam_from_world"),
    Mistake("centre", "the camera's centre stands where the translation belongs: t is -R C, not C"),
    Mistake(
        "inverted-rotation",
        "the rotations are inverted (world_from_cam), the translations are not",
        1.5,
    ),
)
_AXES = Mistake(
    "axes",
    f"the cameras have the axes of OpenGL and Bundler ({_OPENGL}: multiply R and t from the left "
    "with diag(1, -1, -1)",
)
_FRAME = Mistake(
    "frame",
    "the poses are in the workspace's local frame: the offset of world.json has not been undone "
    "(megloc submit does)",
)
_OTHER_FLOOR = Mistake(
    "floor", "the poses fit another floor's cameras, not those of the floor the queries belong to"
)
_RELATIVE = (
    (Mistake("wxyz", "the quaternions are in the order w x y z; the format has w last"),),
    (
        Mistake(
            "inverted", f"{_INVERTED} reference_from_query, the format has query_from_reference"
        ),
        Mistake(
            "centre", "the query's centre stands where the translation belongs: t is -R C, not C"
        ),
        Mistake(
            "absolute", "the poses are absolute: the format has the query relative to its reference"
        ),
    ),
    (Mistake("axes", f"the cameras have the axes of OpenGL ({_OPENGL}"),),
)


def absolute_hypotheses(*, frames: bool, floors: bool) -> list[Hypothesis]:
    """All hypotheses of a file of absolute poses, the right one first; fewer mistakes before more.

    Parameters
    ----------
    frames, floors : whether the map has a frame of its own, and several floors.
    """
    groups = [_ORDER, _CONTENT, (_AXES,), _axis_turns()]
    groups += [(_FRAME,)] * frames + [(_OTHER_FLOOR,)] * floors
    # several rare mistakes at once explain chance as well as they explain a file
    return [
        own
        for own in _combined(groups)
        if own.cost <= (2.5 if "world-axes" in own else 3)
        and not ("world-axes" in own and "xyzw" in own)
    ]


def relative_hypotheses() -> list[Hypothesis]:
    """All hypotheses of an MLAD file, the right one first; fewer mistakes before more."""
    return [
        own
        for own in _combined(_RELATIVE)
        # on a level road these two undo one another
        if not ("axes" in own and ("inverted" in own or "centre" in own))
    ]


def _combined(groups: Sequence[tuple[Mistake, ...]]) -> list[Hypothesis]:
    every = itertools.product(*((None, *group) for group in groups))
    found = [Hypothesis(tuple(own for own in chosen if own is not None)) for chosen in every]
    return sorted(found, key=lambda own: own.cost)


def restore_absolute(
    hypothesis: Hypothesis,
    quats: NDArray[np.float64],
    translations: NDArray[np.float64],
    world: World,
) -> Arrays:
    """``cam_from_local`` of the rows of a file, as quaternions (N, 4) and centres (N, 3).

    Parameters
    ----------
    quats : float64 (N, 4), unit length, in the order of the file's columns.
    translations : float64 (N, 3), as in the file.
    """
    if "xyzw" in hypothesis:
        quats = np.roll(quats, 1, axis=1)
    if "inverted" in hypothesis or "inverted-rotation" in hypothesis:
        quats = invert_quats(quats)
    by_centre = "inverted" in hypothesis or "centre" in hypothesis
    if "axes" in hypothesis:
        quats = multiply_quats(_OPENGL_QUAT, quats)
        translations = translations if by_centre else translations * _OPENGL_SIGNS
    centers = translations if by_centre else camera_centers(quats, translations)
    for mistake in hypothesis.mistakes:
        if mistake.turn_wxyz is not None:
            quats = multiply_quats(quats, mistake.turn_wxyz)
            centers = rotate(invert_quats(mistake.turn_wxyz), centers)
    if "frame" not in hypothesis:
        similarity = world.official_from_local
        official_from_local = np.array(similarity.quat_wxyz)
        quats = multiply_quats(quats, official_from_local)
        offsets = centers - np.array(similarity.translation)
        centers = rotate(invert_quats(official_from_local), offsets) / similarity.scale
    return quats, centers


def restore_relative(
    hypothesis: Hypothesis,
    quats: NDArray[np.float64],
    translations: NDArray[np.float64],
    references: Arrays,
    world: World,
) -> Arrays:
    """``cam_from_local`` of the queries of an MLAD file, as quaternions and centres.

    Parameters
    ----------
    quats, translations, world : as of :func:`restore_absolute`.
    references : ``cam_from_local`` of each row's reference: quaternions and centres.
    """
    if "wxyz" not in hypothesis:
        quats = np.roll(quats, 1, axis=1)
    if "absolute" in hypothesis:
        return restore_absolute(hypothesis, quats, translations, world)
    if "axes" in hypothesis:
        quats = multiply_quats(multiply_quats(_OPENGL_QUAT, quats), _OPENGL_QUAT)
        translations = translations * _OPENGL_SIGNS
    if "inverted" in hypothesis:
        quats, translations = invert(quats, translations)
    elif "centre" in hypothesis:
        translations = -rotate(quats, translations)
    reference_quats, reference_centers = references
    offsets = -rotate(reference_quats, reference_centers)
    scaled = translations / world.official_from_local.scale
    quats, translations = compose(quats, scaled, reference_quats, offsets)
    return quats, -rotate(invert_quats(quats), translations)


def explain(
    scores: NDArray[np.float64], fits: NDArray[np.bool_], costs: Sequence[float]
) -> list[int]:
    """Hypotheses that explain the poses clearly better than the right reading; empty: none does.

    Parameters
    ----------
    scores : float64 (H, N) of N poses under H hypotheses; the first is the right reading.
    fits : bool (H, N), whether a pose could be one under a hypothesis.
    costs : of each hypothesis; ascending.

    Returns
    -------
    The one that does, then what cannot be told from it and is as simple.
    """
    number = scores.shape[1]
    if number < MIN_POSES:
        return []
    gains = _gains(scores, scores[0])
    mean = gains.mean(axis=1)
    uncertain = gains.std(axis=1, ddof=1) / np.sqrt(number)
    share = (gains > 0.5).mean(axis=1)
    fitting = fits.mean(axis=1)
    good = (mean > _GAIN) & (mean - 2 * uncertain > _CERTAIN_GAIN)
    cost = np.array(costs)
    wanted = np.where(cost > 1, _SHARE_FITTING_RARE, _SHARE_FITTING)
    good &= (share >= _SHARE_BETTER) & (fitting >= wanted) & (fitting >= fitting[0])
    found = np.flatnonzero(good).tolist()
    if not found:
        return []
    # compared with one another, not with the right reading, over which they may all gain the most
    # that counts; what is left out is worse than all of these
    base = max(found, key=lambda h: scores[h].clip(-_FLOOR).mean())
    worth = _gains(scores, scores[base]).mean(axis=1)
    worth -= cost * max(_PER_MISTAKE / number, _PER_MISTAKE_AND_POSE)
    best = max(found, key=lambda h: worth[h])
    as_good = [h for h in found if _is_as_good(scores[h], scores[best])]
    # of what cannot be told apart the simplest, and of equally simple ones the best
    as_good.sort(key=lambda h: (cost[h], -worth[h]))
    return [h for h in as_good if cost[h] == cost[as_good[0]]]


def undecided(scores: NDArray[np.float64]) -> list[int]:
    """Hypotheses that the right one (the first of ``scores``) is not clearly better than."""
    return [h for h in range(1, len(scores)) if _is_as_good(scores[h], scores[0])]


def _is_as_good(scores: NDArray[np.float64], best: NDArray[np.float64]) -> bool:
    more = _gains(best, scores)
    return bool(more.mean() < max(_AS_GOOD, 2 * more.std(ddof=1) / np.sqrt(len(more))))


def _gains(scores: NDArray[np.float64], base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Clipped differences; a pose that is infinitely far under both hypotheses gains nothing."""
    with np.errstate(invalid="ignore"):
        difference = scores - base
    return np.clip(np.nan_to_num(difference, nan=0.0, posinf=_CLIP, neginf=-_CLIP), -_CLIP, _CLIP)
