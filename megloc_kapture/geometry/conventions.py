"""Common mistakes in pose conventions, and detection of the convention of given poses.

The package's poses are ``cam_from_world`` with x right, y down and z forward. Other tools export
camera-to-world (NeRF, SLAM), OpenGL's axes (ARKit, Blender), or camera centres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from megloc_kapture.values import RigidTransform

_COLMAP_FROM_OPENGL = RigidTransform((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
# a convention needs this share of explained data, and this gain over the poses as given
_MIN_SHARE, _MIN_GAIN = 0.4, 0.25
_TIE = 0.05


def _quaternion_last(pose: RigidTransform) -> RigidTransform:
    x, y, z, w = pose.quat_wxyz
    return RigidTransform((w, x, y, z), pose.translation)


def _center_given(pose: RigidTransform) -> RigidTransform:
    x, y, z = (-pose.rotation_matrix() @ pose.translation).tolist()
    return RigidTransform(pose.quat_wxyz, (x, y, z))


CONVENTIONS: Mapping[str, Callable[[RigidTransform], RigidTransform]] = {
    "poses inverted (camera-to-world, world_from_cam)": RigidTransform.inverse,
    "poses read with OpenGL's axes (y up, z back)": lambda pose: _COLMAP_FROM_OPENGL @ pose,
    "poses inverted and with OpenGL's axes (camera-to-world, y up, z back)": (
        lambda pose: _COLMAP_FROM_OPENGL @ pose.inverse()
    ),
    "translations read as camera centres": _center_given,
    "quaternions read as x, y, z, w": _quaternion_last,
}
"""By the name of each convention: the ``cam_from_world`` of a pose that was given in it."""


def better_conventions(shares: Sequence[float]) -> list[str]:
    """Return the names of the conventions that explain far more than the poses as given.

    ``shares`` of explained data are for the poses as given, then for :data:`CONVENTIONS`.
    """
    given, *others = shares
    best = max(others)
    if best < max(_MIN_SHARE, given + _MIN_GAIN):
        return []
    return [name for name, share in zip(CONVENTIONS, others, strict=True) if share >= best - _TIE]
