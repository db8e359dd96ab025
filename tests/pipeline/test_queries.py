"""Queries that bring a type's features serve maps of its guided pyramid, and the reverse."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.queries import KaptureQueries
from megloc_kapture.pipeline.results import Results
from megloc_kapture.pipeline.workspace import Workspace
from tests.pipeline.runs import evaluated

FEW = "local_features.rootsift.options.max_keypoints=300"
PYRAMID = ("guided_pyramid.mode=all", "guided_pyramid.scales=[0.5,1.0]")
TYPES = ("rootsift", "rootsift-pyramid")


@pytest.fixture(scope="module")
def workspaces(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Workspace]:
    """A run without and one with guided pyramids, by the type that their maps are of."""
    root = tmp_path_factory.mktemp("pyramids")
    plain, guided = (options_of_preset(assignments=[FEW, *more]) for more in ((), PYRAMID))
    return {
        "rootsift": evaluated(root / "rootsift", scene, plain, last="map"),
        "rootsift-pyramid": evaluated(root / "pyramid", scene, guided, last="localization"),
    }


@pytest.mark.parametrize("of_map", TYPES)
@pytest.mark.parametrize("brought", TYPES)
def test_either_type_serves_the_other(
    workspaces: dict[str, Workspace], tmp_path: Path, of_map: str, brought: str
) -> None:
    place = workspaces["rootsift-pyramid"]
    query = tmp_path / "query"
    shutil.copytree(place.path("query") / "sensors", query / "sensors", symlinks=True)
    (query / "sensors" / "records_data").unlink()  # nothing can be extracted
    features = place.root if brought == "rootsift" else place.path("pyramid/query")
    folder = KaptureFolder(query, features_dirs=[features])
    opened = KaptureMap.open(workspaces[of_map].path("map"))
    assert list(opened.keypoints) == [of_map]
    queries = KaptureQueries(folder, opened)
    assert queries.lacking(of_map) is None
    assert queries.lacking("superpoint") == queries.names[0]
    queries.check()
    assert all(list(one.features) == [brought] for one in queries)
    results = Results(Localizer(opened, options=options_of_preset(assignments=[FEW])), folder)
    assert all(results.values())


def test_of_both_the_fitting_type_is_read_and_an_image_without_either_is_named(
    workspaces: dict[str, Workspace], tmp_path: Path
) -> None:
    place = workspaces["rootsift-pyramid"]
    both = place.folder("query", "", "pyramid/query")
    for of_map, expected in (("rootsift", TYPES[:1]), ("rootsift-pyramid", TYPES)):
        opened = KaptureMap.open(workspaces[of_map].path("map"))
        assert tuple(opened.stored_types()) == expected
        assert all(tuple(one.features) == expected for one in KaptureQueries(both, opened))
    features = Path(shutil.copytree(place.path("pyramid/query"), tmp_path / "features"))
    name = both.read().image_names()[2]
    for suffix in ("kpt", "desc"):
        (found,) = features.rglob(f"{name}.{suffix}")
        found.unlink()
    queries = KaptureQueries(KaptureFolder(place.path("query"), features_dirs=[features]), opened)
    assert queries.lacking("rootsift") == name
