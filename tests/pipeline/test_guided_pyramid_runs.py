"""Guided pyramid matching in whole runs: queries that lie on their side are localized."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture import Camera, KaptureMap, Localizer
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.io.kapture import KaptureFolder, Sensor, write_sensors
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.results import Results
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import RigidTransform
from tests.pipeline.runs import errors, evaluated, recall, run_in

pytestmark = pytest.mark.slow

TURNED_FROM_UPRIGHT = RigidTransform.from_matrix(
    np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)
)


@pytest.fixture(scope="module")
def options(shared_data: Path) -> PipelineOptions:
    """XFeat, which knows no other orientation than upright, on small images."""
    weights = shared_data / "weights" / "xfeat" / "xfeat.pt"
    return options_of_preset(
        assignments=[
            "local_features=xfeat",
            f"local_features.xfeat.options.weights={weights}",
            "local_features.xfeat.options.max_keypoints=800",
            "preprocessing.max_size_px=640",
            "global_features.options.num_clusters=16",
        ],
        changes=[{"guided_pyramid": {"scales": [1.0]}}],
    )


@pytest.fixture(scope="module")
def turned(fountain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with its queries turned by 90 degrees, counter-clockwise."""
    scene = tmp_path_factory.mktemp("turned") / "scene"
    shutil.copytree(fountain, scene, copy_function=shutil.copyfile)
    for part in ("query", "query_gt"):
        folder = KaptureFolder(fountain / part)
        data = folder.read()
        sensors = {
            name: Sensor.from_camera(turned_camera(sensor.camera()), name=sensor.name)
            for name, sensor in data.sensors.items()
        }
        poses = {key: TURNED_FROM_UPRIGHT @ pose for key, pose in data.trajectories.items()}
        write_sensors(scene / part, replace(data, sensors=sensors, trajectories=poses))
        for image in data.image_names() if part == "query" else ():
            upright = read_image_rgb(folder.image_path(image))
            write_image(KaptureFolder(scene / part).image_path(image), np.rot90(upright).copy())
    return scene


def turned_camera(camera: Camera) -> Camera:
    fx, fy, cx, cy = camera.params
    return Camera("PINHOLE", camera.height, camera.width, (fy, fx, cy, camera.width - cx))


def pyramid(options: PipelineOptions, **changes: object) -> PipelineOptions:
    return options.model_copy(
        update={"guided_pyramid": options.guided_pyramid.model_copy(update=changes)}
    )


def test_turned_queries_are_found_with_it_and_easy_pairs_are_not_tried(
    turned: Path, options: PipelineOptions, tmp_path: Path
) -> None:
    workspace = evaluated(tmp_path / "workspace", turned, options)
    assert recall(workspace)[1] == 0
    with_pyramid = pyramid(options, mode="all")
    reports = run_in(workspace, turned, with_pyramid)
    assert recall(workspace)[1] == 1
    counts = reports["query_pyramid"].counts
    assert counts["xfeat pairs_tried"] == counts["xfeat pairs"] == 28
    assert counts["xfeat matches_after"] > 4 * counts["xfeat matches_before"]
    # of the upright map images only those that see little of each other are tried again
    mapping = reports["mapping_pyramid"].counts
    assert mapping["xfeat pairs_tried"] < 0.5 * mapping["xfeat pairs"]
    assert "matches" in workspace.path("evaluation/report.html").read_text()

    # from Python, in the map that it made
    opened = KaptureMap.open(workspace.path("map"))
    assert list(opened.keypoints) == ["xfeat-pyramid"]
    localizer = Localizer(opened, options=with_pyramid)
    truth = KaptureFolder(turned / "query_gt").read().poses()
    for name, pose in Results(localizer, workspace.path("preprocessed/query")).items():
        assert errors(pose, truth[name])[0] < 0.25
