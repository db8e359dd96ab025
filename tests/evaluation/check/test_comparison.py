"""The classic mistakes, made with real and rendered poses, and the map's cameras around poses."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.check.comparison import Neighbourhood, path_scores, storey_offset
from megloc_kapture.evaluation.check.reading import (
    CheckReport,
    Finding,
    MapCameras,
    Reference,
    camera_sets,
)
from megloc_kapture.evaluation.check.submission import check_submission
from megloc_kapture.io.dataset_tables import ImageGroup, SimilarityTransform, World

CLASSIC = ("inverted", "centre", "xyzw", "axes")
# what tools of other fields hand out: camera-to-world with OpenGL's axes, scipy's quaternions
COMBINED = ("inverted+axes", "xyzw+inverted", "xyzw+axes", "xyzw+inverted+axes", "world-axes")

Check = Callable[..., CheckReport]


@pytest.fixture
def check(tmp_path: Path) -> Check:
    def run(lines: Sequence[str], reference: Reference | None) -> CheckReport:
        path = tmp_path / "poses.txt"
        path.write_text("".join(lines))
        return check_submission(path, dataset="kapture", reference=reference)

    return run


def only_error(report: CheckReport) -> Finding:
    errors = [finding for finding in report.findings if finding.severity == "error"]
    assert len(errors) == 1, report.lines()
    return errors[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["fountain_p11", "herzjesu_p25", "herzjesu_wide", "redkitchen_rgbd"]
)
def test_real_scenes_pass(real_scene: Any, pose_lines: Any, check: Check, name: str) -> None:
    scene = real_scene(name)
    report = check(pose_lines(scene), scene.reference())
    assert not report.has_problems and report.lines()[-1].endswith("no problem found")
    assert {finding.kind for finding in report.findings} <= {"undecided"}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", [*CLASSIC, *COMBINED])
@pytest.mark.parametrize("name", ["fountain_p11", "herzjesu_p25", "herzjesu_wide"])
def test_mistakes_in_real_scenes(
    real_scene: Any, pose_lines: Any, check: Check, name: str, mistake: str
) -> None:
    scene = real_scene(name)
    lines = pose_lines(scene, mistake.split("+"))
    assert only_error(check(lines, scene.reference())).kind == mistake


@pytest.mark.slow
@pytest.mark.parametrize("mistake", CLASSIC)
def test_mistakes_where_cameras_hardly_turn(
    real_scene: Any, pose_lines: Any, check: Check, mistake: str
) -> None:
    # a rotation near the identity is near its inverse: what cannot be told apart is said
    scene = real_scene("redkitchen_rgbd")
    error = only_error(check(pose_lines(scene, [mistake]), scene.reference()))
    if mistake in ("inverted", "centre"):
        assert error.kind in ("inverted", "centre")
        assert "inverted" in error.message and "centre stands" in error.message
        assert "cannot tell" in error.message
    else:
        assert error.kind == mistake


@pytest.mark.parametrize("mess", [False, True], ids=["clean", "messy"])
@pytest.mark.parametrize("mistake", ["", *CLASSIC, *COMBINED])
@pytest.mark.parametrize("name", ["street", "table", "city", "floors"])
def test_mistakes_in_made_scenes(
    make_scene: Any, pose_lines: Any, check: Check, name: str, mistake: str, mess: bool
) -> None:
    scene = whole = make_scene(name)
    if mess:
        scene = scene.disturbed(wrong=0.2, noise=0.05 * scene.size**0.5, angle_deg=5)
    report = check(pose_lines(scene, mistake.split("+")), whole.reference())
    if not mistake:
        assert not report.has_problems, report.lines()
        told = {finding.kind: finding.severity for finding in report.findings}
        assert told == ({"far": "warning", "missing": "warning"} if mess else {})
        return
    error = only_error(report)
    assert error.kind == mistake, error
    if mistake == "world-axes" and not mess:
        assert "its x, y, z are the map's x, z, -y" in error.message


def test_poses_in_the_local_frame(make_scene: Any, pose_lines: Any, check: Check) -> None:
    scene = make_scene("street")
    origin = scene.map_centers.mean(axis=0)
    local = replace(scene, map_centers=scene.map_centers - origin)
    world = World(official_from_local=SimilarityTransform(translation=tuple(origin.tolist())))
    reference = replace(local.reference(), world=world)
    assert not check(pose_lines(scene), reference).has_problems
    forgotten = pose_lines(replace(scene, centers=scene.centers - origin))
    error = only_error(check(forgotten, reference))
    assert error.kind == "frame" and "offset of world.json" in error.message


def test_a_whole_file_on_the_other_floor(make_scene: Any, pose_lines: Any, check: Check) -> None:
    scene = make_scene("floors")
    lines = pose_lines(scene)
    poses = [line.split(" ", 1)[1] for line in lines]
    names = zip(scene.query_names(), [*poses[30:], *poses[:30]], strict=True)
    error = only_error(check([f"{name} {pose}" for name, pose in names], scene.reference()))
    assert error.kind == "floor" and "another floor" in error.message


def test_some_poses_on_the_other_floor(make_scene: Any, pose_lines: Any, check: Check) -> None:
    scene = make_scene("floors")
    lines = pose_lines(scene)
    lines[3] = f"{scene.query_names()[3]} {lines[40].split(' ', 1)[1]}"
    report = check(lines, scene.reference())
    assert not report.has_problems
    floor, far = sorted(report.findings, key=lambda finding: finding.kind, reverse=True)
    assert floor.severity == "warning" and floor.names == ("q/00003.jpg",)
    assert "fits the cameras of F2, and its query belongs to F1" in floor.message
    assert far.names == floor.names
    unknown = check(pose_lines(scene), replace(scene, query_frames=()).reference())
    assert [finding.kind for finding in unknown.findings] == ["floor-unknown"]


@pytest.mark.parametrize("storeys", [1, -1])
def test_heights_a_storey_off(make_scene: Any, pose_lines: Any, check: Check, storeys: int) -> None:
    scene = make_scene("floors")
    shifted = replace(scene, centers=scene.centers + [0, 0, 3.5 * storeys])
    errors = check(pose_lines(shifted), scene.reference()).findings
    assert {error.kind for error in errors} == {"height"}
    side = "above" if storeys > 0 else "below"
    told = rf"most poses stand 3\.[456] m {side} the map's cameras of F1"
    assert re.search(told, errors[0].message)
    # half a metre is how people hold cameras
    held = replace(scene, centers=scene.centers + [0, 0, 0.5 * storeys])
    assert not check(pose_lines(held), scene.reference()).findings


def test_poses_that_are_far(make_scene: Any, pose_lines: Any, check: Check) -> None:
    scene = make_scene("city")
    centers = scene.centers.copy()
    centers[5] += [0, 2000, 0]
    centers[9] += [0, 900, 0]
    (finding,) = check(pose_lines(replace(scene, centers=centers)), scene.reference()).findings
    assert (finding.severity, finding.kind) == ("warning", "far")
    assert finding.names == ("q/00005.jpg", "q/00009.jpg")
    # in a frame that nothing explains
    moved = replace(scene, centers=scene.centers + [5000.0, 300.0, 0.0])
    error = only_error(check(pose_lines(moved), scene.reference()))
    assert error.kind == "far" and "another frame, or another scale" in error.message
    # and numbers that overflow
    scene = make_scene("table")
    lines, name = pose_lines(scene), scene.query_names()[2]
    lines[2] = f"{name} 1 0 0 0 1e308 -1e308 1e308\n"
    (finding,) = check(lines, scene.reference()).findings
    assert (finding.severity, finding.kind, finding.names) == ("warning", "far", (name,))


def test_a_pose_far_from_what_its_prior_permits(
    make_scene: Any, pose_lines: Any, check: Check
) -> None:
    scene = make_scene("street")
    reference = scene.reference()
    middle = scene.map_centers[:, 1].min() + 300

    def locations(names: Sequence[str], y: np.ndarray) -> dict[str, str]:
        return dict(zip(names, np.where(y < middle, "south", "north").tolist(), strict=True))

    own = scene.centers[:, 1]
    of_images = locations(reference.cameras.images, scene.map_centers[:, 1])
    groups = {image: ImageGroup(location=where) for image, where in of_images.items()}
    priors = {query: (where,) for query, where in locations(scene.query_names(), own).items()}
    right = replace(reference, groups=groups, priors=priors)
    assert not check(pose_lines(scene), right).findings
    strayed = int(np.argmin(own))
    priors[scene.query_names()[strayed]] = ("north",)
    report = check(pose_lines(scene), replace(right, priors=priors))
    assert [finding.kind for finding in report.findings] == ["far"]
    assert report.findings[0].names == (scene.query_names()[strayed],)


def test_cameras_that_look_elsewhere_are_a_warning(
    make_scene: Any, pose_lines: Any, check: Check
) -> None:
    # sideways from a map that looks back: unusual, and right if they were taken so
    scene = make_scene("street")
    rear = slice(300, 600)
    aside = replace(
        scene,
        map_rotations=scene.map_rotations[rear],
        map_centers=scene.map_centers[rear],
        rotations=np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]) @ scene.rotations,
    )
    report = check(pose_lines(aside), aside.reference())
    assert not report.has_problems
    assert "orientation" in {finding.kind for finding in report.findings}


def test_too_few_poses_to_tell(make_scene: Any, pose_lines: Any, check: Check) -> None:
    scene = make_scene("city")
    report = check(pose_lines(scene, ("inverted",))[:2], scene.reference())
    assert "too-few" in {finding.kind for finding in report.findings}
    whole = pose_lines(scene, ("inverted",))[:5]
    assert only_error(check(whole, scene.reference())).kind == "inverted"
    # and too few cameras
    small = replace(scene, map_rotations=scene.map_rotations[:2], map_centers=scene.map_centers[:2])
    (note,) = check(pose_lines(scene, ("inverted",)), small.reference()).findings
    assert note.severity == "note" and "the map has 2 cameras" in note.message


def test_a_straight_path_is_best_in_any_order() -> None:
    times = np.array([3.0, 0.0, 1.0, 7.0])
    centers = times[:, None] * [1.0, -2.0, 0.5]
    np.testing.assert_allclose(path_scores(centers, times, np.ones(4)), 0.0, atol=1e-12)
    centers[2] += [0.0, 0.0, 3.0]
    scores = path_scores(centers, times, np.full(4, 2.0))
    # the ends have no neighbours on both sides
    np.testing.assert_allclose(scores[[1, 2, 3]], [0.0, -np.log1p(1.5), 0.0])
    assert scores[0] < 0
    # equal times and few rows say nothing
    assert not path_scores(centers, np.zeros(4), np.ones(4)).any()
    assert not path_scores(centers[:2], np.arange(2.0), np.ones(2)).any()


IMAGES = ("m1", "m2", "m3", "m4")
CAMERAS = MapCameras(IMAGES, np.tile([1.0, 0, 0, 0], (4, 1)), np.zeros((4, 3)))
FLOORS = {
    "m1": ImageGroup(frame="DUC1", location="a"),
    "m2": ImageGroup(frame="DUC1", location="b"),
    "m3": ImageGroup(frame="DUC2"),
    "m4": ImageGroup(frame="DUC2"),
}


def test_priors_frames_and_conditions() -> None:
    groups = FLOORS | {
        "by condition": ImageGroup(condition="DUC2"),
        "day": ImageGroup(condition="day"),
    }
    priors = {
        "by location": ("b",),
        "by two": ("a", "DUC2"),
        "by frame": ("DUC1",),
        "by image": ("m4",),
        "by nothing there": ("c",),
    }
    reference = Reference(folder="", groups=groups, priors=priors)
    expected: dict[str | None, tuple[list[int], list[int]]] = {
        "by location": ([1], [2, 3]),
        "by two": ([0, 2, 3], [0, 2, 3]),
        "by frame": ([0, 1], [2, 3]),
        "by image": ([2, 3], [0, 1]),
        "by condition": ([2, 3], [0, 1]),
        "by nothing there": ([0, 1, 2, 3], [0, 1, 2, 3]),
        "day": ([0, 1, 2, 3], [0, 1, 2, 3]),
        None: ([0, 1, 2, 3], [0, 1, 2, 3]),
    }
    sets = camera_sets(reference, CAMERAS, list(expected))
    for number, (query, (own, other)) in enumerate(expected.items()):
        assert sets.members[sets.own[number]].tolist() == own, query
        assert sets.members[sets.other[number]].tolist() == other, query
    assert sets.has_other.tolist() == [own != other for own, other in expected.values()]
    assert sets.labels[sets.own[2]] == "DUC1" and sets.labels[sets.other[2]] == "DUC2"
    # without tables everything is compared with everything
    sets = camera_sets(Reference(folder=""), CAMERAS, ["q1", None])
    assert sets.own.tolist() == [0, 0] and not sets.has_other.any()
    assert sets.members[0].tolist() == [0, 1, 2, 3]


def cameras(number: int, seed: int = 0) -> MapCameras:
    rng = np.random.default_rng(seed)
    quats = Rotation.random(number, random_state=seed).as_quat()
    return MapCameras(
        tuple(map(str, range(number))), np.roll(quats, 1, axis=1), rng.uniform(0, 10, (number, 3))
    )


def test_against_all_cameras_one_by_one() -> None:
    own = cameras(40)
    rng = np.random.default_rng(1)
    quats = np.roll(Rotation.random(25, random_state=1).as_quat(), 1, axis=1)
    centers = rng.uniform(-2, 12, (25, 3))
    hood = Neighbourhood(own, [np.arange(40)])
    found = hood.look(quats, centers, np.zeros(25, dtype=np.int64))
    for i in range(25):
        distances = np.linalg.norm(own.centers - centers[i], axis=1)
        turn = Rotation.from_quat(np.roll(own.quats, -1, axis=1))
        relative = turn * Rotation.from_quat(np.roll(quats[i], -1)).inv()
        angles = np.rad2deg(relative.magnitude())
        assert found.distance[i] == distances.min()
        scores = -np.log1p(distances / hood.spacing[0])
        scores -= np.log1p((np.minimum(angles, 90) / 20) ** 2)
        assert np.isclose(found.score[i], scores.max())
        assert found.fits[i] == ((distances <= found.near[i]) & (angles <= 45)).any()


def test_sets_do_not_see_each_other() -> None:
    own = cameras(40)
    sets = [np.arange(20), np.arange(20, 40), np.array([7])]
    hood = Neighbourhood(own, sets)
    at = own.centers[[3, 30, 3]]
    found = hood.look(own.quats[[3, 30, 3]], at, np.array([0, 0, 2]))
    assert found.distance[0] == 0 and found.score[0] == 0 and found.fits[0]
    others = np.linalg.norm(own.centers[:20] - own.centers[30], axis=1)
    assert np.isclose(found.distance[1], others.min())
    assert np.isclose(found.distance[2], np.linalg.norm(own.centers[3] - own.centers[7]))
    alone = hood.look(own.quats[[8]], own.centers[[8]], np.array([2]))
    assert not alone.fits[0] and np.isfinite(alone.score[0])


def test_scores_know_no_unit() -> None:
    own = cameras(60)
    quats, centers = own.quats[:9], own.centers[:9] + 0.3
    sets = np.zeros(9, dtype=np.int64)
    scores = Neighbourhood(own, [np.arange(60)]).look(quats, centers, sets).score
    for scale in (1e-3, 1e4):
        scaled = MapCameras(own.images, own.quats, own.centers * scale)
        hood = Neighbourhood(scaled, [np.arange(60)])
        np.testing.assert_allclose(hood.look(quats, centers * scale, sets).score, scores)


def test_cameras_of_one_place_are_one_for_the_spacing() -> None:
    line = np.column_stack([np.arange(20) * 5.0, np.zeros(20), np.zeros(20)])
    scans = np.repeat(line, 36, axis=0) + np.random.default_rng(0).normal(0, 1e-3, (720, 3))
    quats = np.tile([1.0, 0, 0, 0], (720, 1))
    hood = Neighbourhood(MapCameras((), quats, scans), [np.arange(720)])
    assert abs(hood.spacing[0] - 5) < 0.3
    # a map in one place says nothing of positions
    quats = cameras(5).quats
    hood = Neighbourhood(MapCameras((), quats, np.ones((5, 3))), [np.arange(5)])
    found = hood.look(quats, np.full((5, 3), 9.0), np.zeros(5, dtype=np.int64))
    assert np.isinf(hood.spacing[0])
    np.testing.assert_allclose(found.score, 0.0, atol=1e-12)


def test_what_is_not_finite_is_infinitely_far() -> None:
    own = cameras(10)
    centers = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e200, 0, 0], [1.0, 1, 1]])
    found = Neighbourhood(own, [np.arange(10)]).look(own.quats[:4], centers, np.zeros(4, np.int64))
    assert np.isinf(found.distance).tolist() == [True, True, True, False]
    assert not found.fits[:3].any() and np.isneginf(found.score[:3]).all()


LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def building(
    heights: np.ndarray | float = 1.5, tilt: Rotation | None = None
) -> tuple[MapCameras, np.ndarray]:
    """Cameras every two metres on a floor, in a world that may be tilted, and stands between."""
    x, y = np.meshgrid(np.arange(0, 40, 2.0), np.arange(0, 20, 2.0))
    centers = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size) + heights])
    world = tilt or Rotation.identity()
    rotation = LEVEL @ world.as_matrix().T
    quat = np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
    own = MapCameras(("",) * len(centers), np.tile(quat, (len(centers), 1)), world.apply(centers))
    return own, np.column_stack([x.ravel() + 0.7, y.ravel() - 0.4, np.full(x.size, 1.6)])


@pytest.mark.parametrize("tilt", [None, Rotation.from_rotvec([0.8, -0.3, 0.4])])
@pytest.mark.parametrize("offset", [3.2, -4.0])
def test_a_storey(tilt: Rotation | None, offset: float) -> None:
    cameras, stands = building(tilt=tilt)
    world = tilt or Rotation.identity()
    found = storey_offset(cameras, world.apply(stands + [0, 0, offset]))
    assert found is not None and abs(found - offset) < 0.15
    assert storey_offset(cameras, world.apply(stands)) is None
    assert storey_offset(cameras, world.apply(stands + [0, 0, 1.0])) is None


def test_a_few_strays_and_infinities_change_nothing() -> None:
    cameras, stands = building()
    stands = stands + [0, 0, 3.0]
    stands[:40, 2] -= 3.0
    stands[40:45] = np.inf
    found = storey_offset(cameras, stands)
    assert found is not None and abs(found - 3.1) < 0.01
    stands[:120, 2] = 1.6
    assert storey_offset(cameras, stands) is None


def test_maps_that_know_no_storey() -> None:
    cameras, stands = building(np.where(np.arange(200) % 2, 1.5, 5.0))  # both storeys
    assert storey_offset(cameras, stands + [0, 0, 3.4]) is None
    cameras, stands = building(np.random.default_rng(0).uniform(0, 8, 200))  # hills
    assert storey_offset(cameras, stands + [0, 0, 5.0]) is None
    cameras, stands = building()
    every_way = np.roll(Rotation.random(200, random_state=0).as_quat(), 1, axis=1)
    tumbling = replace(cameras, quats=every_way)
    assert storey_offset(tumbling, stands + [0, 0, 3.0]) is None
    assert storey_offset(replace(cameras, centers=np.ones((200, 3))), stands) is None
    assert storey_offset(cameras, stands[:0]) is None
