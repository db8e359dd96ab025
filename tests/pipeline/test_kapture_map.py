"""Maps of any tool: which type, whose pixel origin, what is missing."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.geometry.cameras import project, shift_principal_point
from megloc_kapture.io.kapture import FeatureWriter, KaptureFolder, Sensor, write_sensors
from megloc_kapture.localization.map_index import TypedMatches
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.query_folders import KaptureQueries
from megloc_kapture.pipeline.results import Results
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.stages.matches import Features, match_all, verification_of, verified
from megloc_kapture.values import Pose
from tests.pipeline.runs import errors


def shift_keypoints(root: Path, shift_px: float) -> None:
    """Store the keypoints of a map shifted."""
    reader = KaptureFolder(root).keypoints("rootsift")
    arrays = {image: reader.read(image) for image in reader.names}
    with FeatureWriter(root, "keypoints", "rootsift", reader.config) as writer:
        for image, array in arrays.items():
            writer.write(image, array + np.float32(shift_px))


def shift_intrinsics(root: Path, shift_px: float) -> None:
    """Store the principal points of a map shifted."""
    data = KaptureFolder(root).read()
    moved = {
        name: Sensor.from_camera(shift_principal_point(sensor.camera(), shift_px))
        for name, sensor in data.sensors.items()
    }
    write_sensors(root, replace(data, sensors=moved))


def test_our_own_map_is_as_colmap_has_it(workspace: Path) -> None:
    opened = KaptureMap.open(workspace / "map")
    assert list(opened.keypoints) == ["rootsift"]
    assert (opened.pixel_origin.intrinsics, opened.pixel_origin.keypoints) == ("corner", "corner")
    assert opened.pixel_origin.error_px["corner"] < opened.pixel_origin.error_px["centre"]
    assert len(opened.images) == 7
    keypoints = opened.keypoints["rootsift"]
    assert keypoints.has_descriptors(opened.images) and opened.has_images()
    assert keypoints.extractor() == PluginChoice(name="rootsift")
    assert opened.global_types() == ["vlad_rootsift"]


@pytest.mark.parametrize("intrinsics", ["corner", "centre"])
def test_a_half_pixel_between_keypoints_and_intrinsics_is_found_and_undone(
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
        own, expected = (one.camera(image).params for one in (opened, original))
        np.testing.assert_allclose(own, expected, atol=1e-9)


def residuals_px(opened: KaptureMap, queries: KaptureFolder, truth: Path) -> list[float]:
    """Of each query, the median distance of its matches from where its true pose puts them."""
    poses, options, found = KaptureFolder(truth).read().poses(), options_of_preset(), []
    (local_type,) = opened.keypoints
    stored, verify = opened.keypoints[local_type], verification_of(options.query_verification)
    matcher = options.make_matcher(local_type)
    for query in KaptureQueries(queries, opened):
        features = query.features[local_type]
        keypoints = features.keypoints_px[:, :2]
        ours = Features.of(query.camera, keypoints, features.descriptors)
        matches = []
        for image in opened.images:
            described = stored.keypoints_px(image), stored.descriptors(image)
            theirs = Features.of(opened.camera(image), *described)
            of_pair = match_all(matcher, ours, [theirs], ["theirs"])[0]
            matches.append((image, *verified(ours, theirs, of_pair, verify)[:2]))
        pairs = TypedMatches(stored.index, keypoints, matches).correspondences()
        seen = project(query.camera, poses[query.name], stored.index.xyz[pairs.point_ids])
        distances = np.linalg.norm(seen - keypoints[pairs.keypoint_ids], axis=1)
        found.append(float(np.median(distances)))
    return found


@pytest.mark.slow
def test_the_origin_of_the_foreign_map_and_what_the_wrong_one_costs(virtual_gallery: Path) -> None:
    """Its principal points are ((w - 1) / 2, (h - 1) / 2), its keypoints fit them as stored."""
    right = KaptureMap.open(virtual_gallery / "map")
    origin = right.pixel_origin
    assert (origin.intrinsics, origin.keypoints) == ("centre", "centre")
    assert origin.error_px["centre"] < 0.9 * origin.error_px["corner"]
    wrong = KaptureMap.open(virtual_gallery / "map", pixel_origin="corner")
    assert (wrong.pixel_origin.intrinsics, wrong.pixel_origin.reason) == ("corner", "as requested")
    # the map's points, seen from where the queries truly are; no pose can hide the half pixel
    queries, truth = KaptureFolder(virtual_gallery / "query"), virtual_gallery / "query_gt"
    off_px = np.array([residuals_px(opened, queries, truth) for opened in (right, wrong)])
    assert off_px.shape == (2, 4)
    assert (off_px[0] < off_px[1]).all(), off_px


def test_queries_are_described_as_their_map(workspace: Path, map_copy: Path, scene: Path) -> None:
    # a map, and queries, that are all described with the origin at the centre
    shift_intrinsics(map_copy, -0.5)
    query = map_copy.parent / "query"
    shutil.copytree(scene / "query", query, symlinks=True)
    shift_intrinsics(query, -0.5)
    queries, truth = KaptureFolder(query, features_dirs=[workspace]), scene / "query_gt"
    right = KaptureMap.open(map_copy)
    wrong = KaptureMap.open(map_copy, pixel_origin="corner")
    off_px = np.array([residuals_px(opened, queries, truth) for opened in (right, wrong)])
    # half of one query's few matches are wrong ones
    assert np.median(off_px[0]) < 0.6 * np.median(off_px[1]), off_px
    # and the poses are those of the map before
    before = Localizer(KaptureMap.open(workspace / "map"))
    original = KaptureFolder(scene / "query", features_dirs=[workspace])
    expected = Results(before, original)
    for name, pose in Results(Localizer(right), queries).items():
        reference = expected[name]
        assert isinstance(reference, Pose)
        assert errors(pose, reference.cam_from_world)[0] < 1e-3


@pytest.mark.slow
def test_opening_writes_nothing_and_reads_through_links(
    virtual_gallery: Path, tmp_path: Path
) -> None:
    (tmp_path / "link").symlink_to(virtual_gallery / "map")
    before = {p: p.stat().st_mtime_ns for p in virtual_gallery.rglob("*")}
    opened = KaptureMap.open(tmp_path / "link")
    opened.check()
    assert len(opened.images) == 12
    assert {p: p.stat().st_mtime_ns for p in virtual_gallery.rglob("*")} == before


def add_type(root: Path, name: str) -> None:
    """Give the map the same points and keypoints under another type as well."""
    for kind in ("keypoints", "descriptors"):
        folder = root / "reconstruction" / kind
        shutil.copytree(folder / "rootsift", folder / name)
    observations = root / "reconstruction" / "observations.txt"
    rows = observations.read_text().splitlines(keepends=True)
    rows += [row.replace(" rootsift,", f" {name},") for row in rows if row[0] != "#"]
    observations.write_text("".join(rows))


def test_all_types_with_points_are_localized_with_unless_some_are_chosen(map_copy: Path) -> None:
    add_type(map_copy, "other")
    both = KaptureMap.open(map_copy)
    assert list(both.keypoints) == ["other", "rootsift"]
    opened = KaptureMap.open(map_copy, keypoints_types=["other"])
    assert list(opened.keypoints) == ["other"]
    # the name inside its configuration tells who extracted it
    assert opened.keypoints["other"].extractor() == PluginChoice(name="rootsift")
    with pytest.raises(OptionError, match="'third'; there are: other, rootsift"):
        KaptureMap.open(map_copy, keypoints_types=["third"])


def test_what_cannot_be_opened(workspace: Path, map_copy: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="give auto, corner or centre"):
        KaptureMap.open(map_copy, pixel_origin="middle")  # type: ignore[arg-type]
    with pytest.raises(DataError, match="no such kapture folder"):
        KaptureMap.open(tmp_path / "nowhere")
    with pytest.raises(DataError, match="no map to localize in: .*megloc triangulate"):
        KaptureMap.open(workspace / "mapping")
    observations = map_copy / "reconstruction" / "observations.txt"
    header = [row for row in observations.read_text().splitlines() if row.startswith("#")]
    observations.write_text("\n".join(header) + "\n")
    with pytest.raises(DataError, match="the map's points have no observations"):
        KaptureMap.open(map_copy)


def test_features_may_lie_elsewhere_and_their_sizes_are_checked_without_reading(
    workspace: Path, map_copy: Path
) -> None:
    opened = KaptureMap.open(map_copy)
    file = map_copy / "reconstruction/descriptors/rootsift/0003.jpg.desc"
    file.write_bytes(file.read_bytes()[:-512])
    with pytest.raises(DataError, match=r"0003\.jpg\.desc: 799 descriptors for 800 keypoints"):
        opened.check()
    shutil.rmtree(map_copy / "reconstruction" / "descriptors")
    bare = KaptureMap.open(map_copy)
    assert not bare.keypoints["rootsift"].has_descriptors(bare.images)
    opened = KaptureMap.open(map_copy, features_dirs=[workspace])
    assert opened.keypoints["rootsift"].has_descriptors(opened.images)
    opened.check()
