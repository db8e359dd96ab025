"""The localized queries as kapture: fallbacks are marked, failures have no pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import kapture.io.csv

from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import CLUSTERS_FILE, STATUS_FILE, read_clusters, read_status
from megloc_kapture.stages.candidates import QueryPairsOptions, Retrieval
from megloc_kapture.stages.image_pairs import pair_queries
from megloc_kapture.stages.localized_folder import write_localized
from megloc_kapture.stages.query_poses import LocalizationOptions, localize_from_matches
from megloc_kapture.values import Failure, Pose, RigidTransform

Results = list[tuple[str, Pose | Failure]]


def localize(world: Any) -> Results:
    pairs = pair_queries(
        world.mapping(), world.query(), QueryPairsOptions(), retrieval=Retrieval(("vlad_rootsift",))
    )
    matches = world.with_matches("query")
    found = localize_from_matches(
        world.map(), world.query(), matches, pairs, ["rootsift"], LocalizationOptions()
    )
    return list(found)


def written(world: Any, output: Path, results: Results, **more: Any) -> KaptureFolder:
    write_localized(output, world.query(), results, **more)
    return KaptureFolder(output)


def test_localized_queries_are_a_kapture(world: Any, tmp_path: Path) -> None:
    results = localize(world)
    folder = written(world, tmp_path, results, timing=tmp_path / "timing.csv")
    folder.validate(deep=True)  # the images are there too
    poses = folder.read().poses()
    assert poses == {image: result.cam_from_world for image, result in results}  # type: ignore[union-attr]
    theirs = kapture.io.csv.kapture_from_dir(str(tmp_path))
    assert len(theirs.trajectories) == 2 and len(list(theirs.records_camera.key_pairs())) == 2
    status = read_status(tmp_path / STATUS_FILE)
    for image, result in results:
        row = status[image]
        assert (row.status, row.reason, row.fallback) == ("localized", "", "none")
        assert (row.num_inliers, row.candidates) == (result.num_inliers, result.candidates)
    lines = (tmp_path / "timing.csv").read_text().splitlines()
    assert lines[0] == "image,step,seconds"
    assert {line.split(",")[1] for line in lines[1:]} >= {"reading", "estimation", "refinement"}
    clusters = read_clusters(tmp_path / CLUSTERS_FILE)
    for image, result in results:
        (chosen,) = (row for row in clusters[image] if row.chosen == "yes")
        assert status[image].cluster == chosen.cluster
        assert chosen.score is not None and chosen.score > 100
        assert chosen.images == result.candidates


def half_failed(world: Any) -> Results:
    (first, _), second = localize(world)
    return [(first, Failure("no map image matches")), second]


def test_a_failed_query_has_no_pose(world: Any, tmp_path: Path) -> None:
    results = half_failed(world)
    counts = write_localized(tmp_path, world.query(), results)
    assert counts == {"queries": 2, "localized": 1, "failed": 1, "fallbacks": 0}
    folder = KaptureFolder(tmp_path)
    assert set(folder.read().poses()) == {"query/b.png"}
    assert folder.read().image_names() == sorted(world.query_poses)  # but its record
    row = read_status(tmp_path / STATUS_FILE)["query/a.png"]
    assert (row.status, row.reason, row.fallback) == ("failed", "no map image matches", "none")


def test_a_fallback_is_marked_as_such(world: Any, tmp_path: Path) -> None:
    guess = world.map_poses["left/1.png"]
    counts = write_localized(
        tmp_path, world.query(), half_failed(world), fallback="retrieval",
        first_candidates={image: ("left/1.png", guess) for image in world.query_poses},
    )  # fmt: skip
    assert counts == {"queries": 2, "localized": 1, "failed": 1, "fallbacks": 1}
    poses = KaptureFolder(tmp_path).read().poses()
    assert poses["query/a.png"] == guess
    assert poses["query/b.png"] != guess  # a localized query needs no guess
    status = read_status(tmp_path / STATUS_FILE)
    a, b = status["query/a.png"], status["query/b.png"]
    assert (a.status, a.fallback, a.num_inliers) == ("failed", "retrieval", 0)
    assert (b.status, b.fallback) == ("localized", "none")


def test_no_fallback_unless_asked_for(world: Any, tmp_path: Path) -> None:
    guess = {image: ("left/1.png", RigidTransform.identity()) for image in world.query_poses}
    counts = write_localized(tmp_path, world.query(), half_failed(world), first_candidates=guess)
    assert counts["fallbacks"] == 0
    assert set(KaptureFolder(tmp_path).read().poses()) == {"query/b.png"}


def test_a_query_that_retrieved_nothing_has_no_fallback(world: Any, tmp_path: Path) -> None:
    counts = write_localized(
        tmp_path, world.query(), half_failed(world), fallback="retrieval", first_candidates={}
    )
    assert counts["fallbacks"] == 0
    assert read_status(tmp_path / STATUS_FILE)["query/a.png"].fallback == "none"
