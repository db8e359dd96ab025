"""Map refinement on a wall whose points, cameras and depth maps are exact."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.files import read_json_model
from megloc_kapture.io.images import write_depth_map
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    KaptureFolder,
    Observations,
    Sensor,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.points import read_point_covariances
from megloc_kapture.mapping.uncertainty import point_covariances
from megloc_kapture.stages.map_refinement import (
    KEPT_FILE,
    REJECTED_FILE,
    MapRefinementOptions,
    RefinementReport,
    refine_map,
)
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_RADIAL", 320, 240, (250.0, 160.0, 120.0, 0.02))
DEPTH_CAMERA = Camera("PINHOLE", 160, 120, (120.0, 120.0, 80.0, 60.0))
DEPTH_FROM_RIG = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.06, 0.01, 0.0))
WALL_M = 4.0
NUM_IMAGES, WITHOUT_DEPTH = 6, 5
ON_WALL, FLOATING, LIFTED, IN_HOLE = range(0, 40), range(40, 50), range(50, 60), range(60, 66)
OFF = MapRefinementOptions.model_validate({"depth": {"max_sigmas": None}})


@dataclass(frozen=True)
class Wall:
    """The map: six images in a row before a wall; everything sees all but the lifted points."""

    root: Path
    points: np.ndarray

    def folder(self) -> KaptureFolder:
        return KaptureFolder(self.root)


def pose(image: int) -> RigidTransform:
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.3 * image, 0.0, 0.0))


def write_wall(root: Path, *, shift_px: float = 0.0, unposed: Sequence[int] = ()) -> Wall:
    """Write it; points 60 to 65 float where the depth maps have a hole."""
    rng = np.random.default_rng(5)
    xyz = np.column_stack(
        [rng.uniform(-0.6, 2.1, 66), rng.uniform(-1.2, 1.2, 66), np.full(66, WALL_M)]
    )
    xyz[IN_HOLE.start :, 1] = rng.uniform(-0.1, 0.1, 6)
    floating = [*FLOATING, *IN_HOLE]
    xyz[floating] *= 0.5
    xyz[floating, 0] = rng.uniform(0.4, 1.1, 16)
    xyz[[*FLOATING], 1] = rng.uniform(0.3, 0.6, 10) * rng.choice([-1, 1], 10)
    points = np.column_stack([xyz, rng.integers(0, 256, (66, 3))])
    data = KaptureData(
        sensors={
            "camera": Sensor.from_camera(CAMERA),
            "depth": Sensor.from_camera(DEPTH_CAMERA, sensor_type="depth"),
        },
        rigs={"rig": {"camera": RigidTransform.identity(), "depth": DEPTH_FROM_RIG}},
    )
    depth = np.full((120, 160), WALL_M, np.float32)
    depth[50:70] = 0.0
    names = [f"wall/{image}.png" for image in range(NUM_IMAGES)]
    for image, name in enumerate(names):
        data.records_camera[image, "camera"] = name
        if image not in unposed:
            data.trajectories[image, "rig"] = pose(image)
        if image != WITHOUT_DEPTH:
            data.records_depth[image, "depth"] = f"wall/{image}.depth"
            write_depth_map(root / "sensors" / "records_data" / f"wall/{image}.depth", depth)
    write_sensors(root, data)
    of_type = {"a": [], "b": []}  # type: dict[str, list[tuple[int, int, int]]]
    for name in of_type:
        config = FeatureConfig(name, np.dtype(np.float32), 2)
        with FeatureWriter(root, "keypoints", name, config) as writer:
            for image, image_name in enumerate(names):
                pixels = project(CAMERA, pose(image), xyz) + shift_px
                writer.write(image_name, pixels.astype(np.float32))
    for point in range(66):
        if point in LIFTED:
            of_type["b"].append((point, point % NUM_IMAGES, point))
        else:
            own = "a" if point % 3 else "b"
            of_type[own] += [(point, image, point) for image in range(NUM_IMAGES)]
            if point % 5 == 0:  # and now and then one of the other type as well
                of_type["b" if own == "a" else "a"].append((point, 0, point))
    seen = {
        name: Observations(
            name,
            tuple(names),
            np.array([row[0] for row in rows]),
            np.array([row[1] for row in rows], np.int32),
            np.array([row[2] for row in rows], np.int32),
        )
        for name, rows in of_type.items()
    }
    write_points3d(root, points)
    write_observations(root, seen)
    return Wall(root, points)


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Wall:
    """The wall, not to be written to."""
    return write_wall(tmp_path_factory.mktemp("wall") / "map")


def report_of(root: Path) -> RefinementReport:
    return read_json_model(root / "reconstruction" / "refinement.json", RefinementReport)


def contents(root: Path) -> dict[str, set[tuple[tuple[float, ...], str, int]]]:
    """By type, what is observed: the point with its colour, image and keypoint."""
    folder = KaptureFolder(root)
    points = folder.points3d()
    return {
        name: {
            (tuple(points[point].tolist()), seen.image_names[image], int(keypoint))
            for point, image, keypoint in zip(
                seen.point_ids, seen.image_ids, seen.keypoint_ids, strict=True
            )
        }
        for name, seen in folder.observations().items()
    }


def refined(wall: Wall, output: Path, **settings: Any) -> tuple[KaptureFolder, RefinementReport]:
    counts = refine_map(wall.folder(), output, MapRefinementOptions.model_validate(settings))
    report = report_of(output)
    assert counts["points"] == report.points_after == len(KaptureFolder(output).points3d())
    return KaptureFolder(output), report


def test_depth_takes_out_what_floats_before_the_wall(wall: Wall, tmp_path: Path) -> None:
    folder, report = refined(wall, tmp_path / "out")
    kept = np.array([*ON_WALL, *LIFTED, *IN_HOLE])
    np.testing.assert_array_equal(folder.points3d(), wall.points[kept])
    (removed,) = report.filters
    assert removed.name == "depth"
    assert removed.points == len(FLOATING)
    before, after = contents(wall.root), contents(tmp_path / "out")
    gone = {tuple(wall.points[point].tolist()) for point in FLOATING}
    for name, observed in before.items():
        assert after[name] == {row for row in observed if row[0] not in gone}
    assert removed.observations == sum(map(len, before.values())) - sum(map(len, after.values()))
    assert report.observations_before - removed.observations == report.observations_after
    folder.validate()


def test_an_image_without_depth_and_holes_count_for_nobody(wall: Wall, tmp_path: Path) -> None:
    _, report = refined(wall, tmp_path / "out", min_observations=1)
    # the image without depth sees the floating points still: they stay with what it observes
    assert report.filters[0].points == 0
    left = contents(tmp_path / "out")
    floating = {tuple(wall.points[point].tolist()) for point in FLOATING}
    names = {name for rows in left.values() for point, name, _ in rows if point in floating}
    assert names == {f"wall/{WITHOUT_DEPTH}.png"}


def test_depth_maps_that_are_not_there_count_as_none(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "map")
    for path in (wall.root / "sensors" / "records_data").rglob("*.depth"):
        path.unlink()
    _, report = refined(wall, tmp_path / "out")
    assert report.filters == ()
    assert contents(tmp_path / "out") == contents(wall.root)


def test_nothing_is_lost_where_nothing_is_asked_for(wall: Wall, tmp_path: Path) -> None:
    counts = refine_map(wall.folder(), tmp_path / "out", OFF)
    assert counts == {"points": 66, "observations": sum(map(len, contents(wall.root).values()))}
    assert contents(tmp_path / "out") == contents(wall.root)
    assert KaptureFolder(tmp_path / "out").read().poses() == wall.folder().read().poses()


def test_covariances_are_those_of_the_new_map(wall: Wall, tmp_path: Path) -> None:
    folder, report = refined(wall, tmp_path / "out", uncertainty={"keep_quantile": 0.5})
    stored = read_point_covariances(tmp_path / "out", report.points_after)
    assert stored is not None
    seen = list(folder.observations().values())
    point_ids = np.concatenate([s.point_ids for s in seen])
    order = np.argsort(point_ids, kind="stable")
    images = np.concatenate([[int(s.image_names[i][5]) for i in s.image_ids] for s in seen]).astype(
        np.int32
    )
    expected = point_covariances(
        folder.points3d()[:, :3],
        point_ids[order],
        images[order],
        [CAMERA] * NUM_IMAGES,
        [pose(image) for image in range(NUM_IMAGES)],
    )
    np.testing.assert_allclose(stored, expected, rtol=1e-9)
    lifted = np.isin(folder.points3d()[:, 0], wall.points[[*LIFTED], 0])
    assert lifted.sum() == len(LIFTED)
    assert np.isnan(stored[lifted]).all()
    assert np.isfinite(stored[~lifted]).all()
    depth, uncertainty = report.filters
    assert (uncertainty.name, uncertainty.checked) == ("uncertainty", 46)
    assert uncertainty.points == 23


def test_a_point_is_as_uncertain_as_in_its_worst_direction(wall: Wall, tmp_path: Path) -> None:
    # seen in a row from afar: depth is far less sure than the two directions across
    unchecked = {"max_sigmas": None}
    refined(wall, tmp_path / "all", depth=unchecked)
    stored = read_point_covariances(tmp_path / "all", len(wall.points))
    assert stored is not None
    deviations = np.full((len(stored), 3), np.nan)  # of lifted points
    for row in np.flatnonzero(np.isfinite(stored[:, 0])):
        deviations[row] = np.sqrt(np.linalg.eigvalsh(_square(stored[row])))
    limit = float(np.nanmedian(deviations[:, 2]))
    folder, _ = refined(
        wall, tmp_path / "out", depth=unchecked, uncertainty={"max_deviation": limit * (1 + 1e-9)}
    )
    sure = ~(deviations[:, 2] > limit * (1 + 1e-9))
    np.testing.assert_array_equal(folder.points3d(), wall.points[sure])
    for direction in (0, 1):
        assert (~(deviations[:, direction] > limit)).sum() > sure.sum() + 10


def _square(covariance: np.ndarray) -> np.ndarray:
    xx, xy, xz, yy, yz, zz = covariance
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def test_tracks_of_several_types_count_together(wall: Wall, tmp_path: Path) -> None:
    _, report = refined(
        wall,
        tmp_path / "out",
        depth={"max_sigmas": None},
        consistency={"min_track_length": NUM_IMAGES + 1},
    )
    both = [point for point in range(66) if point % 5 == 0 and point not in LIFTED]
    assert report.points_after == len(both)
    np.testing.assert_array_equal(KaptureFolder(tmp_path / "out").points3d(), wall.points[both])
    assert report.filters[0].name == "track_length"


def test_a_lifted_point_has_no_angle_to_be_too_small(wall: Wall, tmp_path: Path) -> None:
    _, report = refined(
        wall, tmp_path / "out", depth={"max_sigmas": None}, consistency={"min_angle_deg": 30.0}
    )
    widest = 2 * np.degrees(np.arctan(0.75 / wall.points[:, 2]))
    far = {tuple(row) for row in wall.points[[*LIFTED]]}
    left = {tuple(row) for row in KaptureFolder(tmp_path / "out").points3d()}
    assert far < left
    assert report.points_after < 66
    assert not {tuple(row) for row in wall.points[(widest < 15)]} & (left - far)


@pytest.mark.parametrize("shift_px", [0.0, -0.5])
def test_keypoints_are_compared_in_the_map_s_pixel_origin(shift_px: float, tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "map", shift_px=shift_px)
    _, report = refined(
        wall,
        tmp_path / "out",
        depth={"max_sigmas": None},
        consistency={"max_reprojection_error_px": 0.1},
    )
    assert report.filters[0].checked == report.observations_before
    assert report.filters[0].observations == 0


def test_observations_far_from_their_keypoints_are_dropped(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "map")
    path = wall.root / "reconstruction" / "keypoints" / "a" / "wall" / "2.png.kpt"
    keypoints = np.fromfile(path, np.float32).reshape(-1, 2)
    keypoints[1] += 10.0
    path.write_bytes(keypoints.tobytes())
    _, report = refined(
        wall,
        tmp_path / "out",
        depth={"max_sigmas": None},
        consistency={"max_reprojection_error_px": 4.0},
    )
    assert (report.filters[0].points, report.filters[0].observations) == (0, 1)
    gone = contents(wall.root)["a"] - contents(tmp_path / "out")["a"]
    assert gone == {(tuple(wall.points[1].tolist()), "wall/2.png", 1)}


def test_observations_of_an_image_without_pose_stay(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "map", unposed=[3])
    strict = {"max_reprojection_error_px": 0.5, "min_angle_deg": 1.0}
    _, report = refined(wall, tmp_path / "out", consistency=strict)
    before, after = contents(wall.root), contents(tmp_path / "out")
    left = {point for rows in after.values() for point, _, _ in rows}
    for name, observed in before.items():
        unposed = {row for row in observed if row[1] == "wall/3.png" and row[0] in left}
        assert unposed
        assert unposed <= after[name]


def test_a_map_without_poses_is_left_as_it_is(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "map", unposed=range(NUM_IMAGES))
    settings = {
        "consistency": {"max_reprojection_error_px": 1.0, "min_angle_deg": 10.0},
        "uncertainty": {"max_deviation": 1e-6, "max_relative_deviation": 1e-6},
    }
    refined(wall, tmp_path / "out", **settings)
    assert contents(tmp_path / "out") == contents(wall.root)
    covariances = read_point_covariances(tmp_path / "out", 66)
    assert covariances is not None
    assert np.isnan(covariances).all()


def test_no_point_is_left_and_nothing_breaks(wall: Wall, tmp_path: Path) -> None:
    folder, report = refined(
        wall, tmp_path / "out", consistency={"min_track_length": 100}, ply=True
    )
    assert report.points_after == report.observations_after == 0
    assert folder.observations() == {}


def test_equal_bytes_whoever_works(
    wall: Wall,
    tmp_path: Path,
    two_processes: Executor,
    folder_bytes: Callable[[Path], dict[str, bytes]],
) -> None:
    options = MapRefinementOptions.model_validate(
        {"ply": True, "uncertainty": {"keep_quantile": 0.9}}
    )
    before = folder_bytes(wall.root)
    refine_map(wall.folder(), tmp_path / "one", options)
    refine_map(wall.folder(), tmp_path / "two", options, work=Work(two_processes))
    assert folder_bytes(tmp_path / "one") == folder_bytes(tmp_path / "two")
    assert folder_bytes(wall.root) == before


def test_features_are_linked_where_they_may_be(wall: Wall, tmp_path: Path) -> None:
    for name, links in (("copied", False), ("linked", True)):
        refine_map(wall.folder(), tmp_path / name, OFF, link_features=links)
        for kind in ("a", "b"):
            place = Path("reconstruction") / "keypoints" / kind / "wall" / "0.png.kpt"
            assert (tmp_path / name / place).read_bytes() == (wall.root / place).read_bytes()
            assert os.path.samefile(tmp_path / name / place, wall.root / place) == links


def test_pictures_hold_all_points(wall: Wall, tmp_path: Path) -> None:
    refined(wall, tmp_path / "out", ply=True)
    pycolmap = pytest.importorskip("pycolmap")
    for name, count in ((KEPT_FILE, 56), (REJECTED_FILE, 10)):
        reconstruction = pycolmap.Reconstruction()
        reconstruction.import_PLY(str(tmp_path / "out" / "reconstruction" / name))
        assert reconstruction.num_points3D() == count
        colours = {tuple(point.color) for point in reconstruction.points3D.values()}
        grey = (128, 128, 128)
        assert (grey in colours) == (name == KEPT_FILE)  # the lifted ones
        assert len(colours) > 5


def test_a_kapture_without_points_is_refused(wall: Wall, tmp_path: Path) -> None:
    write_sensors(tmp_path / "empty", wall.folder().read())
    with pytest.raises(DataError, match="no map to refine"):
        refine_map(KaptureFolder(tmp_path / "empty"), tmp_path / "out")
