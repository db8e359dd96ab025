"""Maps of any tool: their types, extractors, pixel origin, and localization in them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture import Failure, KaptureMap, Localizer, Pose, Query
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.geometry.cameras import shift_principal_point
from megloc_kapture.io.images import read_depth_map, write_image
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    KaptureFolder,
    Sensor,
    write_sensors,
)
from megloc_kapture.pipeline.kapture_map import MapKeypoints
from megloc_kapture.pipeline.live_source import extract_again
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.results import Results
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import LocalFeatures
from tests.pipeline.runs import errors


def shift_keypoints(root: Path, shift_px: float) -> None:
    reader = KaptureFolder(root).keypoints("rootsift")
    arrays = {image: reader.read(image) for image in reader.names}
    writer = FeatureWriter(root, "keypoints", "rootsift", reader.config)
    for image, array in arrays.items():
        writer.write(image, array + np.float32(shift_px))


def shift_intrinsics(root: Path, shift_px: float) -> None:
    data = KaptureFolder(root).read()
    moved = {
        name: Sensor.from_camera(shift_principal_point(sensor.camera(), shift_px))
        for name, sensor in data.sensors.items()
    }
    write_sensors(root, replace(data, sensors=moved))


@pytest.mark.parametrize("intrinsics", ["corner", "centre"])
def test_a_half_pixel_between_keypoints_and_intrinsics_is_corrected(
    workspace: Path, map_copy: Path, intrinsics: str
) -> None:
    (shift_intrinsics if intrinsics == "centre" else shift_keypoints)(map_copy, -0.5)
    original, opened = KaptureMap.open(workspace / "map"), KaptureMap.open(map_copy)
    found = opened.pixel_origin
    assert {found.intrinsics, found.keypoints} == {"corner", "centre"}
    assert found.intrinsics == intrinsics
    assert found.error_px[intrinsics] == min(found.error_px.values())
    before, after = (one.keypoints["rootsift"] for one in (original, opened))
    for image in original.images:
        np.testing.assert_allclose(after.keypoints_px(image), before.keypoints_px(image), atol=1e-3)
        expected = original.camera(image).params
        np.testing.assert_allclose(opened.camera(image).params, expected, atol=1e-9)


def test_queries_have_the_origin_of_their_map(workspace: Path, map_copy: Path, scene: Path) -> None:
    query = Path(shutil.copytree(scene / "query", map_copy.parent / "query", symlinks=True))
    for root in (map_copy, query):
        shift_intrinsics(root, -0.5)
    original = Results(
        Localizer(KaptureMap.open(workspace / "map")),
        KaptureFolder(scene / "query", features_dirs=[workspace]),
    )
    queries = KaptureFolder(query, features_dirs=[workspace])
    moved_m = {
        origin: [
            errors(pose, original[name].cam_from_world)[0]  # type: ignore[union-attr]
            for name, pose in Results(Localizer(opened), queries).items()
        ]
        for origin, opened in (
            ("auto", KaptureMap.open(map_copy)),
            ("corner", KaptureMap.open(map_copy, pixel_origin="corner")),
        )
    }
    assert max(moved_m["auto"]) < 1e-3 < min(moved_m["corner"])


def add_type(root: Path, name: str) -> None:
    for kind in ("keypoints", "descriptors"):
        folder = root / "reconstruction" / kind
        shutil.copytree(folder / "rootsift", folder / name)
    observations = root / "reconstruction" / "observations.txt"
    rows = observations.read_text().splitlines(keepends=True)
    rows += [row.replace(" rootsift,", f" {name},") for row in rows if row[0] != "#"]
    observations.write_text("".join(rows))


def test_all_types_are_used_unless_some_are_chosen(map_copy: Path) -> None:
    add_type(map_copy, "other")
    both = KaptureMap.open(map_copy)
    assert list(both.keypoints) == ["other", "rootsift"]
    opened = KaptureMap.open(map_copy, keypoints_types="other")
    assert list(opened.keypoints) == ["other"]
    # the configuration has the name of the extractor
    assert opened.keypoints["other"].extractor() == PluginChoice(name="rootsift")
    with pytest.raises(OptionError, match="'third'; there are: other, rootsift"):
        KaptureMap.open(map_copy, keypoints_types=["third"])


def test_unusable_maps_are_refused(workspace: Path, map_copy: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="give auto, corner or centre"):
        KaptureMap.open(map_copy, pixel_origin="middle")  # type: ignore[arg-type]
    with pytest.raises(DataError, match="no such kapture folder"):
        KaptureMap.open(tmp_path / "nowhere")
    with pytest.raises(DataError, match="not a kapture folder; it has .*mapping.*: give"):
        KaptureMap.open(workspace)
    (tmp_path / "nerfstudio/colmap/sparse/0").mkdir(parents=True)
    (tmp_path / "nerfstudio/colmap/sparse/0/points3D.bin").touch()
    with pytest.raises(DataError, match="/colmap/sparse/0 has a COLMAP model"):
        KaptureMap.open(tmp_path / "nerfstudio")
    with pytest.raises(DataError, match="points3d.txt: this is a file; give a kapture folder"):
        KaptureMap.open(map_copy / "reconstruction" / "points3d.txt")
    with pytest.raises(DataError, match="no map to localize in: .*megloc triangulate"):
        KaptureMap.open(workspace / "mapping")
    poses = map_copy / "sensors" / "trajectories.txt"
    poses.rename(poses.with_suffix(".old"))
    with pytest.raises(DataError, match="no image of the map has a pose: .*trajectories.txt"):
        KaptureMap.open(map_copy)
    poses.with_suffix(".old").rename(poses)
    observations = map_copy / "reconstruction" / "observations.txt"
    header = [row for row in observations.read_text().splitlines() if row.startswith("#")]
    observations.write_text("\n".join(header) + "\n")
    with pytest.raises(DataError, match="the map's points have no observations"):
        KaptureMap.open(map_copy)


def test_features_of_other_folders_are_used(workspace: Path, map_copy: Path) -> None:
    shutil.rmtree(map_copy / "reconstruction" / "descriptors")
    bare = KaptureMap.open(map_copy)
    assert bare.keypoints["rootsift"].without_descriptors(bare.images) == bare.images
    opened = KaptureMap.open(map_copy, features_dirs=[workspace])
    assert not opened.keypoints["rootsift"].without_descriptors(opened.images)
    opened.check()


@pytest.fixture
def stripped(map_copy: Path) -> KaptureMap:
    """Our map, of 800 keypoints an image, without its descriptors."""
    shutil.rmtree(map_copy / "reconstruction" / "descriptors")
    return KaptureMap.open(map_copy)


def again(opened: KaptureMap, **options: float) -> dict[str, np.ndarray]:
    extractor = RootSift(RootSiftOptions(**options))  # type: ignore[arg-type]
    return extract_again(opened, opened.keypoints["rootsift"], extractor)


def test_descriptors_are_extracted_again(workspace: Path, stripped: KaptureMap) -> None:
    original = KaptureMap.open(workspace / "map")
    found = again(stripped, max_keypoints=400)
    assert sorted(found) == original.images
    for image, descriptors in found.items():
        known = descriptors.any(axis=1)
        assert 300 < known.sum() <= 400
        stored = original.keypoints["rootsift"].descriptors(image)
        np.testing.assert_array_equal(descriptors[known], stored[known])


def test_a_map_of_another_extractor_or_without_images_is_refused(stripped: KaptureMap) -> None:
    with pytest.raises(DataError, match=r"finds only \d+ of \d+ observed keypoints"):
        again(stripped, contrast_threshold=0.2)
    (stripped.folder.root / "sensors" / "records_data").unlink()
    with pytest.raises(DataError, match="no descriptors of type 'rootsift', and no images"):
        again(KaptureMap.open(stripped.folder.root))


@pytest.mark.parametrize(
    ("name", "config", "dtype", "expected"),
    [
        ("SIFT", "SIFT", "uint8", "sift"),
        ("sift", "sift", "float32", "rootsift"),
        ("sift_8192", "x", "uint8", "sift"),
        ("SuperPoint-v1", "x", "float32", "superpoint superpoint_v1"),
        ("r2d2_500", "x", "float32", "r2d2"),
        ("R2D2-WASF-N16", "x", "float32", "r2d2 r2d2_WASF_N16"),
        ("mine", "Aliked", "float32", "aliked"),
        ("D2-Net", "d2net", "float32", None),
    ],
)
def test_extractors_are_recognised_by_names_of_other_tools(
    name: str, config: str, dtype: str, expected: str | None, tmp_path: Path
) -> None:
    of_keypoints = FeatureConfig(config, np.dtype(np.float32), 2)
    of_descriptors = FeatureConfig(config, np.dtype(dtype), 128, name, "L2")
    FeatureWriter(tmp_path, "keypoints", name, of_keypoints)
    FeatureWriter(tmp_path, "descriptors", name, of_descriptors)
    unused: Any = None
    keypoints = MapKeypoints(KaptureFolder(tmp_path), name, index=unused, pixel_origin=unused)
    found = keypoints.extractor()
    assert expected == (found and " ".join([found.name, *map(str, found.options.values())]))


def few(*assignments: str) -> PipelineOptions:
    keypoints = "local_features.options.max_keypoints=800"
    return options_of_preset(assignments=[keypoints, *assignments])


@pytest.fixture(scope="module")
def opened(workspace: Path) -> KaptureMap:
    return KaptureMap.open(workspace / "map")


@pytest.fixture(scope="module")
def localizer(opened: KaptureMap) -> Localizer:
    return Localizer(opened, options=few())


@pytest.fixture(scope="module")
def truth(scene: Path) -> KaptureData:
    return KaptureFolder(scene / "query_gt").read()


@pytest.fixture(scope="module")
def image(scene: Path) -> Path:
    return scene / "query" / "sensors" / "records_data" / "0004.jpg"


@pytest.fixture(scope="module")
def queries(workspace: Path, scene: Path) -> list[Query]:
    folder = KaptureFolder(scene / "query", features_dirs=[workspace])
    data = folder.read()
    keypoints, descriptors = folder.keypoints("rootsift"), folder.descriptors("rootsift")
    scores = np.zeros(800, np.float32)
    return [
        Query(
            camera=data.camera_of(name),
            name=name,
            features={
                "rootsift": LocalFeatures(keypoints.read(name), scores, descriptors.read(name))
            },
        )
        for name in data.image_names()
    ]


def test_an_image_of_another_shape_than_its_camera_is_an_error(
    localizer: Localizer, truth: KaptureData
) -> None:
    message = r"uint8 image \(300, 400, 3\), got uint8 \(10, 10, 3\)"
    with pytest.raises(DataError, match=message):
        localizer.localize(np.zeros((10, 10, 3), np.uint8), truth.camera_of("0004.jpg"))


def test_masked_pixels_have_no_features(
    localizer: Localizer, image: Path, truth: KaptureData
) -> None:
    query = Query(truth.camera_of("0004.jpg"), image)
    mask = np.zeros((300, 400), bool)
    assert not localizer.localize_query(replace(query, mask=mask))
    mask[:, 180:] = True
    half = localizer.localize_query(replace(query, mask=mask))
    whole = localizer.localize_query(query)
    assert isinstance(half, Pose) and isinstance(whole, Pose)
    assert half.num_matches != whole.num_matches
    assert replace(query, mask=str(image.with_name("no_mask.png"))).read_mask() is None
    with pytest.raises(DataError, match="the mask must be bool"):
        localizer.localize_query(replace(query, mask=mask[:10]))


def test_a_prior_restricts_the_candidates(
    localizer: Localizer, image: Path, truth: KaptureData
) -> None:
    camera = truth.camera_of("0004.jpg")
    found = localizer.localize(image, camera, prior=["0003.jpg", "0005.jpg", "0003.jpg"])
    assert set(found.candidates) == {"0003.jpg", "0005.jpg"}
    assert errors(found, truth.cam_from_world("0004.jpg"))[0] < 0.05
    assert localizer.localize(image, camera, prior="0003.jpg").candidates == ("0003.jpg",)
    query = Query(camera, image, prior="0003.jpg")
    assert query.prior == ("0003.jpg",) == replace(query, prior=[Path("0003.jpg")]).prior  # type: ignore[list-item]
    assert localizer.localize(image, camera, prior=[]) == Failure("no map image is a candidate")
    with pytest.raises(DataError, match=r"0004\.jpg has the candidate 0001\.jpg, which is not"):
        localizer.localize(image, camera, prior=["0003.jpg", "0001.jpg"])


def test_candidates_are_ranked_by_retrieval(opened: KaptureMap, queries: list[Query]) -> None:
    narrow = Localizer(opened, options=few("query_pairs.top_k=2"))
    # neighbours along the walk, by VLAD of the local features
    neighbours = {"0007.jpg": {"0006.jpg", "0009.jpg"}, "0010.jpg": {"0008.jpg", "0009.jpg"}}
    for query in queries:
        found = narrow.localize_query(query)
        ranked = narrow.ranked(query)
        assert len(ranked) == 2 and set(found.candidates) <= set(ranked)
        assert set(ranked) == neighbours.get(query.name, set(ranked))
        # within a prior, the best of those
        kept = replace(query, prior=("0000.jpg", "0002.jpg", "0009.jpg"))
        assert set(narrow.ranked(kept)) < set(kept.prior or ())


def test_many_queries_are_localized_lazily_and_in_order(
    localizer: Localizer, queries: list[Query], truth: KaptureData
) -> None:
    read: list[str] = []

    def given() -> Iterator[Query]:
        for query in queries:
            read.append(query.name)
            yield query

    results = localizer.localize_many(given())
    assert read == []
    first = next(results)
    assert read == [queries[0].name]
    for query, found in zip(queries, [first, *results], strict=True):
        assert errors(found, truth.cam_from_world(query.name))[0] < 0.02
    assert read == [query.name for query in queries]


@pytest.mark.parametrize("kind", [str, Path])
def test_an_unreadable_image_among_many_fails_alone(
    localizer: Localizer, queries: list[Query], tmp_path: Path, kind: type
) -> None:
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"no image")
    camera = queries[0].camera
    results = list(localizer.localize_many([(kind(broken), camera), queries[0]]))
    assert isinstance(results[0], Failure) and str(broken) in results[0].reason
    assert isinstance(results[1], Pose)


def test_a_map_survives_a_change_of_the_working_folder(
    workspace: Path, queries: list[Query], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(workspace)
    localizer = Localizer(KaptureMap.open("map"))
    monkeypatch.chdir(tmp_path)
    assert localizer.localize_query(queries[0])


def test_features_of_unequal_lengths_are_refused(queries: list[Query]) -> None:
    """Their keypoints would have the descriptors of others."""
    local = queries[0].features["rootsift"]
    with pytest.raises(DataError, match=r"keypoints \(799, 2\) and descriptors \(800, 128\)"):
        shorter = replace(local, keypoints_px=local.keypoints_px[1:])
        replace(queries[0], features={"rootsift": shorter})


@pytest.mark.parametrize("kind", ["mask", "depth"])
def test_a_query_with_a_broken_mask_or_depth_fails_alone(
    workspace: Path, image: Path, truth: KaptureData, tmp_path: Path, kind: str
) -> None:
    write_image(tmp_path / "mask.png", np.zeros((10, 10), np.uint8))
    (tmp_path / "depth").write_bytes(b"short")
    read = partial(read_depth_map, tmp_path / "depth", width=300, height=200)
    broken: Any = {"mask": tmp_path / "mask.png", "depth": read}[kind]
    options = options_of_preset(assignments=["pose_refinement.by=icp"])
    localizer = Localizer(KaptureMap.open(workspace / "map"), options=options)
    query = Query(truth.camera_of("0004.jpg"), image, "0004.jpg")
    failure, pose = localizer.localize_many([replace(query, **{kind: broken}), query])
    assert isinstance(failure, Failure) and str(tmp_path / kind) in failure.reason
    assert isinstance(pose, Pose)


def test_an_image_that_the_extractor_rejects_fails_alone(
    localizer: Localizer, image: Path, truth: KaptureData, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reject(*_: object) -> None:
        raise DataError("too small")

    monkeypatch.setattr(RootSift, "extract", reject)
    (failure,) = localizer.localize_many([(image, truth.camera_of("0004.jpg"))])
    assert isinstance(failure, Failure) and failure.reason.endswith("too small")
