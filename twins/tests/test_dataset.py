"""All rendered datasets: their bytes, their options, and that their import is their truth."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import kapture
import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir
from megloc_twins.options import SyntheticDataset
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.official import write_official
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import DATASETS
from megloc_kapture.stages.work import Work

LAYOUTS = ("aachen", "robotcar", "4seasons", "inloc")
COUNTS = {
    "synthetic": {"places": 2, "mapping images": 24, "query images": 4},
    "aachen": {"places": 2, "mapping images": 48, "query images": 8},
    "robotcar": {"places": 2, "mapping images": 16, "query images": 36},
    "4seasons": {"places": 2, "mapping images": 24, "query images": 20},
    "inloc": {"floors": 2, "scans": 6, "mapping images": 216, "query images": 5},
}
Rendered = Callable[[str], Path]


@pytest.mark.parametrize(
    "name", ["synthetic", *(pytest.param(name, marks=pytest.mark.slow) for name in LAYOUTS)]
)
def test_processes_write_the_same_bytes(
    name: str, small: dict[str, SyntheticDataset[Any]], rendered: Rendered, tmp_path: Path
) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        assert small[name].write(tmp_path, Work(executor)) == COUNTS[name]
    found = hashes(tmp_path)
    assert len(found) > 25 and found == hashes(rendered(name))


def hashes(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_import_is_the_truth(name: str, rendered: Rendered, tmp_path: Path) -> None:
    """Poses, cameras and sizes, in the official coordinates, as kapture reads them."""
    root = rendered(name)
    dataset = load_plugin(DATASETS, name).read(root)
    assert dataset.missing is not None and dataset.missing.files == []
    write_official(dataset, tmp_path)
    assert not KaptureFolder(tmp_path / "query").read().trajectories
    for part, truth_part in (("mapping", "mapping"), ("query_gt", "query")):
        found, cameras = read(tmp_path / part)
        truth, true_cameras = read(root / "ground_truth" / truth_part)
        assert found.keys() == truth.keys()
        assert len(found) == COUNTS[name][f"{part.removesuffix('_gt')} images"]
        for image, pose in found.items():
            assert np.linalg.norm(pose.center()) < 5000
            official = dataset.world.pose_in_official(pose)
            assert np.linalg.norm(official.center() - truth[image].center()) < 1e-6
            turn = rotation(official) * rotation(truth[image]).inv()
            assert np.degrees(turn.magnitude()) < 1e-6
            model, width, height, *params = cameras[image]
            true = true_cameras[image]
            assert (model, width, height) == tuple(true[:3])
            # InLoc computes its focal length from an angle
            assert [*map(float, params)] == pytest.approx([*map(float, true[3:])], rel=1e-12)
            path = KaptureFolder(tmp_path / part.removesuffix("_gt")).image_path(image)
            assert image_size(path) == (int(width), int(height))


def read(folder: Path) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """Poses by ours and camera parameters by kapture's reader, by image."""
    theirs = kapture_from_dir(str(folder))
    cameras = {
        image: theirs.sensors[sensor].sensor_params
        for _, sensor, image in kapture.flatten(theirs.records_camera)
    }
    return KaptureFolder(folder).read().poses(), cameras


def rotation(pose: Any) -> Rotation:
    return Rotation.from_quat(pose.quat_wxyz, scalar_first=True)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("synthetic", {"num_places": 0}),
        ("synthetic", {"supersampling": 9}),
        ("synthetic", {"image_format": "gif"}),
        ("synthetic", {"colour": "red"}),
        ("aachen", {"version": "2.0"}),
        ("aachen", {"day_queries": 0}),
        ("robotcar", {"size_px": 8}),
        ("4seasons", {"map_keyframes": 1}),
        ("inloc", {"modules": 21}),
    ],
)
def test_wrong_options_are_refused(
    name: str, wrong: dict[str, Any], small: dict[str, SyntheticDataset[Any]]
) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        small[name].Options(**wrong)
