"""The tools of kapture and kapture-localization, run by the command line."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import kapture
import kloc_tools
import pytest
from kapture.algo.pose_operations import world_pose_transform_distance
from kapture.io.csv import kapture_from_dir

needs_kapture_localization = pytest.mark.skipif(
    importlib.util.find_spec("kapture_localization") is None,
    reason="kapture-localization is not installed (make test installs it)",
)


def kloc(tool: str, *arguments: str | Path) -> str:
    """Run a tool of kapture-localization through the adapter; return its output."""
    return _run([sys.executable, kloc_tools.__file__, tool, *map(str, arguments)])


def kapture_tool(tool: str, *arguments: str | Path) -> str:
    return _run([str(Path(sys.executable).with_name(tool)), *map(str, arguments)])


def megloc(*arguments: str | Path) -> str:
    return _run([str(Path(sys.executable).with_name("megloc")), *map(str, arguments)])


def _run(command: Sequence[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def proxy(place: Path, sensors_of: Path, linked: dict[str, Path]) -> Path:
    place.mkdir(parents=True)
    (place / "sensors").symlink_to(sensors_of.resolve() / "sensors")
    for name, target in linked.items():
        link = place / "reconstruction" / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(target.resolve())
    return place


def merged(place: Path, mapping: Path, query: Path, *, skip: Sequence[str]) -> Path:
    images = ["--image_transfer", "link_absolute", "--keep-sensor-ids"]
    kapture_tool("kapture_merge", "-i", mapping, query, "-o", place, *images, "-s", *skip)
    return place


def pose_errors(result: Path, truth: Path) -> dict[str, tuple[float, float]]:
    """Return the errors (metres, degrees) of each localized image, read and compared by kapture."""
    actual, expected = _poses(result), _poses(truth)
    return {
        name: world_pose_transform_distance(actual[name], expected[name])
        for name in sorted(actual.keys() & expected.keys())
    }


def _poses(folder: Path) -> dict[str, kapture.PoseTransform]:
    data = kapture_from_dir(str(folder))
    images = kapture.flatten(data.records_camera)
    return {
        image: data.trajectories[timestamp, sensor]
        for timestamp, sensor, image in images
        if (timestamp, sensor) in data.trajectories
    }
