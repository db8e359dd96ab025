"""Where the cameras sit on RobotCar's car, from the poses of the reference model.

The published extrinsics do not agree well with the model, in which queries are localized. Its poses
of three cameras at one moment say where they are, thousands of times over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from megloc_kapture.datasets.grammars.robotcar_files import ImageKey
from megloc_kapture.datasets.robotcar_layout import CAMERAS
from megloc_kapture.geometry.poses import rotation_angles_deg, stack_poses
from megloc_kapture.values import RigidTransform

_ROOT = "rear"  # the rig's frame
_MIN_MOMENTS = 10
# poses of single images are wrong at times: farther than so many medians off has no say
_OUTLIER = 3.0
_ROUNDS = 3


def rig_of_model(poses: Mapping[ImageKey, RigidTransform]) -> dict[str, RigidTransform]:
    """``sensor_from_rig`` of every camera, the rear camera's frame being the rig's.

    Parameters
    ----------
    poses : ``cam_from_world`` of the model's images.

    Returns
    -------
    Empty where a camera shares too few moments with the rear one to tell.
    """
    rear = {key.timestamp: pose for key, pose in poses.items() if key.camera == _ROOT}
    members = {_ROOT: RigidTransform.identity()}
    for camera in CAMERAS:
        if camera == _ROOT:
            continue
        relative = [
            pose @ rear[key.timestamp].inverse()
            for key, pose in sorted(poses.items(), key=lambda item: item[0].timestamp)
            if key.camera == camera and key.timestamp in rear
        ]
        if len(relative) < _MIN_MOMENTS:
            return {}
        members[camera] = middle_transform(relative)
    return members


def middle_transform(transforms: Sequence[RigidTransform]) -> RigidTransform:
    """The middle of transforms that should be one: mean rotation, median translation.

    The mean quaternion is Markley's (Averaging Quaternions, J. Guidance 2007), of the transforms
    whose rotation is not far off.
    """
    quats, translations = stack_poses(transforms)
    kept = np.ones(len(quats), bool)
    mean = quats[0]
    for _ in range(_ROUNDS):
        _, vectors = np.linalg.eigh(quats[kept].T @ quats[kept])
        mean = vectors[:, -1]
        off = rotation_angles_deg(quats, np.broadcast_to(mean, quats.shape))
        kept = off <= max(_OUTLIER * float(np.median(off)), 1e-9)
    w, x, y, z = (mean if mean[0] >= 0 else -mean).tolist()
    tx, ty, tz = np.median(translations[kept], axis=0).tolist()
    return RigidTransform((w, x, y, z), (tx, ty, tz))
