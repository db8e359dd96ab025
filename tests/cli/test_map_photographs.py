"""``megloc map``: what it says, what is said of a map without metres, what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.cli.main import main
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.service.server import map_overview

FEW = ("--set", "local_features.options.max_keypoints=700", "--executor", "inline")


@pytest.fixture(scope="module")
def unposed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``photos/``, and ``map``, the workspace made of them."""
    root: Path = tmp_path_factory.mktemp("unposed")
    (root / "photos").mkdir()
    for image in (scene / "mapping" / "sensors" / "records_data").iterdir():
        shutil.copyfile(image, root / "photos" / image.name)
    with pytest.raises(SystemExit) as end:
        main(["map", str(root / "photos"), "-o", str(root / "map"), *FEW])
    assert end.value.code == 0
    return root


def test_what_is_done_is_kept(megloc: Any, unposed: Path) -> None:
    done = megloc("map", unposed / "photos", "-o", unposed / "map", *FEW)
    assert done.status == 0
    assert done.out.splitlines() == [
        f"map of 7 of 7 photographs: {unposed / 'map' / 'map'}",
        "the map has no metres, but units of its own; --scale IMAGE IMAGE METRES tells it",
    ]
    assert done.err.count("up to date") == 9


def test_every_command_says_units(megloc: Any, unposed: Path, scene: Path, tmp_path: Path) -> None:
    workspace, localized = unposed / "map", tmp_path / "localized"
    assert "unit              none: units of its own" in megloc("info", workspace).out
    query = scene / "query" / "sensors" / "records_data"
    done = megloc("localize", "-i", workspace, "--images", query, "-o", localized)
    assert done.status == 0 and "4 of 4 queries" in done.out
    assert "positions are in units of the map" in done.err
    done = megloc("evaluate", "-i", localized, "-o", tmp_path / "report")
    assert "the map is in units of its own" in done.out and " m\n" not in done.out
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "The map is in units of its own" in page and "of the first candidate" not in page
    truth = ("--gt", scene / "query_gt")
    megloc("evaluate", "-i", localized, *truth).refused("thresholds are in metres")
    shutil.copytree(localized, tmp_path / "copy", symlinks=True)
    both = ("-i", localized, "-i", tmp_path / "copy")
    megloc("evaluate", *both).refused("thresholds are in metres")
    assert json.loads(map_overview(KaptureMap.open(workspace / "map")))["unit"] == "units"


def test_a_model_of_unknown_scale(megloc: Any, colmap_room: Path, tmp_path: Path) -> None:
    for unit, told in (("units", "none: units of its own"), ("m", "metres")):
        folder = tmp_path / unit
        assert megloc("import", "colmap", colmap_room, "-o", folder, "--unit", unit).status == 0
        assert f"unit              {told}" in megloc("info", folder).out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--scale", "0000.jpg", "0002.jpg"), "takes gps, or two photographs and the metres"),
        (("--scale", "0000.jpg", "0002.jpg", "far"), "'far' is no distance in metres"),
        (("--set", "localization.rigs=true"), "localization"),
        (("--camera", "PINHOLE,1"), "not such a list"),
        (("--every", "3"), "there is no video"),
        (("--preset", "modrn"), "unknown preset"),
    ],
)
def test_what_cannot_be_is_refused(
    megloc: Any, unposed: Path, tmp_path: Path, arguments: tuple[str, ...], told: str
) -> None:
    megloc("map", unposed / "photos", "-o", tmp_path / "map", *arguments).refused(told)
    assert not (tmp_path / "map").exists()


def test_a_known_camera_stays(megloc: Any, unposed: Path, tmp_path: Path) -> None:
    camera = "PINHOLE,400,300,300,302,200,150"
    done = megloc("map", unposed / "photos", "-o", tmp_path / "map", "--camera", camera, *FEW)
    assert done.status == 0, done.err
    found = KaptureMap.open(tmp_path / "map" / "map").camera("0000.jpg")
    assert (found.model, found.params) == ("PINHOLE", (300.0, 302.0, 200.0, 150.0))
