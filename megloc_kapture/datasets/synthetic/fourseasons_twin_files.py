"""The text files of a 4Seasons recording, written for a drive whose poses are known.

The files say what the adapter has to undo: each recording has a SLAM world of its own unit,
orientation and origin, a level world over it, a scene on the earth, and an odometry with yet
another world. Transforms have six decimals as published; poses have twelve, so that they can be
compared with the truth.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.sparse_points import SparsePoints
from megloc_kapture.datasets.fourseasons.poses import earth_from_enu, geodetic
from megloc_kapture.datasets.synthetic.fourseasons_drive import CAM1_FROM_CAM0, Frame
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.portable import settled, settled_pose
from megloc_kapture.values import Camera, RigidTransform


def _settled_earth_from_enu(
    latitude_deg: float, longitude_deg: float, height_m: float
) -> RigidTransform:
    exact = earth_from_enu(latitude_deg, longitude_deg, height_m)
    # to the micrometre: at the earth's surface a float64 holds no nanometres
    return settled_pose(exact.rotation_matrix(), np.round(exact.translation, 6))


# the world's origin: near Munich, its axes east, north and up
EARTH_FROM_WORLD = _settled_earth_from_enu(48.1861, 11.6197, 540.0)

# between the published calibrations of the distorted and the undistorted left camera
_RECTIFICATION_DEG = 2.2
_TAGS = "translation vector, rotation quaternion"
# pixels of the patch whose grey values stand with a point
_PATTERN = ((0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2))


@dataclass(frozen=True)
class SlamFrames:
    """How a recording's frames lie to one another; all as its files have them.

    Parameters
    ----------
    s_from_as, w_from_gpsw, e_from_gpsw : as in ``Transformations.txt``.
    scale : metres per unit of the SLAM world.
    odometry_from_as : the world of the keyframe files and ``result.txt``.
    blank_lines : whether ``Transformations.txt`` has them between its blocks.
    """

    s_from_as: RigidTransform
    w_from_gpsw: RigidTransform
    e_from_gpsw: RigidTransform
    scale: float
    odometry_from_as: RigidTransform
    blank_lines: bool

    @classmethod
    def drawn(cls, seed: int, recording: str, *, blank_lines: bool) -> SlamFrames:
        """The frames of a recording, at random."""
        rng = stream(seed, "frames", recording)
        # each scene has its own origin, some hundred metres away
        east, north, up = rng.uniform(-300, 300, 2).tolist() + [float(rng.uniform(-5, 5))]
        origin = RigidTransform((1.0, 0.0, 0.0, 0.0), (east, north, up))
        place = geodetic(np.array((EARTH_FROM_WORLD @ origin).translation))
        return cls(
            s_from_as=_as_written(_random_transform(rng, 0.03, 3.2e-2, 0.0)),
            w_from_gpsw=_as_written(_random_transform(rng, np.pi, 2e-2, 0.4)),
            e_from_gpsw=_as_written(_settled_earth_from_enu(*place)),
            scale=round(float(rng.uniform(0.96, 0.97)), 6),
            odometry_from_as=_random_transform(rng, np.pi, 0.1, 0.3),
            blank_lines=blank_lines,
        )

    def slam_from_cam(self, cam_from_world: RigidTransform) -> RigidTransform:
        """A pose as ``GNSSPoses.txt`` has it, its translation in units of the SLAM world."""
        s_from_world = self.w_from_gpsw @ self.e_from_gpsw.inverse() @ EARTH_FROM_WORLD
        metric = self.s_from_as.inverse() @ s_from_world @ cam_from_world.inverse()
        x, y, z = (value / self.scale for value in metric.translation)
        return RigidTransform(metric.quat_wxyz, (x, y, z))


def transformations_text(frames: SlamFrames) -> str:
    """``Transformations.txt``."""
    cam_from_imu = RigidTransform(
        (-0.002350, -0.007202, 0.708623, -0.705546), (0.175412, 0.003689, -0.058106)
    )
    blocks = [
        f"# {name}: {_TAGS}\n{_pose_fields(transform, ',', 6)}\n"
        for name, transform in (
            ("transform_S_AS", frames.s_from_as),
            ("TS_cam_imu", cam_from_imu),
            ("transform_w_gpsw", frames.w_from_gpsw),
            ("transform_gps_imu", RigidTransform.identity()),
            ("transform_e_gpsw", frames.e_from_gpsw),
        )
    ]
    blocks.append(f"# GNSS scale\n{frames.scale:.6f}\n")
    return ("\n" if frames.blank_lines else "").join(blocks)


def gnss_poses_text(frames: SlamFrames, keyframes: Iterable[Frame]) -> str:
    """``GNSSPoses.txt``; its header announces a column more than its rows have."""
    lines = [
        "# timestamp_ns, tran_x, tran_y, tran_z, quat_x, quat_y, quat_z, quat_w, scale, "
        "fusion_quality, v3"
    ]
    for frame in keyframes:
        pose = _pose_fields(frames.slam_from_cam(frame.cam0_from_world), ",", 12)
        lines.append(f"{frame.timestamp},{pose},{frames.scale:.6f},2")
    return "\n".join(lines) + "\n"


def times_text(frames: Iterable[Frame], exposure_ms: float) -> str:
    """``times.txt``, all frames, most without images."""
    return "".join(f"{f.timestamp} {f.timestamp / 1e9:.10f} {exposure_ms:.10f}\n" for f in frames)


def result_text(frames: SlamFrames, all_frames: Iterable[Frame]) -> str:
    """``result.txt``: the odometry's poses of all frames, level, of the unrectified camera."""
    half = np.radians(_RECTIFICATION_DEG) / 2
    w, y = settled((np.cos(half), np.sin(half))).tolist()
    rectification = RigidTransform((w, 0.0, y, 0.0), (0.0, 0.0, 0.0))
    lines = []
    for frame in all_frames:
        pose = frames.s_from_as @ _odometry_pose(frames, frame) @ rectification
        lines.append(f"{frame.timestamp / 1e9:.5f}   {_pose_fields(pose, ' ', 15)}\n")
    return "".join(lines)


def keyframe_text(
    frames: SlamFrames,
    frame: Frame,
    camera: Camera,
    points: NDArray[np.float64],
    image: NDArray[np.uint8],
    exposure_ms: float,
) -> str:
    """``KeyFrame_<timestamp>.txt``.

    Parameters
    ----------
    points : float64 (P, 3): u and v in pixels, depth in metres.
    image : grey, uint8 (H, W).
    """
    fx, fy, cx, cy = camera.params
    lines = [
        "# timestamp",
        f"{frame.timestamp}",
        "",
        "# fx, fy, cx, cy, width, height, npoints",
        f"{fx:.12f},{fy:.12f},{cx:.12f},{cy:.12f},{camera.width},{camera.height},{len(points)}",
        "",
        f"# camToWorld: {_TAGS}",
        _pose_fields(_odometry_pose(frames, frame), ",", 12),
        "",
        "# Exposure time (ms)",
        f"{exposure_ms:.6f}",
        "",
        "# Point Cloud Data : ",
        "# u,v,idepth_scaled,idepth_hessian,maxRelBaseline,numGoodRes,status ",
        "# color information ",
    ]
    for u, v, depth_m in points.tolist():
        inverse_depth = frames.scale / depth_m
        lines.append(f"{u:.9f},{v:.9f},{inverse_depth:.12f},900000000.000000,0.050000,0,1")
        lines.append("".join(f"{grey}," for grey in _patch(image, u, v)))
    return "\n".join(lines) + "\n\n"


def cloud_of(
    tracks: SparsePoints, image: int, cam_from_world: RigidTransform
) -> NDArray[np.float64]:
    """What one image sees of the tracks: u and v in pixels, depth in metres, float64 (P, 3)."""
    seen = tracks.image_ids == image
    depth = cam_from_world.apply(tracks.xyz[tracks.point_ids[seen]])[:, 2]
    return np.column_stack([tracks.xy_px[seen].astype(np.float64), depth])


def nmea_text(keyframes: Sequence[Frame]) -> str:
    """``septentrio.nmea``: a fix for each keyframe behind the rest of a line."""
    lines = [",D*1C"]
    for frame in keyframes:
        moment = datetime.fromtimestamp(frame.timestamp // 10**9, UTC)
        hundredths = frame.timestamp // 10**7 % 100
        position = (EARTH_FROM_WORLD @ frame.cam0_from_world.inverse()).translation
        latitude, longitude, height = geodetic(np.array(position))
        time = f"{moment:%H%M%S}.{hundredths:02d}"
        place = f"{_degrees_minutes(latitude, 2)},N,{_degrees_minutes(longitude, 3)},E"
        for content in (
            f"GPRMC,{time},A,{place},7.0,251.7,{moment:%d%m%y},3.5,W,D",
            f"GPGGA,{time},{place},4,09,1.1,{height:.4f},M,0.0000,M,0.6,3119",
        ):
            checksum = 0
            for byte in content.encode():
                checksum ^= byte
            lines.append(f"${content}*{checksum:02X}")
    return "\n".join(lines) + "\n"


def calibration_texts(camera: Camera) -> dict[str, str]:
    """The files of ``calibration/`` that undistorted images need, by name."""
    fx, fy, cx, cy = camera.params
    size = f"{camera.width} {camera.height}"
    pinhole = f"Pinhole {fx!r} {fy!r} {cx!r} {cy!r} 0.0 0.0 0.0 0.0\n{size}\ncrop\n{size}\n"
    matrix = np.eye(4)
    matrix[:3, :3] = CAM1_FROM_CAM0.rotation_matrix()
    matrix[:3, 3] = CAM1_FROM_CAM0.translation
    rows = (" ".join(map(repr, row)) for row in matrix.tolist())
    return {
        "undistorted_calib_0.txt": pinhole,
        "undistorted_calib_1.txt": pinhole,
        "undistorted_calib_stereo.txt": "\n".join(rows) + "\n",
    }


def relocalization_text(reference: Sequence[Frame], queries: Sequence[Frame]) -> str:
    """Pairs of the challenge: each query behind the keyframe of the map that is nearest to it."""
    centers = np.array([frame.cam0_from_world.center() for frame in reference])
    lines = []
    for frame in queries:
        distances = np.linalg.norm(centers - frame.cam0_from_world.center(), axis=1)
        lines.append(f"{reference[int(distances.argmin())].timestamp} {frame.timestamp}\n")
    return "".join(lines)


def start_of(recording: str) -> int:
    """The time in a recording's name, nanoseconds."""
    moment = datetime.strptime(recording, "recording_%Y-%m-%d_%H-%M-%S").replace(tzinfo=UTC)
    return int(moment.timestamp()) * 10**9


def _odometry_pose(frames: SlamFrames, frame: Frame) -> RigidTransform:
    return frames.odometry_from_as @ frames.slam_from_cam(frame.cam0_from_world)


def _patch(image: NDArray[np.uint8], u: float, v: float) -> list[int]:
    height, width = image.shape
    column, row = int(u), int(v)
    return [
        int(image[min(max(row + dy, 0), height - 1), min(max(column + dx, 0), width - 1)])
        for dx, dy in _PATTERN
    ]


def _random_transform(
    rng: np.random.Generator, yaw: float, tilt: float, reach_m: float
) -> RigidTransform:
    """A turn about z by up to ``yaw`` and about x and y by up to ``tilt`` radians, and a shift."""
    ax, ay, az = (float(a) / 2 for a in rng.uniform(-1, 1, 3) * (tilt, tilt, yaw))
    cos_x, cos_y, cos_z = settled(np.cos((ax, ay, az))).tolist()
    sin_x, sin_y, sin_z = settled(np.sin((ax, ay, az))).tolist()
    turns = (
        RigidTransform((cos_z, 0.0, 0.0, sin_z), (0.0, 0.0, 0.0)),
        RigidTransform((cos_y, 0.0, sin_y, 0.0), (0.0, 0.0, 0.0)),
        RigidTransform((cos_x, sin_x, 0.0, 0.0), (0.0, 0.0, 0.0)),
    )
    x, y, z = (float(v) for v in rng.uniform(-1, 1, 3) * reach_m)
    shift = RigidTransform((1.0, 0.0, 0.0, 0.0), (x, y, z))
    return shift @ turns[0] @ turns[1] @ turns[2]


def _as_written(transform: RigidTransform) -> RigidTransform:
    """The transform that six decimals stand for."""
    quat = np.round(transform.quat_wxyz, 6)
    w, x, y, z = (quat / np.sqrt((quat * quat).sum())).tolist()
    tx, ty, tz = np.round(transform.translation, 6).tolist()
    return RigidTransform((w, x, y, z), (tx, ty, tz))


def _pose_fields(pose: RigidTransform, separator: str, decimals: int) -> str:
    """Translation, then rotation x y z w."""
    w, x, y, z = pose.quat_wxyz
    return separator.join(f"{value:.{decimals}f}" for value in (*pose.translation, x, y, z, w))


def _degrees_minutes(angle_deg: float, digits: int) -> str:
    degrees = int(angle_deg)
    return f"{degrees:0{digits}d}{(angle_deg - degrees) * 60:010.7f}"
