"""The twins' models of image features: as COLMAP makes them, and good to localize in."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.aachen.adapter import Aachen, AachenOptions
from megloc_kapture.datasets.formats.colmap_database import ColmapDatabase
from megloc_kapture.datasets.official import write_official
from megloc_kapture.datasets.robotcar.adapter import RobotCar, RobotCarOptions
from megloc_kapture.datasets.synthetic.aachen_shots import build_aachen_shots, official
from megloc_kapture.datasets.synthetic.aachen_twin import AachenTwinOptions, write_aachen_twin
from megloc_kapture.datasets.synthetic.movers import mover_surfaces
from megloc_kapture.datasets.synthetic.places import build_place
from megloc_kapture.datasets.synthetic.render import depth_map, sample_grid, visible_surfaces
from megloc_kapture.datasets.synthetic.robotcar_twin import (
    RobotCarTwinOptions,
    write_robotcar_twin,
)
from megloc_kapture.features.colmap_sift import ColmapSift
from megloc_kapture.io.kapture import ImagePair, KaptureFolder
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours
from megloc_kapture.matching.verification import TwoViewOptions
from megloc_kapture.stages.given_map import given_map, has_descriptors
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.matches import match_pairs

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

pytestmark = pytest.mark.slow

OPTIONS = AachenTwinOptions(
    num_places=1,
    stations_per_place=7,
    sequence_images=3,
    day_queries=2,
    night_queries=1,
    additional_night_queries=1,
    width=256,
    height=192,
    supersampling=1,
    model_features=True,
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("aachen")
    write_aachen_twin(root, OPTIONS)
    return root


def test_the_database_is_what_colmap_extracts(root: Path, tmp_path: Path) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    with ColmapDatabase(root / "aachen.db") as ours:
        assert len(ours.images) == 21  # without the sequence, which v1.0 does not have
        names = sorted(ours.images)[:4]
        pycolmap.extract_features(
            tmp_path / "theirs.db",
            root / "images_upright",
            image_names=names,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        with ColmapDatabase(tmp_path / "theirs.db") as theirs:
            assert sorted(theirs.images) == names
            for name in names:
                rows = [
                    np.hstack([found.keypoints(name), found.descriptors(name)])
                    for found in (ours, theirs)
                ]
                assert len(rows[0]) > 300
                a, b = (some[np.lexsort(some.T)] for some in rows)
                np.testing.assert_array_equal(a, b)


def test_points_lie_on_what_the_images_show(root: Path) -> None:
    model = pycolmap.Reconstruction(str(root / "3D-models/aachen_v_1_1"))
    assert model.num_points3D() > 500
    assert model.compute_mean_track_length() >= 3
    model.update_point_3d_errors()
    assert 0.05 < model.compute_mean_reprojection_error() < 1.0
    # the world itself says how far each point is
    shots = {shot.name: shot for shot in build_aachen_shots(OPTIONS).mapping()}
    place = build_place(OPTIONS.world(), 0)
    errors = []
    for image in model.images.values():
        shot = shots[image.name]
        surfaces = place.surfaces.joined(mover_surfaces(shot.movers))
        cam_from_place = shot.cam_from_world @ place.place_from_world.inverse()
        grid = sample_grid(shot.camera, 1)
        depth = depth_map(visible_surfaces(surfaces, cam_from_place, grid))
        pose = official([shot])[0].cam_from_world
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


def localized(
    query: KaptureFolder, made: KaptureFolder, output: Path
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Rotation and centre of the queries that COLMAP's PnP finds, by matches with all images."""
    seen = made.observations()["sift"]
    xyz = made.points3d()[:, :3]
    index = MapIndex.build(xyz, seen.image_names, seen.image_ids, seen.keypoint_ids, seen.point_ids)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed = 0
    names, images = query.read().image_names(), sorted(made.read().poses())
    pairs = [ImagePair(name, image, 1.0) for name in names for image in images]
    match_pairs(query, made, pairs, "sift", NearestNeighbours(), TwoViewOptions(), output)
    matches = KaptureFolder(made.root, features_dirs=[output]).matches("sift")
    for name in names:
        keypoints = query.keypoints("sift").read(name)
        px, points = [], []
        for image in images:
            if (name, image) in matches:
                rows, _ = matches.read(name, image)
                found = index.points_of_keypoints(image, rows[:, 1])
                px.append(keypoints[rows[found >= 0, 0]])
                points.append(xyz[found[found >= 0]])
        camera = query.read().camera_of(name)
        result = pycolmap.estimate_and_refine_absolute_pose(
            np.concatenate(px).astype(np.float64),
            np.concatenate(points),
            pycolmap.Camera(
                model=camera.model,
                width=camera.width,
                height=camera.height,
                params=list(camera.params),
            ),
            options,
        )
        if result is None:  # a night's
            continue
        rotation = result["cam_from_world"].rotation.matrix()
        yield name, rotation, -rotation.T @ result["cam_from_world"].translation


@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_queries_localize_in_the_given_map(root: Path, tmp_path: Path, version: str) -> None:
    dataset = Aachen(AachenOptions(version=version, reference_model=True)).read(root)
    write_official(dataset, tmp_path)
    reference = KaptureFolder(tmp_path / "reference")
    # v1.0's are published, v1.1's have to be extracted again
    assert has_descriptors(reference) == (version == "1.0")
    wanted = [KaptureFolder(tmp_path / "query")]
    if version == "1.1":
        wanted.append(KaptureFolder(tmp_path / "mapping"))
    extract_local_features(wanted, ColmapSift(), tmp_path)
    mapping = KaptureFolder(tmp_path / "mapping", features_dirs=[tmp_path])
    counts = given_map(reference, mapping, tmp_path / "map")
    assert counts["found_again"] == 1.0
    assert counts["points"] == len(reference.points3d())
    made = KaptureFolder(tmp_path / "map")
    made.validate()
    query = KaptureFolder(tmp_path / "query", features_dirs=[tmp_path])
    truth = KaptureFolder(root / "ground_truth/query").read().poses()
    results = localized(query, made, tmp_path / "matches")
    found = {name: pose for name, *pose in results if name.startswith("query/day")}
    assert len(found) == OPTIONS.day_queries
    for name, (rotation, centre) in found.items():
        turned = Rotation.from_matrix(rotation @ truth[name].rotation_matrix().T)
        assert np.linalg.norm(centre - truth[name].center()) < 0.25
        assert np.degrees(turned.magnitude()) < 2.0


def test_robotcars_models_share_a_database(tmp_path: Path) -> None:
    options = RobotCarTwinOptions(
        num_locations=1,
        stops_per_location=8,
        moments_per_condition=2,
        size_px=128,
        supersampling=1,
        model_features=True,
    )
    write_robotcar_twin(tmp_path / "root", options)
    observations = []
    for model in ("merged", "individual"):
        out = tmp_path / model
        dataset = RobotCar(RobotCarOptions(model=model, reference_model=True)).read(
            tmp_path / "root"
        )
        write_official(dataset, out)
        reference = KaptureFolder(out / "reference")
        # features and models fit each other, or the import would refuse them
        reference.validate()
        assert has_descriptors(reference)
        seen = reference.observations()["sift"]
        observations.append((seen.point_ids, seen.image_ids, seen.keypoint_ids))
        assert len(seen) > 300
    np.testing.assert_array_equal(observations[0], observations[1])
    with ColmapDatabase(tmp_path / "root/3D-models/overcast-reference.db") as database:
        assert len(database.images) == 24
        assert all(name.endswith(".png") for name in database.images)
