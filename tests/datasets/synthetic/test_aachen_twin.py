"""Aachen Day-Night's twin: its layout, truth and import, looked at with kapture and COLMAP."""

from __future__ import annotations

import hashlib
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import kapture
import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir
from kapture.io.features import get_keypoints_fullpath, image_keypoints_from_file
from PIL import Image
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.aachen.adapter import Aachen, AachenOptions
from megloc_kapture.datasets.official import write_official
from megloc_kapture.datasets.synthetic.aachen_shots import AachenShots, build_aachen_shots
from megloc_kapture.datasets.synthetic.aachen_twin import AachenTwinOptions, write_aachen_twin

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

SMALL = AachenTwinOptions(
    num_places=2,
    stations_per_place=7,
    sequence_images=3,
    day_queries=4,
    night_queries=2,
    additional_night_queries=2,
    width=160,
    height=120,
    supersampling=1,
    points_per_image=60,
)
TINY = SMALL.model_copy(
    update={"num_places": 1, "day_queries": 1, "night_queries": 1, "additional_night_queries": 1}
)
NUM_DATABASE, NUM_SEQUENCE = 42, 6

Pose = tuple[Rotation, np.ndarray]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("aachen") / "Aachen-Day-Night"
    counts = write_aachen_twin(root, SMALL)
    assert counts == {
        "places": 2,
        "mapping images": NUM_DATABASE + NUM_SEQUENCE,
        "query images": 8,
    }
    return root


@pytest.fixture(scope="module", params=["1.0", "1.1"])
def imported(
    request: pytest.FixtureRequest, root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """What the adapter makes of it, with the reference model."""
    out = tmp_path_factory.mktemp("imported") / request.param
    options = AachenOptions(version=request.param, reference_model=True)
    dataset = Aachen(options).read(root)
    assert dataset.missing is not None
    assert dataset.missing.files == []
    write_official(dataset, out)
    return out


def poses_by_image(folder: Path) -> dict[str, Pose]:
    """``cam_from_world`` as kapture reads it: rotation and camera centre."""
    data = kapture_from_dir(str(folder))
    poses = {}
    for timestamp, sensor, image in kapture.flatten(data.records_camera):
        pose = data.trajectories[timestamp, sensor]
        w, x, y, z = pose.r_raw
        poses[image] = Rotation.from_quat([x, y, z, w]), pose.inverse().t.ravel()
    return poses


def cameras_by_image(folder: Path) -> dict[str, list[str]]:
    data = kapture_from_dir(str(folder))
    return {
        image: data.sensors[sensor].sensor_params
        for _, sensor, image in kapture.flatten(data.records_camera)
    }


def listed(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().split("\n")]


def test_the_import_has_the_poses_of_the_truth(root: Path, imported: Path) -> None:
    for part, truth_part in (("mapping", "mapping"), ("query_gt", "query")):
        found = poses_by_image(imported / part)
        truth = poses_by_image(root / "ground_truth" / truth_part)
        assert found.keys() <= truth.keys()
        assert len(found) > 5
        for name, (rotation, centre) in found.items():
            true_rotation, true_centre = truth[name]
            assert np.linalg.norm(centre - true_centre) < 1e-6
            assert np.degrees((rotation * true_rotation.inv()).magnitude()) < 1e-6
    # far from the origin and turned, as the original
    assert min(np.linalg.norm(centre) for _, centre in found.values()) > 500


def test_the_import_has_the_cameras_of_the_truth(root: Path, imported: Path) -> None:
    for part in ("mapping", "query"):
        found = cameras_by_image(imported / part)
        truth = cameras_by_image(root / "ground_truth" / part)
        for name, params in found.items():
            assert [params[0], *map(float, params[1:])] == [
                truth[name][0],
                *map(float, truth[name][1:]),
            ]
            with Image.open(root / "images_upright" / name) as image:
                assert [str(side) for side in image.size] == params[1:3]
    assert any(params[1] < params[2] for params in cameras_by_image(imported / "mapping").values())


def test_versions(imported: Path) -> None:
    mapping, query = cameras_by_image(imported / "mapping"), cameras_by_image(imported / "query")
    sensors = kapture_from_dir(str(imported / "mapping")).sensors
    num_added = sum(name.startswith("query/night/nexus5x_additional_night/") for name in query)
    if imported.name == "1.0":
        assert all(name.startswith("db/") for name in mapping)
        assert len(mapping) == len(sensors) == NUM_DATABASE
        assert (len(query), num_added) == (6, 0)
    else:
        in_sequences = sum(name.startswith("sequences/") for name in mapping)
        assert in_sequences == NUM_SEQUENCE
        # each sequence has one camera
        assert len(sensors) == NUM_DATABASE + 2
        assert (len(query), num_added) == (8, 2)


def test_points_reproject_in_colmaps_cameras(imported: Path) -> None:
    folder = str(imported / "reference")
    data = kapture_from_dir(folder)
    points = data.points3d.as_array()[:, :3]
    records: dict[str, tuple[int, str]] = {
        image: (timestamp, sensor)
        for timestamp, sensor, image in kapture.flatten(data.records_camera)
    }
    keypoints = {
        image: image_keypoints_from_file(
            get_keypoints_fullpath("sift", folder, image), np.float32, 2
        )
        for image in records
    }
    counts: dict[str, int] = dict.fromkeys(records, 0)
    worst = 0.0
    for point_id in range(len(points)):
        track = data.observations[point_id, "sift"]
        assert len(track) >= 2
        for image, keypoint_id in track:
            timestamp, sensor = records[image]
            model, width, height, *params = data.sensors[sensor].sensor_params
            camera = pycolmap.Camera(
                model=model, width=int(width), height=int(height), params=[*map(float, params)]
            )
            pose = data.trajectories[timestamp, sensor]
            in_camera = pose.transform_points(points[point_id : point_id + 1])[0]
            px = camera.img_from_cam(np.asarray(in_camera))
            worst = max(worst, float(np.abs(px - keypoints[image][keypoint_id]).max()))
            counts[image] += 1
    assert 0 < worst < 1e-3
    assert len(points) > 200
    assert min(counts.values()) > 5


def test_colmap_reads_the_added_model(root: Path) -> None:
    model = pycolmap.Reconstruction(str(root / "3D-models/aachen_v_1_1"))
    assert model.num_reg_images() == NUM_DATABASE + NUM_SEQUENCE
    assert len(model.cameras) == NUM_DATABASE + 2
    model.update_point_3d_errors()
    assert 0 < model.compute_mean_reprojection_error() < 1e-3
    ids = {image.name: image_id for image_id, image in model.images.items()}
    assert sorted(ids, key=lambda name: ids[name]) != sorted(ids)


def test_quirks_of_the_layout(root: Path) -> None:
    models, queries = root / "3D-models", root / "queries"
    rows = [line.split() for line in (models / "aachen_cvpr2018_db.nvm").read_text().split("\n")]
    rows = [row for row in rows if row and row[0].startswith("db/")]
    names = [row[0] for row in rows]
    # numbered without order, the model's order is its own, and so is that of the intrinsics
    numbers = [int(name[3:-4]) for name in names]
    assert numbers != sorted(numbers)
    assert max(numbers) > len(numbers)
    assert (models / "aachen_cvpr2018_db.list.txt").read_text().split() == names
    intrinsics = listed(models / "database_intrinsics.txt")
    assert {row[0] for row in intrinsics if row} == set(names)
    assert [row[0] for row in intrinsics if row] != names
    # the NVM's distortion has the other sign
    k = {row[0]: float(row[-1]) for row in intrinsics if row}
    assert [float(row[-2]) for row in rows] == [-k[name] for name in names]
    assert any(value != 0 for value in k.values())

    day, night = (
        listed(queries / f"{when}_time_queries_with_intrinsics.txt") for when in ("day", "night")
    )
    assert (len(day), len(night)) == (4, 4)  # no line end, so no empty line, at the end
    assert {len(row) for row in day + night} == {8}
    assert {row[1] for row in day} == {"SIMPLE_RADIAL"}
    assert len({tuple(row[2:]) for row in day + night}) == 8  # a camera each
    # the list without intrinsics has line ends
    text = (queries / "day_time_queries_without_intrinsics.txt").read_text()
    assert text == "".join(f"{row[0]}\n" for row in day)
    on_disk = {
        str(path.relative_to(root / "images_upright"))
        for path in (root / "images_upright/query").rglob("*.jpg")
    }
    in_lists = {row[0] for row in day + night}
    assert in_lists < on_disk
    assert len(on_disk - in_lists) == 2
    assert len({name.split("/")[-1] for name in on_disk}) == len(on_disk)
    assert sum("additional" in row[0] for row in night) == 2


def test_version_10_alone(tmp_path: Path) -> None:
    write_aachen_twin(tmp_path, TINY.model_copy(update={"version": "1.0"}))
    assert sorted(path.name for path in (tmp_path / "3D-models").iterdir()) == [
        "aachen_cvpr2018_db.list.txt",
        "aachen_cvpr2018_db.nvm",
        "database_intrinsics.txt",
    ]
    assert not (tmp_path / "images_upright/sequences").exists()
    dataset = Aachen().read(tmp_path)
    assert len(dataset.mapping.records_camera) == 21
    assert len(dataset.query.records_camera) == 2
    assert dataset.remarks == []


@pytest.mark.slow
def test_processes_write_the_same_bytes(root: Path, tmp_path: Path) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        write_aachen_twin(tmp_path, SMALL, executor)
    assert hashes(tmp_path) == hashes(root)


def hashes(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def shots() -> AachenShots:
    return build_aachen_shots(SMALL)


def test_every_image_is_there_once(shots: AachenShots) -> None:
    everything = [*shots.mapping(), *shots.queries(), *shots.unlisted]
    assert len({shot.name for shot in everything}) == len(everything)
    assert not any(shot.bonnet for shot in everything)
    assert {shot.condition for shot in shots.day} == {"day"}
    assert {shot.condition for shot in shots.night + shots.additional_night} == {"night"}
    assert {shot.place for shot in shots.day} == {shot.place for shot in shots.night} == {0, 1}
    # the digits the published lists have
    assert all(float(f"{p:.6g}") == p for shot in shots.day for p in shot.camera.params)


def test_another_seed_is_another_world() -> None:
    one, other = (build_aachen_shots(TINY.model_copy(update={"seed": seed})) for seed in (0, 1))
    assert [shot.name for shot in other.database] != [shot.name for shot in one.database]
    assert other.day[0].cam_from_world != one.day[0].cam_from_world


@pytest.mark.parametrize(
    "wrong", [{"version": "2.0"}, {"num_places": 0}, {"day_queries": 0}, {"colour": "red"}]
)
def test_wrong_options_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        AachenTwinOptions(**wrong)
    assert AachenTwinOptions(version=1.0).version == "1.0"  # type: ignore[arg-type]
