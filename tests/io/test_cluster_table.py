"""clusters.csv: what is written is read, and what is broken is named by its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.cluster_table import CLUSTERS_COLUMNS, read_clusters, write_clusters
from megloc_kapture.values import ClusterPose, RigidTransform

POSE = RigidTransform((0.5, -0.5, 0.1, 0.7), (1 / 3, -2e-9, 1e7))
FOUND = ClusterPose(("m/1.png", "m/2.png"), 40, 30, POSE, 30.25)
LOST = ClusterPose(("m/3.png",), 7, reason="7 2D-3D matches, at least 12 are needed")


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "clusters.csv"
    write_clusters(path, [("b", (LOST,), None), ("a", (LOST, FOUND), 1), ("c", (), None)])
    found = read_clusters(path)
    assert list(found) == ["a", "b"]
    lost, chosen = found["a"]
    assert (lost.chosen, lost.score, lost.reason) == ("no", None, LOST.reason)
    assert (chosen.chosen, chosen.cluster, chosen.score) == ("yes", 1, 30.25)
    assert (chosen.num_matches, chosen.num_inliers, chosen.images) == (40, 30, FOUND.images)
    assert found["b"][0].chosen == "no"
    assert chosen.cam_from_world == FOUND.cam_from_world and lost.cam_from_world is None


def test_a_broken_row_is_named_by_its_line(tmp_path: Path) -> None:
    path = tmp_path / "clusters.csv"
    path.write_text(",".join(CLUSTERS_COLUMNS) + "\na,0,yes,many,3,1.5,,m/1.png,\n")
    with pytest.raises(DataError, match="num_matches") as caught:
        read_clusters(path)
    assert caught.value.line == 2


def test_a_broken_pose_is_named_by_its_line(tmp_path: Path) -> None:
    path = tmp_path / "clusters.csv"
    path.write_text(",".join(CLUSTERS_COLUMNS) + "\na,0,yes,4,3,1.5,,m/1.png,1 0 0 0 1 2\n")
    with pytest.raises(DataError, match=r"clusters\.csv:2: cam_from_world '1 0 0 0 1 2' is not qw"):
        read_clusters(path)
