"""Maps of several keypoints types, one of them without any point: written, read, localized in."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir

from megloc_kapture import KaptureMap, Localizer, Pose
from megloc_kapture.cli.main import main
from megloc_kapture.io.kapture import (
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
)
from megloc_kapture.io.tables import read_status
from megloc_kapture.pipeline.plan import Workspace
from megloc_kapture.pipeline.presets import options_of_preset
from tests.pipeline.runs import evaluated, run_in

pytestmark = pytest.mark.slow

SETS = ('local_features=["rootsift","sift"]', "local_features.rootsift.options.max_keypoints=400")


def enlarged(root: Path, count: int) -> None:
    """Give a map more points, far from everything, that its second type observes in some images.

    The ids of the second type's points lie behind those of the first: many blocks without a row.
    """
    folder = KaptureFolder(root)
    points, observations = folder.points3d(), folder.observations()
    images = sorted(folder.read().poses())[::2]
    lengths = {image: folder.keypoints("sift").length(image) for image in images}
    image_ids = np.arange(count) % len(images)
    extra = Observations(
        "sift",
        tuple(images),
        len(points) + np.arange(count, dtype=np.int64),
        image_ids.astype(np.int32),
        np.array([k % lengths[images[i]] for k, i in enumerate(image_ids)], np.int32),
    )
    far = np.zeros((count, 6))
    far[:, :3] = 1e5 + np.arange(count)[:, None]
    write_points3d(root, np.concatenate([points, far]))
    write_observations(root, {**observations, "sift": extra})


@pytest.fixture(scope="module")
def workspace(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A finished run with two types."""
    root = tmp_path_factory.mktemp("two_types") / "workspace"
    return evaluated(root, scene, options_of_preset(assignments=SETS))


def test_200_000_points_of_two_types(workspace: Workspace, tmp_path: Path) -> None:
    root, out = tmp_path / "map", tmp_path / "localized"
    shutil.copytree(workspace.path("map"), root, symlinks=True)
    (root / "reconstruction" / "point_covariances.npy").unlink()
    enlarged(root, 200_000)
    theirs = kapture_from_dir(str(root))
    assert len(theirs.points3d) > 200_000 and len(theirs.observations) > 200_000
    localizer = Localizer(KaptureMap.open(root), options=options_of_preset(assignments=SETS))
    assert [local.name for local in localizer.types] == ["rootsift", "sift"]
    found = dict(localizer.localize_kapture(workspace.path("query")))
    assert all(found.values())
    # its second type's points are nowhere near their keypoints: only who insists may go on
    places = ["-i", str(root), "--query", str(workspace.path("query")), "-o", str(out)]
    with pytest.raises(SystemExit) as end:
        main(["localize", *places, "-f", *(flag for one in SETS for flag in ("--set", one))])
    assert end.value.code == 0
    written = KaptureFolder(out).read()
    for name, pose in found.items():
        assert isinstance(pose, Pose) and written.cam_from_world(name) == pose.cam_from_world


def test_a_type_without_any_point(scene: Path, workspace: Workspace, tmp_path: Path) -> None:
    """As ``megloc eval`` leaves one that nothing could be triangulated of."""
    copy = Workspace(tmp_path / "workspace")
    shutil.copytree(workspace.root, copy.root, symlinks=True, dirs_exist_ok=True)
    options = options_of_preset(assignments=[*SETS, "reranking.by=coverage", "reranking.keep=4"])
    for name in ("map_unrefined", "map"):
        seen = copy.folder(name).observations()
        write_observations(copy.path(name), {"rootsift": seen["rootsift"]})
    run_in(copy, scene, options, first="query_candidates")
    in_run = copy.folder("localized").read()
    statuses = read_status(copy.path("localized/status.csv"))
    opened = KaptureMap.open(copy.path("map"))
    assert list(opened.keypoints) == ["rootsift"]
    localizer = Localizer(opened, options=options)
    # its matches have a say in which candidates stay, as in eval
    assert [local.name for local in localizer.types] == ["rootsift", "sift"]
    for name, found in localizer.localize_kapture(copy.path("query")):
        assert isinstance(found, Pose)
        assert found.cam_from_world == in_run.cam_from_world(name)
        assert found.num_matches == statuses[name].num_matches
