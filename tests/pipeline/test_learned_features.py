"""A preset with learned features, in a run and from Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.results import Results
from megloc_kapture.stages.options import PipelineOptions
from tests.pipeline.runs import errors, evaluated

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def real_weights(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))


def modern(*assignments: str) -> PipelineOptions:
    """Return the preset with small images and few keypoints."""
    small = ("preprocessing.max_size_px=640", "global_features.options.num_clusters=16")
    few = "local_features.aliked.options.max_keypoints=600"
    return options_of_preset("modern", assignments=[*assignments, few, *small])


def test_modern_maps_smaller_images_and_localizes_whole_ones(
    fountain: Path, tmp_path: Path
) -> None:
    options = modern()
    workspace = evaluated(tmp_path / "workspace", fountain, options)
    # localized queries have their original size
    for folder, width in (("map", 640), ("localized", 1536)):
        data = workspace.folder(folder).read()
        assert {data.camera_of(image).width for image in data.image_names()} == {width}
    opened = KaptureMap.open(workspace.path("map"))
    assert opened.pixel_origin.intrinsics == "corner"
    truth = KaptureFolder(fountain / "query_gt").read().poses()
    found = Results(Localizer(opened, options=options), fountain / "query")
    assert np.median([errors(pose, truth[name])[0] for name, pose in found.items()]) < 0.02
    with pytest.raises(OptionError, match=r"Query\(mask=...\)"):
        Localizer(opened, options=modern("preprocessing.masks.unchanging=true"))
