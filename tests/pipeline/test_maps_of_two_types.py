"""Maps of several keypoints types, one of them without any point: written, read, localized in."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from megloc_kapture import KaptureMap, Localizer, Pose
from megloc_kapture.io.kapture import (
    write_observations,
)
from megloc_kapture.io.tables import read_status
from megloc_kapture.pipeline.plan import Workspace
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.results import Results
from tests.pipeline.runs import evaluated, run_in

pytestmark = pytest.mark.slow

SETS = ('local_features=["rootsift","sift"]', "local_features.rootsift.options.max_keypoints=400")


@pytest.fixture(scope="module")
def workspace(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A finished run with two types."""
    root = tmp_path_factory.mktemp("two_types") / "workspace"
    return evaluated(root, scene, options_of_preset(assignments=SETS))


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
    for name, found in Results(localizer, copy.path("query")).items():
        assert isinstance(found, Pose)
        assert found.cam_from_world == in_run.cam_from_world(name)
        assert found.num_matches == statuses[name].num_matches
