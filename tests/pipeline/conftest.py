"""Scenes, and a map of the small scene that the tests share."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from megloc_kapture.pipeline.presets import options_of_preset
from tests.pipeline.runs import evaluated


@pytest.fixture(scope="session")
def workspace(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with our map of the scene and few keypoints; read only."""
    few = options_of_preset(assignments=["local_features.options.max_keypoints=800"])
    root = tmp_path_factory.mktemp("map") / "workspace"
    return evaluated(root, scene, few, last="map").root


@pytest.fixture
def map_copy(workspace: Path, tmp_path: Path) -> Path:
    """A copy of our map that a test may change; its images are links."""
    return Path(shutil.copytree(workspace / "map", tmp_path / "map", symlinks=True))
