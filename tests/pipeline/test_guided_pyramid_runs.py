"""Guided pyramid matching in whole runs: queries that lie on their side are localized."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture import Camera, KaptureMap, Localizer
from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.metrics import pose_errors
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.io.kapture import KaptureFolder, Sensor, write_sensors
from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.plan import StageReport, run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import RigidTransform

pytestmark = pytest.mark.slow

TURNED_FROM_UPRIGHT = RigidTransform.from_matrix(
    np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)
)


@pytest.fixture(scope="module")
def options(shared_data: Path) -> PipelineOptions:
    """XFeat, which knows no other orientation than upright, on small images."""
    weights = shared_data / "weights" / "xfeat" / "xfeat.onnx"
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


def run(scene: Path, workspace: Path, options: PipelineOptions) -> list[StageReport]:
    place = Workspace(workspace)
    with place.lock():
        return run_plan(
            plan_evaluation(Run(choose_dataset("kapture", scene), "classic", options, place)), place
        )


def pyramid(options: PipelineOptions, **changes: object) -> PipelineOptions:
    return options.model_copy(
        update={"guided_pyramid": options.guided_pyramid.model_copy(update=changes)}
    )


def recall(workspace: Path) -> float:
    """At 25 cm and 2 degrees."""
    found = json.loads((workspace / "evaluation" / "recall.json").read_text())
    return float(found["rows"][-1]["recall"][1]["recall"])


def test_turned_queries_are_found_with_it_and_easy_pairs_are_not_tried(
    turned: Path, options: PipelineOptions, tmp_path: Path
) -> None:
    workspace = tmp_path / "workspace"
    run(turned, workspace, options)
    assert recall(workspace) == 0
    reports = {
        report.name: report for report in run(turned, workspace, pyramid(options, mode="all"))
    }
    assert recall(workspace) == 1
    counts = reports["query_pyramid"].counts
    assert counts["xfeat pairs_tried"] == counts["xfeat pairs"] == 28
    assert counts["xfeat matches_after"] > 4 * counts["xfeat matches_before"]
    # of the upright map images only those that see little of each other are tried again
    mapping = reports["mapping_pyramid"].counts
    assert mapping["xfeat pairs_tried"] < 0.5 * mapping["xfeat pairs"]
    report = (workspace / "evaluation" / "report.html").read_text()
    assert "matches" in report

    # from Python, in the map that it made
    opened = KaptureMap.open(workspace / "map")
    assert list(opened.keypoints) == ["xfeat-pyramid"]
    localizer = Localizer(opened, options=pyramid(options, mode="all"))
    found = dict(localizer.localize_kapture(workspace / "preprocessed" / "query"))
    truth = KaptureFolder(turned / "query_gt").read().poses()
    assert all(found.values()), found
    errors = pose_errors({name: pose.cam_from_world for name, pose in found.items()}, truth)
    assert max(errors.position_m) < 0.25


def test_upright_queries_are_left_alone(
    fountain: Path, options: PipelineOptions, tmp_path: Path
) -> None:
    few = pyramid(options, mode="max", min_matches=15)
    counts = {report.name: report.counts for report in run(fountain, tmp_path / "runs", few)}
    assert counts["query_pyramid"]["xfeat pairs_tried"] == 0
    assert counts["query_pyramid"]["xfeat images_extracted_again"] == 0


def test_it_needs_verified_matches(
    fountain: Path, options: PipelineOptions, tmp_path: Path
) -> None:
    unverified = pyramid(options, mode="all").model_copy(update={"verification": "none"})
    with pytest.raises(OptionError, match="guided pyramid matching counts verified matches"):
        run(fountain, tmp_path / "runs", unverified)
