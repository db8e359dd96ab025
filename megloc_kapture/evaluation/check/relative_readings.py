"""The ways in which the rows of an MLAD file can be meant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.evaluation.check.readings import Reading
from megloc_kapture.geometry.poses import compose, invert, invert_quats, multiply_quats, rotate
from megloc_kapture.io.side_tables import World

# diag(1, -1, -1)
_OPENGL_QUAT = np.array([0.0, 1.0, 0.0, 0.0])

_SAID = {
    "wxyz": "the quaternions are in the order w x y z; the format has w last",
    "inverted": "the poses are inverted: they are reference_from_query, the format has "
    "query_from_reference",
    "centre": "the query's centre stands where the translation belongs: t is -R C, not C",
    "axes": "the cameras have the axes of OpenGL (y up, z back), the format has y down and z "
    "forward",
    "absolute": "the poses are absolute: the format has the query relative to its reference",
}


@dataclass(frozen=True, slots=True)
class RelativeReading:
    """One way to read a file; the defaults are the right way.

    Parameters
    ----------
    wxyz : the quaternion's w stands first.
    content : ``relative``, or ``inverted``, ``centre``, ``absolute``: see the module's texts.
    opengl : both cameras have OpenGL's axes.
    """

    wxyz: bool = False
    content: str = "relative"
    opengl: bool = False

    @property
    def mistakes(self) -> float:
        """How many things are not as they should be."""
        return float(self.wxyz + (self.content != "relative") + self.opengl)

    @property
    def _names(self) -> list[str]:
        content = "" if self.content == "relative" else self.content
        order = "wxyz" if self.wxyz else ""
        return [name for name in (order, content, "axes" if self.opengl else "") if name]

    @property
    def kind(self) -> str:
        """Short names of the mistakes, joined."""
        return "+".join(self._names)

    def __str__(self) -> str:
        return "; ".join(_SAID[name] for name in self._names)

    def cam_from_local(
        self,
        quats: NDArray[np.float64],
        translations: NDArray[np.float64],
        references: tuple[NDArray[np.float64], NDArray[np.float64]],
        world: World,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The queries' poses of rows read this way, as quaternions (N, 4) and centres (N, 3).

        Parameters
        ----------
        quats : float64 (N, 4), unit length, in the order of the file's columns.
        translations : float64 (N, 3), as in the file.
        references : ``cam_from_local`` of each row's reference: quaternions and centres.
        world : of the workspace.
        """
        if not self.wxyz:
            quats = np.roll(quats, 1, axis=1)
        if self.content == "absolute":
            reading = Reading(axes="opengl" if self.opengl else "colmap")
            return reading.cam_from_local(quats, translations, world)
        if self.opengl:
            quats = multiply_quats(multiply_quats(_OPENGL_QUAT, quats), _OPENGL_QUAT)
            translations = translations * np.array([1.0, -1.0, -1.0])
        if self.content == "inverted":
            quats, translations = invert(quats, translations)
        elif self.content == "centre":
            translations = -rotate(quats, translations)
        reference_quats, reference_centers = references
        offsets = -rotate(reference_quats, reference_centers)
        scaled = translations / world.official_from_local.scale
        quats, translations = compose(quats, scaled, reference_quats, offsets)
        return quats, -rotate(invert_quats(quats), translations)


def relative_readings() -> Iterator[RelativeReading]:
    """All readings to try, the right one first; fewer mistakes before more."""
    every = [
        RelativeReading(wxyz, content, opengl)
        for wxyz in (False, True)
        for content in ("relative", "inverted", "centre", "absolute")
        for opengl in (False, True)
        # on a level road these two undo one another
        if not (opengl and content in ("inverted", "centre"))
    ]
    yield from sorted(every, key=lambda reading: reading.mistakes)


def path_scores(
    centers: NDArray[np.float64], times: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How well each query (N,) lies between its neighbours in time: 0 is best.

    The queries of a file come from one drive, and a wrong reading throws each of them to another
    side of its reference: the path gets ragged, which the distance to the map cannot show.

    Parameters
    ----------
    centers : float64 (N, 3).
    times : float64 (N,), of the queries, from any origin; queries of one time have no part in it.
    scale : float64 (N,), the distance that counts.
    """
    order = np.argsort(times, kind="stable")
    times, places = times[order], centers[order]
    scores = np.zeros(len(order))
    if len(order) < 3:
        return scores
    before, span = times[1:-1] - times[:-2], times[2:] - times[:-2]
    usable = (before > 0) & (span > before)
    share = np.where(usable, before, 0.0) / np.where(usable, span, 1.0)
    between = places[:-2] + share[:, None] * (places[2:] - places[:-2])
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.linalg.norm(places[1:-1] - between, axis=1)
        scores[1:-1] = np.where(usable, -np.log1p(off / scale[order][1:-1]), 0.0)
    unordered = np.empty_like(scores)
    unordered[order] = scores
    return unordered
