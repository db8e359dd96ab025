"""A map of the rendered scene, its queries, and the service before it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from serving import Photo, client_of
from starlette.testclient import TestClient

import megloc_kapture as megloc
from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.presets import options_of_preset

CHANGES = {"local_features.options.max_keypoints": 400}
OPTIONS = options_of_preset(assignments=CHANGES)


@pytest.fixture(scope="session")
def served_map(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    workspace = tmp_path_factory.mktemp("served") / "workspace"
    return megloc.build_map(
        scene / "mapping", set=CHANGES, workspace=workspace
    ).kapture_map.folder.root


@pytest.fixture(scope="session")
def localizer(served_map: Path) -> Localizer:
    """The localizer whose poses the answers must have."""
    return Localizer(KaptureMap.open(served_map), options=OPTIONS)


@pytest.fixture(scope="session")
def photos(scene: Path) -> list[Photo]:
    folder = KaptureFolder(scene / "query")
    data = folder.read()
    return [Photo(folder.image_path(name), data.camera_of(name)) for name in data.image_names()]


@pytest.fixture
def client(localizer: Localizer) -> Iterator[TestClient]:
    with client_of(localizer, threads=2) as result:
        yield result
