"""The localized queries as kapture: fallbacks are marked, failures have no pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import kapture.io.csv
import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
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


def test_localized_queries_are_a_kapture(world: Any, tmp_path: Path) -> None:
    results = world.localized()
    write_localized(tmp_path, world.query(), results, timing=tmp_path / "timing.csv")
    folder = KaptureFolder(tmp_path)
    folder.validate(deep=True)  # the images are there too
    assert folder.read().poses() == {found.name: found.cam_from_world for found in results}
    table = pandas.read_csv(tmp_path / POSES_FILE, index_col="image")
    for found in results:
        image = found.name
        rotation = Rotation.from_quat(
            table.loc[image, ["qx", "qy", "qz", "qw"]].to_numpy(copy=True)
        )
        expected = found.cam_from_world.rotation_matrix()
        np.testing.assert_allclose(rotation.as_matrix(), expected, atol=1e-12)
        moved = rotation.apply(
            table.loc[image, ["center_x", "center_y", "center_z"]].to_numpy(copy=True)
        )
        np.testing.assert_allclose(-moved, table.loc[image, ["tx", "ty", "tz"]], atol=1e-9)
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
    assert {image: c.tolist() for image, c in covariances.items()} == {
        found.name: found.covariance.tolist() for found in results
    }
    lines = (tmp_path / "timing.csv").read_text().splitlines()
    assert lines[0] == "image,step,seconds"
    assert {line.split(",")[1] for line in lines[1:]} >= {"reading", "estimation", "refinement"}


def test_a_broken_covariance_is_refused(world: Any, tmp_path: Path) -> None:
    write_localized(tmp_path, world.query(), half_failed(world))
    path = tmp_path / COVARIANCE_FILE
    header, row = path.read_text().splitlines()
    assert header.startswith("image,rx_rx,rx_ry,rx_rz,rx_tx") and row.startswith("query/b.png,")
    image, _, rest = row.split(",", 2)
    path.write_text(f"{header}\n{image},x,{rest}\n")
    with pytest.raises(DataError, match="covariance.csv: not a table of covariances"):
        read_covariances(path)


def half_failed(world: Any) -> list[Pose | Failure]:
    first, second = world.localized()
    return [Failure("no map image matches", name=first.name), second]


@pytest.mark.parametrize(
    ("fallback", "retrieved", "guessed"),
    [("none", True, False), ("retrieval", False, False), ("retrieval", True, True)],
)
def test_a_failed_query_has_no_pose_but_a_guess_that_was_asked_for(
    world: Any, tmp_path: Path, fallback: Any, retrieved: bool, guessed: bool
) -> None:
    guess = world.map_poses["left/1.png"]
    counts = write_localized(
        tmp_path, world.query(), half_failed(world), fallback=fallback,
        first_candidates={q: ("left/1.png", guess) for q in world.query_poses if retrieved},
    )  # fmt: skip
    assert counts == {"queries": 2, "localized": 1, "failed": 1, "fallbacks": int(guessed)}
    written = KaptureFolder(tmp_path).read()
    assert written.image_names() == sorted(world.query_poses)
    assert written.poses().get("query/a.png") == (guess if guessed else None)
    assert written.poses()["query/b.png"] != guess  # a localized query needs no guess
    status = read_status(tmp_path / STATUS_FILE)
    a, b = status["query/a.png"], status["query/b.png"]
    assert (a.status, a.reason, a.num_inliers) == ("failed", "no map image matches", 0)
    assert a.fallback == ("retrieval" if guessed else "none")
    assert (b.status, b.fallback) == ("localized", "none")
