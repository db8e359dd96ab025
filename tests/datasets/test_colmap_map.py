"""COLMAP models and databases as kapture maps, read by kapture and compared with pycolmap."""

from __future__ import annotations

import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture
import kapture.io.csv
import kapture.io.features
import numpy as np
import pytest
from camera_models import CAMERAS
from kapture.converter.colmap.database import COLMAPDatabase
from PIL import Image

from megloc_kapture.datasets.colmap_map import (
    ColmapFolders,
    ColmapReconstruction,
    find_colmap,
    is_colmap,
)
from megloc_kapture.datasets.reference_map import ColmapDatabase, write_reference_map
from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.colmap_model import SparsePoints, read_colmap_model
from megloc_kapture.io.kapture import KaptureData, KaptureFolder
from megloc_kapture.pipeline.export import export
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.values import Camera, RigidTransform
from tests.worlds import one_camera

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


@pytest.fixture
def room(colmap_room: Path, tmp_path: Path) -> Path:
    """A copy of the colmap_room that a test may change."""
    return Path(shutil.copytree(colmap_room, tmp_path / "room", symlinks=True))


def import_colmap(source: ColmapFolders, output: Path) -> dict[str, float] | None:
    output.mkdir(exist_ok=True)
    return ColmapReconstruction.read(source).write_map(output)


def imported(source: ColmapFolders, output: Path) -> tuple[KaptureFolder, dict[str, float]]:
    counts = import_colmap(source, output)
    assert counts is not None
    folder = KaptureFolder(output)
    folder.validate()
    return folder, counts


def execute(room: Path, statement: str, *values: Any) -> None:
    with sqlite3.connect(room / "database.db") as connection:
        connection.execute(statement, values)
    connection.close()


def synthetic(root: Path) -> Any:
    """Write COLMAP's synthetic scene: rigs of three cameras, of every model that kapture has."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 5, 3, 2
    options.num_points3D, options.track_length = 60, 6
    (root / "sparse").mkdir(parents=True)
    database = pycolmap.Database.open(root / "database.db")
    made = pycolmap.synthesize_dataset(options, database)
    models = [(camera.model, camera.params) for camera in CAMERAS.values()]
    models += [("SIMPLE_FISHEYE", (500.0, 321, 238.5)), ("FISHEYE", (500.0, 510, 321, 238.5))]
    for (_, camera), (model, params) in zip(sorted(made.cameras.items()), models * 2, strict=False):
        camera.model, camera.params = getattr(pycolmap.CameraModelId, model), params
        camera.width, camera.height = 640, 480
        database.update_camera(camera)
    database.close()
    for number, point in enumerate(made.points3D.values()):
        point.color = np.array([number, 100, 200], np.uint8)
    made.write_binary(root / "sparse")
    return made


def test_poses_rigs_and_projections_equal_those_of_colmap(tmp_path: Path) -> None:
    truth = synthetic(tmp_path / "ws")
    folder, counts = imported(find_colmap(tmp_path / "ws"), tmp_path / "map")
    assert counts["images"] == 30 and counts["points"] == len(truth.points3D)
    theirs = kapture.io.csv.kapture_from_dir(str(tmp_path / "map"))
    data, xyz = folder.read(), folder.points3d()[:, :3]
    seen = folder.observations()["sift"]
    points = np.array([point.xyz for _, point in sorted(truth.points3D.items())])
    np.testing.assert_allclose(xyz, points, rtol=0, atol=1e-9)
    colours = [point.color for _, point in sorted(truth.points3D.items())]
    np.testing.assert_array_equal(folder.points3d()[:, 3:], colours)
    order = {point_id: row for row, point_id in enumerate(sorted(truth.points3D))}
    assert theirs.rigs is not None and len({rig for rig, _ in theirs.rigs.key_pairs()}) == 5
    for image in truth.images.values():
        moment, sensor = data.record_of(image.name)
        assert moment == image.frame_id
        # as read by kapture: the pose of the camera, and the same through the rig
        pose, expected = theirs.trajectories[moment, sensor], image.cam_from_world()
        np.testing.assert_allclose(pose.r_raw, np.roll(expected.rotation.quat, 1), atol=1e-9)
        np.testing.assert_allclose(pose.t_raw, expected.translation, rtol=0, atol=1e-9)
        rig = theirs.rigs[f"rig{image.frame.rig_id}", sensor]
        through = pycolmap.Rigid3d(pycolmap.Rotation3d(np.roll(rig.r_raw, -1)), np.ravel(rig.t_raw))
        through = through * image.frame.rig_from_world
        np.testing.assert_allclose(through.matrix(), expected.matrix(), rtol=0, atol=1e-9)
        # what the map observes, projected by our camera, against COLMAP's projection
        rows = seen.image_ids == seen.image_names.index(image.name)
        observed = xyz[seen.point_ids[rows]]
        ours = project(data.camera_of(image.name), data.poses()[image.name], observed)
        at = truth.cameras[image.camera_id].img_from_cam(expected * observed)
        np.testing.assert_allclose(ours, at, rtol=0, atol=1e-6)
        stored = folder.keypoints("sift").read(image.name)
        np.testing.assert_allclose(stored, [p.xy for p in image.points2D], rtol=0, atol=1e-3)
        ids = set(zip(seen.point_ids[rows], seen.keypoint_ids[rows], strict=True))
        tracks = ((p.point3D_id, k) for k, p in enumerate(image.points2D) if p.has_point3D())
        assert ids == {(order[point_id], k) for point_id, k in tracks}


def test_a_map_with_the_features_of_the_database_has_the_observations_of_the_model(
    colmap_room: Path, tmp_path: Path
) -> None:
    source = find_colmap(colmap_room)
    assert source.database == colmap_room / "database.db"
    folder, counts = imported(source, tmp_path / "map")
    model = pycolmap.Reconstruction(colmap_room / "sparse" / "0")
    assert counts["points"] == len(model.points3D)
    assert counts["observations"] == model.compute_num_observations()
    with sqlite3.connect(colmap_room / "database.db") as database:
        rows = database.execute("SELECT SUM(rows) FROM keypoints").fetchone()[0]
    assert counts["keypoints"] == rows
    assert folder.descriptors("sift").names == folder.read().image_names()
    assert sorted(p.name for p in (tmp_path / "map").iterdir()) == ["reconstruction", "sensors"]
    link = tmp_path / "map" / "sensors" / "records_data"
    assert link.readlink() == (colmap_room / "images").resolve()
    opened = KaptureMap.open(tmp_path / "map")
    assert opened.fault() is None and opened.pixel_origin.intrinsics == "corner"


def test_without_a_database_features_are_extracted_again(colmap_room: Path, tmp_path: Path) -> None:
    source = replace(find_colmap(colmap_room), database=None)
    folder, counts = imported(source, tmp_path / "map")
    assert counts["share_found_again"] > 0.99
    assert folder.descriptors("sift").names == folder.read().image_names()


def write_type(room: Path, kind: int, size: int) -> None:
    with sqlite3.connect(room / "database.db") as connection:
        images = connection.execute("SELECT image_id, rows FROM keypoints").fetchall()
    connection.close()
    for image_id, rows in images:
        content = np.full((rows, size // 4), 0.25, "<f4").tobytes()
        change = "UPDATE descriptors SET type = ?, cols = ?, data = ? WHERE image_id = ?"
        execute(room, change, kind, size, content, image_id)


@pytest.mark.parametrize(
    ("kind", "local_type", "dtype", "size", "extractor"),
    [
        (pycolmap.FeatureExtractorType.ALIKED_N16ROT, "aliked-n16rot", np.float32, 128, "aliked"),
        (3, "loma-b", np.float32, 128, None),
        (99, "colmap-99", np.uint8, 512, None),
    ],
)
def test_types_of_features_are_named_after_their_extractor(
    room: Path, tmp_path: Path, kind: Any, local_type: str, dtype: Any, size: int, extractor: Any
) -> None:
    write_type(room, int(kind), 512)
    folder, _ = imported(find_colmap(room), tmp_path / "map")
    config = folder.descriptors(local_type).config
    assert (config.dtype, config.dsize, config.keypoints_type) == (dtype, size, local_type)
    plugin = KaptureMap.open(tmp_path / "map").keypoints[local_type].extractor()
    assert (plugin and plugin.name) == extractor
    if plugin:
        assert plugin.options == {"weights": local_type}


def rename(room: Path, names: dict[str, str]) -> None:
    model = pycolmap.Reconstruction(room / "sparse" / "0")
    for image in model.images.values():
        if image.name in names:
            new = names[image.name]
            (room / "images" / new).parent.mkdir(exist_ok=True)
            (room / "images" / image.name).rename(room / "images" / new)
            execute(room, "UPDATE images SET name = ? WHERE name = ?", new, image.name)
            image.name = new
    model.write_binary(room / "sparse" / "0")


def test_names_that_kapture_cannot_hold_are_changed(room: Path, tmp_path: Path) -> None:
    names = {"0000.jpg": "my photos/a, b.jpg", "0002.jpg": "#c d.jpg", "0003.jpg": " e.jpg"}
    rename(room, names)
    folder, _ = imported(find_colmap(room), tmp_path / "map")
    written = {"my photos/a_ b.jpg": names["0000.jpg"], "_c d.jpg": "#c d.jpg", "_e.jpg": " e.jpg"}
    theirs = kapture.io.csv.kapture_from_dir(str(tmp_path / "map"))
    listed = {name for _, _, name in kapture.flatten(theirs.records_camera)}
    assert listed == set(folder.read().image_names()) and set(written) <= listed
    assert theirs.descriptors is not None and theirs.descriptors["sift"] == listed
    for new, old in written.items():
        assert folder.image_path(new).samefile(room / "images" / old)
    rename(room, {names["0000.jpg"]: "a,b.jpg", "0005.jpg": "a_b.jpg"})
    with pytest.raises(DataError, match=r"'a,b.jpg' and 'a_b.jpg' would both be 'a_b.jpg'"):
        import_colmap(find_colmap(room), tmp_path / "other")


def test_images_and_database_are_searched_near_the_model(
    room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = room / "sparse" / "0"
    expected = ColmapFolders(model, room / "images", room / "database.db")
    for path in (room, room / "sparse", model):
        assert is_colmap(path) and find_colmap(path) == expected
    assert not is_colmap(room / "images") and not is_colmap(room / "none")
    # given folders take precedence
    (room / "other").mkdir()
    assert find_colmap(room, images=room / "other") == replace(expected, images=room / "other")
    # the layout of image_undistorter
    (room / "dense").mkdir()
    (room / "dense" / "sparse").symlink_to(model)
    assert find_colmap(room / "dense") == ColmapFolders(room / "dense" / "sparse", None, None)
    monkeypatch.chdir(room / "sparse")
    for here in ("0", "."):
        relative = find_colmap(Path(here))
        assert relative.images is not None and relative.images.samefile(room / "images")


def test_ambiguous_and_missing_models_are_refused(room: Path) -> None:
    model = room / "sparse" / "0"
    shutil.copytree(model, room / "sparse" / "1")
    shutil.copytree(model, room / "stored")
    (room / "stored" / "images").write_text("../images")
    for path, given, message in (
        (room, {}, "several models, give one of them: sparse/0, sparse/1"),
        (room / "images", {}, "images: no COLMAP model: neither images.bin nor"),
        (room.parent, {}, "no COLMAP model: .*; there is one in .*room/sparse/0"),
        (room / "none", {}, "none: no such folder; give the folder of a COLMAP model"),
        (room / "stored", {}, "stored: the folder of its images is missing; .*stored/images is a"),
        (model, {"images": room / "none"}, "none: no such folder of images"),
        (model, {"database": room / "images"}, "images: no such database"),
    ):
        with pytest.raises(DataError, match=message):
            find_colmap(path, **given)


def test_a_model_without_descriptors_and_images_can_be_viewed_and_exported(
    room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = ColmapFolders(find_colmap(room).model, None, None)
    folder, counts = imported(source, tmp_path / "map")
    model = read_colmap_model(source.model)
    assert counts["observations"] == len(model.points.image_ids) > 0
    np.testing.assert_array_equal(folder.points3d()[:, :3], model.points.xyz)
    assert "viewed and exported; to localize in it, `megloc" in caplog.text
    assert export("ply", tmp_path / "scene.ply", map=folder.root) == len(model.images)
    with pytest.raises(DataError, match="lack descriptors: .*colmap. with --database or --images"):
        Localizer(KaptureMap.open(folder.root))


def test_without_images_that_are_needed_the_import_is_refused(room: Path, tmp_path: Path) -> None:
    source, output = replace(find_colmap(room), database=None), tmp_path / "map"
    (room / "images" / "0003.jpg").rename(room / "images" / "0003.png")
    message = r"images: 1 of the model's 7 images are not here, .* 0003.jpg \(but 0003.png is\)"
    with pytest.raises(DataError, match=message):
        import_colmap(source, output)
    assert list(output.iterdir()) == []


def test_a_database_that_does_not_fit_may_be_set_aside(room: Path, tmp_path: Path) -> None:
    execute(room, "UPDATE images SET name = 'images/' || name")
    with pytest.raises(
        DataError, match=r"database.db: the database has no image '000.*; give .*or rename"
    ):
        import_colmap(find_colmap(room), tmp_path / "map")


def test_a_missing_image_is_tolerated_where_the_database_has_its_features(
    room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before, counts = imported(find_colmap(room), tmp_path / "before")
    (room / "images" / "0003.jpg").unlink()
    after, again = imported(find_colmap(room), tmp_path / "map")
    assert again == counts
    assert "1 of the model's 7 images are not here, the first is 0003.jpg" in caplog.text
    descriptors = (folder.descriptors("sift").read("0003.jpg") for folder in (before, after))
    np.testing.assert_array_equal(*descriptors)


def test_cameras_and_keypoints_are_scaled_to_smaller_images(
    room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole, _ = imported(find_colmap(room), tmp_path / "whole")
    for path in [path for path in (room / "images").rglob("*") if path.is_file()]:
        with Image.open(path) as image:
            half = image.resize((image.width // 2, image.height // 2))
        path.unlink()  # may be a link into the shared scene
        half.save(path)
    halved, _ = imported(find_colmap(room), tmp_path / "half")
    assert f"{room / 'images'}: 1 cameras are scaled to their images" in caplog.text
    name = halved.read().image_names()[0]
    large, small = whole.read().camera_of(name), halved.read().camera_of(name)
    assert (small.width, small.height) == (large.width // 2, large.height // 2)
    np.testing.assert_allclose(small.params, np.array(large.params) / 2)
    np.testing.assert_allclose(
        halved.keypoints("sift").read(name), whole.keypoints("sift").read(name) / 2
    )
    halved.validate(deep=True)
    Image.new("RGB", (50, 50)).save(room / "images" / name)
    with pytest.raises(DataError, match=f"{room}.*{name}.*50x50, its camera says.*--images"):
        imported(find_colmap(room), tmp_path / "third")


def test_features_of_a_model_that_are_not_available(
    room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = find_colmap(room)
    model: Any = pycolmap.Reconstruction(source.model)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + [5.3, 2.6]  # nowhere near SIFT's keypoints
    model.write_binary(source.model)
    assert import_colmap(replace(source, database=None), tmp_path / "map") is None
    assert "sparse/0: the model has no descriptors" in caplog.text
    model.delete_all_points2D_and_points3D()
    model.write_binary(source.model)
    assert import_colmap(find_colmap(room), tmp_path / "none") is None
    assert "sparse/0: the model has no points" in caplog.text
    model.add_point3D(np.zeros(3), pycolmap.Track(), np.zeros(3, np.uint8))  # of a point cloud
    model.write_binary(source.model)
    for database in (None, source.database):
        assert import_colmap(replace(source, database=database), tmp_path / "cloud") is None
    assert "sparse/0: the model has points without tracks" in caplog.text
    with pytest.raises(DataError, match="points without tracks; .* give its images .*--images"):
        import_colmap(replace(source, images=None), tmp_path / "blind")


def test_an_error_names_the_image_behind_a_temporary_link(room: Path, tmp_path: Path) -> None:
    image = room / "images" / "0003.jpg"
    content = image.read_bytes()
    image.unlink()  # may be a link into the shared scene
    image.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match="truncated") as caught:
        import_colmap(replace(find_colmap(room), database=None), tmp_path / "map")
    assert caught.value.path == image


# unsorted, with an image that is not imported
NAMES = ("db/b.jpg", "db/a.jpg", "gone/c.jpg", "db/d.jpg")
# point, image, feature, x, y
ROWS = [
    (0, 0, 900, 1, 2),
    (0, 1, 7, 3, 4),
    (0, 2, 3, 0, 0),
    (0, 0, 4, 5, 6),  # twice in one image
    (1, 0, 4, 5, 6),  # a feature that sees two points
    (1, 1, 7, 3, 4),
    (1, 1, 7, 3, 4),  # the same again
    (3, 1, 2, 7, 8),
]


def points() -> SparsePoints:
    table = np.array(ROWS)
    return SparsePoints(
        np.arange(12.0).reshape(4, 3) / 7,
        np.arange(12, dtype=np.uint8).reshape(4, 3),
        table[:, 0],
        table[:, 1].astype(np.int32),
        table[:, 2].astype(np.int32),
        table[:, 3:].astype(np.float32),
    )


def data() -> KaptureData:
    names = ("db/a.jpg", "db/b.jpg", "db/d.jpg")
    return one_camera(names, RigidTransform.identity(), camera=Camera.pinhole(64, 48, 50))


def keypoints_by_kapture(folder: Path, image: str) -> Any:
    path = kapture.io.features.get_keypoints_fullpath("sift", str(folder), image)
    return kapture.io.features.image_keypoints_from_file(path, np.float32, 2)


def test_kapture_reads_the_points_and_observations_of_the_model(tmp_path: Path) -> None:
    photographs, output = tmp_path / "images", tmp_path / "reference"
    photographs.mkdir()
    counts = write_reference_map(output, data(), {"": photographs}, NAMES, points())
    assert counts == {"images": 3, "keypoints": 4, "points": 4, "observations": 6}

    read = kapture.io.csv.kapture_from_dir(str(output))
    assert (output / "sensors/records_data").resolve() == photographs
    images = sorted(name for *_, name in kapture.flatten(read.records_camera))
    assert images == ["db/a.jpg", "db/b.jpg", "db/d.jpg"]
    assert len(read.trajectories) == 3
    table = read.points3d.as_array()
    assert np.array_equal(table[:, :3], np.arange(12.0).reshape(4, 3) / 7)
    assert np.array_equal(table[:, 3:], np.arange(12.0).reshape(4, 3))
    # keypoints are numbered without gaps, in the order of the model's ids
    assert keypoints_by_kapture(output, "db/b.jpg").tolist() == [[5, 6], [1, 2]]
    assert keypoints_by_kapture(output, "db/a.jpg").tolist() == [[7, 8], [3, 4]]
    assert read.keypoints["sift"] == {"db/a.jpg", "db/b.jpg"}
    seen = {point: read.observations[point, "sift"] for point in read.observations}
    assert seen == {
        0: [("db/b.jpg", 1), ("db/a.jpg", 1), ("db/b.jpg", 0)],
        1: [("db/b.jpg", 0), ("db/a.jpg", 1)],
        3: [("db/a.jpg", 0)],
    }


def write_database(
    path: Path, names: dict[str, int], *, shift: float = 0.0, descriptors: int | None = None
) -> dict[str, tuple[Any, Any]]:
    """Write features that agree with ROWS, of the schema before version 4; counts by name."""
    rng = np.random.default_rng(1)
    database = COLMAPDatabase.connect(str(path))
    database.create_tables()
    camera_id = database.add_camera(1, 64, 48, np.array([50.0, 50, 32, 24]))
    written = {}
    for name, count in names.items():
        keypoints = rng.uniform(0, 48, (count, 4)).astype(np.float32)
        for _, image, feature, x, y in ROWS:
            if NAMES[image].split(".")[0] == name.split(".")[0] and feature < count:
                keypoints[feature, :2] = (x + shift, y)
        values = rng.integers(0, 256, (descriptors or count, 128)).astype(np.uint8)
        image_id = database.add_image(name, camera_id)
        database.add_keypoints(image_id, keypoints)
        database.add_descriptors(image_id, values)
        written[name] = (keypoints, values)
    database.commit()
    database.close()
    return written


# another suffix than in the kapture, as RobotCar's database has it; one image more
FEATURES = {"db/a.png": 10, "db/b.png": 901, "db/d.png": 0, "other.png": 2}


def test_all_features_of_a_database_keep_their_numbers(tmp_path: Path) -> None:
    database = tmp_path / "all of it?#100%.db"
    written = write_database(database, FEATURES, shift=0.01)
    before, output = database.read_bytes(), tmp_path / "map"
    counts = write_reference_map(output, data(), {}, NAMES, points(), database=database)
    assert database.read_bytes() == before
    assert counts == {"images": 3, "keypoints": 911, "points": 4, "observations": 6}
    folder = KaptureFolder(output)
    folder.validate()
    for name in ("a", "b"):
        keypoints, descriptors = written[f"db/{name}.png"]
        read = folder.keypoints("sift").read(f"db/{name}.jpg")
        assert np.array_equal(read, keypoints[:, :2])
        assert np.array_equal(folder.descriptors("sift").read(f"db/{name}.jpg"), descriptors)
    config = folder.descriptors("sift").config
    assert (config.keypoints_type, config.metric_type) == ("sift", "L2")
    # images without keypoints have empty arrays
    assert folder.keypoints("sift").names == ["db/a.jpg", "db/b.jpg", "db/d.jpg"]
    assert folder.keypoints("sift").read("db/d.jpg").shape == (0, 2)
    assert folder.descriptors("sift").read("db/d.jpg").shape == (0, 128)
    theirs = kapture.io.csv.kapture_from_dir(str(output))
    assert theirs.observations[0, "sift"] == [("db/b.jpg", 900), ("db/a.jpg", 7), ("db/b.jpg", 4)]


@pytest.mark.parametrize(
    ("names", "options", "match"),
    [
        ({"db/a.png": 10}, {}, "has no image 'db/b.jpg'"),
        ({**FEATURES, "db/b.png": 900}, {}, "does not fit this model: the keypoints of 'db/b.png'"),
        (FEATURES, {"shift": 1.5}, "does not fit this model: the keypoints of 'db/a.png'"),
        (FEATURES, {"descriptors": 9}, r"descriptors of 'db/a.jpg' have the shape \(9, 128\)"),
    ],
)
def test_the_database_of_another_model_is_refused(
    tmp_path: Path, names: dict[str, int], options: dict[str, Any], match: str
) -> None:
    path = tmp_path / "d.db"
    write_database(path, names, **options)
    with pytest.raises(DataError, match=match) as caught:
        write_reference_map(tmp_path / "m", data(), {}, NAMES, points(), database=path)
    assert str(caught.value).startswith(f"{path}: ")


def test_the_exact_name_takes_precedence_over_another_suffix(tmp_path: Path) -> None:
    names = {"db/a.jpg": 10, "db/a.png": 10, "db/b.jpg": 901}
    written = write_database(tmp_path / "d.db", names)
    write_reference_map(tmp_path, data(), {}, NAMES, points(), database=tmp_path / "d.db")
    # an image that is not in the database
    assert KaptureFolder(tmp_path).descriptors("sift").read("db/d.jpg").shape == (0, 128)
    read = KaptureFolder(tmp_path).keypoints("sift").read("db/a.jpg")
    assert np.array_equal(read, written["db/a.jpg"][0][:, :2])


def test_backslashes_in_a_database_separate_folders(tmp_path: Path) -> None:
    write_database(tmp_path / "d.db", {"db\\a.jpg": 10})
    with ColmapDatabase(tmp_path / "d.db") as database:
        assert list(database.images) == ["db/a.jpg"]


def test_zeros_in_a_database_are_no_descriptors(tmp_path: Path) -> None:
    write_database(tmp_path / "d.db", FEATURES)
    with sqlite3.connect(tmp_path / "d.db") as connection:
        connection.execute("UPDATE descriptors SET data = zeroblob(length(data))")
    connection.close()
    with ColmapDatabase(tmp_path / "d.db") as database:
        assert database.feature_type() is None


def test_a_database_that_is_still_being_written_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    write_database(path, FEATURES)
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode = WAL")  # as COLMAP writes
    writer.execute("UPDATE images SET name = 'new.jpg' WHERE image_id = 1")
    writer.commit()
    assert (tmp_path / "d.db-wal").stat().st_size > 0
    with pytest.raises(DataError, match=r"d\.db: the database was not closed, .* d\.db-wal"):
        ColmapDatabase(path)
    writer.close()
    with ColmapDatabase(path) as database:
        assert "new.jpg" in database.images
        assert list(tmp_path.iterdir()) == [path]  # no files of SQLite


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("UPDATE images SET name = '../a' WHERE image_id = 1", "leads out of its folder"),
        ("UPDATE keypoints SET rows = 4", "not a COLMAP database"),
        ("DROP TABLE images", "no such table: images"),
    ],
)
def test_a_damaged_database_is_named(tmp_path: Path, statement: str, message: str) -> None:
    path = tmp_path / "d.db"
    write_database(path, FEATURES)
    with sqlite3.connect(path) as connection:
        connection.execute(statement)
    connection.close()
    with pytest.raises(DataError, match=rf"d\.db: .*{message}"), ColmapDatabase(path) as database:
        database.keypoints("db/a.png")
