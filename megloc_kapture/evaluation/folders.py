"""Evaluate what lies on disk: a localized kapture or a pose file, against a kapture of truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from megloc_kapture.evaluation.evaluate import Evaluation, evaluate
from megloc_kapture.evaluation.pose_file import poses_by_image, read_pose_file
from megloc_kapture.evaluation.thresholds import Threshold, thresholds_from_pairs
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.io.side_tables import (
    ImageGroup,
    Protocol,
    World,
    read_groups,
    read_protocol,
    read_world,
)
from megloc_kapture.io.status_table import STATUS_FILE, QueryStatus, read_status
from megloc_kapture.values import RigidTransform


def evaluate_folders(
    result: Path | str,
    truth: Path | str,
    *,
    side_tables: Path | str | None = None,
    thresholds: Sequence[Threshold] | None = None,
    label: str = "",
) -> Evaluation:
    """Evaluate ``result`` against the kapture folder ``truth``.

    Parameters
    ----------
    result : a kapture folder with trajectories (and perhaps ``status.csv``), or a pose file.
    side_tables : the workspace's ``megloc/`` folder: conditions, which images are scored, the
        protocol, and the world a pose file has to be brought back from.
    thresholds : instead of the protocol's.

    Raises
    ------
    DataError : something is missing or broken, or there is nothing to count.
    """
    tables = None if side_tables is None else Path(side_tables)
    true_poses = KaptureFolder(Path(truth)).read().poses()
    world = World() if tables is None else read_world(tables)
    estimated = load_poses(result, images=true_poses, world=world)
    groups = {} if tables is None else read_groups(tables)
    protocol = Protocol() if tables is None else read_protocol(tables)
    default = ImageGroup()
    return evaluate(
        estimated,
        true_poses,
        conditions={image: group.condition for image, group in groups.items()},
        thresholds=thresholds or thresholds_from_pairs(protocol.thresholds),
        scored={i for i in {*true_poses, *estimated} if groups.get(i, default).scored},
        statuses=load_statuses(result),
        condition_order=protocol.conditions,
        pools=protocol.pools,
        label=label,
    )


def load_poses(
    source: Path | str, *, images: Iterable[str] = (), world: World | None = None
) -> dict[str, RigidTransform]:
    """``cam_from_world`` by image, of a kapture folder or a pose file.

    Parameters
    ----------
    images : the images that the short names of a pose file may stand for.
    world : of the workspace; a pose file stands in the official frame and is brought to the local
        one. A kapture folder is in the local frame already.
    """
    path = Path(source)
    if path.is_dir():
        return KaptureFolder(path).read().poses()
    poses = poses_by_image(read_pose_file(path), images)
    if world is None or world == World():
        return poses
    return {image: world.pose_in_local(pose) for image, pose in poses.items()}


def load_statuses(result: Path | str) -> dict[str, QueryStatus] | None:
    """The rows of ``status.csv`` in a result folder; None where there is none."""
    path = Path(result) / STATUS_FILE
    return read_status(path) if path.is_file() else None
