"""COLMAP models as kapture maps, read by kapture's own reader and compared with pycolmap."""

from __future__ import annotations

import os
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture.io.csv
import numpy as np
import pytest
from kapture.converter.colmap.database import COLMAPDatabase
from PIL import Image

from megloc_kapture.datasets.colmap_map import (
    ColmapFolders,
    ColmapReconstruction,
    find_colmap,
    is_colmap,
)
from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.results import Results

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


@pytest.fixture
def own(colmap_room: Path, tmp_path: Path) -> Path:
    """A copy of the colmap_room, to be spoilt."""
    return Path(shutil.copytree(colmap_room, tmp_path / "own", symlinks=True))


def import_colmap(source: ColmapFolders, output: Path) -> dict[str, float] | None:
    output.mkdir(exist_ok=True)
    return ColmapReconstruction.read(source).write_map(output)


def imported(source: ColmapFolders, output: Path) -> tuple[KaptureFolder, dict[str, float]]:
    counts = import_colmap(source, output)
    assert counts is not None
    folder = KaptureFolder(output)
    folder.validate()
    return folder, counts


def execute(own: Path, statement: str, *values: Any) -> None:
    with sqlite3.connect(own / "database.db") as connection:
        connection.execute(statement, values)
    connection.close()


# a camera of every model that kapture has
CAMERAS = {
    "SIMPLE_PINHOLE": (900.0, 640, 480),
    "PINHOLE": (900.0, 905, 640, 480),
    "SIMPLE_RADIAL": (900.0, 640, 480, 0.03),
    "RADIAL": (900.0, 640, 480, 0.03, -0.01),
    "OPENCV": (900.0, 905, 640, 480, 0.03, -0.01, 0.001, 0.002),
    "OPENCV_FISHEYE": (900.0, 905, 640, 480, 0.03, -0.01, 0.001, 0.002),
    "FULL_OPENCV": (900.0, 905, 640, 480, 0.03, -0.01, 0.001, 0.002, 0.01, 0.01, 0.01, 0.01),
    "FOV": (900.0, 905, 640, 480, 0.3),
    "SIMPLE_RADIAL_FISHEYE": (900.0, 640, 480, 0.03),
    "RADIAL_FISHEYE": (900.0, 640, 480, 0.03, -0.01),
    "THIN_PRISM_FISHEYE": (900.0, 905, 640, 480, 0.03, -0.01, 0.001, 0.002, 0.01, 0.01, 0, 0.01),
    "SIMPLE_FISHEYE": (900.0, 640, 480),
    "FISHEYE": (900.0, 905, 640, 480),
}


def synthetic(root: Path, form: str) -> Any:
    """COLMAP's own synthetic scene with rigs of three cameras, each camera of another model."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 5, 3, 2
    options.num_points3D, options.track_length = 60, 6
    (root / "sparse").mkdir(parents=True)
    database = pycolmap.Database.open(root / "database.db")
    made = pycolmap.synthesize_dataset(options, database)
    models = list(CAMERAS.items()) * 2
    for (_, camera), (model, params) in zip(sorted(made.cameras.items()), models, strict=False):
        camera.model, camera.params = getattr(pycolmap.CameraModelId, model), params
        camera.width, camera.height = 1280, 960
        database.update_camera(camera)
    database.close()
    getattr(made, f"write_{form}")(root / "sparse")
    return made


@pytest.mark.parametrize("form", ["text", "binary"])
def test_poses_rigs_and_projections_are_colmap_s(tmp_path: Path, form: str) -> None:
    truth = synthetic(tmp_path / "ws", form)
    folder, counts = imported(find_colmap(tmp_path / "ws"), tmp_path / "map")
    assert counts["images"] == 30 and counts["points"] == len(truth.points3D)
    theirs = kapture.io.csv.kapture_from_dir(str(tmp_path / "map"))
    data, xyz = folder.read(), folder.points3d()[:, :3]
    seen = folder.observations()["sift"]
    points = np.array([point.xyz for _, point in sorted(truth.points3D.items())])
    np.testing.assert_allclose(xyz, points, rtol=0, atol=1e-9)
    order = {point_id: row for row, point_id in enumerate(sorted(truth.points3D))}
    assert theirs.rigs is not None and len({rig for rig, _ in theirs.rigs.key_pairs()}) == 5
    for image in truth.images.values():
        moment, sensor = data.record_of(image.name)
        assert moment == image.frame_id
        # kapture's own reading: the pose of the camera, and the same through the rig
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


@pytest.mark.parametrize("with_database", [True, False])
def test_queries_are_localized(
    colmap_room: Path, scene: Path, tmp_path: Path, with_database: bool
) -> None:
    """With the database's features, or with SIFT extracted again, once."""
    found = find_colmap(colmap_room)
    assert found.database == colmap_room / "database.db"
    source = found if with_database else replace(found, database=None)
    folder, counts = imported(source, tmp_path / "map")
    read = pycolmap.Reconstruction(colmap_room / "sparse" / "0")
    assert counts["points"] == len(read.points3D)
    if with_database:
        assert counts["observations"] == read.compute_num_observations()
        with sqlite3.connect(colmap_room / "database.db") as database:
            rows = database.execute("SELECT SUM(rows) FROM keypoints").fetchone()[0]
        assert counts["keypoints"] == rows
    else:
        assert counts["share_found_again"] > 0.99
    assert folder.descriptors("sift").names == folder.read().image_names()
    assert sorted(p.name for p in (tmp_path / "map").iterdir()) == ["reconstruction", "sensors"]
    link = tmp_path / "map" / "sensors" / "records_data"
    assert os.readlink(link) == str((colmap_room / "images").resolve())
    opened = KaptureMap.open(tmp_path / "map")
    assert opened.fault() is None and opened.pixel_origin.intrinsics == "corner"
    truth = KaptureFolder(scene / "query_gt").read().poses()
    for name, pose in Results(Localizer(opened), scene / "query").items():
        assert pose, (name, pose)
        off = pose.cam_from_world @ truth[name].inverse()
        assert np.linalg.norm(pose.cam_from_world.center() - truth[name].center()) < 0.01
        assert 2 * np.degrees(np.arccos(min(1.0, abs(off.quat_wxyz[0])))) < 0.05


def write_type(own: Path, kind: int, size: int) -> None:
    """Give all descriptors another type and size."""
    with sqlite3.connect(own / "database.db") as connection:
        images = connection.execute("SELECT image_id, rows FROM keypoints").fetchall()
    connection.close()
    for image_id, rows in images:
        content = np.full((rows, size // 4), 0.25, "<f4").tobytes()
        change = "UPDATE descriptors SET type = ?, cols = ?, data = ? WHERE image_id = ?"
        execute(own, change, kind, size, content, image_id)


@pytest.mark.parametrize(
    ("kind", "local_type", "dtype", "size", "extractor"),
    [
        (pycolmap.FeatureExtractorType.ALIKED_N16ROT, "aliked-n16rot", np.float32, 128, "aliked"),
        (pycolmap.FeatureExtractorType.ALIKED_N32, "aliked-n32", np.float32, 128, "aliked"),
        (3, "loma-b", np.float32, 128, None),
        (4, "loma-b128", np.float32, 128, None),
        (-1, "colmap-undefined", np.uint8, 512, None),
        (99, "colmap-99", np.uint8, 512, None),
    ],
)
def test_types_of_features(
    own: Path, tmp_path: Path, kind: Any, local_type: str, dtype: Any, size: int, extractor: Any
) -> None:
    write_type(own, int(kind), 512)
    folder, _ = imported(find_colmap(own), tmp_path / "map")
    config = folder.descriptors(local_type).config
    assert (config.dtype, config.dsize, config.keypoints_type) == (dtype, size, local_type)
    plugin = KaptureMap.open(tmp_path / "map").keypoints[local_type].extractor()
    assert (plugin and plugin.name) == extractor
    if plugin:
        assert plugin.options == {"weights": local_type}


def test_the_database_of_an_older_version(colmap_room: Path, own: Path, tmp_path: Path) -> None:
    """Its schema has no types; a model before version 4 has no rigs."""
    for name in ("rigs.bin", "frames.bin"):
        (own / "sparse" / "0" / name).unlink()
    (own / "database.db").unlink()
    database = COLMAPDatabase.connect(str(own / "database.db"))
    database.create_tables()
    with sqlite3.connect(colmap_room / "database.db") as newer:
        for row in newer.execute("SELECT camera_id, model, width, height, params FROM cameras"):
            database.add_camera(*row[1:4], np.frombuffer(row[4]), camera_id=row[0])
        for image_id, name, camera_id in newer.execute("SELECT * FROM images").fetchall():
            database.add_image(name, camera_id, image_id=image_id)
            for table, dtype in (("keypoints", np.float32), ("descriptors", np.uint8)):
                query = f"SELECT rows, cols, data FROM {table} WHERE image_id = {image_id}"
                rows, columns, content = newer.execute(query).fetchone()
                values = np.frombuffer(content, dtype).reshape(rows, columns)
                getattr(database, f"add_{table}")(image_id, values)
    newer.close()
    database.commit()
    database.close()
    new, _ = imported(find_colmap(colmap_room), tmp_path / "new")
    # that the images are not here changes nothing of it
    old, _ = imported(replace(find_colmap(own), images=None), tmp_path / "old")
    assert not KaptureMap.open(old.root).has_images()
    assert old.read().poses() == new.read().poses()
    for image in new.read().image_names():
        for kind in ("keypoints", "descriptors"):
            a, b = (getattr(folder, kind)("sift").read(image) for folder in (new, old))
            assert np.array_equal(a, b)


def rename(own: Path, names: dict[str, str]) -> None:
    """Give images of a workspace other names, in all of its parts."""
    model = pycolmap.Reconstruction(own / "sparse" / "0")
    for image in model.images.values():
        if image.name in names:
            new = names[image.name]
            (own / "images" / new).parent.mkdir(exist_ok=True)
            (own / "images" / image.name).rename(own / "images" / new)
            execute(own, "UPDATE images SET name = ? WHERE name = ?", new, image.name)
            image.name = new
    model.write_binary(own / "sparse" / "0")


@pytest.mark.parametrize("with_database", [True, False])
def test_names_that_kapture_cannot_hold(own: Path, tmp_path: Path, with_database: bool) -> None:
    names = {"0000.jpg": "my photos/a, b.jpg", "0002.jpg": "#c d.jpg", "0003.jpg": " e.jpg"}
    rename(own, names)
    found = find_colmap(own)
    source = found if with_database else replace(found, database=None)
    folder, _ = imported(source, tmp_path / "map")
    written = {"my photos/a_ b.jpg": names["0000.jpg"], "_c d.jpg": "#c d.jpg", "_e.jpg": " e.jpg"}
    theirs = kapture.io.csv.kapture_from_dir(str(tmp_path / "map"))
    listed = {name for _, _, name in kapture.flatten(theirs.records_camera)}
    assert listed == set(folder.read().image_names()) and set(written) <= listed
    assert theirs.descriptors is not None and theirs.descriptors["sift"] == listed
    for new, old in written.items():
        assert folder.image_path(new).samefile(own / "images" / old)


def test_two_images_of_one_name_are_refused(own: Path, tmp_path: Path) -> None:
    rename(own, {"0000.jpg": "a,b.jpg", "0002.jpg": "a_b.jpg"})
    with pytest.raises(DataError, match=r"'a,b.jpg' and 'a_b.jpg' would both be 'a_b.jpg'"):
        import_colmap(find_colmap(own), tmp_path / "map")


def test_the_parts_are_found(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = own / "sparse" / "0"
    found = ColmapFolders(model, own / "images", own / "database.db")
    for path in (own, own / "sparse", model):
        assert is_colmap(path) and find_colmap(path) == found
    assert not is_colmap(own / "images") and not is_colmap(own / "none")
    # given ones come first
    (own / "other").mkdir()
    assert find_colmap(own, images=own / "other") == replace(found, images=own / "other")
    # as image_undistorter has it
    (own / "dense").mkdir()
    (own / "dense" / "sparse").symlink_to(model)
    assert find_colmap(own / "dense") == ColmapFolders(own / "dense" / "sparse", None, None)
    shutil.copytree(model, own / "sparse" / "1")
    for path, given, message in (
        (own, {}, "several models, give one of them: sparse/0, sparse/1"),
        (own / "images", {}, "images: no COLMAP model: neither images.bin nor"),
        (model, {"images": own / "none"}, "none: no such folder of images"),
        (model, {"database": own / "images"}, "images: no such database"),
    ):
        with pytest.raises(DataError, match=message):
            find_colmap(path, **given)
    monkeypatch.chdir(own / "sparse")
    relative = find_colmap(Path("0"))
    assert relative.images is not None and relative.images.samefile(own / "images")
    assert relative.database is not None and relative.database.samefile(own / "database.db")


def test_what_is_missing_is_said_before_the_work(own: Path, tmp_path: Path) -> None:
    found, output = replace(find_colmap(own), database=None), tmp_path / "map"
    with pytest.raises(DataError, match="no descriptors .*--database.* or images .*--images"):
        import_colmap(ColmapFolders(found.model, None, None), output)
    for gone, message in (
        (own / "images" / "0003.jpg", "images: 1 of the model's 7 images are not here, .* 0003"),
        (own / "sparse" / "0" / "cameras.bin", r"cameras.bin: file is missing"),
    ):
        gone.unlink()
        with pytest.raises(DataError, match=message):
            import_colmap(found, output)
    assert list(output.iterdir()) == []


def test_of_images_that_are_not_there_the_database_has_the_features(
    own: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before, counts = imported(find_colmap(own), tmp_path / "before")
    (own / "images" / "0003.jpg").unlink()
    found, again = imported(find_colmap(own), tmp_path / "map")
    assert again == counts
    assert "1 of the model's 7 images are not here, the first is 0003.jpg" in caplog.text
    kept = found.descriptors("sift").read("0003.jpg")
    assert np.array_equal(kept, before.descriptors("sift").read("0003.jpg"))


def test_the_map_is_as_large_as_its_images(
    own: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole, _ = imported(find_colmap(own), tmp_path / "whole")
    for path in [path for path in (own / "images").rglob("*") if path.is_file()]:
        with Image.open(path) as image:
            half = image.resize((image.width // 2, image.height // 2))
        path.unlink()  # a link into the shared scene, perhaps
        half.save(path)
    found, _ = imported(find_colmap(own), tmp_path / "half")
    assert f"{own / 'images'}: 1 cameras are scaled to their images" in caplog.text
    name = found.read().image_names()[0]
    large, small = whole.read().camera_of(name), found.read().camera_of(name)
    assert (small.width, small.height) == (large.width // 2, large.height // 2)
    np.testing.assert_allclose(small.params, np.array(large.params) / 2)
    np.testing.assert_allclose(
        found.keypoints("sift").read(name), whole.keypoints("sift").read(name) / 2
    )
    found.validate(deep=True)
    Image.new("RGB", (50, 50)).save(own / "images" / name)
    with pytest.raises(DataError, match=f"{own}.*{name}.*50x50, its camera expects.*--images"):
        imported(find_colmap(own), tmp_path / "third")


def test_features_of_a_model_that_are_not_available(
    own: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = find_colmap(own)
    model = pycolmap.Reconstruction(found.model)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + [5.3, 2.6]  # nowhere near SIFT's keypoints
    model.write_binary(found.model)
    assert import_colmap(replace(found, database=None), tmp_path / "map") is None
    assert "sparse/0: the model has no descriptors" in caplog.text
    model.delete_all_points2D_and_points3D()
    model.write_binary(found.model)
    assert import_colmap(find_colmap(own), tmp_path / "none") is None
    assert "sparse/0: the model has no points" in caplog.text
