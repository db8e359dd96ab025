"""Pose refinement as a stage: accepted and rejected steps, and consistency of the map."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

from megloc_kapture.errors import PluginError
from megloc_kapture.evaluation.report.content import consistency_sentence
from megloc_kapture.io.dataset_tables import ImageGroup
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import (
    CONSISTENCY_FILE,
    read_consistency,
    read_covariances,
    read_refinement,
)
from megloc_kapture.plugins import PoseRefinement
from megloc_kapture.refinement.references import Displacement
from megloc_kapture.stages.image_pairs import Restrictions
from megloc_kapture.stages.pose_refinement import PoseRefinementOptions, refine_poses
from megloc_kapture.stages.query_poses import write_localized
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform
from tests.worlds import folder_bytes

COVARIANCE = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 1 / 3])
SHIFT = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.25))


class Shift:
    """Moves every pose by 0.25 along the optical axis, but not that of image ``stays``."""

    def __init__(self, stays: str = "", name: str = "shift") -> None:
        self.stays, self.name = stays, name
        self.asked: dict[str, list[str]] = {}

    def refine(
        self,
        query: str,
        camera: Camera,
        cam_from_world: RigidTransform,
        references: Sequence[str],
        scene: Any,
    ) -> Any:
        self.asked[query] = list(references)
        assert scene.query_image(query).shape[:2] == (camera.height, camera.width)
        if self.name == "wrong":
            return None
        if query == self.stays:
            return PoseRefinement(cam_from_world, "nothing overlaps", {"overlap": 0.125})
        return PoseRefinement(SHIFT @ cam_from_world, measures={"overlap": 0.5})


class Sure(Shift):
    """Moves poses in frames whose map is consistent; FRAMES has the inconsistency."""

    def __init__(self, require_consistent_map: bool = True) -> None:
        super().__init__(name="sure")
        self.require_consistent_map = require_consistent_map

    def hold_out(self, image: str, images: Any, scene: Any) -> Displacement | None:
        assert scene.map_pose(image) is not None and image in images.names
        off = FRAMES["good" if int(image.removesuffix(".png")) < 6 else "bad"]
        return Displacement(0.02, 0.2, 3.0, 0.001, 0.01, off)


# frame of a map image: standardised error of held-out map images
FRAMES = {"good": 1.0, "bad": 1e4}


class Chosen(PoseRefinementOptions):
    """Options with given refiners."""

    refiners: tuple[Any, ...] = ()

    def make_refiners(self, placement: Any = None) -> list[Any]:
        return list(self.refiners)


def status_table(localized: Path) -> pandas.DataFrame:
    return pandas.read_csv(localized / "status.csv", index_col="image", keep_default_na=False)


@pytest.fixture
def localized(world: Any, tmp_path: Path) -> KaptureFolder:
    """One query at its true pose, from the map's first image; the other failed."""
    first, second = sorted(world.query_poses)
    image = min(world.map_poses)
    pose = world.query_poses[first]
    found = Pose(pose, 50, 40, name=first, candidates=(image,), covariance=COVARIANCE)
    folder = tmp_path / "localized"
    write_localized(folder, world.query(), [found, Failure("too dark", name=second)])
    return KaptureFolder(folder)


def test_refiners_are_applied_in_order_and_failures_stay(
    world: Any, localized: KaptureFolder, tmp_path: Path
) -> None:
    first, second = sorted(world.query_poses)
    options = Chosen(refiners=(Shift(), Shift(stays=first), Shift()))
    arguments = world.mapping(), world.query(), localized
    counts = refine_poses(*arguments, tmp_path / "out", options)
    assert counts["queries"] == 1
    refined = KaptureFolder(tmp_path / "out").read().poses()
    expected = SHIFT @ SHIFT @ world.query_poses[first]
    assert refined.keys() == {first}
    np.testing.assert_allclose(refined[first].translation, expected.translation)
    status = status_table(tmp_path / "out")
    steps = "shift: accepted; shift: nothing overlaps; shift: accepted"
    assert status.refinement[first] == steps
    assert (status.refinement[second], status.reason[second]) == ("", "too dark")
    steps = read_refinement(tmp_path / "out" / "refinement.csv", refined)[first]
    assert [step.accepted for step in steps] == [True, False, True]
    assert [step.moved_m for step in steps] == pytest.approx([0.25, 0, 0.25])
    assert steps[1].measures == {"overlap": 0.125}
    assert localized.read().poses()[first] == world.query_poses[first]
    with ThreadPoolExecutor(2) as executor:
        refine_poses(*arguments, tmp_path / "threads", options, work=Work(executor))
    assert folder_bytes(tmp_path / "out") == folder_bytes(tmp_path / "threads")


def test_rejected_refinements_keep_the_covariance(
    world: Any, localized: KaptureFolder, tmp_path: Path
) -> None:
    first = min(world.query_poses)
    kept = {}
    for name, stays in (("stays", first), ("moved", "")):
        options = Chosen(refiners=(Shift(stays=stays),))
        refine_poses(world.mapping(), world.query(), localized, tmp_path / name, options)
        kept[name] = read_covariances(tmp_path / name / "covariance.csv")
    np.testing.assert_array_equal(kept["stays"][first], COVARIANCE)
    assert kept["moved"] == {}  # the refiner returns no covariance
    # the references are the candidates of the pose
    assert options.refiners[0].asked[first] == [min(world.map_poses)]


def test_wrong_refiners_are_refused(world: Any, localized: KaptureFolder, tmp_path: Path) -> None:
    wrong = Chosen(refiners=(Shift(name="wrong"),))
    with pytest.raises(PluginError, match="'wrong' on image .*: refine returned NoneType"):
        refine_poses(world.mapping(), world.query(), localized, tmp_path, wrong)


@pytest.fixture
def folders(world: Any, small_kapture: Any, tmp_path: Path) -> tuple[KaptureFolder, ...]:
    """A map of two frames, and two localized queries, one in each."""
    image = next(iter(world.mapping().read().image_names()))
    pixels = read_image_rgb(world.mapping().image_path(image))
    pose = RigidTransform.identity()
    names = [f"{k:02d}.png" for k in range(12)]
    mapping = small_kapture(
        {name: pixels for name in names}, name="map", poses={name: pose for name in names}
    )
    query = small_kapture({"a.png": pixels, "b.png": pixels}, name="query")
    found = [
        Pose(pose, 50, 40, name=q, candidates=(first,))
        for q, first in (("a.png", "00.png"), ("b.png", "06.png"))
    ]
    write_localized(tmp_path / "localized", query, found)
    return mapping, query, KaptureFolder(tmp_path / "localized")


RESTRICTIONS = Restrictions(
    groups={f"{k:02d}.png": ImageGroup(frame="good" if k < 6 else "bad") for k in range(12)}
)


def test_each_coordinate_frame_has_its_consistency(folders: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = Chosen(refiners=(Sure(),))
    counts = refine_poses(*folders, out, options, restrictions=RESTRICTIONS)
    assert counts == {
        "queries": 2, "accepted_by_sure": 1, "frames_where_sure_is_trusted": 1,
    }  # fmt: skip
    text = status_table(out).refinement
    assert text["a.png"] == "sure: accepted"
    assert "sure: the map contradicts itself: 6 of 6" in text["b.png"]
    (first,), (second,) = read_refinement(out / "refinement.csv", {}).values()
    assert (first.accepted, second.accepted) == (True, False) and second.reason in text["b.png"]
    poses = KaptureFolder(out).read().poses()
    assert poses["a.png"] == SHIFT and poses["b.png"] == RigidTransform.identity()
    bad, good = read_consistency(out / CONSISTENCY_FILE)
    assert (bad.frame, bad.images, bad.contradicting) == ("bad", 6, 6)
    assert (good.frame, good.contradicting, good.reason) == ("good", 0, "")
    assert consistency_sentence(good).startswith("sure in good is used; 6 map images held out")
    # without the check the refiner is used everywhere
    options = Chosen(refiners=(Sure(require_consistent_map=False),))
    counts = refine_poses(*folders, tmp_path / "all", options, restrictions=RESTRICTIONS)
    assert counts == {"queries": 2, "accepted_by_sure": 2}
    assert not (tmp_path / "all" / CONSISTENCY_FILE).exists()
