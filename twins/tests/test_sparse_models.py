"""Sparse models of the twins: exact tracks, and SIFT as COLMAP makes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from megloc_twins.aachen import (
    OFFICIAL_FROM_WORLD,
    AachenTwin,
    AachenTwinOptions,
    build_aachen_frames,
)
from megloc_twins.frames import Frame, day_lighting, in_frame, looking_at
from megloc_twins.moving_objects import moving_object_surfaces
from megloc_twins.rasterization import depth_map, sample_grid, visible_surfaces
from megloc_twins.robotcar import RobotCarTwin, RobotCarTwinOptions
from megloc_twins.sparse_models import exact_tracks
from megloc_twins.squares import build_place
from megloc_twins.synthetic_kapture import SyntheticWorld
from numpy.typing import NDArray

from megloc_kapture.datasets.aachen.adapter import Aachen, AachenOptions
from megloc_kapture.datasets.official import write_official
from megloc_kapture.datasets.reference_map import ColmapDatabase
from megloc_kapture.datasets.robotcar.adapter import RobotCar, RobotCarOptions
from megloc_kapture.io.colmap import px_from_cam
from megloc_kapture.io.colmap_model import SparsePoints
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


Depths = dict[str, NDArray[np.float32]]


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def colmap_px(frame: Frame, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where COLMAP projects world points, (N, 2)."""
    w, x, y, z = frame.cam_from_world.quat_wxyz
    pose = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(frame.cam_from_world.translation)
    )
    return px_from_cam(frame.camera, np.array([pose * point for point in points]))


@pytest.fixture(scope="module")
def frames(world: SyntheticWorld) -> list[Frame]:
    """Rig and telephone images of two places, PINHOLE and SIMPLE_RADIAL."""
    return list(world.frames())


@pytest.fixture(scope="module")
def depths(world: SyntheticWorld) -> Depths:
    surfaces = [place.surfaces_in_world() for place in world.places]
    result = {}
    for frame in world.frames():
        grid = sample_grid(frame.camera, 1)
        seen = visible_surfaces(surfaces[frame.place], frame.cam_from_world, grid)
        result[frame.name] = depth_map(seen)
    return result


@pytest.fixture(scope="module")
def points(frames: list[Frame], depths: Depths) -> SparsePoints:
    return exact_tracks(frames, depths, points_per_frame=40, rng=rng())


def test_colmap_projects_the_points_where_they_are_seen(
    frames: list[Frame], depths: Depths, points: SparsePoints
) -> None:
    assert {frame.camera.model for frame in frames} == {"PINHOLE", "SIMPLE_RADIAL"}
    for index, frame in enumerate(frames):
        mine = points.image_ids == index
        assert mine.sum() > 10
        xyz = points.xyz[points.point_ids[mine]]
        np.testing.assert_allclose(points.xy_px[mine], colmap_px(frame, xyz), atol=1e-4)
        # on the visible surface
        column, row = points.xy_px[mine].astype(int).T
        z = frame.cam_from_world.apply(xyz)[:, 2]
        error = np.abs(depths[frame.name][row, column] - z)
        assert (error < 0.021 + 0.011 * z).all() and np.median(error) < 0.02
    # poses may be in another frame
    other_from_world = RigidTransform.from_matrix(np.diag([1.0, -1.0, -1.0]), np.array([9, 8, 7]))
    back = other_from_world.inverse()
    moved = [replace(frame, cam_from_world=frame.cam_from_world @ back) for frame in frames]
    there = exact_tracks(moved, depths, points_per_frame=40, rng=rng())
    np.testing.assert_allclose(there.xyz, other_from_world.apply(points.xyz), atol=1e-9)


def test_tracks_are_in_order_and_within_a_place(frames: list[Frame], points: SparsePoints) -> None:
    assert len(points) > 100
    counts = np.bincount(points.point_ids, minlength=len(points))
    assert counts.min() == 2 and counts.max() > 3
    keys = list(zip(points.point_ids.tolist(), points.image_ids.tolist(), strict=True))
    assert keys == sorted(set(keys))
    place = np.array([frame.place for frame in frames])[points.image_ids]
    first = np.searchsorted(points.point_ids, points.point_ids)
    assert (place == place[first]).all()
    for index in range(len(frames)):
        features = points.feature_ids[points.image_ids == index]
        assert features.tolist() == list(range(len(features)))


def frame(name: str, x: float, *, camera: Camera, yaw_deg: float = 90.0) -> Frame:
    """A camera at (x, 0, 0) that looks along +y unless turned."""
    lighting = day_lighting(rng(), (0.0, 1.0), overcast=0.0)
    pose = looking_at(np.array([x, 0.0, 0.0]), np.radians(yaw_deg), 0.0, 0.0)
    return Frame(name, "mapping", "day", 0, 0, name, camera, pose, lighting, 0)


PINHOLE = Camera("PINHOLE", 40, 30, (40.0, 40.0, 20.0, 15.0))
WALL_M = 10.0


def wall() -> NDArray[np.float32]:
    return np.full((30, 40), WALL_M, np.float32)


def test_what_stands_in_front_hides_the_wall() -> None:
    pair = [frame("a", 0.0, camera=PINHOLE), frame("b", 0.0, camera=PINHOLE)]
    hidden = wall()
    hidden[:, :20] = 5.0  # in b, something covers the left half
    points = exact_tracks(pair, {"a": wall(), "b": hidden}, points_per_frame=1200, rng=rng())
    # nothing at 5 m is seen by a, nothing on the left of the wall by b
    assert (points.xy_px[:, 0] > 20).all()
    np.testing.assert_allclose(points.xyz[:, 1], WALL_M, atol=1e-9)
    # all of the visible half from both, but for the border
    assert len(points) == 2 * 18 * 26


def test_nothing_is_seen_without_depth_behind_beside_or_in_another_place() -> None:
    a, b = frame("a", 0.0, camera=PINHOLE), frame("b", 0.0, camera=PINHOLE)
    behind = frame("b", 0.0, camera=PINHOLE, yaw_deg=-90.0)
    beside = frame("b", 50.0, camera=PINHOLE)
    nothing, both = {"a": 0 * wall(), "b": 0 * wall()}, {"a": wall(), "b": wall()}
    pairs = (([a, b], nothing), ([a, behind], both), ([a, beside], both))
    for frames, depths in (*pairs, ([a, replace(b, place=1)], both), ([], {})):
        assert len(exact_tracks(frames, depths, points_per_frame=50, rng=rng())) == 0


def test_strong_distortion_folds_nothing_back_into_the_image() -> None:
    # r (1 - 0.25 r^2) turns back at r = 1.15: rays from far outside land inside the image again
    camera = Camera("SIMPLE_RADIAL", 40, 30, (40.0, 20.0, 15.0, -0.25))
    pair = [frame("a", 0.0, camera=camera), frame("b", 19.5, camera=camera)]
    both = {"a": wall(), "b": wall()}
    x_px = 20.0 + 40.0 * -1.95 * (1 - 0.25 * 1.95**2)
    assert 2 < x_px < 38  # the middle of a's image, as b's formula has it
    assert len(exact_tracks(pair, both, points_per_frame=1200, rng=rng())) == 0


QUERIES = {"day_queries": 2, "night_queries": 1, "additional_night_queries": 1}
CITY = {"num_places": 1, "stations_per_place": 7, "sequence_images": 3}
SIZE = {"width": 256, "height": 192, "supersampling": 1}
OPTIONS = AachenTwinOptions(**QUERIES, **CITY, **SIZE, model_features=True)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("aachen")
    AachenTwin(OPTIONS).write(root)
    return root


@pytest.mark.slow
def test_the_database_is_what_colmap_extracts(root: Path, tmp_path: Path) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    with ColmapDatabase(root / "aachen.db") as ours:
        assert len(ours.images) == 21  # without the sequence, which v1.0 does not have
        names = sorted(ours.images)[:4]
        how = {"extraction_options": options, "device": pycolmap.Device.cpu}
        images = root / "images_upright"
        pycolmap.extract_features(tmp_path / "theirs.db", images, image_names=names, **how)
        with ColmapDatabase(tmp_path / "theirs.db") as theirs:
            assert sorted(theirs.images) == names
            for name in names:
                both = ((each.keypoints(name), each.descriptors(name)) for each in (ours, theirs))
                rows = [np.hstack(each) for each in both]
                assert len(rows[0]) > 300
                np.testing.assert_array_equal(*(some[np.lexsort(some.T)] for some in rows))
    # v1.0's descriptors are published, v1.1's have to be extracted again
    for version in ("1.0", "1.1"):
        adapter = Aachen(AachenOptions(version=version, reference_model=True))
        write_official(adapter.read(root), tmp_path / version)
        reference = KaptureFolder(tmp_path / version / "reference")
        reference.validate()
        assert bool(reference.types("descriptors")) == (version == "1.0")


@pytest.mark.slow
def test_points_lie_on_what_the_images_show(root: Path) -> None:
    model = pycolmap.Reconstruction(str(root / "3D-models/aachen_v_1_1"))
    assert model.num_points3D() > 500
    assert model.compute_mean_track_length() >= 3
    model.update_point_3d_errors()
    assert 0.05 < model.compute_mean_reprojection_error() < 1.0
    # the world itself says how far each point is
    frames = {frame.name: frame for frame in build_aachen_frames(OPTIONS).mapping()}
    place = build_place(OPTIONS.world(), 0)
    errors = []
    for image in model.images.values():
        frame = frames[image.name]
        surfaces = place.surfaces.joined(moving_object_surfaces(frame.moving_objects))
        cam_from_place = frame.cam_from_world @ place.place_from_world.inverse()
        grid = sample_grid(frame.camera, 1)
        depth = depth_map(visible_surfaces(surfaces, cam_from_place, grid))
        pose = in_frame([frame], OFFICIAL_FROM_WORLD)[0].cam_from_world
        for point2d in image.points2D:
            if point2d.has_point3D():
                point = model.points3D[point2d.point3D_id].xyz
                column, row = point2d.xy.astype(int)
                z = pose.apply(point[None])[0, 2]
                errors.append(abs(depth[row, column] - z) / z)
    assert len(errors) > 2000
    assert np.median(errors) < 0.01
    # what is not at an edge of something is where it seems to be
    assert np.quantile(errors, 0.9) < 0.05


@pytest.mark.slow
def test_robotcars_models_share_a_database(tmp_path: Path) -> None:
    street = {"num_locations": 1, "stops_per_location": 8, "moments_per_condition": 2}
    options = RobotCarTwinOptions(**street, size_px=128, supersampling=1, model_features=True)
    RobotCarTwin(options).write(tmp_path / "root")
    observations = []
    for model in ("merged", "individual"):
        out, adapter = tmp_path / model, RobotCarOptions(model=model, reference_model=True)
        write_official(RobotCar(adapter).read(tmp_path / "root"), out)
        reference = KaptureFolder(out / "reference")
        # features and models fit each other, or the import would refuse them
        reference.validate()
        assert reference.types("descriptors") == ["sift"]
        seen = reference.observations()["sift"]
        observations.append((seen.point_ids, seen.image_ids, seen.keypoint_ids))
        assert len(seen) > 300
    np.testing.assert_array_equal(observations[0], observations[1])
    with ColmapDatabase(tmp_path / "root/3D-models/overcast-reference.db") as database:
        assert len(database.images) == 24
        assert all(name.endswith(".png") for name in database.images)
