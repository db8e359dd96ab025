"""The adapter that lets kapture-localization's tools run on current packages."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pycolmap
import pytest
from kloc import needs_kapture_localization
from kloc_tools import run_tool, shims, tool_scripts

from megloc_kapture.errors import OptionError


@pytest.mark.parametrize("error", [False, True])
def test_shims_add_names_and_take_them_away(error: bool) -> None:
    assert not hasattr(np, "float")
    with suppress(RuntimeError), shims(pycolmap):
        assert np.float is float
        assert callable(pycolmap.absolute_pose_estimation)
        if error:
            raise RuntimeError
    assert not hasattr(np, "float")
    assert not hasattr(pycolmap, "absolute_pose_estimation")


def test_absolute_pose_estimation_as_kapture_localization_calls_it() -> None:
    rng = np.random.default_rng(0)
    camera = pycolmap.Camera(
        model="PINHOLE", width=640, height=480, params=[500.0, 500.0, 320.0, 240.0]
    )
    points = rng.uniform([-1, -1, 4], [1, 1, 6], (60, 3))
    pixels = camera.img_from_cam(points + [0.1, -0.2, 0.3])
    pixels[:10] += 100.0
    with shims(pycolmap):
        # lists of arrays and a plain dictionary, as its tools pass them
        result = pycolmap.absolute_pose_estimation(
            list(pixels), list(points), camera, estimation_options={"ransac": {"max_error": 8.0}}
        )
        none = pycolmap.absolute_pose_estimation([], [], camera)
    assert result["num_inliers"] == 50
    assert result["inliers"] == [False] * 10 + [True] * 50
    np.testing.assert_allclose(result["cam_from_world"].translation, [0.1, -0.2, 0.3], atol=1e-6)
    assert none is None


@needs_kapture_localization
def test_tools_are_found_where_pip_put_them() -> None:
    scripts = tool_scripts()
    assert scripts["kapture_compute_matches"].is_file()
    assert scripts["kapture_pycolmap_localize"].suffix == ".py"
    with pytest.raises(OptionError, match="no tool 'kapture_nothing'.*kapture_compute_matches"):
        run_tool("kapture_nothing", [], pycolmap)
