"""Localized queries as a kapture folder: fallbacks are marked, failures have no pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import kapture.io.csv
import numpy as np
import pandas
import pytest

from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import (
    CLUSTERS_FILE,
    COVARIANCE_FILE,
    POSES_FILE,
    STATUS_FILE,
    read_covariances,
    read_status,
)
from megloc_kapture.stages.query_poses import write_localized
from megloc_kapture.values import Failure, Pose


def test_localized_queries_are_written_as_kapture_and_tables(world: Any, tmp_path: Path) -> None:
    results = world.localized()
    write_localized(tmp_path, world.query(), results, timing=tmp_path / "timing.csv")
    folder = KaptureFolder(tmp_path)
    folder.validate(deep=True)
    assert folder.read().poses() == {found.name: found.cam_from_world for found in results}
    poses = pandas.read_csv(tmp_path / POSES_FILE, index_col="image")
    for result in results:
        pose, row = result.cam_from_world, poses.loc[result.name]
        np.testing.assert_allclose(row[["qw", "qx", "qy", "qz"]].astype(float), pose.quat_wxyz)
        np.testing.assert_allclose(row[["tx", "ty", "tz"]].astype(float), pose.translation)
        centre = row[["center_x", "center_y", "center_z"]].astype(float)
        np.testing.assert_allclose(centre, pose.center(), atol=1e-9)
    theirs = kapture.io.csv.kapture_from_dir(str(tmp_path))
    assert len(theirs.trajectories) == 2 and len(list(theirs.records_camera.key_pairs())) == 2
    status = read_status(tmp_path / STATUS_FILE)
    clusters = pandas.read_csv(tmp_path / CLUSTERS_FILE, index_col="image")
    for result in results:
        row = status[result.name]
        assert (row.status, row.reason, row.fallback) == ("localized", "", "none")
        assert (row.num_inliers, row.candidates) == (result.num_inliers, result.candidates)
        ((_, chosen),) = clusters.loc[[result.name]].query("chosen == 'yes'").iterrows()
        assert chosen.cluster == row.cluster and chosen.images == ",".join(result.candidates)
        assert chosen.score > 100
    covariances = read_covariances(tmp_path / COVARIANCE_FILE)
    for result in results:
        np.testing.assert_array_equal(covariances[result.name], result.covariance)
    lines = (tmp_path / "timing.csv").read_text().splitlines()
    assert lines[0] == "image,step,seconds"
    assert {line.split(",")[1] for line in lines[1:]} >= {"reading", "estimation", "refinement"}


def half_failed(world: Any) -> list[Pose | Failure]:
    first, second = world.localized()
    return [Failure("no map image matches", name=first.name), second]


@pytest.mark.parametrize(
    ("fallback", "retrieved", "has_fallback"),
    [("none", True, False), ("retrieval", False, False), ("retrieval", True, True)],
)
def test_a_failed_query_has_no_pose_without_a_fallback(
    world: Any, tmp_path: Path, fallback: Any, retrieved: bool, has_fallback: bool
) -> None:
    fallback_pose = world.map_poses["left/1.png"]
    counts = write_localized(
        tmp_path, world.query(), half_failed(world), fallback=fallback,
        first_candidates={q: ("left/1.png", fallback_pose) for q in world.query_poses if retrieved},
    )  # fmt: skip
    assert counts == {"queries": 2, "localized": 1, "failed": 1, "fallbacks": int(has_fallback)}
    written = KaptureFolder(tmp_path).read()
    assert written.image_names() == sorted(world.query_poses)
    assert written.poses().get("query/a.png") == (fallback_pose if has_fallback else None)
    assert written.poses()["query/b.png"] != fallback_pose
    status = read_status(tmp_path / STATUS_FILE)
    a, b = status["query/a.png"], status["query/b.png"]
    assert (a.status, a.reason, a.num_inliers) == ("failed", "no map image matches", 0)
    assert a.fallback == ("retrieval" if has_fallback else "none")
    assert (b.status, b.fallback) == ("localized", "none")
