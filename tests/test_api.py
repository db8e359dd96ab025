"""The package in a few calls, on a rendered scene whose poses are known."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from images import photograph
from PIL import Image, ImageOps

import megloc_kapture as megloc
from megloc_kapture.geometry.poses import movement
from megloc_kapture.io.images import read_image_rgb, read_photo
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.preprocessing.frames import scaled_camera

SMALL = {"local_features.options.max_keypoints": 800, "global_features.options.num_clusters": 8}


@pytest.fixture(scope="module")
def built(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> megloc.Map:
    workspace = tmp_path_factory.mktemp("api") / "workspace"
    return megloc.build_map(scene / "mapping", set=SMALL, workspace=workspace)


@pytest.fixture(scope="module")
def results(built: megloc.Map, scene: Path) -> megloc.Results:
    return built.localize(scene / "query")


def errors(scene: Path, name: str, pose: megloc.RigidTransform) -> tuple[float, float]:
    """Metres and degrees from the true pose."""
    return movement(KaptureFolder(scene / "query_gt").read().poses()[name], pose)


def reprojection_px(pose: megloc.Pose, camera: megloc.Camera) -> float:
    """The largest distance of an inlier from where its point is seen."""
    assert pose.inlier_points_px is not None and pose.inlier_points_world is not None
    in_camera = pose.inlier_points_world @ pose.matrix[:3, :3].T + pose.matrix[:3, 3]
    projected = in_camera[:, :2] / in_camera[:, 2:] * camera.params[:2] + camera.params[2:]
    return float(np.linalg.norm(projected - pose.inlier_points_px, axis=1).max())


def test_a_folder_is_localized_when_it_is_asked_for(
    results: megloc.Results, scene: Path, tmp_path: Path
) -> None:
    names = KaptureFolder(scene / "query").read().image_names()
    assert list(results) == names and len(results) == len(names)
    last = results[names[-1]]
    assert last and results[names[-1]] is last
    for name in names:
        result = results[name]
        assert result and np.less(errors(scene, name, result.cam_from_world), (0.05, 0.5)).all()
    with pytest.raises(KeyError):
        _ = results["nowhere.jpg"]
    table = results.to_pandas()
    assert list(table.index) == names and set(table["status"]) == {"localized"}
    assert table.loc[names[0], "tx"] == results[names[0]].cam_from_world.translation[0]  # type: ignore[union-attr]
    counts = results.save(tmp_path / "localized")
    assert counts == {"queries": 4, "localized": 4, "failed": 0, "fallbacks": 0}
    assert set(KaptureFolder(tmp_path / "localized").read().poses()) == set(names)
    with pytest.raises(megloc.OutputError, match="is not empty"):
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "file").touch()
        results.save(tmp_path / "mine")


def test_threads_share_results(built: megloc.Map, results: megloc.Results, scene: Path) -> None:
    fresh = built.localize(scene / "query")
    with ThreadPoolExecutor(4) as threads:
        assert dict(zip(fresh, threads.map(fresh.get, fresh), strict=True)) == dict(results)


def test_interrupted_results_go_on(
    built: megloc.Map, results: megloc.Results, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after Ctrl-C in a notebook."""
    again = built.localize(scene / "query")
    names, localize = list(again), Localizer._localize_unit

    def interrupt(localizer: Localizer, unit: Any) -> Any:
        if unit[0][0].name == names[2]:
            raise KeyboardInterrupt
        return localize(localizer, unit)

    monkeypatch.setattr(Localizer, "_localize_unit", interrupt)
    with pytest.raises(KeyboardInterrupt):
        dict(again)
    monkeypatch.undo()
    assert dict(again) == dict(results)


def test_a_table_without_poses_has_their_columns(built: megloc.Map, tmp_path: Path) -> None:
    Image.new("RGB", (64, 48)).save(tmp_path / "black.png")
    table = built.localize([tmp_path / "black.png"]).to_pandas()
    assert list(table["status"]) == ["failed"] and table[["qw", "tz"]].isna().all(axis=None)


def test_results_are_evaluated_as_they_are(
    results: megloc.Results, scene: Path, tmp_path: Path
) -> None:
    result = megloc.evaluate(results, truth=scene / "query_gt")
    assert "recall (%)" in str(result) and result.row().recall[0].recall == 1.0
    pairs = megloc.evaluate(results, truth=scene / "query_gt", thresholds=[(0.05, 5), (9, 9)])
    assert [str(each.threshold) for each in pairs.row().recall] == ["0.05 m, 5 deg", "9 m, 9 deg"]
    with pytest.raises(megloc.OptionError, match="'-1, 5' is not METRES,DEGREES or METRES"):
        megloc.evaluate(results, truth=scene / "query_gt", thresholds=[(-1, 5)])
    results.save(tmp_path / "saved")
    again = megloc.evaluate(tmp_path / "saved", truth=scene / "query_gt")
    assert list(again.to_pandas().index) == list(results)
    columns = ["position_error_m", "angle_error_deg"]
    difference = result.to_pandas()[columns] - again.to_pandas()[columns]
    assert np.abs(difference.to_numpy()).max() < 1e-9


@pytest.fixture
def photos(scene: Path, tmp_path: Path) -> Path:
    """Two queries as photographs of a phone that was held upright: their pixels lie on the side."""
    for path in sorted((scene / "query").rglob("*.jpg"))[:2]:
        photograph(path, tmp_path / "photos" / path.name, orientation=6, focal_35mm=26)
    return tmp_path / "photos"


def test_photographs_need_no_camera(built: megloc.Map, scene: Path, photos: Path) -> None:
    paths = sorted(photos.iterdir())
    one = built.localize(paths[0])
    with Image.open(paths[0]) as image:
        pillow = built.localize(image)
        array = built.localize(np.asarray(ImageOps.exif_transpose(image)))
    listed = built.localize(paths)
    whole = built.localize(photos)
    assert list(listed) == list(whole) == [path.name for path in paths]
    result = [one, pillow, array, *whole.values()]
    names = [paths[0].name] * 3 + list(whole)
    for name, pose in zip(names, result, strict=True):
        assert np.less(errors(scene, name, pose.cam_from_world), (0.05, 0.5)).all()
        assert isinstance(pose, megloc.Pose) and pose.camera is not None
        assert pose.camera.params[0] == pytest.approx(300, rel=0.015)
        assert (pose.camera.width, pose.camera.height) == (400, 298)
        assert any("focal length estimated" in remark for remark in pose.remarks)
    first = listed[paths[0].name]
    # several of one camera tell of it together
    assert first and np.array_equal(first.matrix, whole[paths[0].name].matrix)
    assert one and np.allclose(first.matrix, one.matrix, atol=0.05)
    # a given camera is of the pixels as they are stored: the same place, another way up
    lying = built.localize(paths[0], read_photo(paths[0]).camera)
    assert lying and lying.camera and (lying.camera.width, lying.camera.height) == (298, 400)
    assert errors(scene, paths[0].name, lying.cam_from_world)[0] < 0.05


def test_a_pose_says_what_it_rests_on(built: megloc.Map, scene: Path) -> None:
    folder = KaptureFolder(scene / "query")
    name = folder.read().image_names()[0]
    camera = folder.read().camera_of(name)
    result, read = (
        built.localize(image, camera)
        for image in (folder.image_path(name), read_image_rgb(folder.image_path(name)))
    )
    for pose in (result, read):
        assert pose and np.less(errors(scene, name, pose.cam_from_world), (0.05, 0.5)).all()
        assert pose.covariance is not None and pose.covariance.shape == (6, 6)
    assert result.camera is None and result.name == folder.image_path(name).name
    assert reprojection_px(result, camera) <= 12
    twice = scaled_camera(camera, 2 * camera.width, 2 * camera.height)
    for image in (folder.image_path(name), read_image_rgb(folder.image_path(name))):
        # the scaled camera differs by rounding
        scaled = built.localize(image, twice)
        np.testing.assert_allclose(scaled.matrix, result.matrix, atol=1e-6)
    assert len(result.inlier_points_px) == len(result.inlier_points_world) == result.num_inliers
    assert {"extraction", "retrieval", "matching", "estimation"} <= result.seconds.keys()
    # in pixels of the image as it was given, whatever was made of it
    options = {**SMALL, "preprocessing.max_size_px": 320}
    smaller = megloc.open_map(built.kapture_map.folder.root, set=options)
    other = smaller.localize(folder.image_path(name), camera)
    assert other and reprojection_px(other, camera) <= 15.1


def test_results_travel(built: megloc.Map, results: megloc.Results) -> None:
    copied = pickle.loads(pickle.dumps(results))
    assert list(copied) == list(results)
    for name, pose in results.items():
        assert pose and np.array_equal(copied[name].matrix, pose.matrix)
        assert copied[name].name == name and copied[name].evidence == pose.evidence
    poses = built.kapture_map.poses
    assert pickle.loads(pickle.dumps(poses)) == poses


def test_a_run_and_the_map_it_made(scene: Path, tmp_path: Path) -> None:
    run = megloc.run("kapture", scene, set=SMALL, workspace=tmp_path / "run")
    assert run.recall.loc["all", "0.25 m, 2 deg"] == 1.0
    assert run.pose_file.is_file() and run.report.is_file()
    assert set(KaptureFolder(run.localized).read().poses()) == set(
        run.map.localize(scene / "query")
    )
    assert run.map.options.local_features[0].options == {"max_keypoints": 800}


def test_features_matches_and_a_pose_by_arrays(built: megloc.Map, scene: Path) -> None:
    mapping, query = KaptureFolder(scene / "mapping"), KaptureFolder(scene / "query")
    name, other = query.read().image_names()[0], mapping.read().image_names()[0]
    first = megloc.extract("rootsift", query.image_path(name), max_keypoints=800)
    second = megloc.extract("rootsift", mapping.image_path(other), max_keypoints=800)
    matches, scores = megloc.match("nn", first, second)
    assert matches.shape == (len(scores), 2) and len(matches) > 50
    assert len(np.unique(matches[:, 0])) == len(matches)

    rng = np.random.default_rng(0)
    camera = megloc.Camera.pinhole(640, 480, 500)
    points = rng.uniform((-2, -2, 4), (2, 2, 8), (60, 3))
    points_px = 500 * points[:, :2] / points[:, 2:] + (320, 240)
    result = megloc.solve_pose(points_px, points, camera)
    assert result and np.allclose(result.cam_from_world.translation, 0, atol=1e-6)
    failed = megloc.solve_pose(rng.uniform(0, 480, (60, 2)), points, camera)
    assert not failed and failed.reason


def test_a_video_has_a_result_per_frame(built: megloc.Map, tmp_path: Path) -> None:
    (tmp_path / "broken.MP4").touch()
    (failure,) = built.localize(tmp_path / "broken.MP4").values()
    assert "not a video" in failure.reason


def test_refused(built: megloc.Map, scene: Path, tmp_path: Path) -> None:
    with pytest.raises(megloc.OptionError, match="prior is for one image"):
        built.localize(scene / "query", prior=["0000.jpg"])
    with pytest.raises(megloc.OptionError, match="--scale takes gps, or two photographs and"):
        megloc.map_photographs(scene / "query", scale=2.0)  # type: ignore[arg-type]
    with pytest.raises(megloc.OptionError, match="has its own cameras"):
        camera: Any = megloc.Camera.pinhole(64, 48, 50)
        built.localize(KaptureFolder(scene / "query"), camera)
    with pytest.raises(megloc.DataError, match="features: no such features folder"):
        megloc.open_map(built.kapture_map.folder.root, features_dirs="features")
    with pytest.raises(megloc.OptionError, match=r"give map=m\.kapture_map for a Map m"):
        megloc.export("ply", tmp_path / "map.ply", map=built)  # type: ignore[arg-type]
    with pytest.raises(megloc.OptionError, match=r"KaptureMap\.open"):
        megloc.Localizer(str(built.kapture_map.folder.root))  # type: ignore[arg-type]
    with pytest.raises(megloc.OptionError, match="needs a reference model"):
        by = {"mapping_pairs.by": ["covisibility"]}
        megloc.build_map(scene / "mapping", set=by, workspace=tmp_path / "refused")
    assert not (tmp_path / "refused").exists()


@pytest.mark.parametrize(
    "image",
    [None, b"", 3, iter([]), np.zeros((8, 8), np.uint8), np.zeros((8, 8, 3)), np.zeros((3, 8, 8))],
)
def test_other_things_than_images_are_refused(built: megloc.Map, image: Any) -> None:
    """Such as the None that cv2.imread returns for a missing file."""
    message = r"an image must be a file, uint8 \(H, W, 3\) RGB or a pillow image, got "
    with pytest.raises(megloc.DataError, match=message):
        built.localize(image)
    with pytest.raises(megloc.DataError, match=message):
        built.localizer().localize(image, megloc.Camera.pinhole(8, 8, 8))
    with pytest.raises(megloc.DataError, match=message):
        megloc.extract("rootsift", image)


@pytest.mark.parametrize(
    "camera",
    [np.eye(3), {"model": "PINHOLE"}, "PINHOLE", 500.0, megloc.Camera.pinhole(640, 480, 0.85)],
)
def test_other_descriptions_of_a_camera_are_refused(
    built: megloc.Map, scene: Path, camera: Any
) -> None:
    path = next((scene / "query" / "sensors" / "records_data").iterdir())
    image = read_image_rgb(path)
    points = np.ones((20, 3))
    for refused in (
        lambda: built.localize(image, camera),
        lambda: built.localize([path], camera),
        lambda: built.localizer().localize(image, camera),
        lambda: megloc.solve_pose(points[:, :2], points, camera),
    ):
        with pytest.raises(
            megloc.DataError, match=r"a camera must be a megloc_kapture.Camera|0\.85 .* give pixels"
        ):
            refused()


def test_arrays_and_limits_of_a_pose_are_checked() -> None:
    camera = megloc.Camera.pinhole(640, 480, 500)
    px, points = np.ones((20, 2)), np.ones((20, 3))
    for wrong in ((points, px), (px.T, points.T), (px[:9], points), (None, None)):
        with pytest.raises(megloc.DataError, match=r"points_px \(N, 2\) and points_world \(N, 3\)"):
            megloc.solve_pose(*wrong, camera)  # type: ignore[arg-type]
    with pytest.raises(megloc.OptionError, match="max_error_px: it should be greater than 0"):
        megloc.solve_pose(px, points, camera, max_error_px=0)
    none: list[Any] = []
    assert "0 2D-3D matches" in megloc.solve_pose(none, none, camera).reason  # type: ignore[arg-type]
