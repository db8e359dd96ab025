"""The ways in which the numbers of a pose file can be meant: the right one and the classic wrong.

A reading says what somebody took a pose to be when he wrote the file. Reading the file the same
way gives the right poses back.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.poses import (
    camera_centers,
    invert_quats,
    multiply_quats,
    rotate,
)
from megloc_kapture.io.side_tables import World
from megloc_kapture.values import RigidTransform

Order = Literal["wxyz", "xyzw"]
Content = Literal["cam_from_world", "world_from_cam", "centre", "rotation_inverse"]
Axes = Literal["colmap", "opengl"]
Frame = Literal["official", "local"]
Floor = Literal["own", "other"]

# diag(1, -1, -1): half a turn about x, from y down and z forward to y up and z back
_OPENGL_QUAT = np.array([0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class Reading:
    """One way to read a file; the defaults are the right way.

    Parameters
    ----------
    order : of the quaternion's columns.
    content : what rotation and translation are. ``world_from_cam``: the inverse pose; ``centre``:
        the translation is the camera's centre; ``rotation_inverse``: only the rotation is inverse.
    axes : of the camera.
    turn : index in :data:`AXIS_TURNS`, how the world's axes are turned.
    frame : ``local``: the workspace's frame, from which the official one was not restored.
    floor : ``other``: the pose stands in the frame of another part of the map.
    """

    order: Order = "wxyz"
    content: Content = "cam_from_world"
    axes: Axes = "colmap"
    turn: int = 0
    frame: Frame = "official"
    floor: Floor = "own"

    @property
    def mistakes(self) -> float:
        """How many things are not as they should be; rare ones count more."""
        right = Reading()
        number = sum(getattr(self, name) != getattr(right, name) for name in self.__slots__)
        rare = (self.content == "rotation_inverse") + (self.turn != 0)
        return number + 0.5 * rare

    def cam_from_local(
        self, quats: NDArray[np.float64], translations: NDArray[np.float64], world: World
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The poses of rows read this way, as quaternions (N, 4) and centres (N, 3).

        Parameters
        ----------
        quats : float64 (N, 4), unit length, in the order of the file's columns.
        translations : float64 (N, 3), as in the file.
        world : of the workspace.
        """
        if self.order == "xyzw":
            quats = np.roll(quats, 1, axis=1)
        if self.content in ("world_from_cam", "rotation_inverse"):
            quats = invert_quats(quats)
        by_centre = self.content in ("world_from_cam", "centre")
        if not by_centre and self.axes == "opengl":
            # what follows turns the rotation; the translation of a camera that has other axes
            translations = translations * np.array([1.0, -1.0, -1.0])
        if self.axes == "opengl":
            quats = multiply_quats(_OPENGL_QUAT, quats)
        centers = translations if by_centre else camera_centers(quats, translations)
        if self.turn:
            turn = AXIS_TURNS[self.turn].quat_wxyz
            quats = multiply_quats(quats, turn)
            centers = rotate(invert_quats(turn), centers)
        if self.frame == "official":
            similarity = world.official_from_local
            quats = multiply_quats(quats, np.array(similarity.quat_wxyz))
            local_from_official = invert_quats(np.array(similarity.quat_wxyz))
            offsets = centers - np.array(similarity.translation)
            centers = rotate(local_from_official, offsets) / similarity.scale
        return quats, centers

    def __str__(self) -> str:
        said = [
            _ORDER_SAID.get(self.order),
            _CONTENT_SAID.get(self.content),
            _AXES_SAID.get(self.axes),
            AXIS_TURNS[self.turn].said if self.turn else None,
            _FRAME_SAID.get(self.frame),
            _FLOOR_SAID.get(self.floor),
        ]
        return "; ".join(text for text in said if text)

    @property
    def kind(self) -> str:
        """Short names of the mistakes, joined."""
        content = {
            "world_from_cam": "inverted",
            "centre": "centre",
            "rotation_inverse": "inverted-rotation",
        }
        found = [
            "xyzw" if self.order == "xyzw" else "",
            content.get(self.content, ""),
            "axes" if self.axes == "opengl" else "",
            "world-axes" if self.turn else "",
            "frame" if self.frame == "local" else "",
            "floor" if self.floor == "other" else "",
        ]
        return "+".join(filter(None, found))


@dataclass(frozen=True, eq=False)
class AxisTurn:
    """A turn of the world that takes axes to axes: ``file_from_map``.

    Parameters
    ----------
    quat_wxyz : float64 (4,).
    said : the mistake in words.
    """

    quat_wxyz: NDArray[np.float64]
    said: str


def _axis_turns() -> list[AxisTurn]:
    """The 24 turns; the identity is the first."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) < 0:
                continue
            names = ", ".join(
                f"{'-' if sign < 0 else ''}{'xyz'[axis]}"
                for axis, sign in zip(order, signs, strict=True)
            )
            pose = RigidTransform.from_matrix(matrix, np.zeros(3))
            said = f"the world has other axes than the map: its x, y, z are the map's {names}"
            turns.append(AxisTurn(np.array(pose.quat_wxyz), said))
    return turns


AXIS_TURNS = _axis_turns()

_ORDER_SAID = {
    "xyzw": "the quaternions are in the order x y z w; the format has w first",
}
_CONTENT_SAID = {
    "world_from_cam": "the poses are inverted: they are world_from_cam, the format has "
    "cam_from_world",
    "centre": "the camera's centre stands where the translation belongs: t is -R C, not C",
    "rotation_inverse": "the rotations are inverted (world_from_cam), the translations are not",
}
_AXES_SAID = {
    "opengl": "the cameras have the axes of OpenGL and Bundler (y up, z back), the format has y "
    "down and z forward: multiply R and t from the left with diag(1, -1, -1)",
}
_FRAME_SAID = {
    "local": "the poses are in the workspace's local frame: the offset of world.json has not been "
    "undone (megloc submit does)",
}
_FLOOR_SAID = {
    "other": "the poses fit another floor's cameras, not those of the floor the queries belong to",
}


def readings(*, frames: bool, floors: bool) -> Iterator[Reading]:
    """All readings to try, the right one first; fewer mistakes before more.

    Parameters
    ----------
    frames, floors : whether the map has a frame of its own, and several floors.
    """
    orders: tuple[Order, ...] = ("wxyz", "xyzw")
    contents: tuple[Content, ...] = (
        "cam_from_world",
        "world_from_cam",
        "centre",
        "rotation_inverse",
    )
    every = [
        Reading(order, content, axes, turn, frame, floor)
        for order in orders
        for content in contents
        for axes in ("colmap", "opengl")
        for turn in (range(len(AXIS_TURNS)) if order == "wxyz" else (0,))
        for frame in (("official", "local") if frames else ("official",))
        for floor in (("own", "other") if floors else ("own",))
    ]
    # several rare mistakes at once explain chance as well as they explain a file
    yield from sorted(
        (reading for reading in every if reading.mistakes <= (2.5 if reading.turn else 3)),
        key=lambda reading: reading.mistakes,
    )
