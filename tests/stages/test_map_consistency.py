"""Rendering is used in a map whose own images stay where they are, and in no other."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.evaluation.report.refinement import consistency_sentence
from megloc_kapture.io.dataset_tables import ImageGroup
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import (
    CONSISTENCY_FILE,
    read_consistency,
    read_refinement,
    read_status,
)
from megloc_kapture.plugins import PoseRefinement
from megloc_kapture.refinement.consistency import Displacement
from megloc_kapture.stages.candidates import Restrictions
from megloc_kapture.stages.localized_folder import write_localized
from megloc_kapture.stages.pose_refinement import PoseRefinementOptions, refine_poses
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Pose, RigidTransform

SHIFT = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.25))
# frame of a map image, and how far from consistent it is
FRAMES = {"good": 1.0, "bad": 1e4}


class Sure:
    """Moves every pose, and map images by what their frame says."""

    name = "sure"

    def __init__(self, require_consistent_map: bool = True) -> None:
        self.require_consistent_map = require_consistent_map

    def hold_out(self, image: str, images: Any, scene: Any) -> Displacement | None:
        assert scene.map_pose(image) is not None and image in images.names
        off = FRAMES["good" if int(image.removesuffix(".png")) < 6 else "bad"]
        return Displacement(0.02, 0.2, 3.0, 0.001, 0.01, off)

    def refine(
        self, query: str, camera: Any, pose: RigidTransform, references: Sequence[str], scene: Any
    ) -> PoseRefinement:
        return PoseRefinement(SHIFT @ pose)


class Chosen(PoseRefinementOptions):
    """Options with refiners of their own."""

    refiners: tuple[Any, ...] = ()

    def make_refiners(self) -> list[Any]:
        return list(self.refiners)


@pytest.fixture
def folders(world: Any, small_kapture: Any, tmp_path: Path) -> tuple[KaptureFolder, ...]:
    """A map of two frames, and two queries that were localized, one in each."""
    image = next(iter(world.mapping().read().image_names()))
    pixels = read_image_rgb(world.mapping().image_path(image))
    pose = RigidTransform.identity()
    names = [f"{k:02d}.png" for k in range(12)]
    mapping = small_kapture(
        {name: pixels for name in names}, name="map", poses={name: pose for name in names}
    )
    query = small_kapture({"a.png": pixels, "b.png": pixels}, name="query")
    found = [
        (q, Pose(pose, 50, 40, candidates=(first,)))
        for q, first in (("a.png", "00.png"), ("b.png", "06.png"))
    ]
    write_localized(tmp_path / "localized", query, found)
    return mapping, query, KaptureFolder(tmp_path / "localized")


RESTRICTIONS = Restrictions(
    groups={f"{k:02d}.png": ImageGroup(frame="good" if k < 6 else "bad") for k in range(12)}
)


def test_each_coordinate_frame_is_judged_by_itself(
    folders: tuple[KaptureFolder, ...], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    options = Chosen(refiners=(Sure(),))
    counts = refine_poses(*folders, out, options, restrictions=RESTRICTIONS)
    assert counts == {
        "queries": 2, "accepted_by_sure": 1, "sure trusted bad": 0, "sure trusted good": 1,
    }  # fmt: skip
    statuses, rows = read_status(out / "status.csv"), read_refinement(out / "refinement.csv")
    assert statuses["a.png"].refinement == "sure: accepted"
    assert "sure: the map contradicts itself: 6 of 6" in statuses["b.png"].refinement
    assert [row.accepted for row in rows] == [True, False]
    assert rows[1].reason in statuses["b.png"].refinement
    poses = KaptureFolder(out).read().poses()
    assert poses["a.png"] == SHIFT and poses["b.png"] == RigidTransform.identity()
    bad, good = read_consistency(out / CONSISTENCY_FILE)
    assert (bad.frame, bad.images, bad.contradicting) == ("bad", 6, 6)
    assert (good.frame, good.contradicting, good.reason) == ("good", 0, "")
    assert consistency_sentence(good).startswith(
        "sure in good is used; 6 map images held out move by 0.02"
    )
    with ThreadPoolExecutor(2) as executor:
        refine_poses(
            *folders, tmp_path / "threads", options, restrictions=RESTRICTIONS, work=Work(executor)
        )
    for name in (CONSISTENCY_FILE, "refinement.csv", "status.csv"):
        assert (out / name).read_bytes() == (tmp_path / "threads" / name).read_bytes()
    shutil.rmtree(out)


def test_a_refiner_that_does_not_ask_is_used_everywhere(
    folders: tuple[KaptureFolder, ...], tmp_path: Path
) -> None:
    options = Chosen(refiners=(Sure(require_consistent_map=False),))
    counts = refine_poses(*folders, tmp_path / "out", options, restrictions=RESTRICTIONS)
    assert counts == {"queries": 2, "accepted_by_sure": 2}
    assert not (tmp_path / "out" / CONSISTENCY_FILE).exists()
