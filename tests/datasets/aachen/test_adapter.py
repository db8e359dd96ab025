"""Aachen Day-Night: what its official layout becomes, on small layouts written by hand and on the
real sample."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from kapture.io.csv import kapture_from_dir
from kapture.io.features import get_descriptors_fullpath, image_descriptors_from_file
from kloc import kapture_tool
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.aachen.adapter import Aachen, AachenOptions
from megloc_kapture.datasets.official import OfficialDataset, write_official
from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.io.dataset_tables import read_groups, read_names, read_protocol
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import DATASETS, DatasetAdapter
from megloc_kapture.values import Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

# name -> width, height; centre, quaternion, focal length, k as COLMAP has it
DATABASE = ("db/7.jpg", "db/1228.jpg", "db/3.jpg")
SIZES = {"db/7.jpg": (8, 6), "db/1228.jpg": (6, 8), "db/3.jpg": (8, 6)}
SEQUENCE = ("sequences/nexus4_sequences/sequence_1/a.jpg", "sequences/gopro3_undistorted/b.png")
DAY = (
    "query/day/nexus4/IMG_2.jpg",
    "query/day/milestone/m_1.jpg",
    "query/day/nexus4/IMG_1.jpg",
)
NIGHT = ("query/night/nexus5x/IMG_9.jpg",)
ADDED = ("query/night/nexus5x_additional_night/IMG_8.jpg",)
UNLISTED = "query/day/nexus4/IMG_3.jpg"
QUERY_CAMERA = Camera("SIMPLE_RADIAL", 8, 6, (7.5, 4.0, 3.0, -0.0353019))

# a pose that tells centre from translation, and a distortion whose sign shows
NVM = """NVM_V3\x20

3
db/7.jpg 10.5 1 0 0 0 2.0 0.0 -5.0 0.08 0
db/1228.jpg 11 0 0 0 1 1.0 2.0 3.0 -0.5 0
db/3.jpg 12 0.5 0.5 0.5 0.5 700.0 -8.0 -40.0 0.25 0

2
2 0 5 255 0 9 2 0 4 4.5 3.25 2 1 1 2
1 1 1 1 2 3 2 2 7 5 5 1 0 3 3
"""
POSES = {
    "db/7.jpg": RigidTransform((1.0, 0.0, 0.0, 0.0), (-2.0, 0.0, 5.0)),
    "db/1228.jpg": RigidTransform((0.0, 0.0, 0.0, 1.0), (1.0, 2.0, -3.0)),
    "db/3.jpg": RigidTransform((0.5, 0.5, 0.5, 0.5), (40.0, -700.0, 8.0)),
}
INTRINSICS = """db/3.jpg SIMPLE_RADIAL 8 6 12 4.25 3 -0.25
db/7.jpg SIMPLE_RADIAL 8 6 10.5 4 3 -0.08
db/1228.jpg SIMPLE_RADIAL 6 8 11 3 4 0.5"""
CAMERAS = """# Camera list
9 SIMPLE_RADIAL 8 6 12 4.25 3 -0.25
2 SIMPLE_RADIAL 6 8 11 3 4 0.5
5 PINHOLE 8 6 9 9 4 3
"""
# the identity's second line is empty; 9 and 5 are shared
IMAGES = f"""# Image list
4 1 0 0 0 -2 0 5 9 db/7.jpg

30 0 0 0 1 1 2 -3 2 db/1228.jpg
1 2 -1
2 0.5 0.5 0.5 0.5 40 -700 8 9 db/3.jpg

11 1 0 0 0 0 0 1 5 {SEQUENCE[0]}

10 1 0 0 0 0 0 2 5 {SEQUENCE[1]}

"""


def put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def picture(path: Path, size: tuple[int, int] = (8, 6)) -> None:
    write_image(path, np.full((size[1], size[0], 3), 99, np.uint8))


def query_list(names: tuple[str, ...]) -> str:
    # the published lists end without a line end
    return "\n".join(f"{name} SIMPLE_RADIAL 8 6 7.5 4 3 -0.0353019" for name in names)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Version 1.0."""
    root = tmp_path / "Aachen-Day-Night"
    put(root / "3D-models/aachen_cvpr2018_db.nvm", NVM)
    put(root / "3D-models/database_intrinsics.txt", INTRINSICS)
    put(root / "queries/day_time_queries_with_intrinsics.txt", query_list(DAY))
    put(root / "queries/night_time_queries_with_intrinsics.txt", query_list(NIGHT))
    # not what the adapter reads, and not even valid
    put(root / "queries/day_time_queries_without_intrinsics.txt", "\n".join(DAY))
    put(root / "3D-models/aachen_cvpr2018_db.list.txt", "\n".join(DATABASE))
    for name in DATABASE:
        picture(root / "images_upright" / name, SIZES[name])
    for name in (*DAY, *NIGHT, UNLISTED):
        picture(root / "images_upright" / name)
    return root


@pytest.fixture
def root11(root: Path) -> Path:
    """Version 1.1, in the same tree."""
    for name in (*SEQUENCE, *ADDED):
        picture(root / "images_upright" / name)
    put(root / "queries/night_time_queries_with_intrinsics.txt", query_list(ADDED + NIGHT))
    model = root / "3D-models/aachen_v_1_1"
    put(model / "cameras.txt", CAMERAS)
    put(model / "images.txt", IMAGES)
    put(model / "points3D.txt", "")
    return root


def read(root: Path, **options: object) -> OfficialDataset:
    return Aachen(AachenOptions(**options)).read(root)  # type: ignore[arg-type]


def written(root: Path, output: Path, *, allow_missing: bool = False, **options: object) -> Path:
    write_official(read(root, **options), output, allow_missing=allow_missing)
    return output


def same_pose(found: RigidTransform, expected: RigidTransform) -> bool:
    return bool(
        np.allclose(found.rotation_matrix(), expected.rotation_matrix(), atol=1e-12)
        and np.allclose(found.translation, expected.translation, atol=1e-9)
    )


def test_it_is_the_plugin() -> None:
    adapter = load_plugin(DATASETS, "aachen", {"version": 1.1, "reference_model": True})
    assert isinstance(adapter, DatasetAdapter)
    assert isinstance(adapter, Aachen)
    assert adapter.options == AachenOptions(version="1.1", reference_model=True)
    assert adapter.name == "aachen"
    for wrong in ({"version": "2"}, {"version": 1.2}, {"reference": True}):
        with pytest.raises(PluginError, match="refuses its options: (version|reference)"):
            load_plugin(DATASETS, "aachen", wrong)


def test_version_10(root: Path, tmp_path: Path) -> None:
    out = written(root, tmp_path / "out")
    mapping, query = (KaptureFolder(out / part).read() for part in ("mapping", "query"))
    poses = mapping.poses()
    assert poses.keys() == POSES.keys()
    for name, pose in POSES.items():
        assert same_pose(poses[name], pose)
    # cameras are those of the list, found by name
    assert mapping.camera_of("db/7.jpg") == Camera("SIMPLE_RADIAL", 8, 6, (10.5, 4, 3, -0.08))
    assert mapping.camera_of("db/3.jpg") == Camera("SIMPLE_RADIAL", 8, 6, (12, 4.25, 3, -0.25))
    assert mapping.camera_of("db/1228.jpg") == Camera("SIMPLE_RADIAL", 6, 8, (11, 3, 4, 0.5))
    assert [mapping.record_of(name) for name in DATABASE] == [
        (position, f"camera_{position:05d}") for position in range(3)
    ]
    # no query but those of the lists, and none with a pose
    assert query.image_names() == sorted(DAY + NIGHT)
    assert query.trajectories == {}
    assert all(query.camera_of(name) == QUERY_CAMERA for name in DAY + NIGHT)
    assert [query.record_of(name) for name in (*DAY, *NIGHT)] == [
        (100_000, "day_00000"),
        (100_001, "day_00001"),
        (100_002, "day_00002"),
        (200_000, "night_00000"),
    ]
    assert not (out / "query_gt").exists()
    for part, name in (("mapping", "db/7.jpg"), ("query", NIGHT[0])):
        assert KaptureFolder(out / part).image_path(name).samefile(root / "images_upright" / name)


def test_version_11(root11: Path, tmp_path: Path) -> None:
    out = written(root11, tmp_path / "out")
    mapping, query = (KaptureFolder(out / part).read() for part in ("mapping", "query"))
    poses = mapping.poses()
    assert poses.keys() == {*DATABASE, *SEQUENCE}
    for name, pose in POSES.items():
        assert same_pose(poses[name], pose)
    assert poses[SEQUENCE[0]].translation == (0, 0, 1)
    # three cameras took five images
    assert {name: mapping.record_of(name)[1] for name in mapping.image_names()} == {
        "db/7.jpg": "camera_00009",
        "db/3.jpg": "camera_00009",
        "db/1228.jpg": "camera_00002",
        SEQUENCE[0]: "camera_00005",
        SEQUENCE[1]: "camera_00005",
    }
    assert len({timestamp for timestamp, _ in mapping.records_camera}) == 5
    assert mapping.camera_of(SEQUENCE[0]) == Camera("PINHOLE", 8, 6, (9, 9, 4, 3))
    assert query.image_names() == sorted(DAY + NIGHT + ADDED)


def test_side_tables(root11: Path, tmp_path: Path) -> None:
    tables = written(root11, tmp_path / "out") / "megloc"
    names = read_names(tables)
    # in the order of the lists, day first
    assert list(names.items()) == [(n, n.split("/")[-1]) for n in (*DAY, *ADDED, *NIGHT)]
    groups = read_groups(tables)
    assert {name: group.condition for name, group in groups.items()} == {
        **dict.fromkeys(DAY, "day"),
        **dict.fromkeys(NIGHT + ADDED, "night"),
    }
    assert all(group.scored for group in groups.values())
    protocol = read_protocol(tables)
    assert protocol.dataset == "aachen"
    assert protocol.thresholds == ((0.25, 2), (0.5, 5), (5, 10))
    assert protocol.conditions == ("day", "night")
    assert (protocol.pose_file, protocol.pose_file_names) == ("ltvl", "basename")
    assert "visuallocalization.net" in protocol.truth
    # both models are there: the version that is read is the version that is handed in
    assert protocol.pose_file_stem == "Aachen_v1_1"
    assert read(root11, version="1.0").protocol.pose_file_stem == "Aachen"
    assert not (tables / "priors.csv").exists()


def test_kapture_reads_it(root11: Path, tmp_path: Path) -> None:
    out = written(root11, tmp_path / "out")
    theirs = kapture_from_dir(str(out / "mapping"))
    timestamp, sensor = theirs.records_camera.key_pairs()[0]
    assert len(theirs.records_camera.data_list()) == 5
    assert len(theirs.sensors) == 3
    assert theirs.trajectories[timestamp, sensor].r is not None
    assert len(kapture_from_dir(str(out / "query")).records_camera.data_list()) == 5


@pytest.mark.parametrize(
    ("version", "database", "night"), [("auto", 5, 2), ("1.0", 3, 1), ("1.1", 5, 2)]
)
def test_the_version_is_found_or_chosen(
    root11: Path, version: str, database: int, night: int
) -> None:
    dataset = read(root11, version=version)
    assert len(dataset.mapping.records_camera) == database
    conditions = [group.condition for group in dataset.groups.values()]
    assert (conditions.count("day"), conditions.count("night")) == (3, night)
    left_out = [remark for remark in dataset.remarks if "left out" in remark]
    assert bool(left_out) == (version == "1.0")
    # a query keeps its record whichever version is read
    if version == "1.0":
        assert dataset.query.record_of(NIGHT[0]) == read(root11).query.record_of(NIGHT[0])


@pytest.mark.parametrize("folder", ["aachen_v_1_1", "aachen_v1_1"])
@pytest.mark.parametrize("images", ["images_upright", "images/images_upright"])
def test_folders_that_are_met_with_other_names(root11: Path, folder: str, images: str) -> None:
    models = root11 / "3D-models"
    (models / "aachen_v_1_1").rename(models / folder)
    (root11 / images).parent.mkdir(exist_ok=True)
    (root11 / "images_upright").rename(root11 / images)
    Aachen().check(root11)
    dataset = read(root11)
    assert len(dataset.mapping.records_camera) == 5
    assert dataset.links == {"": root11 / images}
    assert dataset.missing is not None
    assert dataset.missing.files == []


def test_summary_and_remarks(root: Path, root11: Path) -> None:
    old, new = read(root11, version="1.0"), read(root11)
    assert [(count.what, count.found, count.published) for count in old.summary] == [
        ("database images", 3, 4328),
        ("day queries", 3, 824),
        ("night queries", 1, 98),
    ]
    assert [(count.what, count.found, count.published) for count in new.summary] == [
        ("database images", 3, 4328),
        ("sequence images", 2, 2369),
        ("map images", 5, 6697),
        ("cameras of map and night queries", 5, 5234),
        ("day queries", 3, 824),
        ("night queries", 2, 191),
    ]
    assert any("db/1228.jpg has a wrong pose" in remark for remark in new.remarks)
    (root / "images_upright/db/1228.jpg").unlink()
    assert not any("db/1228.jpg" in remark for remark in read(root).remarks)


# ------------------------------------------------------------------------------- partial downloads


def test_missing_files_are_refused_or_passed_over(root11: Path, tmp_path: Path) -> None:
    gone = (DATABASE[0], SEQUENCE[1], DAY[1], ADDED[0])
    for name in gone:
        (root11 / "images_upright" / name).unlink()
    dataset = read(root11)
    assert dataset.missing is not None
    assert {str(file.relative_to(root11 / "images_upright")) for file in dataset.missing.files} == {
        *gone
    }
    with pytest.raises(DataError, match=r"4 files are missing: .*db/7\.jpg") as caught:
        write_official(dataset, tmp_path / "no")
    assert str(caught.value).startswith(str(root11))
    assert not (tmp_path / "no").exists()
    write_official(dataset, tmp_path / "out", allow_missing=True)
    mapping, query = (KaptureFolder(tmp_path / "out" / p).read() for p in ("mapping", "query"))
    assert mapping.image_names() == sorted({*DATABASE, *SEQUENCE} - {*gone})
    assert query.image_names() == sorted({*DAY, *NIGHT, *ADDED} - {*gone})
    assert list(read_names(tmp_path / "out/megloc")) == [DAY[0], DAY[2], NIGHT[0]]
    # what is left keeps its ids
    assert mapping.record_of("db/3.jpg")[1] == "camera_00009"
    assert query.record_of(DAY[2]) == (100_002, "day_00002")
    assert query.record_of(NIGHT[0]) == (200_001, "night_00001")


def test_missing_lists(root: Path, tmp_path: Path) -> None:
    (root / "queries/night_time_queries_with_intrinsics.txt").unlink()
    (root / "3D-models/database_intrinsics.txt").unlink()
    dataset = read(root)
    assert dataset.missing is not None
    assert [file.name for file in dataset.missing.files] == [
        "database_intrinsics.txt",
        "night_time_queries_with_intrinsics.txt",
    ]
    out = written(root, tmp_path / "out", allow_missing=True)
    mapping = KaptureFolder(out / "mapping").read()
    # the size is the image's, the principal point its middle
    assert mapping.camera_of("db/3.jpg") == Camera("SIMPLE_RADIAL", 8, 6, (12, 4, 3, -0.25))
    assert mapping.camera_of("db/1228.jpg") == Camera("SIMPLE_RADIAL", 6, 8, (11, 3, 4, 0.5))
    assert any("database_intrinsics.txt" in remark for remark in dataset.remarks)


def test_nothing_left_of_map_or_queries(root: Path, tmp_path: Path) -> None:
    backup = tmp_path / "backup"
    shutil.copytree(root, backup)
    shutil.rmtree(root / "images_upright/query")
    with pytest.raises(DataError, match="files are missing: images_upright/query/"):
        written(root, tmp_path / "refused")
    without = written(root, tmp_path / "out", allow_missing=True)
    assert not KaptureFolder(without / "query").read().records_camera
    shutil.rmtree(backup / "images_upright/db")
    with pytest.raises(DataError, match="no mapping image"):
        written(backup, tmp_path / "out2", allow_missing=True)


# ---------------------------------------------------------------------------------- what is refused


def edit(path: str, old: str, new: str) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        text = (root / path).read_text()
        assert old in text
        (root / path).write_text(text.replace(old, new, 1))

    return change


MODEL, LIST = "3D-models/aachen_cvpr2018_db.nvm", "3D-models/database_intrinsics.txt"
DAY_LIST = "queries/day_time_queries_with_intrinsics.txt"
NIGHT_LIST = "queries/night_time_queries_with_intrinsics.txt"


@pytest.mark.parametrize(
    ("change", "where", "match"),
    [
        (edit(LIST, "db/7.jpg", "db/8.jpg"), LIST, "no line for 'db/7.jpg'"),
        (edit(LIST, " 10.5 ", " nan "), f"{LIST}:2", "'nan' is not a finite number"),
        (edit(MODEL, "\n2\n", "\n3\n"), f"{MODEL}:10", "ends after 2 of 3 points"),
        (edit(DAY_LIST, DAY[2], DAY[0]), f"{DAY_LIST}:3", "is listed twice"),
        (edit(NIGHT_LIST, NIGHT[0], DAY[1]), NIGHT_LIST, "is also in day_time_queries"),
        (
            edit(NIGHT_LIST, NIGHT[0], "query/night/nexus5x/IMG_2.jpg"),
            NIGHT_LIST,
            "would both be IMG_2.jpg in the pose file",
        ),
        (
            lambda root: (root / MODEL).write_text(NVM + "\n" + NVM.split("\n", 2)[2]),
            MODEL,
            "2 models, expected one",
        ),
    ],
)
def test_broken_files_are_named(
    root: Path, change: Callable[[Path], None], where: str, match: str
) -> None:
    picture(root / "images_upright/query/night/nexus5x/IMG_2.jpg")
    change(root)
    with pytest.raises(DataError, match=match) as caught:
        read(root)
    assert str(caught.value).startswith(f"{root / where}: ")
    assert "\n" not in str(caught.value)


def test_an_nvm_without_list_must_have_cameras_itself(root: Path) -> None:
    (root / LIST).unlink()
    edit(MODEL, " 10.5 ", " -1 ")(root)
    with pytest.raises(DataError, match=r"\.nvm: image 'db/7\.jpg': focal length"):
        read(root)
    (root / "images_upright/db/7.jpg").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"db/7\.jpg: not an image"):
        read(root)


def test_a_query_must_not_be_in_the_map(root: Path, tmp_path: Path) -> None:
    edit(DAY_LIST, DAY[0], "db/7.jpg")(root)
    with pytest.raises(DataError, match=r"'db/7\.jpg' is in the map and a query"):
        written(root, tmp_path / "out")


def test_a_folder_that_is_another(root: Path, tmp_path: Path) -> None:
    adapter = Aachen()
    adapter.check(root)
    with pytest.raises(DataError, match="no folder images_upright and queries and 3D-models"):
        adapter.check(tmp_path / "absent")
    with pytest.raises(DataError, match=r"v1\.1 is missing: 3D-models/aachen_v_1_1"):
        Aachen(AachenOptions(version="1.1")).check(root)
    (root / "3D-models/aachen_v_1_1").mkdir()
    with pytest.raises(DataError, match="aachen_v_1_1: no COLMAP model"):
        adapter.check(root)
    (root / "3D-models/aachen_v_1_1").rmdir()
    (root / MODEL).unlink()
    with pytest.raises(DataError, match=r"v1\.0 is missing: 3D-models/aachen_cvpr2018_db\.nvm"):
        adapter.check(root)
    shutil.rmtree(root / "queries")
    with pytest.raises(DataError, match="no folder queries; it has to lie as images_upright"):
        adapter.read(root)


_FILES = st.sampled_from([MODEL, LIST, DAY_LIST, NIGHT_LIST])


@given(_FILES, st.binary(max_size=12), st.floats(0, 1), st.integers(0, 30))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mutations_are_read_or_refused(
    root: Path, file: str, new: bytes, where: float, length: int
) -> None:
    content = (root / file).read_bytes()
    start = int(where * len(content))
    (root / file).write_bytes(content[:start] + new + content[start + length :])
    try:
        read(root)
    except DataError as error:
        assert "\n" not in str(error)
    finally:
        (root / file).write_bytes(content)


# ---------------------------------------------------------------------- reference model and truth


def test_reference_model(root: Path, tmp_path: Path) -> None:
    dataset = read(root, reference_model=True)
    write_official(dataset, tmp_path / "out")
    assert any("without descriptors" in remark for remark in dataset.remarks)
    theirs = kapture_from_dir(str(tmp_path / "out/reference"))
    assert theirs.points3d is not None
    np.testing.assert_array_equal(
        theirs.points3d.as_array(), [[2, 0, 5, 255, 0, 9], [1, 1, 1, 1, 2, 3]]
    )
    assert theirs.keypoints is not None
    assert theirs.keypoints.keys() == {"sift"}
    assert theirs.descriptors is None
    assert theirs.observations is not None
    seen = {(point, image) for point in (0, 1) for image, _ in theirs.observations[point, "sift"]}
    assert seen == {(0, "db/7.jpg"), (0, "db/3.jpg"), (1, "db/3.jpg"), (1, "db/1228.jpg")}


def test_reference_model_with_descriptors(root: Path, tmp_path: Path) -> None:
    features = {"db/7.jpg": {4: (4.5, 3.25)}, "db/1228.jpg": {0: (3, 3)}}
    features["db/3.jpg"] = {1: (1, 2), 7: (5, 5)}
    database = pycolmap.Database.open(str(root / "aachen.db"))
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=8, height=6, params=[9, 4, 3, 0])
    camera_id = database.write_camera(camera)
    rng = np.random.default_rng(0)
    descriptors = {}
    for name, known in features.items():
        image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        keypoints = np.ones((9, 4), np.float32)
        for index, xy in known.items():
            keypoints[index, :2] = xy
        descriptors[name] = rng.integers(0, 256, (9, 128), np.uint8)
        database.write_keypoints(image_id, keypoints)
        kind = pycolmap.FeatureExtractorType.SIFT
        database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, descriptors[name]))
    database.close()
    dataset = read(root, reference_model=True)
    assert not any("descriptors" in remark for remark in dataset.remarks)
    write_official(dataset, tmp_path / "out")
    place = str(tmp_path / "out/reference")
    theirs = kapture_from_dir(place)
    assert theirs.descriptors is not None
    for name in features:
        path = get_descriptors_fullpath("sift", place, name)
        np.testing.assert_array_equal(
            image_descriptors_from_file(path, np.uint8, 128), descriptors[name]
        )
    assert theirs.observations is not None
    assert dict(theirs.observations[0, "sift"]) == {"db/7.jpg": 4, "db/3.jpg": 1}


def test_reference_model_of_a_partial_download(root11: Path, tmp_path: Path) -> None:
    (root11 / "images_upright/db/7.jpg").unlink()
    dataset = read(root11, version="1.0", reference_model=True)
    write_official(dataset, tmp_path / "out", allow_missing=True)
    theirs = kapture_from_dir(str(tmp_path / "out/reference"))
    assert sorted(theirs.records_camera.data_list()) == ["db/1228.jpg", "db/3.jpg"]
    # without the option there is none
    write_official(read(root11), tmp_path / "plain", allow_missing=True)
    assert not (tmp_path / "plain/reference").exists()


def test_truth_beside_the_dataset(root: Path, tmp_path: Path) -> None:
    pose = RigidTransform((0.6, 0.8, 0.0, 0.0), (700.25, -8.0, 1e-9))
    data = KaptureData(
        sensors={"any": Sensor.from_camera(QUERY_CAMERA)},
        trajectories={(3, "any"): pose, (4, "any"): pose},
        records_camera={(3, "any"): DAY[1], (4, "any"): "query/day/unknown.jpg"},
    )
    write_sensors(root / "ground_truth/query", data)
    truth = KaptureFolder(written(root, tmp_path / "out") / "query_gt").read()
    assert truth.poses() == {DAY[1]: pose}
    assert truth.image_names() == sorted(DAY + NIGHT)


def test_input_files(root11: Path) -> None:
    def names(**options: object) -> set[str]:
        files = list(Aachen(AachenOptions(**options)).input_files(root11))  # type: ignore[arg-type]
        assert len(files) == len(set(files))
        assert all(file.is_file() for file in files)
        return {str(file.relative_to(root11)) for file in files}

    images = {f"images_upright/{n}" for n in (*DATABASE, *SEQUENCE, *DAY, *NIGHT, *ADDED, UNLISTED)}
    (root11 / "aachen.db").write_bytes(b"")
    model = {f"3D-models/aachen_v_1_1/{n}.txt" for n in ("cameras", "images")}
    assert names() == {*images, DAY_LIST, NIGHT_LIST, *model}
    model.add("3D-models/aachen_v_1_1/points3D.txt")
    assert names(reference_model=True) == {*images, DAY_LIST, NIGHT_LIST, *model}
    old = {*images, DAY_LIST, NIGHT_LIST, MODEL, LIST}
    assert names(version="1.0") == old
    assert names(version="1.0", reference_model=True) == {*old, "aachen.db"}
    write_sensors(
        root11 / "ground_truth/query", KaptureData(sensors={"s": Sensor.from_camera(QUERY_CAMERA)})
    )
    assert "ground_truth/query/sensors/sensors.txt" in names()


# --------------------------------------------------------------------------------- the real sample


@pytest.fixture
def sample(shared_data: Path) -> Path:
    folder = shared_data / "kapture_samples" / "Aachen-Day-Night"
    if not folder.is_dir():
        pytest.skip(f"no sample at {folder}")
    return folder


def assert_same_kapture(ours: str, theirs: str) -> None:
    """The same images with the same cameras and poses; names of sensors are each's own."""
    found, expected = kapture_from_dir(ours), kapture_from_dir(theirs)
    cameras = [
        {name: data.sensors[sensor].camera_params for _, sensor, name in flat(data)}
        for data in (found, expected)
    ]
    assert cameras[0] == cameras[1]
    assert len(cameras[0]) > 2
    if expected.trajectories is None:
        assert found.trajectories is None
        return
    poses = [
        {name: data.trajectories[time, sensor] for time, sensor, name in flat(data)}
        for data in (found, expected)
    ]
    for name, pose in poses[1].items():
        mine = poses[0][name]
        np.testing.assert_allclose(mine.t.ravel(), pose.t.ravel(), rtol=0, atol=1e-9)
        turn = rotation(mine) * rotation(pose).inv()
        assert np.degrees(turn.magnitude()) < 1e-9


def flat(data: object) -> list[tuple[int, str, str]]:
    from kapture import flatten

    return list(flatten(data.records_camera, is_sorted=True))  # type: ignore[attr-defined]


def rotation(pose: object) -> Rotation:
    w, x, y, z = pose.r_raw  # type: ignore[attr-defined]
    return Rotation.from_quat([x, y, z, w])


def test_the_sample_lacks_two_files(sample: Path, tmp_path: Path) -> None:
    adapter = Aachen()
    adapter.check(sample)
    dataset = adapter.read(sample)
    assert dataset.missing is not None
    assert [str(file.relative_to(sample)) for file in dataset.missing.files] == [
        "3D-models/database_intrinsics.txt",
        "queries/night_time_queries_with_intrinsics.txt",
    ]
    with pytest.raises(DataError, match="2 files are missing: 3D-models/database_intrinsics.txt, "):
        write_official(dataset, tmp_path)


def test_the_sample_is_what_kapture_makes_of_it(sample: Path, tmp_path: Path) -> None:
    out = written(sample, tmp_path / "out", allow_missing=True)
    assert_same_kapture(str(out / "mapping"), str(sample / "kapture/training"))
    assert_same_kapture(str(out / "query"), str(sample / "kapture/query"))
    kapture_tool(
        "kapture_import_nvm",
        *("-i", sample / MODEL, "-im", sample / "images_upright"),
        *("-o", tmp_path / "theirs", "--image_transfer", "skip"),
    )
    assert_same_kapture(str(out / "mapping"), str(tmp_path / "theirs"))


def test_the_samples_distortion_has_colmaps_sign(sample: Path) -> None:
    data = read(sample).mapping
    assert data.camera_of("db/1045.jpg").params == (1084.59, 800.0, 533.5, -0.0810989)
    # t = -R C of the file's centre (738.038, -6.17486, -41.8371)
    pose = data.poses()["db/1045.jpg"]
    np.testing.assert_allclose(pose.center(), [738.038, -6.17486, -41.8371], atol=1e-9)
    np.testing.assert_allclose(pose.translation, [652.8336, 84.7060, 336.3358], atol=1e-3)
