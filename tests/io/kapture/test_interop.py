"""kapture reads our files, and we read those of kapture."""

from __future__ import annotations

import tarfile
from pathlib import Path

import kapture
import kapture.io.csv
import kapture.io.features
import kapture.io.records
import numpy as np
import pytest
from kapture.io.tar import TarHandler
from poses import random_pose

from megloc_kapture.io.images import read_depth_map, write_depth_map
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureData,
    KaptureFolder,
    MatchesWriter,
    Observations,
    Sensor,
    points,
    read_pairs,
    write_observations,
    write_pairs,
    write_points3d,
    write_sensors,
)
from megloc_kapture.values import Camera, RigidTransform

FLOAT = np.dtype("float32")
IMAGES = ("cam 0/a.jpg", "cam 0/b.jpg", "z.png")
TIME = 1602074877390449152
INDICES = np.array([[0, 3], [4, 1]])
SCORES = np.array([0.25, 1 / 3])


def pose_of(seed: int) -> RigidTransform:
    return random_pose(np.random.default_rng(seed))


def our_data() -> KaptureData:
    camera = Camera("OPENCV", 640, 480, (1 / 3 + 500, 500.5, 320, 240, 1e-17, -0.1, 0, 2.5e-5))
    small, depth = (
        Camera("SIMPLE_PINHOLE", 2 * w, 2 * h, (f, w, h)) for f, w, h in ((50, 32, 24), (5, 2, 1.5))
    )
    return KaptureData(
        sensors={
            "cam0": Sensor.from_camera(camera, name="left"),
            "cam1": Sensor.from_camera(small),
            "raw": Sensor("", "camera", ("UNKNOWN_CAMERA", "10", "20")),
            "deep": Sensor.from_camera(depth, sensor_type="depth"),
            "gps": Sensor("", "gnss", ("EPSG:4326",)),
        },
        rigs={"rig": {"cam0": pose_of(0), "cam1": pose_of(1)}, "car": {"rig": pose_of(2)}},
        trajectories={(TIME, "rig"): pose_of(3), (TIME + 1, "cam1"): pose_of(4)},
        records_camera=dict(
            zip([(TIME, "cam0"), (TIME, "cam1"), (TIME + 1, "cam1")], IMAGES, strict=True)
        ),
        records_depth={(TIME, "deep"): "a.depth"},
    )


def raw(pose: kapture.PoseTransform) -> RigidTransform:
    return RigidTransform(tuple(pose.r_raw), tuple(pose.t_raw))


def assert_same_sensors(theirs: kapture.Kapture, ours: KaptureData) -> None:
    assert set(theirs.sensors) == set(ours.sensors)
    for sensor_id, sensor in ours.sensors.items():
        assert (theirs.sensors[sensor_id].name or "") == sensor.name
        assert theirs.sensors[sensor_id].sensor_type == sensor.sensor_type
        assert tuple(str(p) for p in theirs.sensors[sensor_id].sensor_params) == sensor.params
        if sensor_id.startswith("cam"):
            assert tuple(theirs.sensors[sensor_id].camera_params[2:]) == sensor.camera().params
    actual = {rig: {s: raw(pose) for s, pose in theirs.rigs[rig].items()} for rig in theirs.rigs}
    assert actual == ours.rigs
    poses = theirs.trajectories
    assert {key: raw(poses[key]) for key in poses.key_pairs()} == ours.trajectories
    for records, expected in (
        (theirs.records_camera, ours.records_camera),
        (theirs.records_depth, ours.records_depth),
    ):
        assert {key: records[key] for key in records.key_pairs()} == expected


def arrays() -> dict[str, dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    return {
        "keypoints": {i: rng.normal(size=(5, 3)).astype(np.float32) for i in IMAGES},
        "descriptors": {i: rng.integers(0, 256, (5, 8)).astype(np.uint8) for i in IMAGES},
        "global_features": {i: rng.normal(size=16) for i in IMAGES},
    }


CONFIGS = {
    "keypoints": FeatureConfig("superpoint", FLOAT, 3),
    "descriptors": FeatureConfig("sp desc", np.dtype("uint8"), 8, "T", "L2"),
    "global_features": FeatureConfig("netvlad", np.dtype("float64"), 16, None, "L2"),
}
POINTS = np.random.default_rng(1).normal(0, 100, (4, 6))
IDS = np.array([[0, 0, 3], [2, 0, 1], [4, 0, 2]], dtype=np.int32)  # points, images, keypoints
OBSERVATIONS = Observations(IMAGES, IDS[0].astype(np.int64), *IDS[1:])


def test_kapture_reads_our_files(tmp_path: Path) -> None:
    write_sensors(tmp_path, our_data())
    for kind, by_image in arrays().items():
        writer = FeatureWriter(tmp_path, kind, "T", CONFIGS[kind])  # type: ignore[arg-type]
        for image, array in by_image.items():
            writer.write(image, array)
    matches = MatchesWriter(tmp_path, "T")
    matches.write(IMAGES[1], IMAGES[0], INDICES, SCORES)
    write_points3d(tmp_path, POINTS)
    write_observations(tmp_path, {"T": OBSERVATIONS})
    with kapture.io.csv.get_all_tar_handlers(str(tmp_path)) as tars:
        theirs = kapture.io.csv.kapture_from_dir(str(tmp_path), tar_handlers=tars)
        assert_same_sensors(theirs, our_data())
        for kind, by_image in arrays().items():
            features = getattr(theirs, kind)["T"]
            config = CONFIGS[kind]
            assert set(features) == set(IMAGES)
            assert (features.type_name, features.dsize) == (config.name, config.dsize)
            assert features.dtype == config.dtype.type
            path_of = getattr(kapture.io.features, f"get_{kind}_fullpath")
            read = getattr(kapture.io.features, f"image_{kind}_from_file")
            for image, array in by_image.items():
                path = path_of("T", str(tmp_path), image, tars)
                assert np.array_equal(
                    read(path, features.dtype, features.dsize), array.reshape(-1, config.dsize)
                )
        assert theirs.descriptors["T"].keypoints_type == "T"
        assert set(theirs.matches["T"]) == {(IMAGES[0], IMAGES[1])}
        path = kapture.io.features.get_matches_fullpath(
            (IMAGES[0], IMAGES[1]), "T", str(tmp_path), tars
        )
        rows = kapture.io.features.image_matches_from_file(path)
        assert np.array_equal(rows, np.c_[INDICES[:, ::-1], SCORES])
        assert np.array_equal(theirs.points3d.as_array(), POINTS)
        assert {key: theirs.observations[key] for key in theirs.observations.key_pairs()} == {
            (0, "T"): [(IMAGES[2], 4), (IMAGES[0], 0)],
            (3, "T"): [(IMAGES[1], 2)],
        }


def their_kapture(root: Path) -> kapture.Kapture:
    write_sensors(root, our_data())
    theirs = kapture.io.csv.kapture_from_dir(str(root))
    theirs.keypoints = {"T": kapture.Keypoints("superpoint", np.float32, 3, set(IMAGES))}
    theirs.descriptors = {"T": kapture.Descriptors("sp desc", np.uint8, 8, "T", "L2", set(IMAGES))}
    theirs.global_features = {
        "T": kapture.GlobalFeatures("netvlad", np.float64, 16, "L2", set(IMAGES))
    }
    theirs.points3d = kapture.Points3d(np.round(POINTS, 10))  # all that its writer keeps
    theirs.observations = kapture.Observations()
    for point, image, keypoint in IDS.T.tolist():
        theirs.observations.add(point, "T", IMAGES[image], keypoint)
    # a pose without its rotation or translation is skipped
    theirs.trajectories[TIME + 2, "cam0"] = kapture.PoseTransform(r=None, t=[1, 2, 3])
    theirs.trajectories[TIME + 3, "cam0"] = kapture.PoseTransform(r=[1, 0, 0, 0], t=None)
    return theirs


def write_theirs(root: Path, *, tar: bool) -> None:
    kapture.io.csv.kapture_to_dir(str(root), their_kapture(root / "ours"))
    handlers = {}
    for kind in [*arrays(), "matches"]:
        folder = root / "reconstruction" / kind / "T"
        folder.mkdir(parents=True, exist_ok=True)
        if tar:
            tarfile.open(folder / f"{kind}.tar", "w").close()
            handlers[kind] = TarHandler(str(folder / f"{kind}.tar"), "a")
    for kind, by_image in arrays().items():
        path_of = getattr(kapture.io.features, f"get_{kind}_fullpath")
        write = getattr(kapture.io.features, f"image_{kind}_to_file")
        for image, array in by_image.items():
            if tar:  # an older version first: the last one must win
                write(path_of("T", str(root), image, handlers[kind]), array * 0)
            write(path_of("T", str(root), image, handlers.get(kind)), array)
    rows = np.c_[INDICES, SCORES].astype(np.float64)
    path = kapture.io.features.get_matches_fullpath(
        IMAGES[:2], "T", str(root), handlers.get("matches")
    )
    kapture.io.features.image_matches_to_file(path, rows)
    for handler in handlers.values():
        handler.close()


@pytest.mark.parametrize("tar", [False, True])
def test_we_read_kaptures_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tar: bool) -> None:
    # observations are read in blocks, here of a row
    monkeypatch.setattr(points, "_BLOCK_CHARACTERS", 10)
    write_theirs(tmp_path, tar=tar)
    folder = KaptureFolder(tmp_path)
    folder.validate()
    assert folder.read() == our_data()
    for kind, by_image in arrays().items():
        assert folder.types(kind) == ["T"]  # type: ignore[arg-type]
        features = getattr(folder, kind)("T")
        assert features.config == CONFIGS[kind]
        assert features.names == sorted(IMAGES)
        for image, array in by_image.items():
            assert np.array_equal(features.read(image), array)
    indices, scores = folder.matches("T").read(IMAGES[0], IMAGES[1])
    assert np.array_equal(indices, INDICES) and np.array_equal(scores, SCORES)
    assert np.array_equal(folder.points3d(), np.round(POINTS, 10))
    read = folder.observations()["T"]
    assert read.image_names == IMAGES
    np.testing.assert_array_equal([read.point_ids, read.image_ids, read.keypoint_ids], IDS)


def test_kapture_and_we_read_the_same_depth_maps(tmp_path: Path) -> None:
    depth = np.random.default_rng(0).normal(2, 1, (3, 4)).astype(np.float32)
    write_sensors(tmp_path, our_data())
    write_depth_map(KaptureFolder(tmp_path).depth_path("a.depth"), depth)
    path = kapture.io.records.get_depth_map_fullpath(str(tmp_path), "a.depth")
    assert np.array_equal(kapture.io.records.depth_map_from_file(path, (4, 3)), depth)
    kapture.io.records.depth_map_to_file(str(tmp_path / "b.depth"), depth + 1)
    read = read_depth_map(tmp_path / "b.depth", width=4, height=3)
    assert np.array_equal(read, depth + 1)
    read[0, 0] = 7  # a copy that the caller may change


def test_kapture_and_we_read_the_same_pairs(tmp_path: Path) -> None:
    pairs = [ImagePair("q", "m", 0.1 + 0.2), ImagePair("q", "a b", -1.0), ImagePair("m", "q", 2.0)]
    write_pairs(tmp_path / "pairs.txt", pairs)
    with open(tmp_path / "pairs.txt") as file:
        table = kapture.io.csv.table_from_file(file)
    assert [ImagePair(q, m, float(s)) for q, m, s in table] == pairs
    with open(tmp_path / "theirs.txt", "w") as file:
        rows = [[p.query, p.map, p.score] for p in (*pairs, ImagePair("q", "m", 5.0))]
        kapture.io.csv.table_to_file(file, rows, header="# query_image, map_image, score")
    assert read_pairs(tmp_path / "theirs.txt") == pairs  # without the repeated pair


@pytest.mark.slow
def test_kapture_reads_a_map_of_other_tools_equally(shared_data: Path) -> None:
    root = shared_data / "foreign_maps/virtual_gallery/map"
    theirs = kapture.io.csv.kapture_from_dir(str(root))
    folder = KaptureFolder(root)
    folder.validate(deep=True)
    assert np.array_equal(folder.points3d(), theirs.points3d.as_array())
    ours = folder.observations()["r2d2_500"]
    rows = [
        (point, image, keypoint)
        for point, kind in sorted(theirs.observations.key_pairs())
        for image, keypoint in theirs.observations[point, kind]
    ]
    names = np.array(ours.image_names)[ours.image_ids].tolist()
    stored = zip(ours.point_ids.tolist(), names, ours.keypoint_ids.tolist(), strict=True)
    assert rows == list(stored) and len(rows) == 3766
    for key, pose in folder.read().trajectories.items():
        assert np.allclose(theirs.trajectories[key].r_raw, pose.quat_wxyz, atol=1e-12)
        assert tuple(theirs.trajectories[key].t_raw) == pose.translation
    keypoints, descriptors = folder.keypoints("r2d2_500"), folder.descriptors("r2d2_500")
    assert set(keypoints.names) == theirs.keypoints["r2d2_500"]
    assert (keypoints.config.name, descriptors.config.keypoints_type) == ("r2d2", "r2d2_500")
    assert folder.global_features("AP-GeM-LM18").read(ours.image_names[0]).shape == (2048,)
