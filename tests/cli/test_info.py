"""``megloc info``: what a map is, and what it allows."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.io.kapture import KaptureFolder, write_sensors


def described(out: str) -> dict[str, str]:
    """First column to the rest, of the lines that have one."""
    return dict(re.findall(r"^(\w[\w ]*?)  +(.*)$", out, re.MULTILINE))


@pytest.mark.parametrize(
    ("given", "images", "origin"),
    [
        ("foreign_map", 7, "corner"),
        pytest.param("virtual_gallery", 12, "centre", marks=pytest.mark.slow),
    ],
)
def test_info_says_what_the_foreign_map_allows(
    megloc: Any, request: pytest.FixtureRequest, given: str, images: int, origin: str
) -> None:
    place = request.getfixturevalue(given) / "map"
    done = megloc("info", place)
    assert (done.status, done.err) == (0, "")
    told = described(done.out)
    assert told["images"] == f"{images} ({images} PINHOLE), {images} with a pose"
    assert told["points"] == str(len(KaptureFolder(place).points3d()))
    assert told["pixel origin"].startswith(f"{origin}: ")
    assert told["map descriptors"] == "there"
    # R2D2 has an extractor, whose weights are not there
    assert told["query features"].startswith("must be given in kapture; plugin r2d2 could extract")
    assert "megloc weights fetch r2d2_WASF_N16" in told["query features"]
    # so few that all are matched; vectors without the weights that make a query's
    every = f"all {images} map images"
    assert told["retrieval"] == f"{every}, not ranked"
    ranked = f"if queries have AP-GeM-LM18: {every}, ranked by global features AP-GeM-LM18"
    assert ranked in done.out
    errors = re.search(r"origin: corner ([\d.]+) px, centre ([\d.]+) px", done.out)
    assert errors is not None
    of_other, of_origin = sorted(map(float, errors.groups()), reverse=True)
    assert of_origin < 0.9 * of_other and float(errors[1 + (origin == "centre")]) == of_origin


def test_info_of_our_own_map_and_of_what_is_none(megloc: Any, finished: Path, scene: Path) -> None:
    told = described(megloc("info", finished / "map", "--deep").out)
    assert told["checked"] == "everything, image by image"
    assert told["pixel origin"].startswith("corner: ")
    assert told["query features"].startswith("extracted by plugin rootsift")
    assert told["map descriptors"] == "there"
    told = described(megloc("info", scene / "query").out)
    assert told["images"] == "4 (4 PINHOLE), 0 with a pose"
    assert told["localizing"] == "not possible: no points3d and observations"


def test_cameras_that_are_not_calibrated(megloc: Any, scene: Path, tmp_path: Path) -> None:
    data = KaptureFolder(scene / "query").read()
    for name, sensor in data.sensors.items():
        data.sensors[name] = replace(sensor, params=("UNKNOWN_CAMERA", *sensor.params[1:3]))
    write_sensors(tmp_path, data)
    assert re.search(r"images +4 \(4 UNKNOWN_CAMERA\)", megloc("info", tmp_path).out)
