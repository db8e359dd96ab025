"""``megloc view --rerun``: recordings as Rerun's own reader and tools find them."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import read_status

needs_rerun = pytest.mark.skipif(find_spec("rerun") is None, reason="rerun-sdk is not installed")


def contents(path: Path) -> dict[str, dict[str, Any]]:
    """Of each entity the values of its columns, as numpy arrays."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, Any]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        assert chunk.is_static
        batch = chunk.to_record_batch()
        for name in batch.schema.names[1:]:
            values = batch.column(name)[0].values.to_numpy(zero_copy_only=False)
            found.setdefault(chunk.entity_path, {})[name.partition(":")[2]] = values
    return found


@needs_rerun
def test_a_recording_has_the_map_and_the_queries(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    out, page = tmp_path / "new/view.rrd", tmp_path / "view.html"
    asked = ("view", finished / "map", finished / "localized", "--gt", finished / "query_gt")
    done = megloc(*asked, "-o", page, "--rerun", out)
    assert done.status == 0 and f"recording: {out}\n" in done.out and page.is_file()
    for command in ("verify", "stats"):
        subprocess.run([sys.executable, "-m", "rerun", "rrd", command, out], check=True)
    found = contents(out)
    told = bytes(found["/origin"]["text"][0], "ascii").split()[-3:]
    origin = np.array([float(value) for value in told])
    points = np.stack(found["/map/points"]["positions"])
    own = KaptureFolder(finished / "map").points3d()[:, :3]
    np.testing.assert_allclose(points + origin, own, atol=1e-4)
    poses = KaptureFolder(finished / "mapping").read().poses()
    for name, pose in poses.items():
        camera = next(v for key, v in found.items() if key.startswith("/map/cam") and name in key)
        np.testing.assert_allclose(camera["translation"][0] + origin, pose.center(), atol=1e-4)
        # rerun's matrices go by columns: of world_from_cam these are rows of cam_from_world
        turned = camera["mat3x3"][0].reshape(3, 3)
        np.testing.assert_allclose(turned, pose.rotation_matrix(), atol=1e-6)
        assert camera["image_from_camera"][0].reshape(3, 3)[0, 0] > 0
        assert cv2.imdecode(camera["blob"][0].astype(np.uint8), 1) is not None
    localized = KaptureFolder(finished / "localized").read().poses()
    statuses = read_status(finished / "localized/status.csv")
    for name in statuses:
        parts = {
            key.rpartition("/")[2]: v
            for key, v in found.items()
            if key.startswith("/quer") and name in key
        }
        assert {"truth", "estimate"} <= parts.keys()
        center = parts["estimate"]["translation"][0] + origin
        np.testing.assert_allclose(center, localized[name].center(), atol=1e-4)
        strips = np.stack([np.stack(strip) for strip in parts["inliers"]["strips"]])
        np.testing.assert_allclose(
            strips[:, 0] + origin, np.tile(center, (len(strips), 1)), atol=1e-4
        )
    # again: a recording may be overwritten, another file may not
    assert megloc(*asked, "-o", page, "--rerun", out).status == 0
    megloc(*asked, "-o", tmp_path / "b.html", "--rerun", page).refused("is no view; -f overwrites")


def test_without_rerun_the_extra_is_named(
    megloc: Any, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    out = tmp_path / "view.html"
    done = megloc("view", finished / "map", "-o", out, "--rerun", tmp_path / "v.rrd")
    done.refused("rerun is not installed", "megloc-kapture.rerun.")
    assert not out.exists() and not (tmp_path / "v.rrd").exists()
