"""Maps of photographs without poses, and of COLMAP models."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

import megloc_kapture as megloc
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.geometry.poses import earth_from_enu, geodetic
from megloc_kapture.io.dataset_tables import World, read_unreadable, write_unreadable, write_world
from megloc_kapture.io.files import user_cache
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.map_making import (
    describe_map,
    import_colmap,
    kapture_of,
    options_of_photographs,
    plan_photographs,
)
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.query_folders import Photographs
from megloc_kapture.values import Camera, RigidTransform
from tests.rendering import corner

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


@pytest.fixture
def workspace(colmap_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of a COLMAP workspace, with an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Path(shutil.copytree(colmap_room, tmp_path / "room", symlinks=True))


def state(root: Path) -> dict[str, tuple[int, int]]:
    found = {path: path.lstat() for path in sorted(root.rglob("*"))}
    return {str(path): (at.st_size, at.st_mtime_ns) for path, at in found.items()}


def test_a_colmap_workspace_is_opened_as_a_map(
    workspace: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(workspace)
    before = state(workspace)
    opened = megloc.open_map("sparse/0")
    queries = KaptureFolder(scene / "query")
    name = queries.read().image_names()[0]
    found = opened.localize(queries.image_path(name), queries.read().camera_of(name))
    assert found, found
    truth = KaptureFolder(scene / "query_gt").read().poses()[name]
    assert np.linalg.norm(found.cam_from_world.center() - truth.center()) < 0.01
    assert state(workspace) == before
    # the map is imported once
    imported = state(user_cache() / "maps")
    megloc.open_map(workspace)
    assert state(user_cache() / "maps") == imported


def test_a_changed_model_is_imported_again(workspace: Path) -> None:
    first = kapture_of(workspace)
    points = len(KaptureFolder(first).points3d())
    model = pycolmap.Reconstruction(workspace / "sparse" / "0")
    model.delete_point3D(next(iter(model.points3D)))
    model.write_binary(workspace / "sparse" / "0")
    assert kapture_of(workspace) == first
    assert len(KaptureFolder(first).points3d()) == points - 1
    # so is a model with moved images
    os.rename(workspace / "images", workspace / "sparse" / "images")
    link = first / "sensors" / "records_data"
    kapture_of(workspace)
    assert link.resolve() == (workspace / "sparse" / "images").resolve()
    assert [path.name for path in (user_cache() / "maps").iterdir()] == [first.name]


def test_a_map_that_another_process_imports_meanwhile_is_not_replaced(
    workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other process may be reading it."""
    inodes, name = list[int](), "megloc_kapture.pipeline.map_making.import_colmap"

    def import_after_another(*given: Any, **named: Any) -> dict[str, float]:
        monkeypatch.setattr(name, import_colmap)
        inodes.append(kapture_of(workspace).stat().st_ino)
        return import_colmap(*given, **named)

    monkeypatch.setattr(name, import_after_another)
    assert [kapture_of(workspace).stat().st_ino] == inodes
    assert len(list((user_cache() / "maps").iterdir())) == 1


def test_a_cache_that_cannot_be_written_names_the_setting(workspace: Path) -> None:
    user_cache().parent.touch()
    with pytest.raises(megloc.OutputError, match="maps: cannot write: .*; XDG_CACHE_HOME sets"):
        kapture_of(workspace)


def test_a_damaged_model_leaves_no_map(
    workspace: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kapture in (scene / "mapping", scene / "none"):
        assert kapture_of(kapture) == kapture  # no COLMAP model
    path = workspace / "sparse" / "0" / "points3D.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(megloc.DataError, match=r"points3D.bin: the file is damaged"):
        megloc.open_map(workspace)
    assert list((user_cache() / "maps").iterdir()) == []


UNREGISTERED = "unregistered.csv"
NUM_PHOTOS = 7  # as many as the map of the scene has
FEW: Any = {"set": {"local_features.options.max_keypoints": 500}}
Poses = Mapping[str, RigidTransform]


def true_poses(*folders: Path) -> dict[str, RigidTransform]:
    found: dict[str, RigidTransform] = {}
    for folder in folders:
        found |= {Path(n).name: pose for n, pose in KaptureFolder(folder).read().poses().items()}
    return found


def errors(found: Poses, truth: Poses) -> tuple[NDArray[np.float64], float, float]:
    """Return errors of camera centres relative to the scene, its size and the scale.

    The centres are aligned by COLMAP's robust similarity.
    """
    names = sorted(found)
    centres = np.array([found[name].center() for name in names])
    true = np.array([truth[Path(name).name].center() for name in names])
    size = float(np.linalg.norm(np.ptp(true, axis=0)))
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = 0.02 * size, 0
    report = pycolmap.estimate_sim3d_robust(centres, true, options)
    aligned = report["tgt_from_src"]
    moved = np.array([aligned * point for point in centres])
    return np.linalg.norm(moved - true, axis=1) / size, size, float(aligned.scale)


def put(folder: Path, images: Iterable[Path], prefix: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for image in images:
        shutil.copyfile(image.resolve(), folder / f"{prefix}{image.name}")
    return folder


def images_of(scene: Path) -> list[Path]:
    folders = (scene / part / "sensors" / "records_data" for part in ("mapping", "query"))
    return sorted(path for folder in folders for path in folder.rglob("*.jpg"))


def add_gps(image: Path, latitude: float, longitude: float, altitude: float) -> None:
    exif = Image.Exif()
    table = exif.get_ifd(0x8825)
    for at, value, names in ((1, latitude, "NS"), (3, longitude, "EW")):
        # degrees, minutes and seconds, of which any may have a fraction
        table[at], table[at + 1] = names[value < 0], (abs(value), 0.0, 0.0)
    table[5], table[6] = b"\x00", altitude
    Image.open(image).save(image, exif=exif, quality=95)


@pytest.fixture(scope="module")
def room(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``photos/`` of the rendered scene, ``mapping/`` and ``query_gt/`` with the true poses."""
    root: Path = tmp_path_factory.mktemp("room") / "room"
    shutil.copytree(scene, root)
    put(root / "photos", images_of(root)[:NUM_PHOTOS])
    return root


def test_poses_focal_length_and_scale_are_accurate(room: Path, tmp_path: Path) -> None:
    truth = true_poses(room / "mapping", room / "query_gt")
    first, last = "0000.jpg", "0003.jpg"
    metres = float(np.linalg.norm(truth[first].center() - truth[last].center()))
    scale = (first, last, metres)
    made = megloc.map_photographs(room / "photos", workspace=tmp_path, scale=scale, **FEW)
    poses = made.kapture_map.poses
    assert len(poses) == NUM_PHOTOS
    found, _, _ = errors(poses, truth)
    assert np.median(found) < 0.01 and found.max() < 0.02
    focal = made.kapture_map.camera("0000.jpg").params[0]
    assert abs(focal / 301 - 1) < 0.05  # the guess is 480 px
    assert made.kapture_map.unit == "m"
    assert np.linalg.norm(poses[first].center() - poses[last].center()) == pytest.approx(metres)
    assert read_unreadable(tmp_path / "megloc", UNREGISTERED) == {}
    for first, second in (("0000.jpg", "0009.jpg"), ("0002.jpg", "0006.jpg")):
        ours, true = ((p[second] @ p[first].inverse()).rotation_matrix() for p in (poses, truth))
        assert Rotation.from_matrix(ours @ true.T).magnitude() < np.radians(1.0)


def test_gps_gives_scale_and_axes(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    truth = true_poses(room / "mapping", room / "query_gt")
    images = images_of(room)[:6]
    photos = put(tmp_path / "trip.2024", images)
    # twenty times the room, since GPS has errors of decimetres
    origin = truth["0000.jpg"].center()
    at = {image.name: 20 * (truth[image.name].center() - origin) for image in images}
    earth = earth_from_enu(48.1, -11.6, 520.0)
    rng = np.random.default_rng(0)
    for name, position in at.items():
        noisy = position + rng.normal(0, 0.3, 3) + (50.0 * (name == "0003.jpg"))
        add_gps(photos / name, *geodetic(earth.apply(noisy[None])[0]))
    found = megloc.map_photographs(photos, scale="gps", **FEW)
    assert found.kapture_map.folder.root == tmp_path / "runs/trip.2024-classic/map"
    assert found.kapture_map.unit == "m"
    poses = found.kapture_map.poses
    assert abs(errors(poses, truth)[2] * 20 - 1) < 0.05
    centres = np.array([poses[name].center() for name in sorted(at)])
    true = np.array([at[name] for name in sorted(at)])
    apart = (centres - centres.mean(axis=0)) - (true - true.mean(axis=0))
    assert np.linalg.norm(apart, axis=1).max() < 2.0  # East, North, Up


def test_photographs_of_two_scenes_are_two_models(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = images_of(room)[:4]
    photos = put(tmp_path / "photos", scene)
    monkeypatch.setattr(corner, "WALLS", corner.WALLS[::-1])  # with other textures
    corner.write_scene(tmp_path / "other")
    others = images_of(tmp_path / "other")[:3]
    put(photos, others, prefix="other_")
    (photos / "broken.jpg").write_bytes((photos / "0002.jpg").read_bytes()[:3000])
    found = megloc.map_photographs(photos, workspace=tmp_path / "map", **FEW)
    assert sorted(found.kapture_map.poses) == [image.name for image in scene]
    assert found.kapture_map.unit == "units"
    reasons = read_unreadable(tmp_path / "map" / "megloc", UNREGISTERED)
    assert reasons.pop("broken.jpg").startswith("cannot be read")
    assert sorted(reasons) == [f"other_{image.name}" for image in others]
    assert all(reason.startswith("model 2, of 3 photographs") for reason in reasons.values())


def test_photographs_without_a_common_scene_are_refused(room: Path, tmp_path: Path) -> None:
    photos = sorted((room / "photos").iterdir())
    put(tmp_path / "few", photos[:2])
    for at in range(3):
        noise = np.random.default_rng(at).integers(0, 255, (40, 60, 3), dtype=np.uint8)
        write_image(tmp_path / "strangers" / f"{at}.png", cv2.resize(noise, (480, 320)))
    for at, yaw in enumerate((-14.0, -7.0, 0.0, 7.0, 14.0)):
        view = corner.render(corner.pose_at((0.2, 0, 0.1), yaw, 2.0))
        write_image(tmp_path / "turned" / f"{at}.png", view)
    for name, message in (
        ("few", "2 photographs are too few for a map; give 3 or more"),
        ("turned", "taken from one place"),
        ("strangers", "enough of the same things"),
    ):
        with pytest.raises(DataError, match=message):
            megloc.map_photographs(tmp_path / name, workspace=tmp_path / f"of_{name}", **FEW)
    assert not (tmp_path / "of_few").exists()
    wrong = Camera.pinhole(100, 512, 690.0)
    with pytest.raises(
        DataError, match=r"0 photo.* \(2 more .* 0000.jpg: .*its camera says 100x512"
    ):
        megloc.map_photographs(tmp_path / "few", workspace=tmp_path / "wrong", camera=wrong)


def test_a_map_is_described_with_the_photographs_it_lacks(room: Path, tmp_path: Path) -> None:
    put(tmp_path / "photos", images_of(room)[:4])
    (tmp_path / "photos" / "torn.jpg").write_bytes(b"torn")
    photographs = Photographs([tmp_path / "photos"])
    assert (len(photographs.names), len(photographs.unreadable)) == (4, 1)
    missing = {"torn.jpg": "unreadable", photographs.names[0]: "too few matches"}
    write_unreadable(tmp_path / "megloc", missing, UNREGISTERED)
    write_world(tmp_path / "megloc", World(unit="units"))
    lines = describe_map(tmp_path, photographs)
    assert lines[0].startswith("map of 3 of 5 photographs: ")
    assert lines[-1].endswith("not metres; --scale IMAGE IMAGE METRES sets the scale")
    assert "not in the map: torn.jpg: unreadable" in lines


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": ("0000.jpg", "none.jpg", 1.0)}, "no photograph 'none.jpg'"),
        ({"scale": "gps"}, "0 photographs have a GPS position"),
        ({"mapper": "glomap"}, "option mapper: it should be 'incremental' or 'global'"),
        ({"set": {"mapping_pairs.by": ["poses"]}}, "have no poses yet"),
        ({"set": {"preprocessing.undistort": True}}, "the distortion of photographs is unknown"),
    ],
)
def test_options_that_need_poses_are_refused(
    room: Path, tmp_path: Path, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises((OptionError, DataError), match=message):
        megloc.map_photographs(room / "photos", workspace=tmp_path / "map", **arguments)
    assert not (tmp_path / "map").exists()


def test_a_map_of_photographs_can_be_densified(room: Path, tmp_path: Path) -> None:
    photographs = Photographs([put(tmp_path / "photos", images_of(room)[:4])])
    options = options_of_preset(assignments=["mvs.mode=points"])
    stages = plan_photographs(photographs, options, mapper="incremental")
    assert any("map" in stage.writes for stage in stages)


def test_presets_for_photographs_need_no_poses() -> None:
    options = options_of_photographs("megloc")
    assert options.mapping_pairs.by == ("retrieval",)
    assert not options.preprocessing.undistort


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "mapper", "number", "max_error"),
    [("fountain_p11", "global", 11, 0.002), ("herzjesu_p25", "incremental", 25, 0.003)],
)
def test_surveyed_facades(
    shared_data: Path, tmp_path: Path, scene: str, mapper: Any, number: int, max_error: float
) -> None:
    root = shared_data / "scenes" / scene
    found = megloc.map_photographs(images_of(root), workspace=tmp_path / "map", mapper=mapper)
    poses = found.kapture_map.poses
    assert len(poses) == number
    shares, _, _ = errors(poses, true_poses(root / "mapping", root / "query_gt"))
    assert shares.max() < max_error
    focal = found.kapture_map.camera(found.kapture_map.images[0]).params[0]
    assert abs(focal / 1381 - 1) < 0.01
