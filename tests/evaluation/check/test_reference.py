"""What is read of an import to compare a pose file with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.check.reference import read_reference
from megloc_kapture.io.challenge_tables import write_names
from megloc_kapture.io.kapture_store import KaptureFolder, write_sensors
from megloc_kapture.io.side_tables import ImageGroup, Protocol, write_groups, write_protocol


@pytest.fixture
def imported(shared_data: Path, tmp_path: Path) -> Path:
    for part in ("mapping", "query"):
        data = KaptureFolder(shared_data / "scenes" / "fountain_p11" / part).read()
        data.records_camera = {k: f"{part}/{name}" for k, name in data.records_camera.items()}
        write_sensors(tmp_path / part, data)
    return tmp_path


def test_plain_folders(imported: Path) -> None:
    found = read_reference(imported)
    queries = KaptureFolder(imported / "query").read().image_names()
    assert list(found.expected) == list(found.expected.values()) == queries
    assert not found.listed and found.queries == set(queries)
    assert found.cameras is not None and len(found.cameras.images) == 7
    poses = KaptureFolder(imported / "mapping").read().poses()
    assert found.cameras.images == tuple(poses)
    centers = [pose.center() for pose in poses.values()]
    np.testing.assert_allclose(found.cameras.centers, centers, atol=1e-12)


def test_rules_and_lists(imported: Path) -> None:
    first, second, *_ = sorted(read_reference(imported).queries or ())
    write_protocol(imported / "megloc", Protocol(pose_file_names="basename"))
    write_groups(imported / "megloc", {first: ImageGroup(scored=False)})
    found = read_reference(imported)
    assert len(found.expected) == 3 and found.expected[second.split("/")[1]] == second
    write_names(imported / "megloc", {second: "b.png", first: "a.png"})
    found = read_reference(imported)
    assert list(found.expected.items()) == [("b.png", second), ("a.png", first)]
    assert found.listed and found.queries is not None and len(found.queries) == 4


def test_parts_that_are_not_there(imported: Path, tmp_path: Path) -> None:
    (imported / "mapping").rename(tmp_path / "away")
    assert read_reference(imported).cameras is None
    (imported / "query").rename(tmp_path / "gone")
    with pytest.raises(DataError, match="none of mapping/, query/ and megloc/"):
        read_reference(imported)
    write_protocol(imported / "megloc", Protocol(dataset="aachen"))
    found = read_reference(imported)
    assert (found.protocol.dataset, found.queries, dict(found.expected)) == ("aachen", None, {})


def test_broken_parts_are_named(imported: Path) -> None:
    (imported / "mapping" / "sensors" / "trajectories.txt").write_text("broken\n")
    with pytest.raises(DataError, match="trajectories.txt"):
        read_reference(imported)
